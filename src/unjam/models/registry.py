"""The world models of all kinds of roads, and the world model of rows, the paper's virtual environment."""

from collections.abc import Iterator
from typing import Any

from unjam.models.ensemble import ModelFit, Seed, torch_generator
from unjam.models.rollouts import ModelDynamics, RolloutBatch, prepare_starts, roll_out
from unjam.models.row_model import RowModel, fit_row_model
from unjam.models.settings import ModelSettings
from unjam.models.whole_road_models import ClosedRoadModel, MotorwayModel, WholeRoadModel
from unjam.models.world_model import RolloutPlan, Rollouts, WorldModel
from unjam.scenarios.scenario import Scenario


class RowWorldModel(WorldModel[RowModel, None]):
    """The world model of rows: a CAV, its leader and its follower, which continue from a recorded state."""

    def new_ensemble(self) -> RowModel:
        """Return an unfitted ensemble."""
        return RowModel(self.settings, len(self.scenario.drawn_ranges), self.seed, self.settings.device)

    def fit(self, seed: Seed) -> ModelFit:
        """Fit the ensemble to all transitions in D_a."""
        transitions = self.data.transitions(self.settings.holdout)
        return fit_row_model(self.ensemble, transitions, self.settings, self.scenario, self.task.reward, seed)

    def simulate(self, plan: RolloutPlan) -> RolloutBatch:
        """Return the rollouts of a plan with `StartIndices` as starts."""
        device = self.settings.device
        noise, exploration = (torch_generator(seed, device) for seed in (plan.noise_seed, plan.exploration_seed))
        dynamics = ModelDynamics(self.ensemble, self.scenario, self.task.reward, noise, self.settings.add_noise)
        starts = prepare_starts(self.data, plan.starts, self.task.expert, device)
        return roll_out(plan.driver, dynamics, starts, plan.control_steps, exploration)

    def roll_out(self, plan: RolloutPlan) -> Iterator[Rollouts]:
        """Yield all rollouts in one batch."""
        rows = self.simulate(plan)
        returns, crashed = rows.rewards.sum(1).double().cpu().numpy(), rows.terminated.tolist()
        yield Rollouts(rows.control_steps, returns, crashed, rows, facts={"clipped_share": rows.clipped_share})


ROAD_MODELS: dict[str, type[WorldModel[Any, Any]]] = {"closed": ClosedRoadModel, "motorway": MotorwayModel}
"""world models of whole roads by `Scenario.road_model`"""


def world_model_class(scenario: Scenario, settings: ModelSettings) -> type[WorldModel[Any, Any]]:
    """Return the class of the world model for a scenario and settings; its `check` refuses those without support."""
    return RowWorldModel if settings.kind == "row" else ROAD_MODELS.get(scenario.road_model, WholeRoadModel)
