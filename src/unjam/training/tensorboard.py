"""Progress of a training as TensorBoard shows it."""

import secrets
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from unjam.errors import MissingPartError
from unjam.files import make_folder
from unjam.parameters import flatten_keys
from unjam.training.executors import IterationCallback

TENSORBOARD_FOLDER = "tensorboard"
"""of a run: what `tensorboard --logdir` is given"""


def tensorboard_writer(folder: Path | str) -> IterationCallback:
    """Return what writes each row of progress into a run's folder: for `on_iteration` of `unjam.train`.

    Every number of a row has its curve over actual steps; those of one kind have one group.

    Raises:
        MissingPartError: TensorBoard is not installed.
    """
    if find_spec("tensorboard") is None:  # else only the first iteration would tell
        raise MissingPartError("tensorboard: it is not installed: pip install 'unjam[train]'")
    from torch.utils.tensorboard.writer import SummaryWriter

    place = Path(folder, TENSORBOARD_FOLDER)
    writer: SummaryWriter | None = None

    def write(row: dict[str, Any]) -> None:
        nonlocal writer
        if writer is None:  # the run makes its folder first
            make_folder(place)  # no link is followed there, and nobody can guess the name of the file
            writer = SummaryWriter(str(place), filename_suffix=f".{secrets.token_hex(8)}")
        for name, value in flatten_keys(row).items():
            if isinstance(value, int | float) and name not in ("iteration", "environment_steps"):
                writer.add_scalar(name.replace(".", "/", 1), value, row["environment_steps"])
        writer.flush()

    return write
