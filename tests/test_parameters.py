import re
from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers import PISaturation
from unjam.drivers.registry import driver_recipe
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.wrappers import FilteredDriver, MixedDriver
from unjam.errors import InputError
from unjam.following.calibration import CalibrationSettings
from unjam.parameters import (
    STRICT,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    build_dataclass,
    parse_assignments,
    parse_toml,
    parse_value,
)
from unjam.physics.idm import IDMParameters
from unjam.scenarios import FigureEight, Motorway, Ramp, Ring, make_scenario
from unjam.scenarios.scenario import CruiseControl
from unjam.training.config import EvaluationSettings, RunConfig


@dataclass(frozen=True, config=STRICT)
class Inner:
    size: PositiveInt = 1


@dataclass(frozen=True, config=STRICT)
class Outer:
    needed: float
    positive: Positive = 1.0
    share: NonNegative = 0.0
    extra: NonNegativeInt = 0
    inner: Inner = Inner()
    names: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _order(self) -> "Outer":
        if self.extra > self.inner.size:
            raise ValueError(f"extra: {self.extra} is not allowed; allowed: <= {self.inner.size}")
        return self


def test_nested_parameters_are_built() -> None:
    made = build_dataclass(Outer, {"needed": 2, "inner": {"size": 3}, "names": ["a"], "extra": 3}, "here")
    assert made == Outer(needed=2.0, inner=Inner(size=3), names=("a",), extra=3)
    assert type(made.needed) is float


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({}, "here.needed: missing"),
        ({"needed": 1, "other": 2}, "here.other: unknown name; allowed: extra, inner, names, needed, positive, share"),
        ({"needed": 1, "inner": {"other": 2}}, "here.inner.other: unknown name; allowed: size"),
        (
            {"needed": "x"},
            "here.needed: 'x' is not allowed; allowed: a valid number, unable to parse string as a number",
        ),
        ({"needed": 1, "positive": 0}, "here.positive: 0 is not allowed; allowed: greater than 0"),
        ({"needed": 1, "share": -1}, "here.share: -1 is not allowed; allowed: greater than or equal to 0"),
        ({"needed": 1, "inner": {"size": 0}}, "here.inner.size: 0 is not allowed; allowed: greater than or equal to 1"),
        ({"needed": float("nan")}, "here.needed: nan is not allowed; allowed: a finite number"),
        ({"needed": 1, "extra": 2}, "here.extra: 2 is not allowed; allowed: <= 1"),
        ({"needed": 1, "names": [1]}, "here.names.0: 1 is not allowed; allowed: a valid string"),
    ],
)
def test_an_invalid_value_is_reported_in_one_line(values: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as caught:
        build_dataclass(Outer, values, "here")
    assert str(caught.value) == line


def test_without_a_field_the_line_begins_with_the_name() -> None:
    with pytest.raises(InputError) as caught:
        build_dataclass(Outer, {}, "")
    assert str(caught.value) == "needed: missing"
    with pytest.raises(InputError) as caught:
        build_dataclass(Outer, {"needed": 1, "extra": 2}, "")
    assert str(caught.value) == "extra: 2 is not allowed; allowed: <= 1"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("3.5", 3.5),
        ("1e-3", 1e-3),
        ("true", True),
        ("[220, 270]", [220, 270]),
        ("['a', \"b\"]", ["a", "b"]),
        ("{time_headway = 1.3}", {"time_headway": 1.3}),
        ("pi", "pi"),
        ("pi:window=30", "pi:window=30"),
        ("'3'", "3"),
        ("", ""),
        ("my driver.py:x", "my driver.py:x"),
    ],
)
def test_a_value_is_read_as_toml_or_as_text(text: str, value: object) -> None:
    found = parse_value(text)
    assert found == value
    assert type(found) is type(value)


def test_assignments_are_read() -> None:
    found = parse_assignments(["trpo.gamma=0.9", " seed = 3 ", "expert=pi:window=30"], "--set")
    assert found == {"trpo.gamma": 0.9, "seed": 3, "expert": "pi:window=30"}


