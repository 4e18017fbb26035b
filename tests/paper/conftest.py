"""A study of a road so small that a training takes a second."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from unjam.cli import app
from unjam.training.executors import CommandLine
from unjam_paper import reproduce as reproduction
from unjam_paper import study
from unjam_paper.comparison import comparison_study
from unjam_paper.reproduce import make_plan, run_plan
from unjam_paper.studies import STUDIES
from unjam_paper.study import StudyFolder
from unjam_paper.variants import TUNED_REFERENCES, VARIANTS, Variant

SMALL: dict[str, Any] = {
    "scenario": "ring",
    "scenario_options.length": [60, 70],
    "scenario_options.vehicles": 5,
    "scenario_options.horizon": 80,
    "trpo.steps_per_iteration": 160,
    "evaluation.validation_episodes": 1,
    "evaluation.episodes": 2,
    "model.epochs": 1,
    "model.members": 2,
}
SMALL_STUDY = comparison_study("two variants on a small ring", ("plain", "with-model"), "small")
REFERENCES = {"human": "human", "PI": "pi", "ACC": "acc"}
TUNED = {"tuned PI": "pi:window=20"}
SMALL_VARIANTS = {
    "plain": Variant("plain", "", {"model.model_ratio": 0.0}, 320),
    "with-model": Variant("with a model", "", {"model.model_ratio": 1.0}, 320),
}


@pytest.fixture(scope="module")
def small_study() -> Iterator[pytest.MonkeyPatch]:
    """Add the study `small`."""
    with pytest.MonkeyPatch.context() as patch:
        add_small_study(patch)
        yield patch


def add_small_study(patch: pytest.MonkeyPatch) -> None:
    """Add the study `small` to this process."""
    patch.setitem(STUDIES, "small", SMALL_STUDY)
    patch.setitem(study.STUDY_ROADS, "small", SMALL)
    for name, variant in SMALL_VARIANTS.items():
        patch.setitem(VARIANTS, name, variant)
    patch.setattr(reproduction, "REFERENCE_DRIVERS", REFERENCES)
    patch.setitem(TUNED_REFERENCES, "small", TUNED)


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory: pytest.TempPathFactory, small_study: pytest.MonkeyPatch) -> tuple[Path, list[str]]:
    """Return the folder of the reproduced study `small`, with trainings in this process, and the messages."""
    small_study.setattr(reproduction, "run_all", run_here)
    small_study.setattr("unjam.training.train.write_report_page", lambda folders, path: path.touch())
    folder, messages = tmp_path_factory.mktemp("studies"), []
    plan = make_plan(["small"], 2, StudyFolder(folder))
    assert len(plan.runs) == 4
    run_plan(plan, 2, on_message=messages.append)
    return folder, messages


def run_here(commands: dict[str, CommandLine], workers: int, executor: str, on_message: Callable[[str], None]) -> None:
    """Run command lines of `unjam` in this process."""
    for name, command in commands.items():
        app(command.argv()[4:], standalone_mode=False)
        on_message(name)
