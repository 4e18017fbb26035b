"""Inputs of networks: features by name, each a function of observation, expert acceleration and memory.

A user's own feature is a function of a `LocalState` that returns an array of shape (n,) or (n, m), about unit size:
`path.py:name`, or a function of this process, which `as_features` converts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import AfterValidator

from unjam.drivers.check import check_row_independence, probe_state
from unjam.drivers.command import as_numbers
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import (
    ADJACENT_POSITIONS,
    COMMON_FIELDS,
    FIELD_SIZES,
    ROAD_SECTION_LENGTH,
    SECTIONS_AHEAD,
    SPEED_SCALE,
    STATE_UNITS,
    LocalState,
    ScaledInput,
    lap_angle,
    state_of_ones,
)
from unjam.drivers.requirements import NO_REQUIREMENTS, Requirements
from unjam.drivers.user_driver import FileReference, UserFunction, is_file_reference
from unjam.errors import InputError, RowError, invalid_value, unknown_name
from unjam.parameters import STRICT, Number, parameter_dataclass
from unjam.physics.arrays import Array, Floats, as_column, clip, join_columns, namespace, stack_columns
from unjam.text import format_count

RELATIVE_SPEED_SCALE, GAP_SCALE, MERGE_DISTANCE_SCALE = 5.0, 20.0, 1000.0
MAX_OBSERVATION = 50.0
"""largest magnitude of observations in environments, which clip larger values"""
PROXIMITY_DISTANCES = (0.0, 250.0, 500.0, 1000.0, 2000.0)
"""distances to the merge [m]: at each of them one column of the feature `merge_proximity` is one"""


class FeatureArguments(NamedTuple):
    """The arguments of a feature, for n CAVs."""

    state: LocalState
    expert_acceleration: Array
    """acceleration of the expert within the limits [m/s2], shape (n,)"""
    expert: Driver
    memory: Memory
    """memory of the expert after its decision"""


@dataclass(frozen=True)
class Feature:
    """A feature of the observation: one or more inputs of a network."""

    compute: Callable[[FeatureArguments], Array | None]
    """function that returns the inputs, about unit size: shape (n, m), a tuple of m floats for plain numbers, or None
    without inputs"""

    inputs: tuple[ScaledInput, ...] | None
    """descriptions of the columns, in order; None: `Driver.memory_inputs` of the expert describes them"""
    requirements: Requirements = NO_REQUIREMENTS
    """requirements of the feature on a road and on the type of its inputs"""


def local_observation(state: LocalState) -> Array:
    """Return the observation of the paper, divided by fixed scales: shape (n, 5), no unit; a tuple for plain numbers.

    The columns are own speed, relative speed of the leader, its gap, relative speed of the follower, and its gap.
    """
    leader = (state.leader_speed - state.speed) / RELATIVE_SPEED_SCALE, state.leader_gap / GAP_SCALE
    follower = (state.follower_speed - state.speed) / RELATIVE_SPEED_SCALE, state.follower_gap / GAP_SCALE
    return stack_columns((state.speed / SPEED_SCALE, *leader, *follower))


def lap_position(state: LocalState) -> Array:
    """Return cosine and sine of `lap_angle`: shape (n, 2), no unit; a tuple for plain numbers."""
    xp, angle = namespace(state.speed), lap_angle(state)
    return stack_columns((xp.cos(angle), xp.sin(angle)))


def _section_speed_feature(field: str, location: str) -> Feature:
    distances = (f"{ROAD_SECTION_LENGTH * number:g} m" for number in range(SECTIONS_AHEAD))
    return Feature(
        lambda arguments: (getattr(arguments.state, field) - arguments.state.speed[..., None]) / SPEED_SCALE,
        tuple(
            ScaledInput(f"mean speed {location} {distance} ahead - own speed", SPEED_SCALE, "m/s")
            for distance in distances
        ),
        Requirements(frozenset({field}), needs_arrays=True),
    )


def merge_proximity(state: LocalState) -> Array:
    """Return how near each distance of `PROXIMITY_DISTANCES` is, shape (n, 5), no unit; zero after the merge.

    The columns are piecewise linear functions of the distance to the merge, with sum one. Therefore a network that
    learns on one section before the merge hardly changes on other sections.
    """
    distance = clip(state.distance_to_merge, PROXIMITY_DISTANCES[0], PROXIMITY_DISTANCES[-1])
    xp, columns = namespace(distance), [distance * 0.0 + 1.0]
    for low, high in pairwise(PROXIMITY_DISTANCES):
        share = clip((distance - low) / (high - low), 0.0, 1.0)
        columns[-1:] = [columns[-1] - share, share]
    return xp.where((state.distance_to_merge > 0.0)[..., None], stack_columns(tuple(columns)), 0.0)


def _adjacent_lane_features(state: LocalState) -> Array:
    speeds = (state.adjacent_speeds - state.speed[..., None]) / RELATIVE_SPEED_SCALE
    return namespace(speeds).concatenate((speeds, state.adjacent_gaps / GAP_SCALE), -1)


RELATIVE_SPEEDS = {"leader_relative_speed": "leader_speed", "follower_relative_speed": "follower_speed"}
"""quantities that are a field of `LocalState` minus the own speed, with this field"""
OPTIONAL_QUANTITIES = ("loop_length", "route_position")
"""quantities that are NaN on some roads"""
UNIT_FACTORS = {"m/s": {"m/s": 1.0, "km/h": 3.6}}
"""allowed units of an SI unit, with their number in one SI unit; for other SI units only this unit is allowed"""


def unit_factor(unit: str, si_unit: str) -> float:
    """Return how many of `unit`, or if it is empty of `si_unit`, are one `si_unit`; `InputError` if not allowed."""
    factors = UNIT_FACTORS.get(si_unit, {si_unit: 1.0})
    if (unit or si_unit) not in factors:
        raise unknown_name("unit", unit, factors)
    return factors[unit or si_unit]


def _check_scale(scale: float) -> float:
    if not scale or not np.isfinite(scale):
        raise ValueError("a number other than 0")
    return scale


Scale = Annotated[Number, AfterValidator(_check_scale)]


@parameter_dataclass(frozen=True, config=STRICT, repr=False)
class PolicyInput:
    """A quantity as an input of a network: the network receives `(value - offset) / scale`, with `value` in `unit`."""

    quantity: str
    """a field of `LocalState`, or the relative speed of a neighbor: `leader_relative_speed` or
    `follower_relative_speed`"""
    unit: str = ""
    """km/h instead of m/s; empty: the SI unit"""
    scale: Scale = 1.0
    offset: Number = 0.0
    """value that is subtracted, in `unit`"""
    optional: bool = False
    """whether the quantity may be NaN on roads without it: only for `loop_length` and `route_position`"""
    tensor: str = ""
    """name of the ONNX input that has this quantity as its next column; if empty, the input with the name of the
    quantity, or the only input"""

    def __post_init__(self) -> None:
        if self._field not in STATE_UNITS:
            raise unknown_name("quantity", self.quantity, [*STATE_UNITS, *RELATIVE_SPEEDS])
        unit_factor(self.unit, STATE_UNITS[self._field])
        if self.optional and self.quantity not in OPTIONAL_QUANTITIES:
            raise invalid_value("optional", self.optional, f"only for {', '.join(OPTIONAL_QUANTITIES)}")

    def __repr__(self) -> str:
        return repr(self.quantity)

    @property
    def _field(self) -> str:
        return RELATIVE_SPEEDS.get(self.quantity, self.quantity)

    @cached_property
    def feature(self) -> Feature:
        """The feature that computes this quantity."""
        name, unit = self._field, self.unit or STATE_UNITS[self._field]
        factor, is_relative = unit_factor(self.unit, STATE_UNITS[name]), self.quantity in RELATIVE_SPEEDS
        is_converted = factor != 1.0 or self.offset

        def compute(arguments: FeatureArguments) -> Array:
            value = getattr(arguments.state, name)
            value = value - arguments.state.speed if is_relative else value
            value = (value * factor - self.offset if is_converted else value) / self.scale
            return value if name in FIELD_SIZES else as_column(value)

        requirements = Requirements(
            required_fields=frozenset({name}).difference(COMMON_FIELDS),
            needs_loop=name == "loop_length" and not self.optional,
            needs_coordinate=name == "route_position" and not self.optional,
            needs_arrays=name in FIELD_SIZES,
        )
        label = self.quantity.replace("_", " ") + (f" - {self.offset:g} {unit}" if self.offset else "")
        return Feature(compute, (ScaledInput(label, self.scale, unit),) * FIELD_SIZES.get(name, 1), requirements)


FEATURES: dict[str, Feature] = {
    "local": Feature(
        lambda arguments: local_observation(arguments.state),
        (
            ScaledInput("own speed", SPEED_SCALE, "m/s"),
            ScaledInput("leader speed - own speed", RELATIVE_SPEED_SCALE, "m/s"),
            ScaledInput("leader gap", GAP_SCALE, "m"),
            ScaledInput("follower speed - own speed", RELATIVE_SPEED_SCALE, "m/s"),
            ScaledInput("follower gap", GAP_SCALE, "m"),
        ),
    ),
    "expert_acceleration": Feature(
        lambda arguments: as_column(arguments.expert_acceleration), (ScaledInput("expert acceleration", 1.0, "m/s2"),)
    ),
    "expert_memory": Feature(lambda arguments: arguments.expert.memory_features(arguments.memory), None),
    "loop_length": PolicyInput("loop_length", scale=250.0).feature,
    "lap_position": Feature(
        lambda arguments: lap_position(arguments.state),
        (ScaledInput("cosine of lap position", 1.0, ""), ScaledInput("sine of lap position", 1.0, "")),
        Requirements(needs_loop=True),
    ),
    "route_position": PolicyInput("route_position", scale=100.0).feature,
    "allowed_speed": Feature(
        lambda arguments: as_column((arguments.state.allowed_speed - arguments.state.speed) / SPEED_SCALE),
        (ScaledInput("allowed speed - own speed", SPEED_SCALE, "m/s"),),
        Requirements(frozenset({"allowed_speed"})),
    ),
    "distance_to_merge": Feature(
        lambda arguments: as_column(clip(arguments.state.distance_to_merge / MERGE_DISTANCE_SCALE, -1.0, 2.0)),
        (ScaledInput("distance to merge", MERGE_DISTANCE_SCALE, "m"),),
        Requirements(frozenset({"distance_to_merge"})),
    ),
    "merge_proximity": Feature(
        lambda arguments: merge_proximity(arguments.state),
        tuple(
            ScaledInput(f"proximity to {distance:g} m before the merge", 1.0, "") for distance in PROXIMITY_DISTANCES
        ),
        Requirements(frozenset({"distance_to_merge"}), needs_arrays=True),
    ),
    "lane_speeds": _section_speed_feature("lane_speeds", "in own lane"),
    "road_speeds": _section_speed_feature("road_speeds", "on all lanes"),
    "penetration_rate": PolicyInput("penetration_rate").feature,
    "adjacent_lanes": Feature(
        lambda arguments: _adjacent_lane_features(arguments.state),
        (
            *(
                ScaledInput(f"speed {position} - own speed", RELATIVE_SPEED_SCALE, "m/s")
                for position in ADJACENT_POSITIONS
            ),
            *(ScaledInput(f"gap {position}", GAP_SCALE, "m") for position in ADJACENT_POSITIONS),
        ),
        Requirements(frozenset({"adjacent_gaps", "adjacent_speeds"}), needs_arrays=True),
    ),
}
"""all features by name; `local` is the observation of the paper"""


def _check_feature_name(name: str) -> str:
    if name not in FEATURES and not is_file_reference(name):
        raise ValueError(f"{', '.join(map(repr, FEATURES))} or 'path.py:name'")
    return name


FeatureName = Annotated[str, AfterValidator(_check_feature_name)]
"""a key of FEATURES, or `path.py:name`"""
NetworkInput = str | PolicyInput | Feature
FeatureLike = FeatureName | PolicyInput | Feature | Callable[[LocalState], Any]
"""the name of a feature, a quantity, a feature, or a function of a `LocalState`"""


def as_features(features: Sequence[FeatureLike]) -> tuple[NetworkInput, ...]:
    """Return network inputs for a list of features; raise `InputError` if it is not a list, or a feature is invalid."""
    if isinstance(features, str) or not isinstance(features, Sequence) or not features:
        raise invalid_value("features", features, "a list of features, like ('local', 'expert_acceleration')")
    return tuple(map(_as_network_input, features))


def _as_network_input(candidate: FeatureLike) -> NetworkInput:
    if isinstance(candidate, str) and is_file_reference(candidate):
        return feature(candidate)
    if isinstance(candidate, NetworkInput):
        return candidate
    return _user_feature(UserFunction.from_object(candidate, "a LocalState"))


def feature(network_input: NetworkInput) -> Feature:
    """Return the feature of a network input; raise `InputError` if no feature has the name, or no user's function."""
    if not isinstance(network_input, str):
        return network_input if isinstance(network_input, Feature) else network_input.feature
    if network_input in FEATURES:
        return FEATURES[network_input]
    if not is_file_reference(network_input):
        raise unknown_name("features", network_input, [*FEATURES, "path.py:name"])
    return load_feature(FileReference.parse(network_input))[0]


