"""The agents of a road in PettingZoo environments, and slots: constant agents for algorithms that require them."""

from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from unjam.environments.gymnasium_env import CopiedWhole, ResetOptions, RoadStepper, as_action, synchronized
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.parameters import check_integer


class RoadAgents(CopiedWhole, ParallelEnv[str, Any, Any]):
    """Agents of a road, each with the spaces of one CAV, without rendering."""

    def __init__(self, road: RoadStepper, possible_agents: Iterable[str]) -> None:
        self._road, self.render_mode = road, None
        self.possible_agents, self.agents = list(possible_agents), []
        self.observation_spaces = {agent: deepcopy(road.observation_space) for agent in self.possible_agents}
        self.action_spaces = {agent: deepcopy(road.action_space) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the observation space of an agent: that of one CAV; raise `InputError` for an unknown agent."""
        self._check_agent(agent)
        return self.observation_spaces[agent]  # pyright: ignore[reportReturnType]

    def action_space(self, agent: str) -> spaces.Box:
        """Return the action space of an agent: that of one CAV; raise `InputError` for an unknown agent."""
        self._check_agent(agent)
        return self.action_spaces[agent]  # pyright: ignore[reportReturnType]

    def _check_agent(self, agent: str) -> None:
        if agent not in self.possible_agents:
            raise unknown_name("agent", agent, self.possible_agents)

    @staticmethod
    def _check_actions(actions: object) -> None:
        if not isinstance(actions, Mapping):
            raise invalid_value("step: actions", actions, "a dict with an action for each agent")

    def render(self) -> None:
        """Do nothing, because there is no rendering."""

    @synchronized
    def close(self) -> None:
        """Close SUMO; further calls have no effect."""
        self._road.close()


class SlottedRoadEnv(RoadAgents):
    """A `ParallelRoadEnv` with the agents slot_0, slot_1, ..., all of which exist for the whole episode.

    A CAV that enters gets the first free slot until it leaves the road. If no slot is free, the expert drives the CAV
    for its whole trip (without an expert the CAV keeps its speed, as with action 0). When a CAV leaves, its slot has
    its last observation in this control step, and is free from the next control step on.

    An empty slot observes zeros, its action is ignored, and its reward is 0. `infos` has for each slot the mask
    `is_occupied`, `has_left` (its CAV left in this step), the id of its `vehicle`, and the `reward_terms`.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "unjam_slots_v0", "render_modes": []}  # pyright: ignore

    def __init__(self, environment: Any, slots: int) -> None:
        """Map the agents of a `ParallelRoadEnv` to a number of slots."""
        count = check_integer("slots", slots, 1)
        super().__init__(environment._road, (f"slot_{index}" for index in range(count)))
        self._environment = environment
        self._cavs: dict[str, str] = {}  # agent of the environment by occupied slot
        self._without_slot: set[str] = set()

    @synchronized
    def reset(self, seed: int | None = None, options: ResetOptions = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode as `ParallelRoadEnv.reset` does."""
        observations, infos = self._environment.reset(seed, options)
        self.agents = list(self.possible_agents)
        self._cavs, self._without_slot = {}, set()
        self._assign_slots(self.agents)
        return self._observe(observations, self._cavs), self._infos(infos, self._cavs, {})

    @synchronized
    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Advance one control step; empty slots need no action."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        self._check_actions(actions)
        if missing := [slot for slot in self._cavs if slot not in actions]:
            raise InputError(f"step: no action for {', '.join(missing)}; allowed: one for each occupied slot")
        if unknown := actions.keys() - set(self.possible_agents):
            raise unknown_name("step: slot", min(unknown, key=str), self.possible_agents)
        previous_cavs = self._cavs
        commands = dict.fromkeys(self._environment.agents, 0.0)
        commands |= {cav: as_action(actions[slot], slot) for slot, cav in previous_cavs.items()}
        observations, rewards, terminations, _, infos = self._environment.step(commands)
        present, is_terminated = set(self._environment.agents), any(terminations.values())
        has_ended = not present
        left = {} if has_ended else {slot: cav for slot, cav in previous_cavs.items() if cav not in present}
        self._cavs = {slot: cav for slot, cav in previous_cavs.items() if slot not in left}
        self._assign_slots([slot for slot in self.possible_agents if slot not in previous_cavs])
        slots, observed_cavs = self.possible_agents, self._cavs | left
        self.agents = [] if has_ended else list(slots)
        return (
            self._observe(observations, observed_cavs),
            {slot: rewards[previous_cavs[slot]] if slot in previous_cavs else 0.0 for slot in slots},
            dict.fromkeys(slots, is_terminated),
            dict.fromkeys(slots, has_ended and not is_terminated),
            self._infos(infos, observed_cavs, left),
        )

    def _assign_slots(self, free: list[str]) -> None:
        """Give `free` slots to the CAVs that have entered; CAVs without a slot do not get one later."""
        known = {*self._cavs.values(), *self._without_slot}
        new_cavs = [cav for cav in self._environment.agents if cav not in known]
        self._cavs |= zip(free, new_cavs, strict=False)
        self._without_slot.update(new_cavs[len(free) :])

    def _observe(self, observations: dict[str, Any], cavs: dict[str, str]) -> dict[str, Any]:
        empty = np.zeros(self._road.observation_space.shape, np.float32)
        return {slot: observations[cavs[slot]] if slot in cavs else empty.copy() for slot in self.possible_agents}

    def _infos(self, infos: dict[str, Any], cavs: dict[str, str], left: dict[str, str]) -> dict[str, Any]:
        entries: dict[str, Any] = {}
        # At the end all slots have the metrics, also slots without CAVs.
        metrics = [info["episode_metrics"] for info in infos.values() if "episode_metrics" in info]
        final = {"episode_metrics": metrics[0]} if metrics else {}
        for slot in self.possible_agents:
            state = {"is_occupied": slot in self._cavs, "has_left": slot in left, "vehicle": cavs.get(slot, "")}
            entries[slot] = final | infos.get(state["vehicle"], {}) | state
        return entries
