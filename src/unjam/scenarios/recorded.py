"""The recorded road: a platoon on one lane behind a vehicle that repeats the recorded speeds of a real vehicle.

Source: Lichtlé et al. 2022, Deploying traffic smoothing cruise controllers learned from trajectory data, ICRA; the
usual recordings are the drives on I-24 of that experiment.
"""

import re
from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property
from math import ceil, floor, nan
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from unjam.drivers.command import Limits
from unjam.drivers.safety import STANDARD_ACTUATOR, Actuator
from unjam.errors import InputError
from unjam.parameters import STRICT, NonNegative, Positive, parameter_dataclass
from unjam.physics.arrays import Floats
from unjam.physics.idm import IDMParameters, equilibrium_gap
from unjam.recordings.leaders import LeaderRecording, recording_files
from unjam.scenarios.road import Edge, Entry, Node, RecordedRoad, Road, RoadNetwork, Route
from unjam.scenarios.scenario import VEHICLE_LENGTH, Horizon, Scenario
from unjam.text import format_count, shorten_list

LEADER_ID = "leader"
EDGE_NAME = "road"
MAX_RECORDED_SPEED = 70.0
"""largest recorded speed [m/s]"""
ROAD_LENGTH_STEP = 5000.0
"""step of the lengths of roads, so that few different networks are built [m]"""
MAX_FREE_SPEED_SHARE = 0.95
"""largest start speed / desired speed; at the desired speed itself the IDM's equilibrium gap is infinite"""
MAX_VEHICLES = 1000
ARTIFICIAL_SECONDS = 600.0
ARTIFICIAL_STEP = 0.1
ARTIFICIAL_SPEEDS, ARTIFICIAL_PERIODS = (6.0, 20.0), (40.0, 200.0)
"""ranges of the mean speed [m/s] and of the periods [s] of artificial waves"""


