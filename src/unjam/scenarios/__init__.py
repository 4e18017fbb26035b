"""Where the vehicles drive: roads, traffic, how an episode starts and ends."""

from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.registry import SCENARIOS, make_scenario
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Road, Scenario

__all__ = ["SCENARIOS", "FigureEight", "Ring", "Road", "Scenario", "make_scenario"]
