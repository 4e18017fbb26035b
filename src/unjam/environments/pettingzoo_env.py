"""A scenario with several CAVs as a PettingZoo environment."""

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from unjam.drivers.observation import FeatureLike
from unjam.drivers.user_driver import DriverLike
from unjam.environments.gymnasium_env import RoadStepper
from unjam.environments.threads import synchronized
from unjam.errors import InputError
from unjam.worlds.backend import BackendLike
from unjam.worlds.reward import RewardLike


class ParallelRoadEnv(ParallelEnv[str, Any, Any]):
    """Several CAVs among human drivers, with a common reward.

    Action and observation of each CAV are those of `RoadEnv`. On the merge `agents` changes: a CAV appears at the
    first control step after its entry, and is truncated when it leaves; without CAVs on the road, the simulation
    continues by itself. On a user network the agents are cav_0, cav_1, ... in order of entry, at most `cavs`.
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
        self._road = RoadStepper(scenario, changes, reward, expert, features, backend)
        self.possible_agents = list(self._road.scenario.possible_cav_ids())
        self.agents: list[str] = []
        self._agent_by_vehicle: dict[str, str] = {}
        self._departed_agents: set[str] = set()
        """agents with a vehicle that has left; if the vehicle returns, its expert drives it without the agent"""
        self.render_mode = None
        self.observation_spaces = {agent: deepcopy(self._road.observation_space) for agent in self.possible_agents}
        self.action_spaces = {agent: deepcopy(self._road.action_space) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the observation space of one CAV."""
        return self.observation_spaces[agent]  # pyright: ignore[reportReturnType]

    def action_space(self, agent: str) -> spaces.Box:
        """Return the action space of one CAV."""
        return self.action_spaces[agent]  # pyright: ignore[reportReturnType]

    @synchronized
    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode: that of `seed`; without one, the next after that of the last seed."""
        observations = self._road.reset(seed, np.random.default_rng())
        self._agent_by_vehicle.clear()
        self._departed_agents.clear()
        self.agents = self._agents_of(self._road.world.cav_ids)
        return dict(zip(self.agents, observations, strict=True)), {agent: {} for agent in self.agents}

    @synchronized
    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Advance one control step with the actions of all CAVs."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise InputError(f"step: no action for {', '.join(missing)}; allowed: one for each of the agents")
        acted, departed = self.agents, self._departed_agents
        present = self._agents_of(self._road.world.cav_ids)
        values = [0.0 if agent in departed else float(np.asarray(actions[agent]).reshape(())) for agent in present]
        done = self._road.step(values)
        is_over = done.terminated or done.truncated
        left, now = (
            {agent: each for agent, each in zip(self._agents_of(ids), rows, strict=True) if agent not in departed}
            for ids, rows in ((done.departed, done.departed.values()), (done.cav_ids, done.observations))
        )
        departed.update(left)
        # A vehicle that enters as the episode ends never becomes an agent.
        observations = {agent: each for agent, each in (left | now).items() if agent in acted or not is_over}
        self.agents = [] if is_over else list(now)
        return (
            observations,
            {agent: done.reward if agent in acted else 0.0 for agent in observations},
            dict.fromkeys(observations, done.terminated),
            {agent: done.truncated or (agent in left and not done.terminated) for agent in observations},
            {agent: {"reward_terms": done.reward_terms} for agent in observations},
        )

    def _agents_of(self, vehicles: Iterable[str]) -> list[str]:
        """Return the agents of vehicles; if their names are not known in advance, in order of entry."""
        for name in vehicles:
            if name not in self._agent_by_vehicle:
                taken = self._agent_by_vehicle.values()
                free = [agent for agent in self.possible_agents if agent not in taken]
                self._agent_by_vehicle[name] = name if name in free else free[0]
        return [self._agent_by_vehicle[name] for name in vehicles]

    def render(self) -> None:
        """Draw nothing."""

    @synchronized
    def close(self) -> None:
        """Close SUMO; may be called twice."""
        self._road.close()


def parallel_env(scenario: str = "ring", **arguments: Any) -> ParallelRoadEnv:
    """Return a scenario with several CAVs as a PettingZoo environment; arguments are those of `RoadEnv`."""
    return ParallelRoadEnv(scenario, **arguments)
