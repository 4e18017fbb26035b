"""Who is counted as overridden, and who is not: a car that may not creep, or that cannot drive faster."""

from dataclasses import replace

from unjam.drivers import PISaturation
from unjam.drivers.registry import named_driver
from unjam.measures.metrics import measure
from unjam.scenarios import Ring
from unjam.training.family import FAMILY
from unjam.training.seeds import held_out_seeds
from unjam.worlds.audit import SHIELD_ROUNDING
from unjam.worlds.episode import run_episode


def test_a_car_that_may_not_creep_is_not_one_that_had_to_be_braked() -> None:
    road = FAMILY["ring-66-grown-4-cavs"].make().part(1, 10)
    row = measure(run_episode(replace(road, horizon=620), PISaturation(), held_out_seeds(2)[1]))
    assert 0.0 < row["shield_max_braking"] < SHIELD_ROUNDING, "SUMO holds it, a micrometre from its place"
    assert (row["overridden"], row["shield_override_share"]) == (0.0, 0.0)


def test_a_car_that_cannot_drive_as_fast_as_it_is_told_to_is_not_braked() -> None:
    road = Ring(vehicles=2, length=(1500, 1500), horizon=600)
    episode = run_episode(road, named_driver("constant:acceleration=0.9", 0.1), (1,))
    row = measure(episode)
    assert episode.trajectories[0].states.speed.max() == road.top_speed
    assert (row["shield_max_braking"], row["overridden"], row["shield_override_share"]) == (0.0, 0.0, 0.0)
