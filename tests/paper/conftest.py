"""Studies of a road so small that training takes a second."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from unjam.cli import app
from unjam.training.executors import CommandLine
from unjam_paper import STUDIES, references, study
from unjam_paper import reproduce as reproduction
from unjam_paper.comparison import comparison_study
from unjam_paper.reproduce import make_plan, run_plan
from unjam_paper.study import StudyFolder, Variant

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
LITTLE = comparison_study("two ways to learn on a little ring", ("plain", "virtual"), "little")


REFERENCES = {"human": "human", "PI": "pi", "ACC": "acc"}
TUNED = {"tuned PI": "pi:window=20"}
VARIANTS = {
    "plain": Variant("plain", "", {"model.model_ratio": 0.0}, 320),
    "virtual": Variant("with a model", "", {"model.model_ratio": 1.0}, 320),
}


@pytest.fixture(scope="module")
def little() -> Iterator[pytest.MonkeyPatch]:
    """Have the study `little` beside the others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STUDIES, "little", LITTLE)
        patch.setitem(study.STUDY_ROADS, "little", SMALL)
        for name, variant in VARIANTS.items():
            patch.setitem(study.VARIANTS, name, variant)
        patch.setattr(references, "REFERENCES", REFERENCES)
        patch.setitem(references.TUNED_REFERENCES, "little", TUNED)
        yield patch


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory: pytest.TempPathFactory, little: pytest.MonkeyPatch) -> tuple[Path, list[str]]:
    """A study that was made, its trainings in this process and without reports: its folder, what was told."""
    little.setattr(reproduction, "run_all", run_here)
    little.setattr("unjam.training.train.write_report", lambda folders, path: path.touch())
    folder, told = tmp_path_factory.mktemp("studies"), []
    to_do = make_plan(["little"], 2, StudyFolder(folder))
    assert len(to_do.runs) == 4
    run_plan(to_do, 2, on_message=told.append)
    return folder, told


def run_here(commands: dict[str, CommandLine], workers: int, executor: str, on_line: Callable[[str], None]) -> None:
    """Run command lines of `unjam` in this process."""
    for name, command in commands.items():
        app(command.argv()[4:], standalone_mode=False)
        on_line(name)
