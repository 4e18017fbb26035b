"""Studies of a road so small that training takes a second."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from unjam.cli import app
from unjam.studies import STUDIES, references, study
from unjam.studies import reproduce as reproduction
from unjam.studies.comparison import comparison_of
from unjam.studies.reproduce import make_plan, reproduce
from unjam.studies.study import StudyFolder, Variant
from unjam.training.executors import CommandLine

SMALL: dict[str, Any] = {
    "scenario": "ring",
    "road.length": [60, 70],
    "road.vehicles": 5,
    "road.horizon": 80,
    "trpo.batch_steps": 160,
    "evaluation.validation_episodes": 1,
    "evaluation.episodes": 2,
    "virtual.epochs": 1,
    "virtual.members": 2,
}
LITTLE = comparison_of("two ways to learn on a little ring", ("plain", "virtual"), "little")


REFERENCES = {"human": "human", "PI": "pi", "ACC": "acc"}
TUNED = {"tuned PI": "pi:window=20"}
VARIANTS = {
    "plain": Variant("plain", "", {"virtual.virtual_ratio": 0.0}, 320),
    "virtual": Variant("with a model", "", {"virtual.virtual_ratio": 1.0}, 320),
}


@pytest.fixture(scope="module")
def little() -> Iterator[pytest.MonkeyPatch]:
    """Have the study `little` beside the others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STUDIES, "little", LITTLE)
        patch.setitem(study.ROADS, "little", SMALL)
        for name, variant in VARIANTS.items():
            patch.setitem(study.VARIANTS, name, variant)
        patch.setattr(references, "REFERENCES", REFERENCES)
        patch.setitem(references.TUNED, "little", TUNED)
        yield patch


@pytest.fixture(scope="module")
def reproduced(
    tmp_path_factory: pytest.TempPathFactory, little: pytest.MonkeyPatch
) -> tuple[Path, list[str]]:
    """A study that was made, its trainings in this process and without reports: its folder, what was told."""
    little.setattr(reproduction, "run_all", run_here)
    little.setattr("unjam.training.train.write_report", lambda folders, path: path.touch())
    folder, told = tmp_path_factory.mktemp("studies"), []
    to_do = make_plan(["little"], 2, StudyFolder(folder))
    assert len(to_do.runs) == 4
    reproduce(to_do, 2, on_line=told.append)
    return folder, told


def run_here(
    commands: dict[str, CommandLine], workers: int, executor: str, on_line: Callable[[str], None]
) -> None:
    """Run command lines of `unjam` in this process."""
    for name, command in commands.items():
        app(command.line()[4:], standalone_mode=False)
        on_line(name)
