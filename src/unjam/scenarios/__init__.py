"""Where the vehicles drive: roads, traffic, how an episode starts and ends."""

from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.merge import Merge
from unjam.scenarios.registry import SCENARIOS, make_scenario
from unjam.scenarios.ring import Ring
from unjam.scenarios.road import Road
from unjam.scenarios.scenario import Scenario

__all__ = ["SCENARIOS", "FigureEight", "Merge", "Ring", "Road", "Scenario", "make_scenario"]