@pytest.mark.parametrize("text", ["gamma", "=3", " =3", ""])
def test_a_text_without_assignment_is_refused(text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_assignments([text], "--set")
    assert str(caught.value) == f"--set: {text!r} is not allowed; allowed: key=value"


@given(st.integers() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_are_read_as_written(value: float) -> None:
    assert parse_value(str(value).lower()) == value


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"needed": 2**64}, "it.needed: a number of 65 bits is not allowed; allowed: at most 63 bits"),
        ({"needed": 1.0, "inner": {"size": -(2**70)}}, "it.inner.size: a number of 71 bits is not"),
        ({"needed": 1.0, "names": ["a", "b\0"]}, r"it.names: 'b\x00' is not allowed; allowed: a text without NUL"),
    ],
)
def test_huge_integers_and_nul_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as caught:
        build_dataclass(Outer, values, "it")
    assert str(caught.value).startswith(words)


@pytest.mark.parametrize("part", ["a", '"a b"', "'a'", '"\\""', '"a\\\\"'])
def test_a_key_of_many_parts_is_refused_before_it_takes_memory(part: str) -> None:
    deep = " . ".join([part] * 100_000)
    for text in (f"{deep} = 1", f"[{deep}]", f"a = {{{deep} = 1}}"):
        with pytest.raises(ValueError, match="a key of more than 100 parts"):
            parse_toml(text)
    assert parse_toml(f"{'.'.join([part] * 50)} = 1")
    assert parse_toml(f"a = {[0.5] * 1000}\nb = '{'../' * 50}'")


@pytest.mark.parametrize("text", ["a" * 10**6, "a " * 10**6, '\\"' * 10**6, "\\\\" * 10**6, "a." * 99 + " a" * 10**6])
def test_a_long_text_is_read_in_time_proportional_to_its_length(text: str) -> None:
    """A search that goes on from each letter would take hours."""
    assert parse_toml(f'long = "{text}"')


class UndecoratedRing(Ring):
    length = 130  # pyright: ignore[reportAssignmentType]
    vehicles: int = 11


class RingOfIt(UndecoratedRing):
    """Replaces nothing."""


@dataclass(frozen=True, config=STRICT)
class DecoratedRing(Ring):
    length = (130, 130)
    vehicles: int = 11


class SmallEight(FigureEight):
    radius = 31  # pyright: ignore[reportAssignmentType]
    extra: float = 1.0


class TwoRamps(Motorway):
    ramps = (Ramp(position=900.0), Ramp(position=1800.0))
    lanes = 1
    inflow: float = 1200.0


class BusyRamp(Ramp):
    inflow = 700.0


class QuickPI(PISaturation):
    time_constant = 10.0


class WaryFilter(SafetyFilter):
    time_gap = 2.0


class SlowPair(MixedDriver):
    drivers = (PISaturation(), PISaturation())


@pytest.mark.parametrize(
    ("kind", "arguments", "expected"),
    [
        (UndecoratedRing, {"horizon": 5}, {"length": (130, 130), "vehicles": 11, "horizon": 5}),
        (RingOfIt, {"vehicles": 9}, {"length": (130, 130), "vehicles": 9}),
        (DecoratedRing, {}, {"length": (130, 130), "vehicles": 11}),
        (SmallEight, {"extra": 2.0}, {"radius": (31, 31), "extra": 2.0}),
        (TwoRamps, {}, {"ramps": (Ramp(position=900.0), Ramp(position=1800.0)), "lanes": 1, "inflow": 1200.0}),
        (BusyRamp, {"position": 10.0}, {"inflow": 700.0, "position": 10.0}),
        (QuickPI, {"window": 5.0}, {"time_constant": 10.0, "window": 5.0}),
        (WaryFilter, {}, {"time_gap": 2.0}),
        (SlowPair, {}, {"drivers": (PISaturation(), PISaturation())}),
    ],
)
def test_values_in_the_body_of_a_class_are_its_defaults(kind: Any, arguments: dict[str, Any], expected: Any) -> None:
    for made in (kind(**arguments), build_dataclass(kind, arguments, "it")):
        assert {name: getattr(made, name) for name in expected} == expected
        assert replace(made) == made
        with pytest.raises(FrozenInstanceError):
            setattr(made, next(iter(expected)), 3.0)


