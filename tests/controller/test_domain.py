from dataclasses import replace

import numpy as np
import pytest

from unjam.controller import packaged_file
from unjam.controller.domain import controller_notes, outside_domain_share, road_description, road_mismatch
from unjam.controller.file import read_controller
from unjam.drivers import LocalState
from unjam.scenarios import Ring, Scenario, make_scenario, scenario_recipe

TRAINED = {"scenario": scenario_recipe(Ring())}


@pytest.mark.parametrize(
    ("road", "words"),
    [
        (Ring(), ""),
        (make_scenario("ring", {"length": 230, "horizon": 100}), ""),
        (Ring(length=(260, 280)), "was trained on the ring road with other parameters: length 260-280 (there 220-270)"),
        (Ring(warmup=6000, vehicles=20), "warmup 6000 (there 0), vehicles 20 (there 22)"),
        (make_scenario("ring", {"safety.active": False}), ": safety.active False (there True)"),
        (make_scenario("merge"), "was trained on the ring road, not on the merge road"),
    ],
)
def test_another_road_than_that_of_the_training_is_told(road: Scenario, words: str) -> None:
    mismatch = road_mismatch(TRAINED, scenario_recipe(road))
    assert mismatch.endswith(words) if words else mismatch == ""


def test_a_tuned_controller_was_not_trained_and_an_unknown_road_is_no_other() -> None:
    mismatch = road_mismatch({**TRAINED, "tuning": {}}, scenario_recipe(make_scenario("merge")))
    assert mismatch == "was tuned on the ring road, not on the merge road"
    assert road_mismatch({}, scenario_recipe(Ring())) == ""
    assert road_description(TRAINED) == "ring, length 220-270, vehicles 22, cavs 1, warmup 0"


def test_states_outside_of_the_certified_domain_are_counted() -> None:
    controller = read_controller(packaged_file("ring-best"))
    inside = LocalState(*(np.full(4, value) for value in (3.5, 3.5, 6.0, 3.5, 6.0, 1.0, 230.0)))
    assert outside_domain_share(controller, inside) == 0.0
    far = inside._replace(leader_gap=np.array([6.0, 6.0, 900.0, 6.0]))
    assert outside_domain_share(controller, far) == 0.25
    assert outside_domain_share(replace(controller, parts={}), far) == 0.0


def test_controllers_on_another_road_and_models_without_their_control_step_get_a_note() -> None:
    road = scenario_recipe(make_scenario("figure-eight"))
    names = ["pi", "human", "unjam:figure-eight-tuned", "unjam:ring-tuned", "ppo.zip"]
    assert controller_notes(road, names, {}) == [
        "unjam:ring-tuned was tuned on the ring road, not on the figure-eight road",
        "ppo.zip does not contain its control step: here it acts every 0.1 s; "
        "ppo.zip:policy_time_step=1.0 sets another",
    ]
