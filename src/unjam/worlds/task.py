"""What is learned on: a road, an expert that drives there, and what is earned."""

from dataclasses import dataclass

from unjam.drivers.driver import Driver
from unjam.scenarios.scenario import Scenario


@dataclass(frozen=True)
class Task:
    """One road of a training; a training takes a list of them, and one road is a list of one."""

    scenario: Scenario
    expert: Driver
    """who drives before anything is learned, and whom the residual is added to"""
    reward: str = ""
    """name, or `path.py:name`; empty: the scenario's own"""
    weight: float = 1.0
    """share of the actual steps, beside the weights of the other tasks"""
    name: str = ""
    """in progress, tables and folders; empty where there is one task alone"""
