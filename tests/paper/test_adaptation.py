"""Does something happen on the road where the study says so, and is it seen when a driver has settled?"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from unjam.drivers.registry import driver_from_name
from unjam.files import to_json
from unjam.scenarios import Ring
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.drive import finish_drive
from unjam.worlds.record import Floats
from unjam_paper import adaptation
from unjam_paper.adaptation import (
    ADAPTATION_DRIVERS,
    HURRIED_IDM,
    ROAD_CHANGES,
    STEPS_PER_SECOND,
    CAVSwitchesOff,
    ChangingRings,
    HumansChange,
    WaveArrives,
    adaptation_table,
    settling_times,
)

RING = Ring(horizon=120, cavs=2)
AT = 40


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adaptation, "CHANGE", AT)


def speeds_on(world: type[RingBatch], ring: Ring = RING, driver: str = "pi") -> Floats:
    """Speeds of all vehicles, shape (decisions + 1, vehicles)."""
    made = start_batch_drive(world([ring], [(1,)]), driver_from_name(driver, ring.control_step))
    return finish_drive(made).episodes[0].speeds


@pytest.mark.usefixtures("early")
@pytest.mark.parametrize("world", [WaveArrives, HumansChange, CAVSwitchesOff])
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
    assert speeds_on(HumansChange, calm, "idm")[-1].mean() > 1.05 * speeds_on(RingBatch, calm, "idm")[-1].mean()
    changed = ROAD_CHANGES["people change"]
    assert changed.humans == HURRIED_IDM != ROAD_CHANGES["a wave arrives"].humans


@pytest.mark.usefixtures("early")
def test_who_leaves_drives_as_people_do_and_the_other_goes_on() -> None:
    lone = replace(RING, noise=0.0)
    places = [index for index, name in enumerate(_names(lone)) if name in _cavs(lone)]
    as_ever, found = speeds_on(RingBatch, lone), speeds_on(CAVSwitchesOff, lone)
    first, last = places
    changed = np.abs(found - as_ever)[AT + 1]
    assert changed[last] > 0.0
    assert changed[first] == 0.0


def _names(ring: Ring) -> tuple[str, ...]:
    return RingBatch([ring], [(1,)]).roads[0].vehicle_ids


def _cavs(ring: Ring) -> tuple[str, ...]:
    return RingBatch([ring], [(1,)]).roads[0].cav_ids


def test_settled_is_who_stays_near_the_limit_for_a_minute_until_the_end() -> None:
    change, end = adaptation.CHANGE_STEP // STEPS_PER_SECOND, adaptation.END_STEP // STEPS_PER_SECOND
    speeds = np.full((4, end), 4.0)
    speeds[1, change : change + 50] = 2.0
    speeds[2, change:] = 3.7
    speeds[3, -30:] = 2.0
    found = settling_times(speeds, np.full(4, 4.0))
    assert found[0] == 0.0
    assert 45.0 < found[1] <= 50.0, "a mean over ten seconds sees it a little earlier"
    assert np.isnan(found[2])
    assert np.isnan(found[3])


def test_a_table_has_a_row_for_each_driver(tmp_path: Path) -> None:
    speeds = np.full((3, adaptation.END_STEP // STEPS_PER_SECOND), 4.0)
    for place in range(len(ADAPTATION_DRIVERS)):
        content = {"limits": [4.0] * 3, "speeds": (speeds - 0.5 * (place == 0)).tolist()}
        (tmp_path / f"1-{place}.json").write_text(to_json(content))
    shown = adaptation_table("people change", tmp_path)
    assert list(shown[""]) == list(ADAPTATION_DRIVERS)
    assert list(shown["settled"]) == ["0 of 3", *["3 of 3"] * (len(ADAPTATION_DRIVERS) - 1)]
    assert list(shown["after, in the median [s]"])[:2] == ["–", "0"]
