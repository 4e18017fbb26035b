"""The world models by kind of road."""

from typing import Any

from unjam.models.row_world_model import RowWorldModel
from unjam.models.settings import ModelSettings
from unjam.models.whole_road_models import ClosedRoadModel, MotorwayModel, WholeRoadModel
from unjam.models.world_model import WorldModel
from unjam.scenarios.scenario import Scenario

ROAD_MODELS: dict[str, type[WorldModel[Any, Any]]] = {"closed": ClosedRoadModel, "motorway": MotorwayModel}
"""world models of whole roads by `Scenario.road_model`; none of them supports other roads"""


def world_model_class(scenario: Scenario, settings: ModelSettings) -> type[WorldModel[Any, Any]]:
    """Return the world model for a scenario with these settings; its `check` says whether it supports them."""
    return RowWorldModel if settings.kind == "row" else ROAD_MODELS.get(scenario.road_model, WholeRoadModel)
