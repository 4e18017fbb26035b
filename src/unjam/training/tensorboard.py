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
    """Return an `on_iteration` of `unjam.train` that writes each row of progress into the run's folder.

    Each number has a curve over environment steps. Raise `MissingPartError` if TensorBoard is not installed.
    """
    import_optional("tensorboard")  # otherwise the error would come after the first iteration
    from torch.utils.tensorboard.writer import SummaryWriter

    place = Path(folder, TENSORBOARD_FOLDER)
    writer: SummaryWriter | None = None

    def write(row: dict[str, Any]) -> None:
        nonlocal writer
        if writer is None:  # the run creates its folder first
            make_folder(place)  # follows no links; the name of the file cannot be guessed
            writer = SummaryWriter(str(place), filename_suffix=f".{secrets.token_hex(8)}")
        for name, value in flatten_keys(row).items():
            if isinstance(value, int | float) and name not in ("iteration", "environment_steps"):
                writer.add_scalar(name.replace(".", "/", 1), value, row["environment_steps"])
        writer.flush()

    return write
