import itertools

import numpy as np
import pytest

from unjam.errors import InputError
from unjam.scenarios import SCENARIOS, Ring, make_scenario, scenario_from_recipe, scenario_recipe


def test_lengths_are_integers_from_the_whole_range() -> None:
    generator = np.random.default_rng(0)
    lengths = {Ring().draw(generator).loop_length for _ in range(2000)}
    assert lengths == set(range(220, 271))


def test_vehicles_stand_evenly_spread() -> None:
    road = Ring(length=(220, 220)).draw(np.random.default_rng(0))
    np.testing.assert_allclose(np.diff(road.start_positions), 10.0)
    assert len(road.vehicle_ids) == 22
    assert road.cav_ids == ("cav_0",)


def test_several_cavs_are_spread_evenly() -> None:
    road = Ring(cavs=4).draw(np.random.default_rng(0))
    assert road.cav_ids == ("cav_0", "cav_6", "cav_11", "cav_16")


def test_limit_is_the_equilibrium_speed_of_the_length() -> None:
    road = Ring(length=(260, 260)).draw(np.random.default_rng(0))
    assert road.limit_speed == pytest.approx(4.816, abs=5e-4)


def test_strata_cover_the_range_without_overlap() -> None:
    parts = [Ring().stratum(index, 4) for index in range(4)]
    assert parts[0].length[0] == 220
    assert parts[-1].length[1] == 270
    for before, after in itertools.pairwise(parts):
        assert after.length[0] == before.length[1] + 1


@pytest.mark.parametrize("count", [1, 2, 8, 60])
def test_strata_of_a_single_length_are_that_length(count: int) -> None:
    assert {Ring(length=(230, 230)).stratum(index, count).length for index in range(count)} == {(230, 230)}


def test_drawn_values_are_scaled_over_their_range() -> None:
    ring = Ring()
    assert ring.scale_drawn_values({"length": 220}) == (-1.0,)
    assert ring.scale_drawn_values({"length": 245}) == (0.0,)
    assert ring.scale_drawn_values({"length": 270}) == (1.0,)
    assert np.isfinite(Ring(length=(230, 230)).scale_drawn_values({"length": 230})).all()


def test_warmups_of_the_named_rings() -> None:
    rings = {name: scenario.warmup for name, scenario in SCENARIOS.items() if name.startswith("ring")}
    assert rings == {"ring": 0, "ring-warm": 750, "ring-jammed": 6000}


def test_noise_is_flows_by_default_and_the_papers_on_request() -> None:
    assert Ring().noise_per_step == pytest.approx(0.0632, abs=5e-5)
    assert Ring(noise_scaling="none").noise_per_step == 0.2


def test_a_recipe_restores_the_scenario() -> None:
    ring = make_scenario("ring-warm", {"length": (230, 240), "humans": {"time_headway": 1.3}, "noise": 0.1})
    assert scenario_from_recipe(scenario_recipe(ring)) == ring


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"length": (250, 230)}, "length: 230 m is not allowed as the largest; allowed: >= 250 m"),
        ({"vehicles": 50}, "length: 220 m is not allowed for 50 vehicles; allowed: >= 350 m"),
        ({"vehicles": 1}, "vehicles: 1 is not allowed"),
        ({"cavs": 30}, "cavs: 30 is not allowed; allowed: <= vehicles, 22"),
        ({"cavs": 0}, "cavs: 0 is not allowed"),
        ({"lenght": (230, 230)}, "lenght: unknown name"),
        ({"noise": "much"}, "noise: 'much' is not allowed"),
        ({"noise": float("nan")}, "noise: nan is not allowed"),
        ({"humans": {"time_headway": -1}}, "humans.time_headway: -1 is not allowed"),
        ({"actuation": "magic"}, "actuation: 'magic' is not allowed"),
        ({"length": (230.5, 240)}, "length.0: 230.5 is not allowed"),
    ],
)
def test_invalid_parameters_are_reported_in_one_line(changes: dict, words: str) -> None:
    with pytest.raises(InputError) as caught:
        make_scenario("ring", changes)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_scenario_lists_the_known() -> None:
    with pytest.raises(InputError, match="'rong' is not allowed; allowed: ring, ring-warm, ring-jammed"):
        make_scenario("rong")
