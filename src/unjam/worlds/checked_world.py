"""Checks of a user's backend: errors name its file, and its states and records must be finite and consistent."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from traceback import walk_tb
from typing import Any

import numpy as np

from unjam.drivers.command import Command
from unjam.drivers.local_state import COMMON_FIELDS, FIELD_SIZES, LocalState
from unjam.drivers.user_driver import object_reference
from unjam.errors import InputError, UnjamError
from unjam.processes import ForkGuard
from unjam.scenarios.scenario import Scenario
from unjam.user_code import USER_MODULE_PREFIX
from unjam.worlds.audit import OVERRIDE_TOLERANCE
from unjam.worlds.record import Episode, Trajectory
from unjam.worlds.world import DriverLog

COMMAND_TOLERANCE = 0.01
"""largest difference of commanded and actual acceleration that does not count as an override [m/s2]"""
DISTANCE_TOLERANCE = 1.0, 0.02
"""allowed difference between a distance and the sum of the speeds: [m], and relative to the distance"""
STATE_TOLERANCE = 0.05
"""allowed difference between the last recorded and the last measured state [m, m/s]"""


def backend_label(backend: Any) -> str:
    """Return a given name of a backend; for an object or a class its label, or `path.py:name` without folders."""
    if isinstance(backend, str):
        return backend
    backend_class = backend if isinstance(backend, type) else type(backend)
    path, _, name = object_reference(backend_class).rpartition(":")
    return getattr(backend_class, "label", "") or (f"{Path(path).name}:{name}" if path else backend_class.__name__)


def call_backend(label: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a function of a user's backend; its errors become `InputError` with their line of code."""
    try:
        with ForkGuard():
            return function(*arguments)
    except UnjamError:
        raise
    except (Exception, SystemExit) as error:
        frames = [
            (Path(frame.f_code.co_filename).name, line)
            for frame, line in walk_tb(error.__traceback__)
            if str(frame.f_globals.get("__name__")).startswith(USER_MODULE_PREFIX)
        ]
        location = " ({}, line {})".format(*frames[-1]) if frames else ""
        raise InputError(f"backend: {label}: {type(error).__name__}: {error}{location}") from error


