"""Is what is held out never seen, and can each road be driven?"""

import pytest

from unjam.scenarios.ring import Ring
from unjam.training.family import FAMILY, GROUPS, roads_of

SEEN, HELD_OUT = roads_of("everywhere", "seen"), roads_of("everywhere", "combination", "axis")


def test_no_road_that_is_held_out_is_seen() -> None:
    assert len(SEEN) + len(HELD_OUT) == len(FAMILY)
    assert not set(HELD_OUT.values()) & set(SEEN.values())


def test_each_held_out_axis_lies_beyond_what_is_seen() -> None:
    rings = [road for road in SEEN.values() if isinstance(road, Ring)]
    spacings = [size / road.vehicles for road in rings for size in road.length]
    dense = HELD_OUT["ring-22-dense"]
    assert isinstance(dense, Ring)
    assert dense.length[1] / dense.vehicles < min(spacings)
    assert all(road.vehicles < 88 for road in rings)
    assert all(road.cavs < 5 for road in rings)


@pytest.mark.parametrize("group", GROUPS)
def test_every_group_has_roads_of_both_kinds(group: str) -> None:
    assert roads_of(group, "seen")
    assert roads_of(group, "combination", "axis")


def test_rings_are_shared_where_six_in_a_hundred_are_cavs() -> None:
    assert list(roads_of("shared-rings", "seen")) == ["ring-33-growing-3-cavs", "ring-66-grown-4-cavs"]
    assert list(roads_of("shared-rings", "combination", "axis")) == ["ring-44-grown-5-cavs"]
