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
from unjam.files import atomic_write
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.statistics import estimate
from unjam.physics.arrays import Array, Floats, clamp_min
from unjam.physics.idm import PAPER_IDM, IDMParameters, idm_acceleration
from unjam.reports.figures import LINE_COLORS, MUTED_COLOR, PLOT_STYLE, new_figure, png_bytes
from unjam.scenarios.ring import Ring
from unjam.training.road_family import AGGRESSIVE_IDM, SHORT_WARM_UP
from unjam.training.seeds import make_test_seeds
from unjam.worlds.batch.leaders import Leader
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.drive import finish_drive
from unjam_paper.all_roads import PI_TUNED_ON_RINGS
from unjam_paper.parts import measure_parts
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, StudyFolder

ADAPTATION_EPISODES = 20
CHANGE_STEP, END_STEP = 3000, 7200
"""decision in which the road changes, and the last one, of 0.1 s each"""
WAVE_BRAKING, WAVE_SPEED, WAVE_STEPS = 2.0, 0.5, 200
"""how somebody makes a wave: braking [m/s2] to a speed [m/s], for so many decisions"""
STEPS_PER_SECOND = 10
"""decisions of a second"""
SMOOTHING_SECONDS, FINAL_SECONDS = 10, 60
"""seconds over which a mean speed is taken: to see whether it has settled, and in the end"""
SETTLED_SHARE = 0.95
"""share of what the road allows that counts as settled once it is kept"""
ADAPTATION_DRIVERS = {
    HUMAN_LABEL: "human",
    "PI, tuned on the rings": PI_TUNED_ON_RINGS,
    "FollowerStopper": "follower-stopper",
    "unjam:best": "unjam:best",
}


HURRIED_IDM = replace(PAPER_IDM, **AGGRESSIVE_IDM)


class ChangingRings(RingBatch):
    """Rings on which something happens in decision `CHANGE`."""

    @property
    def has_changed(self) -> bool:
        """Whether it has happened."""
        return self.control_steps >= CHANGE_STEP


