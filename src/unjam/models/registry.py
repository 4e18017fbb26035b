"""The world models by kind of road."""

from typing import Any

from unjam.errors import InputError
from unjam.models.row_world_model import RowWorldModel
from unjam.models.settings import ModelSettings
from unjam.models.whole_road_models import ClosedRoadModel, MotorwayModel
from unjam.models.world_model import WorldModel
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.support import statistically_unsupported_reason

ROAD_MODELS: dict[str, type[WorldModel[Any, Any]]] = {"closed": ClosedRoadModel, "motorway": MotorwayModel}
"""world models of whole roads by `Scenario.road_model`"""


def world_model_class(scenario: Scenario, settings: ModelSettings) -> type[WorldModel[Any, Any]]:
    """Return the world model for a scenario with these settings; raise `InputError` if there is none."""
    if settings.kind == "row":
        return RowWorldModel
    if scenario.road_model not in ROAD_MODELS:
        reason = statistically_unsupported_reason(scenario) or f"{scenario.title}, which has no road model"
        raise InputError(f"model.kind: road is not allowed; allowed: row, for {reason}")
    return ROAD_MODELS[scenario.road_model]
