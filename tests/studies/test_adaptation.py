"""Does something happen on the road where the study says so, and is it seen when a driver has settled?"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from unjam.drivers.registry import named_driver
from unjam.files import to_json
from unjam.scenarios import Ring
from unjam.studies import adaptation
from unjam.studies.adaptation import (
    CHANGES,
    DRIVERS,
    HURRIED_PEOPLE,
    SECOND,
    CAVLeaves,
    ChangingRings,
    PeopleChange,
    WaveArrives,
    settled_after,
    table,
)
from unjam.worlds.batch.run import begin
from unjam.worlds.batch.world import RingBatch
from unjam.worlds.drive import driven_to_the_end
from unjam.worlds.record import Floats

RING = Ring(horizon=120, cavs=2)
AT = 40


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adaptation, "CHANGE", AT)


def speeds_on(world: type[RingBatch], ring: Ring = RING, driver: str = "pi") -> Floats:
    """Speeds of all vehicles, shape (decisions + 1, vehicles)."""
    made = begin(world([ring], [(1,)]), named_driver(driver, ring.decision_step))
    return driven_to_the_end(made).episodes[0].speeds


@pytest.mark.usefixtures("early")
@pytest.mark.parametrize("world", [WaveArrives, PeopleChange, CAVLeaves])
def test_nothing_happens_before_the_change_and_something_after(world: type[ChangingRings]) -> None:
    ring = replace(RING, cavs=1) if world is WaveArrives else RING
    as_ever, found = speeds_on(RingBatch, ring), speeds_on(world, ring)
    np.testing.assert_array_equal(found[: AT + 1], as_ever[: AT + 1])
    assert not np.array_equal(found[AT + 10 :], as_ever[AT + 10 :])


@pytest.mark.usefixtures("early")
def test_somebody_who_is_no_cav_brakes_to_a_crawl() -> None:
    ring = replace(RING, cavs=1, warmup=400)
    before, after = speeds_on(WaveArrives, ring)[[AT, AT + 60]]
    crawls = np.flatnonzero((after <= 0.5 + 0.3) & (before > 1.5))
    assert len(crawls), "noise is added to what was commanded"


@pytest.mark.usefixtures("early")
def test_people_who_follow_closer_drive_faster_in_the_end() -> None:
    calm = replace(RING, horizon=900, noise=0.0)
    assert (
        speeds_on(PeopleChange, calm, "idm")[-1].mean() > 1.05 * speeds_on(RingBatch, calm, "idm")[-1].mean()
    )
    changed = CHANGES["people change"]
    assert changed.humans == HURRIED_PEOPLE != CHANGES["a wave arrives"].humans


@pytest.mark.usefixtures("early")
def test_who_leaves_drives_as_people_do_and_the_other_goes_on() -> None:
    lone = replace(RING, noise=0.0)
    places = [index for index, name in enumerate(_names(lone)) if name in _cavs(lone)]
    as_ever, found = speeds_on(RingBatch, lone), speeds_on(CAVLeaves, lone)
    first, last = places
    changed = np.abs(found - as_ever)[AT + 1]
    assert changed[last] > 0.0
    assert changed[first] == 0.0


def _names(ring: Ring) -> tuple[str, ...]:
    return RingBatch([ring], [(1,)]).roads[0].vehicle_ids


def _cavs(ring: Ring) -> tuple[str, ...]:
    return RingBatch([ring], [(1,)]).roads[0].cav_ids


def test_settled_is_who_stays_near_the_limit_for_a_minute_until_the_end() -> None:
    change, end = adaptation.CHANGE // SECOND, adaptation.END // SECOND
    speeds = np.full((4, end), 4.0)
    speeds[1, change : change + 50] = 2.0
    speeds[2, change:] = 3.7
    speeds[3, -30:] = 2.0
    found = settled_after(speeds, np.full(4, 4.0))
    assert found[0] == 0.0
    assert 45.0 < found[1] <= 50.0, "a mean over ten seconds sees it a little earlier"
    assert np.isnan(found[2])
    assert np.isnan(found[3])


def test_a_table_has_a_row_for_each_driver(tmp_path: Path) -> None:
    speeds = np.full((3, adaptation.END // SECOND), 4.0)
    for place in range(len(DRIVERS)):
        content = {"limits": [4.0] * 3, "speeds": (speeds - 0.5 * (place == 0)).tolist()}
        (tmp_path / f"1-{place}.json").write_text(to_json(content))
    shown = table("people change", tmp_path)
    assert list(shown[""]) == list(DRIVERS)
    assert list(shown["settled"]) == ["0 of 3", *["3 of 3"] * (len(DRIVERS) - 1)]
    assert list(shown["after, in the median [s]"])[:2] == ["–", "0"]