class WaveArrives(ChangingRings):
    """Halfway round from the first CAV somebody brakes, and crawls for twenty seconds."""

    def _human_speeds(self, speed: Array, leader: Leader) -> Array:
        """Return the speeds after this step of all vehicles, if people drive them."""
        found = super()._human_speeds(speed, leader)
        if self.has_changed and self.control_steps < CHANGE_STEP + WAVE_STEPS:
            place = (self._cav_indices[0] + len(speed) // 2) % len(speed)
            crawls = clamp_min(speed[place] - WAVE_BRAKING * self.scenario.simulation_step, WAVE_SPEED)
            found[place] = np.minimum(found[place], crawls)
        return found


class HumansChange(ChangingRings):
    """People follow closer, accelerate and brake harder from then on."""

    def _human_speeds(self, speed: Array, leader: Leader) -> Array:
        """Return the speeds after this step of all vehicles, if people drive them."""
        if self.has_changed:
            self._human_parameters = HURRIED_IDM
        return super()._human_speeds(speed, leader)


class CAVSwitchesOff(ChangingRings):
    """The last CAV drives as people do from then on, within what a CAV may command."""

    def advance(self, command: Command | None) -> None:
        """Simulate one decision."""
        if command is not None and self.has_changed:
            seen = self.local_state()
            rows = np.arange(self.cav_count) >= self.cav_count - len(self.roads)
            alone = idm_acceleration(seen.speed, seen.leader_speed, seen.leader_gap, self.scenario.humans)
            command = command._replace(acceleration=np.where(rows, alone, command.acceleration))
        super().advance(command)


@dataclass(frozen=True)
class RoadChange:
    """Something that happens on a road."""

    ring: Ring
    world: type[ChangingRings]
    humans: IDMParameters = PAPER_IDM
    """how people drive afterwards"""


ROAD_CHANGES: dict[str, RoadChange] = {
    "a wave arrives": RoadChange(Ring(horizon=END_STEP), WaveArrives),
    "people change": RoadChange(Ring(horizon=END_STEP, warmup=SHORT_WARM_UP), HumansChange, HURRIED_IDM),
    "a CAV of two leaves": RoadChange(
        Ring(length=(440, 540), vehicles=44, cavs=2, horizon=END_STEP, warmup=SHORT_WARM_UP), CAVSwitchesOff
    ),
}
"""by name"""


def _measure_speeds(name: str, driver: str) -> dict[str, list[Any]]:
    """Return the mean speed of all over each second, and the limit after the change, by episode [m/s]."""
    change = ROAD_CHANGES[name]
    rings = [change.ring.stratum(number, ADAPTATION_EPISODES) for number in range(ADAPTATION_EPISODES)]
    world = change.world(rings, make_test_seeds(ADAPTATION_EPISODES))
    found = finish_drive(start_batch_drive(world, make_driver(driver, rings[0].control_step)))
    each = [episode.speeds[1:].mean(1).reshape(-1, STEPS_PER_SECOND).mean(1) for episode in found.episodes]
    after = replace(change.ring, humans=change.humans)
    limits = [after.limit_speed(episode.drawn[after.size_parameter]) for episode in found.episodes]
    return {"limits": limits, "speeds": [values.round(4).tolist() for values in each]}


def _write_adaptation(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    parts = {
        f"{number}-{place}": (_measure_speeds, (name, driver))
        for number, name in enumerate(ROAD_CHANGES)
        for place, driver in enumerate(ADAPTATION_DRIVERS.values())
    }
    measure_parts(folder, parts, workers)
    atomic_write(folder / "adaptation.png", png_bytes(adaptation_figure(folder)))


def read_speeds(folder: Path, name: str, label: str) -> dict[str, Floats]:
    """Return what was measured of a driver where something changes [m/s].

    `speeds` of all in the mean, shape (episodes, seconds), and `limits`, shape (episodes,).
    """
    number, place = list(ROAD_CHANGES).index(name), list(ADAPTATION_DRIVERS).index(label)
    return {key: np.array(found) for key, found in read_part(folder, f"{number}-{place}").items()}


def settling_times(speeds: Floats, limits: Floats) -> Floats:
    """Return how long after the change everybody's mean speed has settled [s], shape (episodes,).

    It has, once its mean over ten seconds stays at `SETTLED` or more of the limit for at least a minute until
    the end; NaN where it never does.
    """
    found = []
    for values, limit in zip(speeds, limits, strict=True):
        low = np.flatnonzero(_moving_average(values[CHANGE_STEP // STEPS_PER_SECOND :]) < SETTLED_SHARE * limit)
        after = float(low[-1] + 1 if len(low) else 0)
        found.append(after if CHANGE_STEP // STEPS_PER_SECOND + after <= speeds.shape[1] - FINAL_SECONDS else np.nan)
    return np.array(found)


def _moving_average(values: Floats) -> Floats:
    return np.convolve(values, np.ones(SMOOTHING_SECONDS) / SMOOTHING_SECONDS, "valid")


def adaptation_table(name: str, folder: Path) -> pd.DataFrame:
    """Return how fast everybody drives before and after a change, and how soon that is so."""
    rows = []
    for label in ADAPTATION_DRIVERS:
        found, at = read_speeds(folder, name, label), CHANGE_STEP // STEPS_PER_SECOND
        speeds, after = found["speeds"], settling_times(**found)
        settled, slowest = np.isfinite(after), [_moving_average(values[at:]).min() for values in speeds]
        median = np.median(np.where(settled, after, np.inf))  # of all: who never settles is the last
        rows.append(
            {
                "": label,
                "before [m/s]": _mean_cell(speeds[:, at - FINAL_SECONDS : at].mean(1)),
                "slowest ten seconds after [m/s]": _mean_cell(np.array(slowest)),
                "last minute [m/s]": _mean_cell(speeds[:, -FINAL_SECONDS:].mean(1)),
                "settled": f"{settled.sum()} of {len(after)}",
                "after, in the median [s]": f"{median:.0f}" if np.isfinite(median) else "–",
            }
        )
    return pd.DataFrame(rows)


def _mean_cell(values: Floats) -> str:
    return str(estimate_cell(estimate(values.tolist()), 2))


@rc_context(PLOT_STYLE)
def adaptation_figure(folder: Path) -> Figure:
    """Return everybody's mean speed over time, the mean of all episodes and the middle half of them."""
    figure = new_figure(2.4 * len(ROAD_CHANGES))
    panels = figure.subplots(len(ROAD_CHANGES), 1, sharex=True)
    for axes, name in zip(panels, ROAD_CHANGES, strict=True):
        axes.set_title(f"{name} after {CHANGE_STEP // STEPS_PER_SECOND} s")
        for label, colour in zip(ADAPTATION_DRIVERS, LINE_COLORS, strict=False):
            speeds = read_speeds(folder, name, label)["speeds"]
            low, high = np.quantile(speeds, (0.25, 0.75), axis=0)
            seconds = np.arange(speeds.shape[1])
            axes.plot(seconds, speeds.mean(0), color=colour, label=label)
            axes.fill_between(seconds, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.axvline(CHANGE_STEP / STEPS_PER_SECOND, color=MUTED_COLOR, linestyle=":")
        axes.set_ylabel("mean speed [m/s]")
    panels[0].legend(ncols=len(ADAPTATION_DRIVERS), loc="lower right")
    panels[-1].set_xlabel("time [s]")
    return figure


ADAPTATION = Study(
    title="how soon drivers settle where the road changes while they drive",
    make_runs=lambda seeds: [],
    write=_write_adaptation,
    minutes=10.0,
    is_resumable=True,
    tables={name: partial(adaptation_table, name) for name in ROAD_CHANGES},
)
