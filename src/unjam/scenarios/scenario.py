"""What a scenario is: where the vehicles drive, how an episode starts and when it ends."""

from collections.abc import Sequence
from dataclasses import field
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal
from xml.sax.saxutils import quoteattr

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, Count, CountOrNone, NotNegative, Positive
from unjam.physics.idm import IDMParameters
from unjam.scenarios.population import Population, read_population
from unjam.scenarios.road import Road

VEHICLE_LENGTH = 5.0
"""[m], of every vehicle"""

SMALLEST_CAV_GAP = 0.5
"""gap that SUMO keeps for a CAV [m]"""

CAV_COLOUR = "215,38,61"
"""red, in SUMO's window"""

Actuation = Literal["shielded", "raw", "flow"]
"""How SUMO carries out a CAV's command.

`shielded`: exactly, until it is unsafe; then SUMO brakes, and the override is counted.
`raw`: exactly, always; a collision ends the episode.
`flow`: as in Flow, the CAV is also bound by SUMO's human model and can never accelerate beyond it.
"""

People = Literal["native", "commanded"]
"""Who computes how people drive.

`native`: SUMO's own IDM with the scenario's parameters, to whose speeds noise is added.
`commanded`: the same IDM and noise as a speed command in every step, as Flow does it, over a quicker model
of SUMO's that keeps vehicles safe and obeys the right of way. SUMO's IDM with the paper's parameters alone is
far more timid where roads cross.
"""


@dataclass(frozen=True, config=STRICT)
class Scenario:
    """What all scenarios share; each kind of road adds its own."""

    title: ClassVar[str]
    reward: ClassVar[str]
    """reward used where none is named"""
    closed: ClassVar[bool] = True
    """whether the road is a loop"""
    has_coordinate: ClassVar[bool] = True
    """whether vehicles have a position along the road"""
    people_gap: ClassVar[float] = 0.0
    """gap that SUMO keeps for commanded people [m]"""

    simulation_step: Positive = 0.1
    """time step of SUMO [s]"""
    steps_per_decision: Count = 1
    """simulation steps for which one command holds"""
    horizon: Count = 3000
    """decisions in an episode"""
    warmup: CountOrNone = 0
    """all-human simulation steps before the CAVs take over"""
    recall_warmup: bool = True
    """whether a driver may remember the warm-up, which it saw but did not drive"""
    action_limit: Positive = 1.0
    """largest acceleration that a CAV may ask for, in either direction [m/s2]"""
    actuation: Actuation = "shielded"
    """how SUMO carries out a CAV's command: `shielded` exactly until it is unsafe, then SUMO brakes; `raw`
    exactly; `flow` bound by the human IDM"""
    humans: IDMParameters = field(default_factory=IDMParameters)
    """how people drive"""
    population: str = ""
    """file of calibrated drivers, of `unjam fit-drivers`, each of whom drives in its own way; empty: all
    drive as `humans` says"""
    people: People = "native"
    """who computes how people drive: `native` SUMO's own IDM; `commanded` the same IDM as a speed command in
    every step, as in Flow"""
    right_of_way: bool = True
    """whether vehicles obey the right of way where roads meet; if not, SUMO only keeps them from colliding"""
    impatience: Annotated[float, Field(ge=0, le=1)] = 0.0
    """how readily vehicles that must yield take a gap in crossing traffic (SUMO's `impatience`)"""
    noise: NotNegative = 0.2
    """standard deviation of the humans' acceleration noise [m/s2]"""
    noise_scaling: Literal["sqrt-step", "none"] = "sqrt-step"
    """`sqrt-step`: noise times sqrt(time step), as Flow; `none`: as the paper says"""
    emission_class: str = "HBEFA4/PC_petrol_Euro-6ab"
    """SUMO's emission class of every vehicle, for fuel"""

    @property
    def decision_step(self) -> float:
        """Time between two decisions [s]."""
        return self.simulation_step * self.steps_per_decision

    @property
    def noise_per_step(self) -> float:
        """Standard deviation of the acceleration noise in one simulation step [m/s2]."""
        scale = self.simulation_step**0.5 if self.noise_scaling == "sqrt-step" else 1.0
        return self.noise * scale

    @cached_property
    def calibrated(self) -> Population | None:
        """The people of `population`, read once."""
        return read_population(self.population) if self.population else None

    @property
    def top_speed(self) -> float:
        """What the road allows: as fast as the fastest driver wants to be [m/s]."""
        population = self.calibrated
        return population.fastest if population else self.humans.desired_speed

    def draw_people(self, names: Sequence[str], generator: np.random.Generator) -> dict[str, IDMParameters]:
        """Return who drives which vehicle; nobody where all drive as `humans` says."""
        population = self.calibrated
        return dict(zip(names, population.draw(len(names), generator), strict=True)) if population else {}

    @property
    def people_in_words(self) -> str:
        """How people drive."""
        if self.calibrated:
            return f"{len(self.calibrated.drivers)} calibrated drivers of {self.population}"
        return f"IDM with acceleration noise of std {self.noise_per_step:.3f} m/s2 a step"

    def draw(self, generator: np.random.Generator) -> Road:
        """Return the road of one episode; everything random about it comes from `generator`."""
        raise NotImplementedError

    def drawn_scaled(self, drawn: dict[str, float]) -> tuple[float, ...]:
        """Return what an episode has drawn, each number scaled to [-1, 1] over its range: for a critic."""
        return tuple(
            (drawn[name] - (low + high) / 2) / max((high - low) / 2, 1e-9)
            for name, (low, high) in self.drawn_ranges.items()
        )

    @property
    def drawn_ranges(self) -> dict[str, tuple[float, float]]:
        """What each episode draws anew, and from which range."""
        raise NotImplementedError

    def part(self, index: int, count: int) -> "Scenario":
        """Return this scenario with what it draws narrowed to one of `count` equal parts of the range.

        Episodes of all parts cover the range evenly: with few episodes, whether a ring is long or short
        otherwise hides what the driver does.
        """
        raise NotImplementedError

    def possible_cavs(self) -> tuple[str, ...]:
        """Return the ids of all CAVs that an episode may have."""
        raise NotImplementedError

    def facts(self) -> list[tuple[str, str]]:
        """Return what a reader wants to know of this road, as (name, value) pairs."""
        raise NotImplementedError