class Zero(SafetyFilter):
    def limit(self, acceleration: Any, *_: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return 0.0 * acceleration


class Sloped(IDMParameters):
    grade: float = 0.0


class Computed(CruiseControl):
    time_gap = property(lambda self: 3.0)  # pyright: ignore[reportAssignmentType]


class Late(Actuator):
    def next_state(self) -> None:
        """Replace nothing of the base."""


class LateRamp(Ramp):
    def starts(self) -> float:
        return 60.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Ring(safety=Zero()), "scenario Ring.safety: the class Zero with its 'limit'"),
        (lambda: Ring(humans=Sloped()), "scenario Ring.humans: the class Sloped with its 'grade'"),
        (lambda: Ring(cruise=Computed()), "scenario Ring.cruise: the class Computed with its 'time_gap'"),
        (lambda: Ring(actuator=Late()), "scenario Ring.actuator: the class Late with its 'next_state'"),
        (lambda: make_scenario(type("A", (Ring,), {"safety": Zero()})), "scenario A.safety: the class Zero"),
        (lambda: Motorway(ramps=(LateRamp(position=900.0),)), "scenario Motorway.ramps: the class LateRamp"),
        (lambda: driver_recipe(FilteredDriver(PISaturation(), 1.0, Zero(), 0.1)), "driver .*safety: the class Zero"),
    ],
)
def test_code_of_a_part_that_records_do_not_store_is_refused(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(InputError, match=rf"^{words}.* is not allowed; allowed: .*, or a class of other values"):
        make()


def test_an_invalid_value_in_the_body_of_a_class_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"^scenario Bad\.vehicles: 1 is not allowed; allowed: greater than or equal"):
        make_scenario(type("Bad", (Ring,), {"vehicles": 1}))


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"ramps": [Ramp(position=900.0)]}, "mutable default .*list.* for field ramps is not allowed"),
        ({"__annotations__": {"extra": float}}, "non-default argument 'extra' follows default argument"),
    ],
)
def test_a_class_that_cannot_be_a_dataclass_is_refused_in_one_line(members: dict[str, Any], message: str) -> None:
    for make in (lambda kind: kind(), make_scenario):
        with pytest.raises(InputError, match=rf"^class Bad: .*{message}.*$"):
            make(type("Bad", (Motorway,), dict(members)))


def test_computed_values_and_constructors_of_a_subclass_remain_its_own() -> None:
    class Computed(Ring):
        @property
        def horizon(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
            return 7

    class Constructed(PISaturation):
        window = 4.0

        def __init__(self) -> None:
            super().__init__(time_constant=3.0)

    assert Computed().horizon == 7
    assert Constructed().time_constant == 3.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Ring(horizon=0), "Ring.horizon: 0 is not allowed"),
        (lambda: Ring(cavs=23), "Ring.cavs: 23 is not allowed; allowed: <= vehicles, 22"),
        (lambda: type("Short", (Ring,), {"horizon": 0})(), "Short.horizon: 0 is not allowed"),
        (lambda: IDMParameters(exponent=-1.0), "IDMParameters.exponent: -1.0 is not allowed"),
        (lambda: RunConfig(steps=0), "steps: 0 is not allowed; allowed: greater than or equal to 1"),
        (lambda: replace(RunConfig(), backend="batch", scenario="merge"), "backend: batch is not allowed"),
        (lambda: RunConfig(scenario_options={"horizon": 0}), "scenario ring.horizon: 0 is not allowed"),
        (lambda: cast(Any, RunConfig)(trpo={"gamma": 2}), "trpo.gamma: 2 is not allowed; allowed: less than 1"),
        (lambda: EvaluationSettings(episodes=0), "EvaluationSettings.episodes: 0 is not allowed"),
        (lambda: cast(Any, CalibrationSettings)(pears=0), "CalibrationSettings.pears: unknown name"),
    ],
)
def test_an_invalid_value_in_python_is_one_line(make: Any, message: str) -> None:
    with pytest.raises(InputError, match="^" + re.escape(message)) as refused:
        make()
    assert "\n" not in str(refused.value)
