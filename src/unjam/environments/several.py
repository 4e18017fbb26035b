"""A road with several CAVs as a PettingZoo environment."""

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from unjam.drivers.observation import FeatureName
from unjam.environments.single import SteppedRoad
from unjam.environments.threads import one_thread_at_a_time
from unjam.errors import InputError


class ParallelRoad(ParallelEnv[str, Any, Any]):
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
        observe: Sequence[FeatureName] = ("local",),
        **changes: Any,
    ) -> None:
        """Prepare the environment; the arguments are those of `RoadEnv`."""
        self._road = SteppedRoad(scenario, changes, reward, expert, observe)
        self.possible_agents = list(self._road.scenario.possible_cavs())
        self.agents: list[str] = []
        self._agents: dict[str, str] = {}
        """by vehicle"""
        self._gone: set[str] = set()
        """whose vehicle has left: where it comes back, only its expert drives it, as no agent does"""
        self.render_mode = None
        self.observation_spaces = {
            agent: deepcopy(self._road.observation_space) for agent in self.possible_agents
        }
        self.action_spaces = {agent: deepcopy(self._road.action_space) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the observation space of one CAV."""
        return self.observation_spaces[agent]  # pyright: ignore[reportReturnType]

    def action_space(self, agent: str) -> spaces.Box:
        """Return the action space of one CAV."""
        return self.action_spaces[agent]  # pyright: ignore[reportReturnType]

    @one_thread_at_a_time
    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode: that of `seed`; without one, the next after the last seed's."""
        observations = self._road.reset(seed, np.random.default_rng())
        self._agents.clear()
        self._gone.clear()
        self.agents = self._named(self._road.traffic.cavs)
        return dict(zip(self.agents, observations, strict=True)), {agent: {} for agent in self.agents}

    @one_thread_at_a_time
    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Make one decision of every CAV."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        acted = self.agents
        if missing := [agent for agent in acted if agent not in actions]:
            raise InputError(f"step: no action for {', '.join(missing)}; allowed: one for each of the agents")
        driven = [
            0.0 if name in self._gone else actions[name] for name in self._named(self._road.traffic.cavs)
        ]
        done = self._road.step([float(np.asarray(each).reshape(())) for each in driven])
        ended = done.terminated or done.truncated
        left = dict(zip(self._named(done.left), done.left.values(), strict=True))
        now = dict(zip(self._named(done.cavs), done.observations, strict=True))
        now, left = (
            {name: seen for name, seen in each.items() if name not in self._gone} for each in (now, left)
        )
        self._gone |= left.keys()
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
            {agent: {"terms": done.terms} for agent in agents},
        )

    def _named(self, vehicles: Iterable[str]) -> list[str]:
        """Return the agents that drive these vehicles; where names cannot be foretold, in order of entry."""
        for name in vehicles:
            if name not in self._agents:
                taken = self._agents.values()
                free = [agent for agent in self.possible_agents if agent not in taken]
                self._agents[name] = name if name in free else free[0]
        return [self._agents[name] for name in vehicles]

    def render(self) -> None:
        """Draw nothing."""

    @one_thread_at_a_time
    def close(self) -> None:
        """End SUMO; may be called twice."""
        self._road.close()


def parallel_env(scenario: str = "ring", **arguments: Any) -> ParallelRoad:
    """Return a road with several CAVs as a PettingZoo environment; arguments are those of `RoadEnv`."""
    return ParallelRoad(scenario, **arguments)
