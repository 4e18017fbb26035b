"""What a network sees: features by name, each a function of what is perceived, decided and remembered.

A feature of your own is `path.py:name`, a function of a `LocalState` that answers an array of shape (n,) or
(n, m), about unit size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator

from unjam.drivers.driver import Driver, Memory, Recipe
from unjam.drivers.local_state import (
    ADJACENT_POSITIONS,
    ROAD_SECTION_LENGTH,
    SECTIONS_AHEAD,
    SPEED_SCALE,
    LocalState,
    ScaledInput,
    lap_angle,
    state_of_ones,
)
from unjam.drivers.user_driver import FileReference, is_file_reference
from unjam.errors import InputError, unknown_name
from unjam.physics.arrays import Array, as_column, clip, join_columns, namespace, stack_columns
from unjam.user_code import UserCode

RELATIVE_SPEED_SCALE = 5.0
GAP_SCALE = 20.0
ACCELERATION_SCALE = 1.0
LOOP_LENGTH_SCALE = 250.0
ROUTE_POSITION_SCALE = 100.0
MERGE_DISTANCE_SCALE = 1000.0
PROXIMITY_DISTANCES = (0.0, 250.0, 500.0, 1000.0, 2000.0)
"""ways to where a ramp joins at which one of the feature `merge_proximity` is one [m]"""


class FeatureInputs(NamedTuple):
    """What features are made of; n rows."""

    state: LocalState
    expert_acceleration: Array
    """within the limits [m/s2], shape (n,)"""
    expert: Driver
    memory: Memory
    """the expert's after its decision: what it will act on next"""


@dataclass(frozen=True)
class Feature:
    """Some of the numbers that a network sees."""

    compute: Callable[[FeatureInputs], Array | None]
    """answers them, about unit size, shape (n, m); a tuple of m for plain numbers; None: there are none"""
    inputs: tuple[ScaledInput, ...] | None
    """what they are, in order; None: what the expert remembers is its own to say"""
    road_requirement: Literal["", "loop", "coordinate"] = ""
    """what the road must have: `loop` no ends, `coordinate` a position along it"""
    required_fields: tuple[str, ...] = ()
    """fields of a `LocalState` that it looks at and that only some roads tell (`Scenario.tells`)"""
    accepts_floats: bool = True
    """whether it takes plain numbers and tensors; otherwise it is asked through NumPy"""


def local_observation(state: LocalState) -> Array:
    """Return the paper's observation: five numbers a row, divided by fixed physical scales.

    Own speed; relative speed and gap to the leader; relative speed and gap to the follower.
    Relative speeds are the other's minus the own; gaps are bumper to bumper.

    Returns:
        Shape (n, 5), no unit; a tuple of five for plain numbers.
    """
    return stack_columns(
        (
            state.speed / SPEED_SCALE,
            (state.leader_speed - state.speed) / RELATIVE_SPEED_SCALE,
            state.leader_gap / GAP_SCALE,
            (state.follower_speed - state.speed) / RELATIVE_SPEED_SCALE,
            state.follower_gap / GAP_SCALE,
        )
    )


def lap_position(state: LocalState) -> Array:
    """Return cosine and sine of the place on a closed road, 0 to 2 pi from its start.

    Returns:
        Shape (n, 2), no unit; a tuple of two for plain numbers.
    """
    xp, angle = namespace(state.speed), lap_angle(state)
    return stack_columns((xp.cos(angle), xp.sin(angle)))


def _section_speed_feature(field: str, location: str) -> Feature:
    """Return the feature of a state's field with a speed for each section ahead, less the own speed."""
    words = (
        f"mean speed {location} {ROAD_SECTION_LENGTH * number:g} m ahead - own speed"
        for number in range(SECTIONS_AHEAD)
    )
    return Feature(
        lambda seen: (getattr(seen.state, field) - seen.state.speed[..., None]) / SPEED_SCALE,
        tuple(ScaledInput(each, SPEED_SCALE, "m/s") for each in words),
        required_fields=(field,),
        accepts_floats=False,
    )


def merge_proximity(state: LocalState) -> Array:
    """Return how near each place of `APPROACH` is: piecewise linear, in all one; none behind the last.

    What is learned of one stretch of the way then changes nothing elsewhere.
    """
    way = clip(state.distance_to_merge, PROXIMITY_DISTANCES[0], PROXIMITY_DISTANCES[-1])
    xp, columns = namespace(way), [way * 0.0 + 1.0]
    for low, high in pairwise(PROXIMITY_DISTANCES):
        share = clip((way - low) / (high - low), 0.0, 1.0)
        columns[-1:] = [columns[-1] - share, share]
    return xp.where((state.distance_to_merge > 0.0)[..., None], stack_columns(tuple(columns)), 0.0)


