"""The request of an assessment: road, controllers, penetration rates and budget."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

from unjam.controller import DEFAULT_DRIVER, make_driver
from unjam.drivers.driver import Driver
from unjam.errors import InputError, invalid_value
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import ACC_SETTINGS, UserNetwork
from unjam.text import format_count
from unjam.training.run_folder import check_controllers
from unjam.training.selection import (
    ACC_DRIVER,
    HUMAN_BASELINE,
    UNCHANGED_ACC_DRIVER,
    Option,
    min_episodes,
    verdict_episodes,
)
from unjam.worlds.episode import check_can_drive

DEFAULT_CONTROLLERS = (DEFAULT_DRIVER, "follower-stopper", "pi")
ACC_PROPERTIES = ("acceleration", "deceleration", "keep_right", "speed_gain")
"""settings of the CAVs' ACC that replace a property of the vehicle"""
PLOT_EPISODE_COUNT = 2
"""episodes for pictures: of the human baseline, and of one controller"""
ZERO_PENETRATION_RATE = 1e-12
"""penetration rate of human-only traffic, because user networks do not allow zero"""
CAV_SELECTION_OPTIONS = "penetration_rate", "cav_types", "cavs"
"""options of a road that the penetration rates replace"""


@dataclass(frozen=True)
class AssessmentRequest:
    """The checked settings of an assessment."""

    file: str
    network: UserNetwork
    """user network with human-only traffic"""
    drivers: dict[str, Driver]
    """controllers by name"""
    penetration_rates: tuple[float, ...]
    episodes: int
    """budget of episodes"""
    minutes: float | None
    """time budget [min]; it does not limit the minimum number of seeds of an answer"""
    precision: float
    """target half-width of the CI of travel time, as a share of the baseline's travel time"""

    @property
    def options(self) -> list[Option]:
        """Each controller at each penetration rate."""
        return [Option(rate, driver) for rate in self.penetration_rates for driver in self.drivers]

    @property
    def compared_options(self) -> list[Option]:
        """The human baseline, ACC vehicles and each controller at each penetration rate."""
        return [HUMAN_BASELINE, *(Option(rate, ACC_DRIVER) for rate in self.penetration_rates), *self.options]

    @property
    def has_acc_properties(self) -> bool:
        """Whether the user replaces a property of the vehicles for CAVs."""
        return any(getattr(self.network.cruise, name) is not None for name in ACC_PROPERTIES)

    @property
    def verdict_episodes(self) -> int:
        """Smallest number of episodes for a verdict."""
        counts = len(self.penetration_rates), len(self.drivers), self.has_acc_properties
        return verdict_episodes(*counts) + PLOT_EPISODE_COUNT

    @property
    def smallest_request(self) -> "AssessmentRequest":
        """The request for only the median penetration rate and the first controller."""
        rate = self.penetration_rates[len(self.penetration_rates) // 2]
        drivers = dict(list(self.drivers.items())[:1])
        return replace(self, penetration_rates=(rate,), drivers=drivers)

    def make_setup(self, option: Option) -> tuple[Scenario, Driver]:
        """Return the road with the penetration rate of an option, and the driver of the CAVs."""
        if option == HUMAN_BASELINE:
            return self.network, make_driver(HUMAN_BASELINE.driver, self.network.control_step)
        road = replace(self.network, penetration_rate=option.penetration_rate)
        if option.driver not in (ACC_DRIVER, UNCHANGED_ACC_DRIVER):
            return road, self.drivers[option.driver]
        unchanged = dict.fromkeys(ACC_PROPERTIES if option.driver == UNCHANGED_ACC_DRIVER else ())
        safety, cruise = replace(road.safety, active=False), replace(road.cruise, **unchanged)
        road = replace(road, actuation="cruise", safety=safety, cruise=cruise)
        return road, make_driver(ACC_DRIVER, road.control_step)


def make_request(
    file: str,
    penetration_rates: Sequence[float],
    episodes: int,
    precision: float,
    minutes: float | None = None,
    drivers: Sequence[str] = DEFAULT_CONTROLLERS,
    options: dict[str, Any] | None = None,
) -> AssessmentRequest:
    """Return a checked request, with the human baseline; raise `InputError` if an argument is wrong."""
    if not file.endswith(".sumocfg"):
        raise invalid_value("scenario", file, "your own .sumocfg file")
    for name in [name for name in options or {} if name in CAV_SELECTION_OPTIONS]:
        raise InputError(f"{name}: it is not allowed here, because --penetration-rates sets the share of CAVs")
    for rate in penetration_rates:
        if not 0 <= rate <= 1:
            raise invalid_value("penetration_rates", rate, "shares from 0 to 1, such as 0.05 for 5 %")
    rates = tuple(sorted(set(penetration_rates) - {0.0}))
    if not rates:
        text = ",".join(f"{rate:g}" for rate in penetration_rates)
        raise invalid_value("penetration_rates", text, "one above 0 at least")
    if minutes is not None and not minutes > 0:
        raise invalid_value("minutes", minutes, "> 0")
    if not 0 < precision < 1:
        raise invalid_value("precision", precision, "> 0, < 1")
    changes = {**ACC_SETTINGS, **(options or {}), "penetration_rate": ZERO_PENETRATION_RATE}
    road = cast(UserNetwork, make_scenario(file, changes))
    controllers = {name: make_driver(name, road.control_step) for name in drivers if name != ACC_DRIVER}
    for name, driver in controllers.items():
        check_controllers(name, "assess")
        if driver.is_driven_by_simulator:
            raise invalid_value("driver", name, "the human baseline is always included")
        check_can_drive(driver, road, f"driver {name}")
    request = AssessmentRequest(file, road, controllers, rates, episodes, minutes, precision)
    minimum = min_episodes(len(rates), len(controllers), request.has_acc_properties) + PLOT_EPISODE_COUNT
    if episodes < minimum:
        counts = format_count(len(rates), "penetration rate"), format_count(len(controllers), "controller")
        allowed = f">= {minimum} for {' and '.join(counts)}"
        raise invalid_value("episodes", episodes, allowed)
    return request
