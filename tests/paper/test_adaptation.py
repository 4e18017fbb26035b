"""Changes of the road in the study `adaptation`, and settling times."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from unjam.drivers.registry import driver_from_name
from unjam.drivers.safety import INSTANT_ACTUATOR
from unjam.files import to_json
from unjam.scenarios import Ring
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.drive import finish_drive
from unjam.worlds.record import Floats
from unjam_paper import adaptation
from unjam_paper.adaptation import (
    ADAPTATION_DRIVERS,
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
CHANGE = 40


@pytest.fixture
def early_change(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adaptation, "CHANGE_STEP", CHANGE)


def speeds_on(world: type[RingBatch], ring: Ring = RING, driver: str = "pi") -> Floats:
    """Return the speeds of all vehicles, shape (control steps + 1, vehicles)."""
    drive = start_batch_drive(world([ring], [(1,)]), driver_from_name(driver, ring.control_step))
    return finish_drive(drive)[0].speeds


@pytest.mark.usefixtures("early_change")
@pytest.mark.parametrize("world", [WaveArrives, HumansChange, CAVSwitchesOff])
def test_speeds_differ_only_after_the_change(world: type[ChangingRings]) -> None:
    ring = replace(RING, cavs=1) if world is WaveArrives else RING
    unchanged, changed = speeds_on(RingBatch, ring), speeds_on(world, ring)
    np.testing.assert_array_equal(changed[: CHANGE + 1], unchanged[: CHANGE + 1])
    assert not np.array_equal(changed[CHANGE + 10 :], unchanged[CHANGE + 10 :])


@pytest.mark.usefixtures("early_change")
def test_a_human_driven_vehicle_brakes_to_a_low_speed() -> None:
    ring = replace(RING, cavs=1, warmup=400)
    speeds_before, speeds_after = speeds_on(WaveArrives, ring)[[CHANGE, CHANGE + 60]]
    assert ((speeds_after <= 0.5 + 0.3) & (speeds_before > 1.5)).any(), "noise is added to the commanded speed"


@pytest.mark.usefixtures("early_change")
def test_human_drivers_that_follow_closer_are_faster_in_the_end() -> None:
    calm = replace(RING, horizon=900, noise=0.0)
    assert speeds_on(HumansChange, calm, "idm")[-1].mean() > 1.05 * speeds_on(RingBatch, calm, "idm")[-1].mean()
    _, changed = ROAD_CHANGES["human drivers change"]
    assert changed is HumansChange
    assert changed.humans_after.time_headway < WaveArrives.humans_after.time_headway


@pytest.mark.usefixtures("early_change")
def test_only_the_last_cav_switches_off() -> None:
    ring = replace(RING, noise=0.0, actuator=INSTANT_ACTUATOR)
    road = RingBatch([ring], [(1,)]).roads[0]
    first, last = (index for index, vehicle_id in enumerate(road.vehicle_ids) if vehicle_id in road.cav_ids)
    unchanged, changed = speeds_on(RingBatch, ring), speeds_on(CAVSwitchesOff, ring)
    difference = np.abs(changed - unchanged)[CHANGE + 1]
    assert difference[last] > 0.0
    assert difference[first] == 0.0


def test_a_driver_has_settled_when_it_stays_near_the_limit_for_the_last_minute() -> None:
    change, end = adaptation.CHANGE_STEP // STEPS_PER_SECOND, adaptation.END_STEP // STEPS_PER_SECOND
    speeds = np.full((4, end), 4.0)
    speeds[1, change : change + 50] = 2.0
    speeds[2, change:] = 3.7
    speeds[3, -30:] = 2.0
    times = settling_times(speeds, np.full(4, 4.0))
    assert times[0] == 0.0
    assert 45.0 < times[1] <= 50.0, "the mean over ten seconds reaches it a little earlier"
    assert np.isnan(times[2])
    assert np.isnan(times[3])


def test_a_table_has_a_row_for_each_driver(tmp_path: Path) -> None:
    speeds = np.full((3, adaptation.END_STEP // STEPS_PER_SECOND), 4.0)
    for number in range(len(ADAPTATION_DRIVERS)):
        content = {"limits": [4.0] * 3, "speeds": (speeds - 0.5 * (number == 0)).tolist()}
        (tmp_path / f"1-{number}.json").write_text(to_json(content))
    table = adaptation_table("human drivers change", tmp_path)
    assert list(table[""]) == list(ADAPTATION_DRIVERS)
    assert list(table["settled"]) == ["0 of 3", *["3 of 3"] * (len(ADAPTATION_DRIVERS) - 1)]
    assert list(table["after, median [s]"])[:2] == ["–", "0"]
