"""Progress of a training as TensorBoard shows it, written by Stable-Baselines3's logger."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from unjam.errors import MissingPartError
from unjam.parameters import flat
from unjam.training.executors import OnIteration

FOLDER = "tensorboard"
"""of a run: what `tensorboard --logdir` is given"""


def tensorboard_into(folder: Path | str) -> OnIteration:
    """Return what writes each row of progress into a run's folder: for `on_iteration` of `unjam.train`.

    Every number of a row has its curve over actual steps; those of one kind have one group.

    Raises:
        MissingPartError: TensorBoard is not installed.
    """
    if find_spec("tensorboard") is None:  # Stable-Baselines3 would say so after the first iteration
        raise MissingPartError("tensorboard: it is not installed: pip install 'unjam[train]'")
    from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

    logger: Logger | None = None

    def write(row: dict[str, Any]) -> None:
        nonlocal logger
        if logger is None:  # the run makes its folder first
            logger = Logger(str(folder), [TensorBoardOutputFormat(str(Path(folder, FOLDER)))])
        for name, value in flat(row).items():
            if isinstance(value, int | float) and name not in ("iteration", "actual_steps"):
                logger.record(name.replace(".", "/", 1), value)
        logger.dump(row["actual_steps"])

    return write