def _adjacent_lane_features(state: LocalState) -> Array:
    """Return the relative speeds of those on the lanes beside, then the gaps, shape (n, 8), no unit."""
    speeds = (state.adjacent_speeds - state.speed[..., None]) / RELATIVE_SPEED_SCALE
    return namespace(speeds).concatenate((speeds, state.adjacent_gaps / GAP_SCALE), -1)


FEATURES: dict[str, Feature] = {
    "local": Feature(
        lambda seen: local_observation(seen.state),
        (
            ScaledInput("own speed", SPEED_SCALE, "m/s"),
            ScaledInput("leader speed - own speed", RELATIVE_SPEED_SCALE, "m/s"),
            ScaledInput("leader gap", GAP_SCALE, "m"),
            ScaledInput("follower speed - own speed", RELATIVE_SPEED_SCALE, "m/s"),
            ScaledInput("follower gap", GAP_SCALE, "m"),
        ),
    ),
    "expert_acceleration": Feature(
        lambda seen: as_column(seen.expert_acceleration / ACCELERATION_SCALE),
        (ScaledInput("expert acceleration", ACCELERATION_SCALE, "m/s2"),),
    ),
    "expert_memory": Feature(lambda seen: seen.expert.memory_features(seen.memory), None),
    "loop_length": Feature(
        lambda seen: as_column(seen.state.loop_length / LOOP_LENGTH_SCALE),
        (ScaledInput("loop length", LOOP_LENGTH_SCALE, "m"),),
        road_requirement="loop",
    ),
    "lap_position": Feature(
        lambda seen: lap_position(seen.state),
        (ScaledInput("cosine of lap position", 1.0, ""), ScaledInput("sine of lap position", 1.0, "")),
        road_requirement="loop",
    ),
    "route_position": Feature(
        lambda seen: as_column(seen.state.route_position / ROUTE_POSITION_SCALE),
        (ScaledInput("route position", ROUTE_POSITION_SCALE, "m"),),
        road_requirement="coordinate",
    ),
    "allowed_speed": Feature(
        lambda seen: as_column((seen.state.allowed_speed - seen.state.speed) / SPEED_SCALE),
        (ScaledInput("allowed speed - own speed", SPEED_SCALE, "m/s"),),
        required_fields=("allowed_speed",),
    ),
    "distance_to_merge": Feature(
        lambda seen: as_column(clip(seen.state.distance_to_merge / MERGE_DISTANCE_SCALE, -1.0, 2.0)),
        (ScaledInput("distance to merge", MERGE_DISTANCE_SCALE, "m"),),
        required_fields=("distance_to_merge",),
    ),
    "merge_proximity": Feature(
        lambda seen: merge_proximity(seen.state),
        tuple(ScaledInput(f"proximity to {way:g} m before the merge", 1.0, "") for way in PROXIMITY_DISTANCES),
        required_fields=("distance_to_merge",),
        accepts_floats=False,
    ),
    "lane_speeds": _section_speed_feature("lane_speeds", "in own lane"),
    "road_speeds": _section_speed_feature("road_speeds", "on all lanes"),
    "penetration_rate": Feature(
        lambda seen: as_column(seen.state.penetration_rate),
        (ScaledInput("penetration rate", 1.0, ""),),
        required_fields=("penetration_rate",),
    ),
    "adjacent_lanes": Feature(
        lambda seen: _adjacent_lane_features(seen.state),
        (
            *(ScaledInput(f"speed {where} - own speed", RELATIVE_SPEED_SCALE, "m/s") for where in ADJACENT_POSITIONS),
            *(ScaledInput(f"gap {where}", GAP_SCALE, "m") for where in ADJACENT_POSITIONS),
        ),
        required_fields=("adjacent_gaps", "adjacent_speeds"),
        accepts_floats=False,
    ),
}
"""all that a network can be shown: the paper's five numbers; the expert's acceleration; what the expert
remembers; the length of the closed road; the place on it; the position along a road with ends; the share of
CAVs; on motorways the wanted speed, the way to where a ramp joins, also stretch by stretch, the speeds ahead
in its lane and on all, and who drives beside it"""


def _is_feature(name: str) -> bool:
    return name in FEATURES or is_file_reference(name)


