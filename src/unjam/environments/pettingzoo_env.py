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

API_TEST_OPTIONS = {"options": 1}  # options without a meaning with which PettingZoo's `parallel_api_test` calls `reset`


class ParallelRoadEnv(RoadAgents):
    """Several CAVs among human drivers, with a common reward.

    Action and observation of each CAV are those of `RoadEnv`. On open roads `agents` changes: a CAV becomes an agent at
    the first control step after its entry, and is truncated when it leaves the road. While there are no CAVs, the
    simulation continues until the next one enters. On a user network the agents are cav_0, cav_1, ... in the order of
    entry, at most `cavs` of them.
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
        self._departed_agents: set[str] = set()  # whose vehicle has left; if it returns, only the expert drives it

    @synchronized
    def reset(self, seed: int | None = None, options: ResetOptions = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode as `RoadEnv.reset`; raise `InputError` if the road can then have other CAVs."""
        options = None if options == API_TEST_OPTIONS else options
        observations = self._road.reset(seed, np.random.default_rng(), options)
        if options and (others := {*self._road.episode_scenario.possible_cav_ids()}.difference(self.possible_agents)):
            self._road.end_episode()
            more, allowed = format_count(len(others), "more CAV"), "as many CAVs as in the constructor, or fewer"
            raise InputError(f"reset: options: {more} cannot be there; allowed: {allowed}")
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
            {agent: each for agent, each in zip(self._assign_agents(ids), rows, strict=True) if agent not in departed}
            for ids, rows in ((result.departed, result.departed.values()), (result.cav_ids, result.observations))
        )
        departed.update(leaving)
        # A vehicle that enters in the last control step does not become an agent.
        shown = leaving | present
        observations = {agent: shown[agent] for agent in shown if agent in previous or not has_ended}
        self.agents = [] if has_ended else list(present)
        info = self._road.step_info(result, has_ended)
        return (
            observations,
            {agent: result.reward if agent in previous else 0.0 for agent in observations},
            dict.fromkeys(observations, result.terminated),
            {agent: result.truncated or (agent in leaving and not result.terminated) for agent in observations},
            {agent: dict(info) for agent in observations},
        )

    def _assign_agents(self, vehicles: Iterable[str]) -> list[str]:
        """Return the agents of vehicles; a new vehicle gets the agent with its name, else the first free one."""
        for name in vehicles:
            if name not in self._agent_by_vehicle:
                taken = self._agent_by_vehicle.values()
                free = [agent for agent in self.possible_agents if agent not in taken]
                self._agent_by_vehicle[name] = name if name in free else free[0]
        return [self._agent_by_vehicle[name] for name in vehicles]


@overload
def parallel_env(scenario: str = "ring", slots: None = None, **arguments: Any) -> ParallelRoadEnv: ...


@overload
def parallel_env(scenario: str, slots: int, **arguments: Any) -> SlottedRoadEnv: ...


def parallel_env(
    scenario: str = "ring", slots: int | None = None, **arguments: Any
) -> ParallelRoadEnv | SlottedRoadEnv:
    """Return the PettingZoo environment of a scenario; the arguments are those of `RoadEnv`.

    With `slots`, CAVs that come and go are mapped to so many agents that stay for the whole episode: `SlottedRoadEnv`.
    """
    environment = ParallelRoadEnv(scenario, **arguments)
    return environment if slots is None else SlottedRoadEnv(environment, slots)
