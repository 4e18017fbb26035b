"""The family of roads on which one controller is trained and evaluated, divided into training and unseen roads.

Each road draws its size, its human drivers and their noise from the seed. Unseen roads have a value outside of the
training values (of density, number of vehicles, human drivers, demand or radius) or a new combination of training
values. This division was fixed before anything was trained or tuned on these roads. Roads with noisy sensors, long
actuator delays and calibrated populations were added last, as unseen roads. Each road is the scenario `family/NAME`.
This module imports nothing of unjam, because `import unjam` registers the roads as environments.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

FamilyPart = Literal["training", "combination", "axis"]
FAMILY_PREFIX = "family/"  # beginning of the scenario names of these roads

SHORT_WARM_UP, LONG_WARM_UP = (750, 6000)  # human-only simulation steps: a wave begins, or is fully developed
AGGRESSIVE_IDM = {"time_headway": 0.9, "max_acceleration": 1.3, "comfortable_deceleration": 2.0}
"""human drivers that follow closer and accelerate harder than those of the paper"""
NGSIM_IDM = {
    **{"desired_speed": 17.49, "time_headway": 1.355, "minimum_gap": 2.157},
    **{"max_acceleration": 1.243, "comfortable_deceleration": 1.424},
}
"""IDM parameters fitted to all 325 drivers of the NGSIM pairs together, from results/field.json"""
NO_LATENCY, LATENCY, LONG_LATENCY = {"lag": 0.0, "delay": 0.0}, {"lag": 0.3, "delay": 0.2}, {"lag": 0.5, "delay": 0.5}
"""lag and delay of actuators [s]: of ideal vehicles, usual cars and slow cars"""
IDEAL_VEHICLES: dict[str, Any] = {"actuator": NO_LATENCY}
"""vehicles that obey at once, on all roads of the family without `delayed` or `delay` in their name"""
SENSOR_ERRORS = {"gap_error": 0.5, "speed_error": 0.3}
NOISY_SENSORS: dict[str, Any] = {"sensors": {**SENSOR_ERRORS, "dropout": 0.1}, "safety": SENSOR_ERRORS}
"""sensors with errors, which lose a tenth of the readings; the safety filter accounts for the errors"""
NGSIM_DRIVERS: dict[str, Any] = {"population": "unjam:ngsim"}
ASTAZERO_DRIVERS: dict[str, Any] = {"population": "unjam:astazero"}
"""populations of recorded drivers; on the on-ramp the demand is adapted to their capacity"""


@dataclass(frozen=True)
class FamilyRoad:
    """One road of the family."""

    scenario: str
    options: dict[str, Any] = field(default_factory=dict)
    part: FamilyPart = "training"
    """`training`, also for tuning; or unseen: a `combination` of training values, or a new value on an `axis`"""


def ring_options(
    vehicles: int, cavs: int, warmup: int, spacing: tuple[float, float] = (10.0, 12.27), **extra: Any
) -> dict[str, Any]:
    """Return the options of a ring of ideal vehicles; `spacing` is the range of road length per vehicle [m]."""
    length = [round(vehicles * length_per_vehicle) for length_per_vehicle in spacing]
    return {"vehicles": vehicles, "cavs": cavs, "warmup": warmup, "length": length, **IDEAL_VEHICLES, **extra}


FAMILY: dict[str, FamilyRoad] = {
    "ring-22-no-warm-up": FamilyRoad("ring", ring_options(22, 1, 0)),
    "ring-22-growing": FamilyRoad("ring", ring_options(22, 1, SHORT_WARM_UP)),
    "ring-22-grown": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP)),
    "ring-33-growing-3-cavs": FamilyRoad("ring", ring_options(33, 3, SHORT_WARM_UP)),
    "ring-44-grown": FamilyRoad("ring", ring_options(44, 1, LONG_WARM_UP)),
    "ring-44-growing-2-cavs": FamilyRoad("ring", ring_options(44, 2, SHORT_WARM_UP)),
    "ring-66-grown-4-cavs": FamilyRoad("ring", ring_options(66, 4, LONG_WARM_UP)),
    "ring-22-wide": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, (13.0, 16.0))),
    "ring-22-aggressive": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, humans=AGGRESSIVE_IDM)),
    "ring-22-delayed": FamilyRoad("ring", ring_options(22, 1, SHORT_WARM_UP, actuator=LATENCY)),
    "figure-eight-14": FamilyRoad("figure-eight", IDEAL_VEHICLES),
    "figure-eight-12": FamilyRoad("figure-eight", {"vehicles": 12, **IDEAL_VEHICLES}),
    "on-ramp-5": FamilyRoad("on-ramp", {"penetration_rate": 0.05}),
    "on-ramp-20": FamilyRoad("on-ramp", {"penetration_rate": 0.2}),
    "on-ramp-10-less-demand": FamilyRoad("on-ramp", {"penetration_rate": 0.1, "inflow": 2900.0}),
    "ring-33-grown": FamilyRoad("ring", ring_options(33, 1, LONG_WARM_UP), "combination"),
    "ring-66-growing-2-cavs": FamilyRoad("ring", ring_options(66, 2, SHORT_WARM_UP), "combination"),
    "ring-44-delayed-aggressive": FamilyRoad(
        "ring", ring_options(44, 2, LONG_WARM_UP, humans=AGGRESSIVE_IDM, actuator=LATENCY), "combination"
    ),
    "on-ramp-10": FamilyRoad("on-ramp", {"penetration_rate": 0.1}, "combination"),
    "ring-22-dense": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, (9.1, 9.8)), "axis"),
    "ring-88-grown": FamilyRoad("ring", ring_options(88, 1, LONG_WARM_UP), "axis"),
    "ring-44-grown-5-cavs": FamilyRoad("ring", ring_options(44, 5, LONG_WARM_UP), "axis"),
    "ring-22-ngsim-idm": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, humans=NGSIM_IDM), "axis"),
    "figure-eight-wide": FamilyRoad("figure-eight", {"radius": (36, 38), **IDEAL_VEHICLES}, "axis"),
    "on-ramp-10-more-demand": FamilyRoad(
        "on-ramp", {"penetration_rate": 0.1, "inflow": 3400.0, "ramps.0.inflow": 600.0}, "axis"
    ),
    "one-lane-10": FamilyRoad("on-ramp-1", {"penetration_rate": 0.1}, "axis"),
    "ring-22-long-delay": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, actuator=LONG_LATENCY), "axis"),
    "ring-22-noisy-sensors": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, **NOISY_SENSORS), "axis"),
    "ring-22-ngsim": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, **NGSIM_DRIVERS), "axis"),
    "ring-22-astazero": FamilyRoad("ring", ring_options(22, 1, LONG_WARM_UP, **ASTAZERO_DRIVERS), "axis"),
    "figure-eight-ngsim": FamilyRoad("figure-eight", {**NGSIM_DRIVERS, **IDEAL_VEHICLES}, "axis"),
    "figure-eight-astazero": FamilyRoad("figure-eight", {**ASTAZERO_DRIVERS, **IDEAL_VEHICLES}, "axis"),
    "on-ramp-10-ngsim": FamilyRoad(
        "on-ramp", {"penetration_rate": 0.1, "inflow": 2600.0, "ramps.0.inflow": 400.0, **NGSIM_DRIVERS}, "axis"
    ),
    "on-ramp-10-astazero": FamilyRoad(
        "on-ramp", {"penetration_rate": 0.1, "inflow": 2200.0, "ramps.0.inflow": 350.0, **ASTAZERO_DRIVERS}, "axis"
    ),
}
FAMILY_SCENARIOS = {f"{FAMILY_PREFIX}{name}": road for name, road in FAMILY.items()}  # roads by name of their scenario
GROUP_BY_SCENARIO = {"ring": "rings", "figure-eight": "figure-eights", "on-ramp": "motorways", "on-ramp-1": "motorways"}
"""group of the roads of each scenario; one expert is tuned for each group"""
SHARED_RINGS_GROUP, ALL_ROADS_GROUP = "shared-rings", "all-roads"  # rings with several CAVs, and all roads
ROAD_GROUPS = (*dict.fromkeys(GROUP_BY_SCENARIO.values()), SHARED_RINGS_GROUP, ALL_ROADS_GROUP)