def load_feature(file: FileReference) -> tuple[Feature, FileReference]:
    """Return the feature in a user's file, and the reference with the hash; `InputError` if one is invalid."""
    function, file = file.load_object_once()
    return _user_feature(UserFunction.from_object(function, "a LocalState", file)), file


def _user_feature(function: UserFunction) -> Feature:
    example = state_of_ones(LocalState._fields, np.ones, rows=2)
    size = _feature_columns(function, example).shape[1]
    random_state = probe_state()
    check_row_independence(lambda rows: _feature_columns(function, random_state.select(rows), size), function.label)

    def compute(arguments: FeatureArguments) -> Array:
        state, speed = arguments.state, arguments.state.speed
        is_numpy = isinstance(speed, np.ndarray)
        if not is_numpy:  # users' functions take NumPy arrays, not tensors
            if any(tensor is not None and tensor.requires_grad for tensor in state):
                raise InputError(f"{function.label}: feature has no gradient; allowed: within torch.no_grad()")
            state = state.map(lambda tensor: tensor.double().cpu().numpy())
        columns = _feature_columns(function, state, size)
        if not (is_finite := np.isfinite(columns)).all():
            row, column = np.argwhere(~is_finite)[0]
            raise RowError(f"{function.label}: column {column} is {columns[row, column]}; allowed: finite", row)
        return columns if is_numpy else namespace(speed).as_tensor(columns, dtype=speed.dtype, device=speed.device)

    inputs = tuple(ScaledInput(f"{function.label} {column}", 1.0, "") for column in range(size))
    return Feature(compute, inputs, Requirements(reads_any_field=True, needs_arrays=True))


