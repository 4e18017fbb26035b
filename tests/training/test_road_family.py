"""Is what is held out never seen, and can each road be driven?"""

import pytest

from unjam.scenarios.ring import Ring
from unjam.training.road_family import FAMILY, ROAD_GROUPS, family_scenarios

SEEN, HELD_OUT = family_scenarios("all-roads", "training"), family_scenarios("all-roads", "combination", "axis")


def test_unseen_roads_are_not_used_for_training() -> None:
    assert len(SEEN) + len(HELD_OUT) == len(FAMILY)
    assert not set(HELD_OUT.values()) & set(SEEN.values())


def test_unseen_axes_lie_beyond_training_values() -> None:
    rings = [road for road in SEEN.values() if isinstance(road, Ring)]
    spacings = [size / road.vehicles for road in rings for size in road.length]
    dense = HELD_OUT["ring-22-dense"]
    assert isinstance(dense, Ring)
    assert dense.length[1] / dense.vehicles < min(spacings)
    assert all(road.vehicles < 88 for road in rings)
    assert all(road.cavs < 5 for road in rings)


@pytest.mark.parametrize("group", ROAD_GROUPS)
def test_every_group_has_training_and_unseen_roads(group: str) -> None:
    assert family_scenarios(group, "training")
    assert family_scenarios(group, "combination", "axis")


def test_shared_rings_have_at_least_six_percent_cavs() -> None:
    assert list(family_scenarios("shared-rings", "training")) == ["ring-33-growing-3-cavs", "ring-66-grown-4-cavs"]
    assert list(family_scenarios("shared-rings", "combination", "axis")) == ["ring-44-grown-5-cavs"]
