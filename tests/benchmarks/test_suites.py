"""Suites: fixed roads, references from the study, and the roads as scenarios and environments."""

import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import unjam
from unjam.benchmarks.result import FAMILY_TEST_SEEDS
from unjam.benchmarks.run import drive_by_label
from unjam.benchmarks.suites import SUITES, find_suite, load_references
from unjam.errors import InputError
from unjam.measures.gain import MIN_REFERENCE_GAIN, performance
from unjam.road_family import FAMILY
from unjam.scenarios import make_scenario
from unjam.seeds import selection_seeds, tuning_seeds
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.all_roads import suite_references

RESULTS = Path(__file__).parents[2] / "results/all-roads.json"


def test_references_are_the_rows_of_the_study() -> None:
    study = suite_references(RESULTS)["roads"]  # with seven digits
    for road, found in load_references().items():
        assert found["expert"] == study[road]["expert"]
        for values in ("baseline", "performance"):
            assert found[values] == pytest.approx(study[road][values], rel=1e-6)
    assert set(load_references()) == set(FAMILY)


@pytest.mark.parametrize("name", SUITES)
def test_a_suite_has_training_and_unseen_roads_of_the_family(name: str) -> None:
    parts = [FAMILY[road].part for road in find_suite(name).roads]
    assert 0 < parts.count("training") < len(parts)


@pytest.mark.parametrize("name", ["closed-roads-v1", "motorways-v1"])
def test_the_best_expert_gains_on_each_road_of_the_smaller_suites(name: str) -> None:
    for road in find_suite(name).roads:
        best, human = (float(np.mean(load_references()[road][key])) for key in ("performance", "baseline"))
        assert best - human > MIN_REFERENCE_GAIN * abs(human)
        assert make_scenario(f"family/{road}").is_closed == (name == "closed-roads-v1")


@pytest.mark.parametrize("name", ["all-roads", ["all-roads-v1"], 5])
def test_an_unknown_suite_is_refused_with_the_names(name: Any) -> None:
    with pytest.raises(
        InputError, match=f"suite: {re.escape(repr(name))} is not allowed; allowed: all-roads-v1, closed"
    ):
        find_suite(name)


@pytest.mark.parametrize("name", FAMILY)
def test_each_road_is_a_scenario_and_an_environment(name: str) -> None:
    assert gymnasium.spec(f"unjam/{name}-v1").kwargs["scenario"] == f"family/{name}"
    road = make_scenario(f"family/{name}", {"horizon": 7})
    assert road == make_scenario(FAMILY[name].scenario, {**FAMILY[name].options, "horizon": 7})


@pytest.mark.parametrize(("name", "vehicles"), [("ring-33-growing-3-cavs", 33), ("figure-eight-14", 14)])
def test_an_environment_of_a_road_has_one_cav(name: str, vehicles: int) -> None:
    environment = gymnasium.make(f"unjam/{name}-v1", warmup=10)
    try:
        environment.reset(seed=3)
        assert len(environment.get_wrapper_attr("_road").world.speeds) == vehicles
        assert len(environment.get_wrapper_attr("_road").world.cav_ids) == 1
    finally:
        environment.close()


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        *((name, "family/ring-22-grown") for name in ("family/ring-22-grwn", "ring-22-grown", "ring-22-grwn")),
        *(("figure-eight-15", "family/figure-eight-14"), ("ring-jamed", "ring-jammed"), ("family/ring", "ring")),
    ],
)
def test_an_unknown_road_has_a_hint_with_its_full_name(name: str, hint: str) -> None:
    with pytest.raises(InputError, match=f"'{name}' is not allowed.*; did you mean '{hint}'"):
        make_scenario(name)


def test_test_seeds_are_public_and_reserved() -> None:
    assert unjam.held_out_seeds(10) == FAMILY_TEST_SEEDS
    environment = gymnasium.make("unjam/Ring-v0", horizon=5, warmup=0)
    with pytest.warns(UserWarning, match="seed=1000039 is reserved for tests"):
        environment.reset(seed=unjam.held_out_seeds(1)[0][0])
    environment.close()
    for seeds in (unjam.held_out_seeds, selection_seeds, tuning_seeds):
        cases: list[dict[str, Any]] = [{"count": "x"}, {"count": -1}, {"count": 2, "first": None}]
        for wrong in cases:
            with pytest.raises(InputError, match=f"^{list(wrong)[-1]}: .* is not allowed; allowed: an integer >= 0"):
                seeds(**wrong)
    with pytest.raises(InputError, match="seed"):
        unjam.load_config(changes={"seed": unjam.held_out_seeds(1)[0][0]})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ring-22-no-warm-up", "figure-eight-12", "one-lane-10"])
def test_the_references_of_a_road_can_be_measured_again(name: str) -> None:
    reference = load_references()[name]
    with WorkerPool(2) as pool:
        drivers = {"human": "human", "best": reference["expert"]}
        rows = drive_by_label(make_scenario(f"family/{name}"), drivers, FAMILY_TEST_SEEDS, pool, in_batches=True)
    found = {label: list(map(performance, own)) for label, own in rows.items()}
    assert found == {
        "human": pytest.approx(reference["baseline"], rel=1e-9),
        "best": pytest.approx(reference["performance"], rel=1e-9),
    }