class CheckedWorld:
    """A world of a user's backend with checks of its states, speeds and record."""

    def __init__(self, world: Any, label: str, scenario: Scenario) -> None:
        self._world, self._label, self._scenario = world, label, scenario
        may_be_nan = set[str]() if scenario.is_closed else {"loop_length"}
        may_be_nan |= set() if scenario.has_route_position else {"route_position"}
        self._finite_fields = set(COMMON_FIELDS) - may_be_nan
        self._step_count = 0

    def __getattr__(self, name: str) -> Any:
        value = call_backend(self._label, getattr, self._world, name)
        return partial(call_backend, self._label, value) if callable(value) else value

    def local_state(self) -> LocalState:
        """Return the state that the CAVs observe now."""
        return self._check_state(self.__getattr__("local_state")(), "local_state()")

    def exact_state(self) -> LocalState:
        """Return the exact local state of the CAVs now."""
        return self._check_state(self.__getattr__("exact_state")(), "exact_state()")

    def advance(self, command: Command | None) -> None:
        """Make one control step, and check the speeds of all vehicles after it."""
        self.__getattr__("advance")(command)
        self._step_count += 1
        if self.control_steps != self._step_count:
            raise self._error(f"control_steps is {self.control_steps}", f"{self._step_count}, the number of calls")
        ids = getattr(self.road, "vehicle_ids", None)
        speeds = self._as_array("speeds", self.speeds, (len(ids) if ids else np.size(self.speeds),))
        ids = ids or [f"vehicle {row}" for row in range(len(speeds))]
        self._check_finite("speed", speeds, ids)
        if len(speeds) and speeds.min() < -STATE_TOLERANCE:
            raise self._error(f"speed of {ids[int(speeds.argmin())]} is {speeds.min():.2f}", "at least 0")

    def record(self, driver_log: DriverLog) -> Episode:
        """Return the record; commands that were not carried out count as overridden in its audit."""
        episode = self.__getattr__("record")(driver_log)
        if not isinstance(episode, Episode):
            raise self._error(f"record() returns {type(episode).__name__}", "Episode")
        if episode.control_steps != self._step_count:
            raise self._error(f"record() has {episode.control_steps} control steps", str(self._step_count))
        if self._scenario.is_closed:
            self._check_motion(episode)
        self._check_last_state(episode)
        return self._count_overrides(episode)

    def record_so_far(self) -> Episode:
        """Return the record without the driver's decisions."""
        return self.record(DriverLog())

    def _error(self, problem: str, allowed: str, step: int | None = None) -> InputError:
        time = (self._step_count if step is None else step) * self._scenario.control_step
        return InputError(f"backend: {self._label}: {problem} at {time:g} s; allowed: {allowed}")

    def _as_array(self, name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
        try:
            array = np.asarray(values, np.float64)
        except (TypeError, ValueError):
            raise self._error(f"{name} is {values!r:.60}", "numbers") from None
        if array.shape != shape:
            raise self._error(f"{name} has shape {array.shape}", str(shape))
        return array

    def _check_finite(self, name: str, values: np.ndarray, ids: Any, step: int | None = None) -> None:
        if not (is_finite := np.isfinite(values)).all():
            row = int(is_finite.argmin())
            raise self._error(f"{name} of {ids[row]} is {values[row]}", "finite", step)

    def _check_state(self, state: Any, method: str) -> LocalState:
        if not isinstance(state, LocalState):
            raise self._error(f"{method} returns {type(state).__name__}", "LocalState")
        ids, values_by_name = self.cav_ids, state._asdict()
        rows = () if np.ndim(state.speed) == 0 and self.is_scalar else (len(ids),)
        for name, values in values_by_name.items():
            if values is not None:
                array = self._as_array(name, values, rows + ((FIELD_SIZES[name],) if name in FIELD_SIZES else ()))
                if name in self._finite_fields:
                    self._check_finite(name, np.atleast_1d(array), ids)
            elif name in COMMON_FIELDS:
                raise self._error(f"{method} has no {name}", "a value for each CAV")
        return state

    def _check_motion(self, episode: Episode) -> None:
        """Raise `InputError` if distances driven on a closed road differ from the sums of the speeds."""
        shape, ids = (self._step_count + 1, len(episode.vehicle_ids)), episode.vehicle_ids
        speeds, positions, _ = (
            self._as_array(f"{name} of the record", getattr(episode, name), shape)
            for name in ("speeds", "positions", "gaps")
        )
        for step in range(self._step_count + 1):
            self._check_finite("recorded speed", speeds[step], ids, step)
            self._check_finite("recorded position", positions[step], ids, step)
        moved, expected = positions[-1] - positions[0], np.trapezoid(speeds, dx=episode.control_step, axis=0)
        absolute, relative = DISTANCE_TOLERANCE
        difference = np.abs(moved - expected) - relative * np.abs(expected)
        row = int(difference.argmax())
        if difference[row] > absolute:
            problem = f"{ids[row]} has moved {moved[row]:.1f} m according to its positions"
            raise self._error(problem, f"{expected[row]:.1f} m, the sum of its speeds")

    def _check_last_state(self, episode: Episode) -> None:
        """Raise `InputError` if the last recorded state of a CAV on the road differs from its measured state."""
        ids, state = list(self.cav_ids), self.exact_state()
        rows = {name: row for row, name in enumerate(ids)}
        names = ("speed", "leader_gap", "route_position")
        for trip in episode.trajectories:
            for name in names if trip.step_slice.stop == self._step_count and trip.vehicle in rows else ():
                recorded = float(getattr(trip.states, name)[-1])
                measured = float(np.atleast_1d(getattr(state, name))[rows[trip.vehicle]])
                difference = measured - recorded
                if name == "route_position" and self._scenario.is_closed:
                    difference -= episode.loop_length * round(difference / episode.loop_length)
                if abs(difference) > STATE_TOLERANCE:
                    problem = f"{name} of {trip.vehicle} is {measured:.2f} in the state"
                    raise self._error(problem, f"{recorded:.2f}, as in the record")

    def _count_overrides(self, episode: Episode) -> Episode:
        """Return the record with an audit in which all commands that were not carried out count as overridden."""
        # Other actuators and modes of actuation do not carry out commands exactly.
        if not self._scenario.actuator.is_instant or self._scenario.actuation not in ("raw", "shielded"):
            return episode
        is_overridden = np.concatenate([np.zeros(0, bool), *map(self._is_overridden, episode.trajectories)])
        audit, share = episode.audit, float(is_overridden.mean()) if is_overridden.size else 0.0
        following = replace(audit.following, override_share=max(share, audit.following.override_share))
        return replace(episode, audit=replace(audit, following=following))

    def _is_overridden(self, trip: Trajectory) -> Any:
        """Return in which control steps a CAV did not carry out its command, although no added braking was recorded."""
        speed, actual = trip.states.speed[1:], np.diff(trip.states.speed) / self._scenario.control_step
        deficit = trip.applied_acceleration - actual
        is_standing, is_fastest = speed < OVERRIDE_TOLERANCE, speed > self._scenario.top_speed - OVERRIDE_TOLERANCE
        # A standing vehicle cannot brake harder, and no vehicle exceeds its top speed.
        is_limited = is_fastest | (trip.shield_braking > OVERRIDE_TOLERANCE)
        return (np.abs(deficit) > COMMAND_TOLERANCE) & ~np.where(deficit > 0, is_limited, is_standing)
