"""Does tuning find better settings with the steps it has, and write what every verb can drive?"""

import json
from pathlib import Path

import pytest

from unjam.controller import load_controller
from unjam.drivers import PISaturation
from unjam.errors import InputError
from unjam.scenarios import Ring
from unjam.training.search import Choice, Range
from unjam.training.seeds import TUNE, tuning_seeds
from unjam.training.tune import EPISODES, FINALISTS, TUNED, space_around, tune
from unjam.worlds.workers import Workers

SMALL = Ring(horizon=60)
FINAL = (FINALISTS + 1) * 2 * EPISODES * 60
STEPS = FINAL + 4 * EPISODES * 60
SPACE = {"catch_up_speed": Range(0.5, 3.0), "safe_gap_rule": Choice(("constant", "closing"))}


def test_a_tuned_expert_is_written_and_no_worse_than_it_was(tmp_path: Path) -> None:
    with Workers(1) as workers:
        lines: list[str] = []
        found = tune(SMALL, "pi", SPACE, STEPS, tmp_path, workers, on_line=lines.append)
    assert found.actual_steps <= STEPS
    assert len(found.settings) == len(lines) == 4
    assert found.best.score is not None
    assert found.default.score is not None
    assert found.best.score >= found.default.score
    driver = load_controller(found.file)
    assert isinstance(driver, PISaturation)
    assert found.best.values.items() <= vars(driver).items()
    written = json.loads((tmp_path / TUNED).read_text())
    assert written["best"]["driver"] == found.best.driver
    assert len(written["settings"]) == 4


def test_the_same_seed_tries_the_same_settings_whoever_drives(tmp_path: Path) -> None:
    tried = []
    for count in (1, 2):
        with Workers(count) as workers:
            (folder := tmp_path / str(count)).mkdir()
            tried.append(tune(SMALL, "pi", SPACE, STEPS, folder, workers).settings)
    assert tried[0] == tried[1]


def test_too_few_steps_are_refused_before_anything_is_driven(tmp_path: Path) -> None:
    with (
        Workers(1) as workers,
        pytest.raises(InputError, match=f"steps: {FINAL} is not allowed; allowed: >= "),
    ):
        tune(SMALL, "pi", SPACE, FINAL, tmp_path, workers)


def test_the_space_around_an_expert_has_its_numbers_words_and_truths() -> None:
    space = space_around("pi", 0.1)
    assert space["catch_up_speed"] == Range(0.25, 4.0, log=True)
    assert space["safe_gap_rule"] == Choice(("constant", "closing"))
    assert "time_step" not in space
    assert space_around("pacer", 0.1)["varying"] == Choice((False, True))
    for name in ("human", "nobody"):
        with pytest.raises(InputError):
            space_around(name, 0.1)


def test_finalists_meet_seeds_that_no_setting_was_tried_on() -> None:
    assert not set(tuning_seeds(EPISODES)) & set(tuning_seeds(2 * EPISODES, EPISODES))
    assert {first for first, _ in tuning_seeds(3)} == {TUNE}
