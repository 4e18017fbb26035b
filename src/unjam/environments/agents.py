"""What the PettingZoo environments of a road have in common: the spaces of their agents."""

from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any

from gymnasium import spaces
from pettingzoo import ParallelEnv

from unjam.environments.gymnasium_env import RoadStepper
from unjam.errors import invalid_value, unknown_name


class RoadAgents(ParallelEnv[str, Any, Any]):
    """Agents of a road, each with the spaces of one CAV; nothing is drawn."""

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
        """Draw nothing."""