def _feature_columns(function: UserFunction, state: LocalState, size: int | None = None) -> Floats:
    """Return what a user's feature computes, shape (n, size); raise `InputError` if it has another shape."""
    rows, values = len(state.speed), as_numbers(function(state), f"{function.label}: feature")
    columns = values[:, None] if values.ndim == 1 else values
    if columns.ndim != 2 or columns.shape != (rows, columns.shape[1] if size is None else size):
        allowed = f"({rows},) or ({rows}, m)" if size is None else f"({rows}, {size})" + f" or ({rows},)" * (size == 1)
        shape = f"{values.shape} for {format_count(rows, 'CAV')}"
        raise InputError(f"{function.label}: feature has shape {shape}; allowed: {allowed}")
    return columns


def compute_observation(network_inputs: Sequence[NetworkInput], arguments: FeatureArguments) -> Array:
    """Return the observation of a network: the columns of its features, shape (n, inputs), no unit."""
    blocks = (feature(network_input).compute(arguments) for network_input in network_inputs)
    return join_columns([block for block in blocks if block is not None])


def observation_inputs(network_inputs: Sequence[NetworkInput], expert: Driver) -> tuple[ScaledInput, ...]:
    """Return the descriptions of the columns of `compute_observation` with an expert, in order."""
    features = [feature(network_input) for network_input in network_inputs]
    described = sum(len(known.inputs or ()) for known in features)
    undescribed = range(observation_size(network_inputs, expert) - described)
    expert_inputs = expert.memory_inputs or tuple(
        ScaledInput(f"expert memory {number}", 1.0, "") for number in undescribed
    )
    return tuple(entry for known in features for entry in (known.inputs or expert_inputs))


def observation_size(network_inputs: Sequence[NetworkInput], expert: Driver) -> int:
    """Return the number of columns of `compute_observation` with an expert."""
    memory_columns = memory_size(expert)
    features = map(feature, network_inputs)
    size = sum(memory_columns if known.inputs is None else len(known.inputs) for known in features)
    if not size:
        raise InputError("policy.inputs: expert_memory alone is not allowed: the expert has no memory features")
    return size


def memory_size(expert: Driver) -> int:
    """Return the number of columns of an expert's memory features."""
    state = state_of_ones(LocalState._fields, np.ones)
    acceleration, memory = expert.act(state, expert.initial_memory(1))
    if np.shape(acceleration) != (1,):
        raise InputError(f"driver: acceleration has shape {np.shape(acceleration)}; allowed: one for each CAV")
    features = expert.memory_features(memory)
    return 0 if features is None else features.shape[1]