@parameter_dataclass(frozen=True, config=STRICT)
class Recorded(Scenario):
    """A platoon on one lane behind a vehicle that repeats recorded speeds; each episode draws a recording.

    The recorded vehicle does not react, and vehicles do not change lanes. All vehicles start with its speed and the
    IDM's equilibrium gaps. Without recordings, the first vehicle drives through artificial waves.
    """

    title: ClassVar[str] = "recorded"
    reward: ClassVar[str] = "fuel"
    controller: ClassVar[str] = "unjam:recorded-tuned"
    is_closed: ClassVar[bool] = False
    size_parameter: ClassVar[str] = "recordings"
    """the parameter in which the roads of a batch may differ"""

    recordings: str = ""
    """a file with speeds, a folder of them, or a pattern like `drives/2021-03*`, see `unjam.recordings.leader_files`;
    empty: artificial waves"""
    order: Literal["random", "name"] = "random"
    """order in which episodes with consecutive seeds use the files; each file is used once before any is repeated"""
    platoon: str = "cav human*5"
    """vehicles behind the recorded vehicle, from front to back, like `human*2 cav human*20`"""
    begin: NonNegative = 0.0
    """time in the recording at which an episode begins [s]"""
    window: NonNegative = 0.0
    """duration of the random part of a recording that an episode uses [s]; 0: the whole recording"""
    horizon: Horizon = 20_000
    """maximum number of control steps in an episode; an episode also ends with its recording"""
    action_limit: Positive = 3.0
    """strongest braking that a CAV can command [m/s2]"""
    max_acceleration: Positive = 1.5
    """largest acceleration that a CAV can command [m/s2]"""
    actuator: Actuator = STANDARD_ACTUATOR
    humans: IDMParameters = field(
        default_factory=lambda: IDMParameters(
            desired_speed=45.0, max_acceleration=1.3, comfortable_deceleration=2.0, time_headway=1.0
        )
    )
    """parameters of human drivers, as in the source of this road"""
    noise: NonNegative = 0.3

    @model_validator(mode="after")
    def _check_settings(self) -> Self:
        kinds = self.vehicle_kinds
        if self.warmup:
            raise ValueError(f"warmup: {self.warmup} is not allowed on a recorded road; allowed: 0")
        if not self.cavs or len(kinds) > MAX_VEHICLES:
            allowed = f"at least one cav, and <= {MAX_VEHICLES} vehicles"
            raise ValueError(f"platoon: {self.platoon!r} is not allowed; allowed: {allowed}")
        try:
            _ = self.user_files
        except InputError as error:
            raise ValueError(str(error)) from None
        return self

    @cached_property
    def vehicle_kinds(self) -> tuple[str, ...]:
        """`cav` or `human` for each vehicle behind the recorded vehicle, from front to back."""
        kinds = list[str]()
        for group in self.platoon.split():
            match = re.fullmatch(r"(cav|human)(?:\*([1-9]\d{0,3}))?", group)
            if match is None:
                raise ValueError(f"platoon: {group!r} is not allowed; allowed: cav, human, cav*2, human*5, ...")
            kinds += [match[1]] * int(match[2] or 1)
        return tuple(kinds)

    @property
    def cavs(self) -> int:
        """Number of CAVs."""
        return self.vehicle_kinds.count("cav")

    @property
    def max_episode_steps(self) -> int:
        """Control steps of the window, or of the longest recording after `begin`; at most the horizon."""
        seconds = self.window or self._longest_recording - self.begin
        return min(self.horizon, max(1, floor(seconds / self.control_step + 1e-9)))

    @cached_property
    def _longest_recording(self) -> float:
        return max(leader.seconds for leader in self._recordings) if self.recordings else ARTIFICIAL_SECONDS

    @property
    def max_leader_speed(self) -> float:
        """Largest speed of all recordings [m/s]; 0 without recordings."""
        return float(max(leader.speed.max() for leader in self._recordings)) if self.recordings else 0.0

    @cached_property
    def _recordings(self) -> list[LeaderRecording]:
        from unjam.recordings.leader_files import read_leaders

        files, recordings, messages = recording_files(Path(self.recordings)), list[LeaderRecording](), dict[str, str]()
        for path in files:
            try:
                recordings += read_leaders(path)
            except InputError as error:
                messages[path.name] = str(error)
        if messages:
            first_file, *other_files = messages
            also_refused = f"; also refused: {shorten_list(other_files)}" if other_files else ""
            hint = "; move it elsewhere, or select other files by a pattern like 'drives/2021-03*'"
            raise InputError(f"{messages[first_file]}{also_refused}{hint if len(files) > 1 else ''}")
        return recordings

    @property
    def acceleration_limits(self) -> Limits:
        """Accelerations that a CAV can command."""
        return Limits(-self.action_limit, self.max_acceleration)

    @property
    def user_files(self) -> list[Path]:
        """The files with the recordings and the calibrated drivers."""
        return [*(recording_files(Path(self.recordings)) if self.recordings else []), *super().user_files]

    @property
    def top_speed(self) -> float:
        """Speed limit of the road [m/s]: above all recorded speeds and desired speeds."""
        return max(MAX_RECORDED_SPEED, super().top_speed)

    @property
    def provided_fields(self) -> tuple[str, ...]:
        """Optional fields of a `LocalState` that this road provides."""
        return ("penetration_rate",)

    @property
    def notes(self) -> list[str]:
        """The recordings, and the limits of a replay."""
        source = self._recordings_note() if self.recordings else "artificial waves; --recordings names a recording"
        return [source, "the recorded vehicle does not react, and vehicles do not change lanes"]

    def _recordings_note(self) -> str:
        """Return a summary of the recordings, in which wrong units and gaps in time are visible."""
        path, files, parts = Path(self.recordings), recording_files(Path(self.recordings)), self._recordings
        seconds, speeds = [part.seconds for part in parts], np.concatenate([part.speed for part in parts])
        source = path.name if path.is_file() else f"{format_count(len(files), 'file')} of {path.name}"
        count = f"{format_count(len(parts), 'part')} of {min(seconds):.0f} to " if len(parts) > 1 else ""
        text = f"{count}{max(seconds):.0f} s with speeds of {speeds.min():.1f} to {speeds.max():.1f} m/s"
        order_text = {"random": ", drawn at random", "name": ", in the order of their names"}[self.order]
        return f"recordings: {source}: {text}{order_text if len(files) > 1 else ''}"

    @property
    def training_notes(self) -> list[str]:
        """A note on the recordings of the test seeds."""
        if not self.recordings:
            return []
        return ["test seeds use the recordings of the training; for others: drive recorded --recordings FOLDER -d RUN"]

    def stratum(self, index: int, count: int) -> Self:
        """Return this road with the recordings of one of `count` equal parts, if there are as many files."""
        if not self.recordings or len(files := recording_files(Path(self.recordings))) < count:
            return self
        return replace(self, recordings=str(files[index * len(files) // count]))

    def draw_from_seed(self, seed: Sequence[int]) -> tuple[Road, Sequence[np.random.SeedSequence]]:
        """Return the road of an episode's seed; the last index of the seed selects the file."""
        files = recording_files(Path(self.recordings)) if self.recordings else []
        if len(files) < 2:
            return super().draw_from_seed(seed)
        index = seed[-1] % len(files)
        if self.order == "random":
            index = int(np.random.default_rng([len(files), *seed[:-1]]).permutation(len(files))[index])
        road, seeds = replace(self, recordings=str(files[index])).draw_from_seed(seed)
        return replace(road, drawn_values={**road.drawn_values, "file": float(index)}), seeds

    def draw(self, generator: np.random.Generator) -> RecordedRoad:
        """Return the road with the speeds of a random recording, or of a random part of it."""
        indices, recording = self._draw_recording(generator)
        available = recording.seconds - self.begin
        if available < self.control_step:
            raise InputError(
                f"begin: {self.begin:g} s is not allowed; allowed: < {recording.seconds:g} s, the duration of "
                f"{recording.name}"
            )
        begin, seconds = self.begin, min(available, self.horizon * self.control_step)
        if self.window > available:
            raise InputError(
                f"window: {self.window:g} s is not allowed; allowed: <= {available:g} s, the duration of "
                f"{recording.name} after begin"
            )
        if self.window:
            begin += float(generator.uniform(0.0, available - self.window))
            seconds = min(self.window, seconds)
        speeds = recording.speeds_at(begin, seconds, self.simulation_step)
        return self.build(speeds, {**indices, "begin": begin}, generator)

    def build(self, speeds: Floats, drawn_values: dict[str, float], generator: np.random.Generator) -> RecordedRoad:
        """Return the road behind a vehicle with `speeds` at the start and after each step [m/s], shape (S + 1,)."""
        vehicle_ids = (*self._platoon_ids(), LEADER_ID)
        human_parameters, speed = self.draw_humans(vehicle_ids, generator), float(speeds[0])
        humans = [human_parameters.get(vehicle_id, self.humans) for vehicle_id in vehicle_ids[:-1]]
        start_speeds = [min(speed, MAX_FREE_SPEED_SHARE * human.desired_speed) for human in humans]
        spaces = [VEHICLE_LENGTH + gap for gap in map(equilibrium_gap, start_speeds, humans)]
        positions = VEHICLE_LENGTH + np.concatenate([[0.0], np.cumsum(spaces)])
        distance = float(positions[-1] + speeds.sum() * self.simulation_step)
        length = ROAD_LENGTH_STEP * ceil(distance / ROAD_LENGTH_STEP + 0.5)
        nodes = Node("begin", 0.0, 0.0), Node("end", length, 0.0)
        return RecordedRoad(
            network=RoadNetwork(nodes, (Edge(EDGE_NAME, "begin", "end", length),), self.top_speed),
            routes=(Route(EDGE_NAME, (EDGE_NAME,)),),
            entries=tuple(
                Entry(name, EDGE_NAME, position) for name, position in zip(vehicle_ids, positions.tolist(), strict=True)
            ),
            has_entry_checks=False,
            vehicle_ids=vehicle_ids,
            cav_ids=self.possible_cav_ids(),
            start_positions=positions,
            replayed_speeds=speeds,
            limit_speed=nan,
            drawn_values=drawn_values,
            human_parameters=human_parameters,
        )

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids of the CAVs, in their order along the road."""
        return tuple(vehicle_id for vehicle_id in self._platoon_ids() if vehicle_id.startswith("cav"))

    def _platoon_ids(self) -> tuple[str, ...]:
        """Return the ids of the vehicles behind the recorded vehicle, in their order along the road."""
        return tuple(f"{kind}_{index}" for index, kind in enumerate(self.vehicle_kinds))[::-1]

    def _draw_recording(self, generator: np.random.Generator) -> tuple[dict[str, float], LeaderRecording]:
        """Return the indices of a random file and of a random part of this file, and that part as a recording."""
        if not self.recordings:
            return {}, artificial_waves(generator)
        from unjam.recordings.leader_files import read_leaders  # pandas takes half a second

        files = recording_files(Path(self.recordings))
        file_index = int(generator.integers(len(files)))
        parts = read_leaders(files[file_index])
        part_index = int(generator.integers(len(parts)))
        return {"file": float(file_index), "part": float(part_index)}, parts[part_index]

    def _summary_texts(self) -> tuple[str, str, str, str]:
        source = f"recordings of {self.recordings}" if self.recordings else "artificial waves"
        road = f"one lane behind a vehicle with the speeds of {source}"
        return road, f"{len(self.vehicle_kinds)} ({self.cavs} CAV)", "that vehicle's", "the mean speed of that vehicle"


def artificial_waves(generator: np.random.Generator) -> LeaderRecording:
    """Return the speeds of a vehicle in stop-and-go waves: three sinusoids of random periods around a random mean."""
    times = ARTIFICIAL_STEP * np.arange(round(ARTIFICIAL_SECONDS / ARTIFICIAL_STEP) + 1)
    mean, periods = generator.uniform(*ARTIFICIAL_SPEEDS), generator.uniform(*ARTIFICIAL_PERIODS, 3)
    phases = generator.uniform(0.0, 2.0 * np.pi, 3)
    waves = np.sin(2.0 * np.pi * times[:, None] / periods + phases) * generator.uniform(0.1, 0.5, 3) * mean
    return LeaderRecording("artificial waves", ARTIFICIAL_STEP, np.maximum(mean + waves.sum(1), 0.0))
