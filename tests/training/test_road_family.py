"""The road family: training and unseen roads."""

import pytest

from unjam.road_family import FAMILY, ROAD_GROUPS
from unjam.scenarios.family import family_scenarios
from unjam.scenarios.ring import Ring

TRAINING, UNSEEN = family_scenarios("all-roads", "training"), family_scenarios("all-roads", "combination", "axis")


def test_unseen_roads_are_not_used_for_training() -> None:
    assert len(TRAINING) + len(UNSEEN) == len(FAMILY)
    assert not set(UNSEEN.values()) & set(TRAINING.values())


def test_unseen_axes_lie_beyond_training_values() -> None:
    rings = [road for road in TRAINING.values() if isinstance(road, Ring)]
    spacings = [size / road.vehicles for road in rings for size in road.length]
    dense = UNSEEN["ring-22-dense"]
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
