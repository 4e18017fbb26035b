"""How soon drivers settle where a road changes under them: a wave arrives, people change, a CAV leaves.

Rings are stepped in batches, as SUMO's but for rounding. What changes is unknown to every driver.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.controller import make_driver
from unjam.drivers.command import Command
from unjam.files import write_whole
from unjam.measures.statistics import estimate
from unjam.measures.table import PEOPLE, cell_of
from unjam.physics.arrays import Array, Floats, at_least
from unjam.physics.idm import PAPER_IDM, IDMParameters, idm_acceleration
from unjam.reports.figures import LINES, MUTED, STYLE, new_figure, png_bytes
from unjam.scenarios.ring import Ring
from unjam.studies.everywhere import PI_ON_RINGS
from unjam.studies.parts import measure_parts
from unjam.studies.results_file import read_part
from unjam.studies.study import Study, StudyFolder
from unjam.training.family import GROWING, HURRIED
from unjam.training.seeds import held_out_seeds
from unjam.worlds.batch.lanes import Leader
from unjam.worlds.batch.run import begin
from unjam.worlds.batch.world import RingBatch
from unjam.worlds.drive import driven_to_the_end

EPISODES = 20
CHANGE, END = 3000, 7200
"""decision in which the road changes, and the last one, of 0.1 s each"""
BRAKING, CRAWLING, CRAWL = 2.0, 0.5, 200
"""how somebody makes a wave: braking [m/s2] to a speed [m/s], for so many decisions"""
SECOND = 10
"""decisions of a second"""
SMOOTHED, LAST = 10, 60
"""seconds over which a mean speed is taken: to see whether it has settled, and in the end"""
SETTLED = 0.95
"""share of what the road allows that counts as settled once it is kept"""
DRIVERS = {
    PEOPLE: "human",
    "PI, tuned on the rings": PI_ON_RINGS,
    "FollowerStopper": "follower-stopper",
    "unjam:best": "unjam:best",
}


HURRIED_PEOPLE = replace(PAPER_IDM, **HURRIED)


class ChangingRings(RingBatch):
    """Rings on which something happens in decision `CHANGE`."""

    @property
    def changed(self) -> bool:
        """Whether it has happened."""
        return self.decisions >= CHANGE


class WaveArrives(ChangingRings):
    """Halfway round from the first CAV somebody brakes, and crawls for twenty seconds."""

    def _people_speed(self, speed: Array, ahead: Leader) -> Array:
        """Return the speeds after this step of all vehicles, if people drive them."""
        found = super()._people_speed(speed, ahead)
        if self.changed and self.decisions < CHANGE + CRAWL:
            place = (self._places[0] + len(speed) // 2) % len(speed)
            crawls = at_least(speed[place] - BRAKING * self.scenario.simulation_step, CRAWLING)
            found[place] = np.minimum(found[place], crawls)
        return found


class PeopleChange(ChangingRings):
    """People follow closer, accelerate and brake harder from then on."""

    def _people_speed(self, speed: Array, ahead: Leader) -> Array:
        """Return the speeds after this step of all vehicles, if people drive them."""
        if self.changed:
            self._people = HURRIED_PEOPLE
        return super()._people_speed(speed, ahead)


class CAVLeaves(ChangingRings):
    """The last CAV drives as people do from then on, within what a CAV may command."""

    def advance(self, command: Command | None) -> None:
        """Simulate one decision."""
        if command is not None and self.changed:
            seen = self.perceive()
            rows = np.arange(self.rows) >= self.rows - len(self.roads)
            alone = idm_acceleration(seen.speed, seen.leader_speed, seen.leader_gap, self.scenario.humans)
            command = command._replace(acceleration=np.where(rows, alone, command.acceleration))
        super().advance(command)


@dataclass(frozen=True)
class Change:
    """Something that happens on a road."""

    ring: Ring
    world: type[ChangingRings]
    humans: IDMParameters = PAPER_IDM
    """how people drive afterwards"""


CHANGES: dict[str, Change] = {
    "a wave arrives": Change(Ring(horizon=END), WaveArrives),
    "people change": Change(Ring(horizon=END, warmup=GROWING), PeopleChange, HURRIED_PEOPLE),
    "a CAV of two leaves": Change(
        Ring(length=(440, 540), vehicles=44, cavs=2, horizon=END, warmup=GROWING), CAVLeaves
    ),
}
"""by name"""


def _driven(name: str, driver: str) -> dict[str, list[Any]]:
    """Return the mean speed of all over each second, and the limit after the change, by episode [m/s]."""
    change = CHANGES[name]
    rings = [change.ring.part(number, EPISODES) for number in range(EPISODES)]
    world = change.world(rings, held_out_seeds(EPISODES))
    found = driven_to_the_end(begin(world, make_driver(driver, rings[0].decision_step)))
    each = [episode.speeds[1:].mean(1).reshape(-1, SECOND).mean(1) for episode in found.episodes]
    after = replace(change.ring, humans=change.humans)
    limits = [after.limit(episode.drawn[after.size]) for episode in found.episodes]
    return {"limits": limits, "speeds": [values.round(4).tolist() for values in each]}


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    parts = {
        f"{number}-{place}": (_driven, (name, driver))
        for number, name in enumerate(CHANGES)
        for place, driver in enumerate(DRIVERS.values())
    }
    measure_parts(folder, parts, workers)
    write_whole(folder / "adaptation.png", png_bytes(picture(folder)))


def measured(folder: Path, name: str, label: str) -> dict[str, Floats]:
    """Return what was measured of a driver where something changes [m/s].

    `speeds` of all in the mean, shape (episodes, seconds), and `limits`, shape (episodes,).
    """
    number, place = list(CHANGES).index(name), list(DRIVERS).index(label)
    return {key: np.array(found) for key, found in read_part(folder, f"{number}-{place}").items()}


def settled_after(speeds: Floats, limits: Floats) -> Floats:
    """Return how long after the change everybody's mean speed has settled [s], shape (episodes,).

    It has, once its mean over ten seconds stays at `SETTLED` or more of the limit for at least a minute until
    the end; NaN where it never does.
    """
    found = []
    for values, limit in zip(speeds, limits, strict=True):
        low = np.flatnonzero(_smooth(values[CHANGE // SECOND :]) < SETTLED * limit)
        after = float(low[-1] + 1 if len(low) else 0)
        found.append(after if CHANGE // SECOND + after <= speeds.shape[1] - LAST else np.nan)
    return np.array(found)


def _smooth(values: Floats) -> Floats:
    return np.convolve(values, np.ones(SMOOTHED) / SMOOTHED, "valid")


def table(name: str, folder: Path) -> pd.DataFrame:
    """Return how fast everybody drives before and after a change, and how soon that is so."""
    rows = []
    for label in DRIVERS:
        found, at = measured(folder, name, label), CHANGE // SECOND
        speeds, after = found["speeds"], settled_after(**found)
        settled, slowest = np.isfinite(after), [_smooth(values[at:]).min() for values in speeds]
        median = np.median(np.where(settled, after, np.inf))  # of all: who never settles is the last
        rows.append(
            {
                "": label,
                "before [m/s]": _cell(speeds[:, at - LAST : at].mean(1)),
                "slowest ten seconds after [m/s]": _cell(np.array(slowest)),
                "last minute [m/s]": _cell(speeds[:, -LAST:].mean(1)),
                "settled": f"{settled.sum()} of {len(after)}",
                "after, in the median [s]": f"{median:.0f}" if np.isfinite(median) else "–",
            }
        )
    return pd.DataFrame(rows)


def _cell(values: Floats) -> str:
    return str(cell_of(estimate(values.tolist()), 2))


@rc_context(STYLE)
def picture(folder: Path) -> Figure:
    """Return everybody's mean speed over time, the mean of all episodes and the middle half of them."""
    figure = new_figure(2.4 * len(CHANGES))
    panels = figure.subplots(len(CHANGES), 1, sharex=True)
    for axes, name in zip(panels, CHANGES, strict=True):
        axes.set_title(f"{name} after {CHANGE // SECOND} s")
        for label, colour in zip(DRIVERS, LINES, strict=False):
            speeds = measured(folder, name, label)["speeds"]
            low, high = np.quantile(speeds, (0.25, 0.75), axis=0)
            seconds = np.arange(speeds.shape[1])
            axes.plot(seconds, speeds.mean(0), color=colour, label=label)
            axes.fill_between(seconds, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.axvline(CHANGE / SECOND, color=MUTED, linestyle=":")
        axes.set_ylabel("mean speed [m/s]")
    panels[0].legend(ncols=len(DRIVERS), loc="lower right")
    panels[-1].set_xlabel("time [s]")
    return figure


ADAPTATION = Study(
    title="how soon drivers settle where the road changes while they drive",
    runs=lambda seeds: [],
    write=_write,
    minutes=10.0,
    goes_on=True,
    tables={name: partial(table, name) for name in CHANGES},
)
