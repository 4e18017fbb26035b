"""A road with several CAVs as a PettingZoo environment."""

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from unjam.drivers.observation import FeatureName
from unjam.environments.gymnasium_env import RoadStepper
from unjam.environments.threads import synchronized
from unjam.errors import InputError


class ParallelRoadEnv(ParallelEnv[str, Any, Any]):
    """Several CAVs among people; all earn the same reward, that of the road.

    Action and observation of each are those of `RoadEnv`. On the merge `agents` changes: a CAV appears at the
    first decision after it entered, and is truncated when it leaves; while none is on the road, time goes on
    by itself. On a network of your own they are called cav_0, cav_1, ... as they enter, at most `cavs`.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "unjam_road_v0", "render_modes": []}  # pyright: ignore

    def __init__(
        self,
        scenario: str = "ring",
        reward: str = "",
        expert: str = "",
        features: Sequence[FeatureName] = ("local",),
        **changes: Any,
    ) -> None:
        """Prepare the environment; the arguments are those of `RoadEnv`."""
        self._road = RoadStepper(scenario, changes, reward, expert, features)
        self.possible_agents = list(self._road.scenario.possible_cav_ids())
        self.agents: list[str] = []
        self._agent_by_vehicle: dict[str, str] = {}
        """by vehicle"""
        self._departed_agents: set[str] = set()
        """whose vehicle has left: where it comes back, only its expert drives it, as no agent does"""
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
        """Start an episode: that of `seed`; without one, the next after the last seed's."""
        observations = self._road.reset(seed, np.random.default_rng())
        self._agent_by_vehicle.clear()
        self._departed_agents.clear()
        self.agents = self._agents_of(self._road.traffic.cav_ids)
        return dict(zip(self.agents, observations, strict=True)), {agent: {} for agent in self.agents}

    @synchronized
    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Make one decision of every CAV."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        acted = self.agents
        if missing := [agent for agent in acted if agent not in actions]:
            raise InputError(f"step: no action for {', '.join(missing)}; allowed: one for each of the agents")
        driven = [
            0.0 if name in self._departed_agents else actions[name]
            for name in self._agents_of(self._road.traffic.cav_ids)
        ]
        done = self._road.step([float(np.asarray(each).reshape(())) for each in driven])
        ended = done.terminated or done.truncated
        left = dict(zip(self._agents_of(done.departed), done.departed.values(), strict=True))
        now = dict(zip(self._agents_of(done.cav_ids), done.observations, strict=True))
        now, left = (
            {name: seen for name, seen in each.items() if name not in self._departed_agents} for each in (now, left)
        )
        self._departed_agents |= left.keys()
        there, seen = list(now), {**left, **now}
        # Who enters as the episode ends never was an agent.
        observations = {name: seen[name] for name in seen if name in acted or not ended}
        agents = list(observations)
        self.agents = [] if ended else there
        return (
            observations,
            {agent: done.reward if agent in acted else 0.0 for agent in agents},
            dict.fromkeys(agents, done.terminated),
            {agent: done.truncated or (agent in left and not done.terminated) for agent in agents},
            {agent: {"reward_terms": done.reward_terms} for agent in agents},
        )

    def _agents_of(self, vehicles: Iterable[str]) -> list[str]:
        """Return the agents that drive these vehicles; where names cannot be foretold, in order of entry."""
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
        """End SUMO; may be called twice."""
        self._road.close()


def parallel_env(scenario: str = "ring", **arguments: Any) -> ParallelRoadEnv:
    """Return a road with several CAVs as a PettingZoo environment; arguments are those of `RoadEnv`."""
    return ParallelRoadEnv(scenario, **arguments)
