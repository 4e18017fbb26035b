"""SUMO's warnings are read from its log: each kind once, with its count, without those that unjam counts itself."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.worlds.sumo.user_networks import STANDING, TELEPORTS, UNSORTED, straight
from unjam.drivers import Human
from unjam.errors import EpisodeError
from unjam.measures.metrics import measure
from unjam.measures.notes import episode_notes
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.record import SlowEntrance, SumoWarning, Trips
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.outputs import (
    MAX_EXAMPLE_LENGTH,
    MAX_LOG_BYTES,
    find_slow_entrances,
    read_warnings,
    warning_kind,
)
from unjam.worlds.sumo.simulation import Simulation

STOP = "Vehicle '%' performs emergency stop at lane '%', decel=%, time=%, stage=%."


def stop(number: int) -> str:
    return STOP.replace("'%'", f"'car.{number}'").replace("stage=%", "stage=move").replace("=%", f"={number}.50")


def test_messages_of_a_kind_differ_only_in_names_values_and_numbers(tmp_path: Path) -> None:
    assert warning_kind(stop(1)) == warning_kind(stop(20)) == STOP
    log = tmp_path / "error.log"
    log.write_text(f"Warning: {stop(1)}\nWarning: {stop(2)}\nError: No route\n  from 'a'\n")
    assert read_warnings(log) == (
        SumoWarning(STOP, stop(1), 2),
        SumoWarning("No route from '%'", "No route from 'a'", 1),
    )


def test_the_totals_that_sumo_writes_at_the_end_are_counts_of_examples(tmp_path: Path) -> None:
    log = tmp_path / "error.log"
    other = "Edge 'e' has 3 lanes"
    log.write_text(
        f"Warning: {stop(1)}\nWarning: {other}\nWarning: 900000 total messages of type: {STOP}\n"
        "Warning: Teleporting vehicle 'f'; waited too long (jam), lane='a_0'.\n"
        "Warning: 7 total messages of type: Teleporting vehicle '%'; waited too long (jam), lane='%'.\n"
    )
    assert {each.example: each.count for each in read_warnings(log)} == {stop(1): 900_000, other: 1}


def test_names_of_strangers_cannot_make_a_log_endless_to_read(tmp_path: Path) -> None:
    log = tmp_path / "error.log"
    form, digits = "%a" * 40, "9" * 5000
    totals = [f"Warning: {number} total messages of type: {form}b" for number in (7, digits)]
    log.write_text(
        "\n".join([f"Warning: {'a' * 5000}", "Warning: x[1]*y", *totals, "Warning: 3 total messages of type: x[%]*y\n"])
    )
    counts = {each.example: each.count for each in read_warnings(log)}
    assert counts["a" * MAX_EXAMPLE_LENGTH] == 1
    assert counts["x[1]*y"] == 3


def test_the_size_of_a_log_that_is_read_is_limited(tmp_path: Path) -> None:
    log = tmp_path / "error.log"
    log.write_text(f"Warning: {'long ' * 200}\n" + "".join(f"Warning: {stop(n)}\n" for n in range(40_000)))
    assert log.stat().st_size > 2 * MAX_LOG_BYTES
    long, many = read_warnings(log)
    assert len(long.example) == MAX_EXAMPLE_LENGTH
    assert 5_000 < many.count < 20_000


def test_a_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match="warnings cannot be read: No such file"):
        read_warnings(tmp_path / "none.log")


@pytest.mark.parametrize(
    ("departure", "speed"),
    [('departSpeed="max"', None), ('departSpeed="0"', 0.0), ('departSpeed="5"', 5.0), ('departSpeed="desired"', 20.0)],
)
def test_an_entrance_is_slow_if_vehicles_wait_without_a_jam(
    departure: str, speed: float | None, tmp_path: Path, sumo: SumoBackend
) -> None:
    period = 1.0 if speed in (0.0, 5.0) else 1.9
    flow = f'<flow id="f" type="{{}}" route="along" begin="0" end="60" period="{period}" {departure}/>'
    # Slow vans between cars: the desired speed of a car is often not safe behind them.
    vans = flow.replace('"f"', '"g"').format("van").replace('period="1.9"', 'period="7"')
    kinds = flow.format("car") + (vans if "desired" in departure else "")
    file = straight(tmp_path, kinds, length=600.0, step=0.5)
    episode = run_episode(make_scenario(str(file), {"penetration_rate": 0.1}), Human(), 1, backend=sumo)
    notes = [note for note in episode_notes({"human": [measure(episode)]}) if note.startswith("road: ")]
    if speed is None:
        assert (episode.slow_entrances, notes) == ((), [])
        return
    (slow,) = episode.slow_entrances
    assert (slow.edge, slow.depart_speed) == ("road", pytest.approx(speed, abs=0.5))
    assert notes[0].startswith(f"road: {slow.vehicles} vehicles wait {slow.depart_delay:.0f} s on average")


def test_an_entrance_in_a_jam_is_not_slow() -> None:
    trips = Trips(entrances=("a",) * 12, depart_delay=np.full(12, 30.0), depart_speed=np.linspace(1.0, 6.0, 12))
    assert find_slow_entrances(trips, {"a": 20.0}) == ()
    fast = replace(trips, depart_speed=np.linspace(16.0, 21.0, 12))
    assert find_slow_entrances(fast, {"a": 20.0}) == (SlowEntrance("a", 12, 30.0, 18.5),)
    assert find_slow_entrances(replace(fast, entrances=("",) * 12), {"a": 20.0}) == ()


@pytest.mark.parametrize("backend", ["libsumo", pytest.param("traci", marks=pytest.mark.long)])
def test_an_episode_has_only_its_own_warnings(backend: str, tmp_path: Path) -> None:
    for name in ("unsorted", "sorted"):
        (tmp_path / name).mkdir()
    unsorted = straight(tmp_path / "unsorted", UNSORTED)
    plain = straight(tmp_path / "sorted", UNSORTED[: UNSORTED.index('<flow id="c"')])
    with Simulation(backend) as simulation:  # pyright: ignore[reportArgumentType]
        found = [
            run_episode(
                make_scenario(str(file), {"penetration_rate": 0.5}), Human(), (0,), backend=SumoBackend(simulation)
            )
            for file in (unsorted, plain, unsorted)
        ]
    assert [[each.example for each in episode.warnings] for episode in found] == [
        ["Route file should be sorted by departure time, ignoring 'c'!"],
        [],
        ["Route file should be sorted by departure time, ignoring 'c'!"],
    ]
    assert len({len(episode.vehicle_ids) for episode in found}) == 1


def test_teleports_are_counted_and_not_listed_as_warnings(tmp_path: Path, sumo: SumoBackend) -> None:
    file = straight(tmp_path, STANDING, end=90.0, step=0.5, options=TELEPORTS)
    episode = run_episode(make_scenario(str(file), {"penetration_rate": 0.5}), Human(), (0,), backend=sumo)
    assert episode.teleports > 0
    assert episode.warnings == ()


@pytest.mark.parametrize(
    ("road", "changes"),
    [
        ("ring", {"horizon": 50}),
        ("figure-eight", {"horizon": 50}),
        ("merge", {"horizon": 30}),
        ("on-ramp", {"horizon": 60, "penetration_rate": 0.3}),
    ],
)
def test_there_are_no_warnings_on_the_built_in_roads(road: str, changes: dict[str, object], sumo: SumoBackend) -> None:
    scenario = make_scenario(road, changes)
    assert run_episode(scenario, Human(), (0,), backend=sumo).warnings == ()
