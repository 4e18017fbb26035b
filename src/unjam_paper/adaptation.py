"""Time until traffic on a ring settles after a change of which the drivers are not informed."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.controller import make_driver
from unjam.drivers.command import Command
from unjam.drivers.safety import INSTANT_ACTUATOR
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.physics.arrays import Array, Floats, clamp_min
from unjam.physics.idm import PAPER_IDM, IDMParameters, idm_acceleration
from unjam.reports.figures import LINE_COLORS, MUTED_COLOR, PLOT_STYLE, new_figure
from unjam.road_family import AGGRESSIVE_IDM, SHORT_WARM_UP
from unjam.scenarios.ring import Ring
from unjam.seeds import held_out_seeds
from unjam.worlds.batch.human_idm import Leader
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.drive import finish_drive
from unjam_paper.all_roads import PI_ON_RINGS_LABEL, PI_TUNED_ON_RINGS
from unjam_paper.results_file import read_part
from unjam_paper.study import NO_VALUE_TEXT, Study, mean_text

ADAPTATION_EPISODES = 20
STEPS_PER_SECOND = 10
CHANGE_STEP, END_STEP = 3000, 7200
"""control steps of the change and of the end of an episode"""
CHANGE_SECOND = CHANGE_STEP // STEPS_PER_SECOND
WAVE_BRAKING, WAVE_SPEED, WAVE_STEPS = 2.0, 0.5, 200
"""braking [m/s2], lowest speed [m/s] and number of control steps of a vehicle that causes a wave"""
SMOOTHING_SECONDS, FINAL_SECONDS = 10, 60
"""durations of averages of the mean speed [s]: for the settling time, and at the end of an episode"""
SETTLED_SHARE = 0.95
"""smallest mean speed of settled traffic, as a share of the limit speed of the ring"""
ADAPTATION_DRIVERS = {
    **{HUMAN_LABEL: "human", PI_ON_RINGS_LABEL: PI_TUNED_ON_RINGS},
    **{"FollowerStopper": "follower-stopper", "unjam:best": "unjam:best"},
}


class ChangingRings(RingBatch):
    """Rings with a change in control step `CHANGE_STEP`."""

    humans_after: ClassVar[IDMParameters] = PAPER_IDM
    """parameters of the human drivers after the change"""

    @property
    def has_changed(self) -> bool:
        """Whether the change has happened."""
        return self.control_steps >= CHANGE_STEP


class WaveArrives(ChangingRings):
    """The vehicle half a ring ahead of the first CAV brakes, and drives slowly for twenty seconds."""

    def _human_speeds(self, speed: Array, leader: Leader) -> Array:
        speeds = super()._human_speeds(speed, leader)
        if self.has_changed and self.control_steps < CHANGE_STEP + WAVE_STEPS:
            index = (self._cav_indices[0] + len(speed) // 2) % len(speed)
            slow = clamp_min(speed[index] - WAVE_BRAKING * self.scenario.simulation_step, WAVE_SPEED)
            speeds[index] = np.minimum(speeds[index], slow)
        return speeds


class HumansChange(ChangingRings):
    """Human drivers follow at smaller gaps, accelerate faster and brake harder after the change."""

    humans_after = replace(PAPER_IDM, **AGGRESSIVE_IDM)

    def _human_speeds(self, speed: Array, leader: Leader) -> Array:
        if self.has_changed:
            self._human_parameters = self.humans_after
        return super()._human_speeds(speed, leader)


class CAVSwitchesOff(ChangingRings):
    """After the change the last CAV drives as human drivers do, within the limits for commands of CAVs."""

    def advance(self, command: Command | None) -> None:
        """Simulate one control step."""
        if command is not None and self.has_changed:
            state = self.local_state()
            is_off = np.arange(self.cav_count) >= self.cav_count - len(self.roads)
            human = idm_acceleration(state.speed, state.leader_speed, state.leader_gap, self.scenario.humans)
            command = command._replace(acceleration=np.where(is_off, human, command.acceleration))
        super().advance(command)


ROAD_CHANGES: dict[str, tuple[Ring, type[ChangingRings]]] = {
    "a wave arrives": (Ring(horizon=END_STEP, actuator=INSTANT_ACTUATOR), WaveArrives),
    "human drivers change": (Ring(horizon=END_STEP, warmup=SHORT_WARM_UP, actuator=INSTANT_ACTUATOR), HumansChange),
    "one of two CAVs switches off": (
        Ring(length=(440, 540), vehicles=44, cavs=2, horizon=END_STEP, warmup=SHORT_WARM_UP, actuator=INSTANT_ACTUATOR),
        CAVSwitchesOff,
    ),
}


def _measure_speeds(name: str, driver: str, workers: int) -> dict[str, list[Any]]:
    """Return the mean speed of all vehicles in each second and the limit speed after the change, by episode [m/s]."""
    ring, batch_class = ROAD_CHANGES[name]
    rings = [ring.stratum(index, ADAPTATION_EPISODES) for index in range(ADAPTATION_EPISODES)]
    batch = batch_class(rings, held_out_seeds(ADAPTATION_EPISODES))
    episodes = finish_drive(start_batch_drive(batch, make_driver(driver, ring.control_step)))
    speeds = [episode.speeds[1:].mean(1).reshape(-1, STEPS_PER_SECOND).mean(1) for episode in episodes]
    changed_ring = replace(ring, humans=batch_class.humans_after)
    limits = [changed_ring.limit_speed(episode.drawn_values[ring.size_parameter]) for episode in episodes]
    return {"limits": limits, "speeds": [values.round(2).tolist() for values in speeds]}


def read_speeds(folder: Path, name: str, label: str) -> dict[str, Floats]:
    """Return the speeds of a driver at a change: `speeds` (episodes, seconds) and `limits` (episodes,) [m/s]."""
    part = f"{list(ROAD_CHANGES).index(name)}-{list(ADAPTATION_DRIVERS).index(label)}"
    return {key: np.array(values) for key, values in read_part(folder, part).items()}


def settling_times(speeds: Floats, limits: Floats) -> Floats:
    """Return the times until the moving average of speeds stays above a share of `limits`, shape (episodes,) [s].

    NaN for episodes in which the average is below `SETTLED_SHARE` of the limit in the last minute.
    """
    times = []
    for values, limit in zip(speeds, limits, strict=True):
        unsettled = np.flatnonzero(_moving_average(values[CHANGE_SECOND:]) < SETTLED_SHARE * limit)
        time = float(unsettled[-1] + 1 if len(unsettled) else 0)
        times.append(time if CHANGE_SECOND + time <= speeds.shape[1] - FINAL_SECONDS else np.nan)
    return np.array(times)


def _moving_average(values: Floats) -> Floats:
    return np.convolve(values, np.ones(SMOOTHING_SECONDS) / SMOOTHING_SECONDS, "valid")


def adaptation_table(name: str, folder: Path) -> pd.DataFrame:
    """Return the mean speeds before and after a change and the settling time of each driver."""
    rows = []
    for label in ADAPTATION_DRIVERS:
        results = read_speeds(folder, name, label)
        speeds, times = results["speeds"], settling_times(**results)
        slowest = np.array([_moving_average(values[CHANGE_SECOND:]).min() for values in speeds])
        median = np.median(np.where(np.isfinite(times), times, np.inf))  # episodes that never settle come last
        speeds_before = speeds[:, CHANGE_SECOND - FINAL_SECONDS : CHANGE_SECOND]
        row = {"": label, "before [m/s]": mean_text(speeds_before.mean(1), 2)}
        row |= {"slowest ten seconds after [m/s]": mean_text(slowest, 2)}
        row |= {"last minute [m/s]": mean_text(speeds[:, -FINAL_SECONDS:].mean(1), 2)}
        row |= {"settled": f"{np.isfinite(times).sum()} of {len(times)}"}
        rows.append({**row, "after, median [s]": f"{median:.0f}" if np.isfinite(median) else NO_VALUE_TEXT})
    return pd.DataFrame(rows)


@rc_context(PLOT_STYLE)
def adaptation_figure(folder: Path) -> Figure:
    """Draw the mean speed of all vehicles over time: mean and interquartile range over the episodes."""
    figure = new_figure(2.4 * len(ROAD_CHANGES))
    panels = figure.subplots(len(ROAD_CHANGES), 1, sharex=True)
    for axes, name in zip(panels, ROAD_CHANGES, strict=True):
        for label, color in zip(ADAPTATION_DRIVERS, LINE_COLORS, strict=False):
            speeds = read_speeds(folder, name, label)["speeds"]
            low, high = np.quantile(speeds, (0.25, 0.75), axis=0)
            seconds = np.arange(speeds.shape[1])
            axes.plot(seconds, speeds.mean(0), color=color, label=label)
            axes.fill_between(seconds, low, high, color=color, alpha=0.15, linewidth=0)
        axes.axvline(CHANGE_STEP / STEPS_PER_SECOND, color=MUTED_COLOR, linestyle=":")
        axes.set(title=f"{name} after {CHANGE_SECOND} s", ylabel="mean speed [m/s]")
    panels[0].legend(ncols=len(ADAPTATION_DRIVERS), loc="lower right")
    panels[-1].set_xlabel("time [s]")
    return figure


ADAPTATION = Study(
    title="time until traffic settles after a change of the road",
    make_parts=lambda study_folder, seeds: {
        f"{change_index}-{driver_index}": (_measure_speeds, (name, driver))
        for change_index, name in enumerate(ROAD_CHANGES)
        for driver_index, driver in enumerate(ADAPTATION_DRIVERS.values())
    },
    minutes=10.0,
    tables={name: partial(adaptation_table, name) for name in ROAD_CHANGES},
    figures={"adaptation": adaptation_figure},
)
