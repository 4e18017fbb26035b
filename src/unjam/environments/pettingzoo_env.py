"""A scenario with several CAVs as a PettingZoo environment."""

from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, overload

import numpy as np

from unjam.drivers.observation import FeatureLike
from unjam.drivers.user_driver import DriverLike
from unjam.environments.gymnasium_env import ResetOptions, RoadStepper, as_action, synchronized
from unjam.environments.slots import RoadAgents, SlottedRoadEnv
from unjam.errors import InputError
from unjam.text import format_count
from unjam.worlds.backend import BackendLike
from unjam.worlds.reward import RewardLike

API_TEST_OPTIONS = {"options": 1}  # meaningless options of `reset` in PettingZoo's `parallel_api_test`


class ParallelRoadEnv(RoadAgents):
    """Several CAVs among human drivers, which share one reward.

    Actions and observations of each CAV are those of `RoadEnv`. On open roads `agents` changes: a CAV becomes an agent
    at the first control step after its entry, and is truncated when it leaves the road. Without CAVs, the simulation
    continues until the next CAV enters. On a user network the agents are cav_0, cav_1, ... in the order of entry, up
    to `cavs` agents.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "unjam_road_v0", "render_modes": []}  # pyright: ignore

    def __init__(
        self,
        scenario: str = "ring",
        reward: RewardLike = "",
        expert: str | DriverLike = "",
        features: Sequence[FeatureLike] = ("local",),
        backend: BackendLike = "sumo",
        **changes: Any,
    ) -> None:
        """Prepare the environment; the arguments are those of `RoadEnv`."""
        road = RoadStepper(scenario, changes, reward, expert, features, backend)
        super().__init__(road, road.scenario.possible_cav_ids())
        self._agent_by_vehicle: dict[str, str] = {}
        self._departed_agents: set[str] = set()  # their vehicles have left, and are driven by the expert if they return

    @synchronized
    def reset(self, seed: int | None = None, options: ResetOptions = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode as `RoadEnv.reset` does; raise `InputError` if `options` allow other CAVs."""
        options = None if options == API_TEST_OPTIONS else options
        observations = self._road.reset(seed, np.random.default_rng(), options)
        if options and (added := {*self._road.episode_scenario.possible_cav_ids()}.difference(self.possible_agents)):
            self._road.end_episode()
            count, allowed = format_count(len(added), "more CAV"), "as many CAVs as in the constructor, or fewer"
            raise InputError(f"reset: options: {count} cannot be there; allowed: {allowed}")
        self._agent_by_vehicle.clear()
        self._departed_agents.clear()
        self.agents = self._assign_agents(self._road.world.cav_ids)
        return dict(zip(self.agents, observations, strict=True)), {agent: {} for agent in self.agents}

    @synchronized
    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Advance one control step with the actions of all agents."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        self._check_actions(actions)
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise InputError(f"step: no action for {', '.join(missing)}; allowed: one for each of the agents")
        previous, departed = self.agents, self._departed_agents
        agents = self._assign_agents(self._road.world.cav_ids)
        result = self._road.step([0.0 if agent in departed else as_action(actions[agent], agent) for agent in agents])
        has_ended = result.terminated or result.truncated
        leaving, present = (
            {agent: row for agent, row in zip(self._assign_agents(ids), rows, strict=True) if agent not in departed}
            for ids, rows in ((result.departed, result.departed.values()), (result.cav_ids, result.observations))
        )
        departed.update(leaving)
        # A vehicle that enters in the last control step does not become an agent.
        observed = leaving | present
        observations = {agent: row for agent, row in observed.items() if agent in previous or not has_ended}
        self.agents = [] if has_ended else list(present)
        info = self._road.step_info(result, has_ended)
        return (
            observations,
            {agent: result.reward if agent in previous else 0.0 for agent in observations},
            dict.fromkeys(observations, result.terminated),
            {agent: result.truncated or (agent in leaving and not result.terminated) for agent in observations},
            {agent: dict(info) for agent in observations},
        )

    def _assign_agents(self, vehicle_ids: Iterable[str]) -> list[str]:
        """Return the agents of vehicles; a new vehicle gets the agent with its id, else the first free agent."""
        for vehicle_id in vehicle_ids:
            if vehicle_id not in self._agent_by_vehicle:
                assigned = self._agent_by_vehicle.values()
                free = [agent for agent in self.possible_agents if agent not in assigned]
                self._agent_by_vehicle[vehicle_id] = vehicle_id if vehicle_id in free else free[0]
        return [self._agent_by_vehicle[vehicle_id] for vehicle_id in vehicle_ids]


@overload
def parallel_env(scenario: str = "ring", slots: None = None, **arguments: Any) -> ParallelRoadEnv: ...


@overload
def parallel_env(scenario: str, slots: int, **arguments: Any) -> SlottedRoadEnv: ...


def parallel_env(
    scenario: str = "ring", slots: int | None = None, **arguments: Any
) -> ParallelRoadEnv | SlottedRoadEnv:
    """Return the PettingZoo environment of a scenario; the arguments are those of `RoadEnv`.

    With `slots`, CAVs that enter and leave are mapped to this number of constant agents: `SlottedRoadEnv`.
    """
    environment = ParallelRoadEnv(scenario, **arguments)
    return environment if slots is None else SlottedRoadEnv(environment, slots)