def vehicle_type(name: str, scenario: Scenario, **attributes: Any) -> str:
    """Return the XML of a vehicle type: SUMO's defaults of chance switched off, the rest as given."""
    common = {
        "id": name,
        "length": VEHICLE_LENGTH,
        "speedFactor": 1.0,
        "speedDev": 0.0,  # without it SUMO draws factors between 0.8 and 1.2
        "sigma": 0.0,
        "impatience": scenario.impatience,
        "emissionClass": scenario.emission_class,
    }
    return type_xml({**common, **attributes})


def type_xml(attributes: dict[str, Any]) -> str:
    """Return the XML of a vehicle type."""
    pairs = " ".join(f"{key}={quoteattr(str(value))}" for key, value in attributes.items())
    return f"<vType {pairs}/>"


def human_types(scenario: Scenario, people: dict[str, IDMParameters]) -> list[str]:
    """Return the XML of the human drivers: SUMO's own IDM with the scenario's parameters, or each its own.

    Under commanded people lies Flow's layer: quick, and with no gap of its own.
    """
    own = people if scenario.people == "native" else {}
    return [
        vehicle_type("human", scenario, **_human_layer(scenario, scenario.humans)),
        *(vehicle_type(f"of_{name}", scenario, **_human_layer(scenario, one)) for name, one in own.items()),
    ]


def human_type_of(name: str, scenario: Scenario, people: dict[str, IDMParameters]) -> str:
    """Return which of `human_types` a vehicle has, as attributes of its XML.

    SUMO would not let a driver who keeps a large distance begin closer than that.
    """
    own = name in people and scenario.people == "native"
    checks = ' insertionChecks="none"' if own else ""
    return f'type="{f"of_{name}" if own else "human"}"{checks}'


def _human_layer(scenario: Scenario, humans: IDMParameters) -> dict[str, Any]:
    population = scenario.calibrated
    layer = {
        "carFollowModel": "IDM",
        "accel": humans.max_acceleration,
        "decel": humans.comfortable_deceleration,
        "tau": humans.time_headway,
        "delta": humans.exponent,
        "minGap": humans.minimum_gap,
        "maxSpeed": humans.desired_speed,
    }
    if scenario.people == "commanded":
        layer |= {"accel": 2.6, "decel": 4.5, "tau": 1.0, "minGap": scenario.people_gap}
        if population:  # the layer may not hold back who keeps less than a second
            layer |= {"tau": min(1.0, population.quickest), "maxSpeed": population.fastest}
    return layer


def cav_type(scenario: Scenario) -> str:
    """Return the XML of the CAVs: a type that executes any safe command exactly.

    Where the actuation is Flow's, it is the human type instead; with a gap, or it would creep up until it
    touches.
    """
    if scenario.actuation == "flow":
        layer = _human_layer(scenario, scenario.humans)
        smallest = max(layer["minGap"], SMALLEST_CAV_GAP)
        return vehicle_type("cav", scenario, color=CAV_COLOUR, **{**layer, "minGap": smallest})
    layer = obedient_layer(scenario.simulation_step)
    return vehicle_type("cav", scenario, **layer, maxSpeed=scenario.top_speed)


def obedient_layer(simulation_step: float) -> dict[str, Any]:
    """Return the attributes of a type that executes any safe command exactly.

    With SUMO's safe-speed check on, a Krauss vehicle with a reaction time of one step and a small minimum
    gap is the one that stays out of the way until the command would lead to a crash.
    """
    limits = 20.0  # [m/s2] far beyond what a CAV asks for, so that only safety clips a command
    return {
        "color": CAV_COLOUR,
        "carFollowModel": "Krauss",
        "accel": limits,
        "decel": limits,
        "emergencyDecel": limits,
        "apparentDecel": limits,
        "tau": simulation_step,
        "minGap": SMALLEST_CAV_GAP,
    }
