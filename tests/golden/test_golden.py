"""Are trajectories what they were? If not, and rightly so: python tests/golden/bless.py "why"."""

from pathlib import Path

import numpy as np
import pytest

from tests.golden.trajectories import (
    GRAIN,
    ROADS,
    cases,
    drive_all,
    fingerprint,
    folder,
    hash_of,
    read_hashes,
    table_of,
)
from unjam.drivers.registry import DRIVERS
from unjam.worlds.record import Episode

BLESS = 'python tests/golden/bless.py "why they have changed"'


@pytest.fixture(scope="module")
def episodes() -> dict[str, Episode]:
    return dict(drive_all())


@pytest.mark.parametrize("case", cases(), ids="-".join)
def test_a_trajectory_is_the_golden_one(case: tuple[str, str], episodes: dict[str, Episode]) -> None:
    name = "-".join(case)
    episode, golden = episodes[name], (folder() / f"{name}.csv").read_text()
    assert episode.has_run
    found = table_of(episode)
    assert [row.count(",") for row in found.splitlines()] == [row.count(",") for row in golden.splitlines()]
    np.testing.assert_allclose(numbers(found), numbers(golden), rtol=0, atol=2 * GRAIN, err_msg=BLESS)
    assert hash_of(episode) == read_hashes(folder())[name], BLESS


def numbers(table: str) -> np.ndarray:
    _, *rows = table.splitlines()
    return np.array([[float(cell or "nan") for cell in row.split(",")] for row in rows])


def test_every_expert_has_a_golden_trajectory_and_almost_all_differ(episodes: dict[str, Episode]) -> None:
    assert {driver for _, driver in cases()} == set(DRIVERS)
    hashes = read_hashes(folder())
    assert hashes.keys() == episodes.keys() == {path.stem for path in folder().glob("*.csv")}
    for road in ROADS:
        own = [hashes["-".join(case)] for case in cases() if case[0] == road]
        assert len(set(own)) >= len(own) - 1, road  # without noise, `human` and `idm` are the same


def test_the_changelog_names_the_golden_trajectories() -> None:
    changelog = (Path(__file__).parents[2] / "CHANGELOG.md").read_text()
    for place in folder().parent.glob("*/hashes.json"):
        line = f"Golden trajectories of SUMO {place.parent.name} ({fingerprint(read_hashes(place.parent))}): "
        assert line in changelog, BLESS


def test_a_small_change_of_a_trajectory_is_detected(episodes: dict[str, Episode]) -> None:
    episode = episodes["ring-pi"]
    before = hash_of(episode)
    episode.speeds[-1, 3] += 2 * GRAIN
    assert hash_of(episode) != before
    episode.speeds[-1, 3] -= 2 * GRAIN
    assert hash_of(episode) == before