def _check_feature_name(name: str) -> str:
    if not _is_feature(name):
        raise ValueError(f"{', '.join(map(repr, FEATURES))} or 'path.py:name'")
    return name


def check_features(names: Sequence[str]) -> None:
    """Raise `InputError` where one of the names is not that of a feature, or of a function of one's own."""
    for name in names:
        if not _is_feature(name):
            raise unknown_name("features", name, [*FEATURES, "path.py:name"])


FeatureName = Annotated[str, AfterValidator(_check_feature_name)]
"""a key of FEATURES, or `path.py:name`"""


def feature(name: str) -> Feature:
    """Return a feature by name; raise `InputError` where a file of the user's has no such function."""
    return FEATURES[name] if name in FEATURES else _user_feature(name)


@cache
def _user_code(name: str) -> UserCode:
    return FileReference.parse(name).read_code()


@cache
def _user_feature(name: str) -> Feature:
    reference = FileReference.parse(name)
    function = reference.load_function("a LocalState", _user_code(name))

    def compute(inputs: FeatureInputs) -> Array:
        like, state = inputs.state.speed, inputs.state
        if not isinstance(like, np.ndarray):  # tensors: users' functions know NumPy alone
            state = state.map(lambda values: values.double().cpu().numpy())
        found = np.asarray(reference.call_user_code(function, state), np.float64)
        found = found[:, None] if found.ndim == 1 else found
        if isinstance(like, np.ndarray):
            return found
        return namespace(like).as_tensor(found, dtype=like.dtype, device=like.device)

    found = compute(FeatureInputs(state_of_ones(LocalState._fields, np.ones), np.ones(1), Driver(), {}))
    if found.ndim != 2 or len(found) != 1:
        raise InputError(f"{reference}: answers shape {found.shape} for one CAV; allowed: (n,) or (n, m) for n")
    words = (ScaledInput(f"{reference} {number}", 1.0, "") for number in range(found.shape[1]))
    return Feature(compute, tuple(words), accepts_floats=False)


def feature_fields(names: Sequence[str]) -> frozenset[str]:
    """Return the fields of a `LocalState` that features look at: of a user's own, which alone knows, all."""
    if any(is_file_reference(name) for name in names):
        return frozenset(LocalState._fields)
    return frozenset(field for name in names for field in feature(name).required_fields)


def compute_observation(names: Sequence[str], inputs: FeatureInputs) -> Array:
    """Return what the network sees: the chosen features side by side, shape (n, inputs), no unit."""
    blocks = [block for name in names if (block := feature(name).compute(inputs)) is not None]
    if not blocks:
        raise InputError("policy.inputs: expert_memory alone is not allowed: the expert remembers nothing")
    return join_columns(blocks)


def observation_inputs(names: Sequence[str], expert: Driver) -> tuple[ScaledInput, ...]:
    """Return what the network sees with this expert, in the order of `observe`."""
    known = sum(len(feature(name).inputs or ()) for name in names)
    remembered = observation_size(names, expert) - known
    unnamed = tuple(ScaledInput(f"expert memory {number}", 1.0, "") for number in range(remembered))
    own = expert.memory_inputs or unnamed
    return tuple(number for name in names for number in (feature(name).inputs or own))


def observation_size(names: Sequence[str], expert: Driver) -> int:
    """Return how many numbers the network sees with this expert."""
    state = state_of_ones(LocalState._fields, np.ones)
    acceleration, memory = expert.act(state, expert.initial_memory(1))
    if np.shape(acceleration) != (1,):
        shape = np.shape(acceleration)
        raise InputError(f"driver: acceleration has shape {shape}; allowed: one for each CAV")
    return compute_observation(names, FeatureInputs(state, acceleration, expert, memory)).shape[1]


def check_user_files(names: Sequence[str], files: Sequence[Recipe]) -> None:
    """Load the users' own features anew where they were loaded from another code than `files` lists.

    Raises:
        InputError: their code is not what `files` lists.
    """
    if any(file not in files for file in user_files(names)):
        _user_code.cache_clear()
        _user_feature.cache_clear()
    for file in user_files(names):
        if file not in files:
            allowed = "allowed: as it was when the driver was made"
            raise InputError(f"driver recipe: the code {file['path']!r} of a feature has changed; {allowed}")


def user_files(names: Sequence[str]) -> list[Recipe]:
    """Return where the code of the users' own features is, and the hash of what runs."""
    own = [name for name in names if name not in FEATURES]
    return [FileReference.parse(name).file_recipe(_user_code(name).sha256) for name in own]
