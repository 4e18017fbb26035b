"""Trainings as command lines: each in a process of its own, begun or gone on with."""

from pathlib import Path

from unjam.files import make_folder, write_whole
from unjam.training.config import RunConfig, to_toml
from unjam.training.executors import Command


def training_command(config: RunConfig, folder: Path, plan: Path, log: Path) -> Command:
    """Return the command line that begins a training, or goes on with it.

    Args:
        config: what to train.
        folder: of the run.
        plan: file for the configuration, written here.
        log: where what it prints is added.
    """
    make_folder(plan.parent)
    write_whole(plan, to_toml(config))
    once = ["--workers", str(config.workers)]
    return Command(
        ["train", "--config", str(plan), *once, "--out", str(folder)],
        log,
        folder / "config.toml",
        ["train", "--resume", str(folder), *once, "--steps", str(config.steps)],
    )
