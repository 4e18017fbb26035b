"""Is a car that SUMO keeps from creeping up to who stands counted as overridden?"""

from dataclasses import replace

from unjam.drivers import PISaturation
from unjam.measures.metrics import measure
from unjam.training.family import FAMILY
from unjam.training.seeds import held_out_seeds
from unjam.worlds.audit import SHIELD_ROUNDING
from unjam.worlds.episode import run_episode


def test_a_car_that_may_not_creep_is_not_one_that_had_to_be_braked() -> None:
    road = FAMILY["ring-66-grown-4-cavs"].make().part(1, 10)
    row = measure(run_episode(replace(road, horizon=620), PISaturation(), held_out_seeds(2)[1]))
    assert 0.0 < row["shield_max_braking"] < SHIELD_ROUNDING, "SUMO holds it, a micrometre from its place"
    assert (row["overridden"], row["shield_override_share"]) == (0.0, 0.0)
