"""Progress of a training for TensorBoard."""

import secrets
from pathlib import Path
from typing import Any

from unjam.errors import import_optional
from unjam.files import make_folder
from unjam.parameters import flatten_keys
from unjam.training.executors import IterationCallback

TENSORBOARD_FOLDER = "tensorboard"
"""folder within a run, for `tensorboard --logdir`"""


def tensorboard_writer(folder: Path | str) -> IterationCallback:
    """Return a function for `on_iteration` of `unjam.train` that writes each row of progress into the run's folder.

    Each number has a curve over environment steps. Raise `MissingPartError` if TensorBoard is not installed.
    """
    import_optional("tensorboard")  # otherwise, the error would be raised after the first iteration
    from torch.utils.tensorboard.writer import SummaryWriter

    log_folder = Path(folder, TENSORBOARD_FOLDER)
    writer: SummaryWriter | None = None

    def write_row(row: dict[str, Any]) -> None:
        nonlocal writer
        if writer is None:  # the training creates the run's folder before
            make_folder(log_folder)  # follows no links; the random suffix keeps others from placing a link as the file
            writer = SummaryWriter(str(log_folder), filename_suffix=f".{secrets.token_hex(8)}")
        for name, value in flatten_keys(row).items():
            if isinstance(value, int | float) and name not in ("iteration", "environment_steps"):
                writer.add_scalar(name.replace(".", "/", 1), value, row["environment_steps"])
        writer.flush()

    return write_row
