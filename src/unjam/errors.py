"""Errors that a user can cause or correct: a message of one line and an exit code, without a traceback."""

import errno
import shlex
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from unjam.text import spelling_hint


class UnjamError(Exception):
    """An error with a message of one line for users; the command line exits with `exit_code`."""

    exit_code = 1


class InputError(UnjamError):
    """Invalid input: the message names the field, the value and what is allowed."""

    exit_code = 2


class RowError(InputError):
    """An invalid value in a row of CAVs; the driving loop adds the name of the CAV and the control step."""

    def __init__(self, message: str, row: int = 0) -> None:
        super().__init__(message)
        self.row = row


class NoCavError(InputError):
    """A driver had no vehicle to drive: by chance, or because too few vehicles are CAVs."""


class MissingPartError(UnjamError):
    """A required program or package is missing: the message says how to install it."""

    exit_code = 3


EXTRAS = {
    **dict.fromkeys(("torch", "stable_baselines3", "sb3_contrib", "tensorboard"), "train"),
    **dict.fromkeys(("onnx", "onnxscript", "onnxruntime"), "train"),
    **{"optuna": "tune", "imageio_ffmpeg": "video", "cryptography": "sign", "pettingzoo": "marl", "ray": "ray"},
}
"""extra of unjam that installs each optional package; `drive` and `assess` need no extra"""


def missing_package_error(error: ImportError, name: str | None = None) -> MissingPartError:
    """Return the error for a missing package (`name`, or that in `error`) or shared library; else raise `error`."""
    package = (name or error.name or "").partition(".")[0]
    reason = f"cannot be imported ({' '.join(str(error).split())})"
    if package not in EXTRAS:
        if "shared object" not in reason:
            raise error
        return MissingPartError(f"a package {reason}; allowed: enough memory, and its files as pip installed them")
    if isinstance(error, ModuleNotFoundError):
        reason = "is not installed"
    return MissingPartError(f"{package} {reason}; install it: pip install 'unjam[{EXTRAS[package]}]'")


def import_optional(name: str) -> Any:
    """Import a package of an extra and return it; raise `MissingPartError`, which names the extra, if this fails."""
    try:
        return import_module(name)
    except ImportError as error:
        raise missing_package_error(error, name) from None


class DiskError(UnjamError):
    """The disk is full or cannot be written."""

    exit_code = 74


class EpisodeError(UnjamError):
    """An episode failed repeatedly: the message says how to repeat it."""


class SumoInputError(EpisodeError):
    """SUMO refuses its input files; the message is the reason that SUMO gives."""

    exit_code = 2


class LostWorkerError(EpisodeError):
    """The process that ran an episode was lost; the same episode may succeed when repeated."""


DISK_ERRNOS = errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ENOTDIR


def disk_error(error: OSError, path: object) -> DiskError:
    """Return the one-line error for a failed write to `path`."""
    return DiskError(f"cannot write {path}: {error.strerror or error}")


def error_from_name(name: str, message: str) -> UnjamError:
    """Return an error of the class `name`, which another process reported; an `UnjamError` for an unknown class."""
    parents = UnjamError, InputError, EpisodeError
    classes = {error.__name__: error for parent in parents for error in parent.__subclasses__()}
    return classes.get(name, UnjamError)(message)


def raise_failure(rows: Sequence[dict[str, Any]]) -> None:
    """Raise the error of the first failed episode among metric rows, with its original class."""
    for row in rows:
        if row["status"] == "failed":
            seed = "" if row["error"] == InputError.__name__ else f" (seed {row['seed']})"
            raise error_from_name(row["error"], f"{row['reason']}{seed}")


def as_unjam_error(error: Exception) -> UnjamError:
    """Convert any error to an `UnjamError`, to report it to another process."""
    if isinstance(error, OSError) and error.errno in DISK_ERRNOS:
        return disk_error(error, error.filename or "a temporary file")
    if isinstance(error, UnjamError):
        return error
    message = " ".join(str(error).split())
    if type(error).__module__.partition(".")[0] in ("libsumo", "traci"):
        return EpisodeError(f"SUMO cannot go on: {message}")
    return UnjamError(f"{type(error).__name__}: {message}")


def invalid_value(field: str, value: object, allowed: str) -> InputError:
    """Return the error for an invalid value, in the common form of messages."""
    text = " ".join(repr(value).splitlines())  # arrays have several lines
    return InputError(f"{field}: {text} is not allowed; allowed: {allowed}")


def unknown_name(field: str, value: object, names: Iterable[str]) -> InputError:
    """Return the error for a name that is not among `names`, with a suggestion."""
    known_names = list(names)
    return invalid_value(field, value, f"{', '.join(known_names)}{spelling_hint(value, known_names)}")


@contextmanager
def prefix_errors(prefix: str) -> Iterator[None]:
    """Put `prefix` before the message of an `InputError` from the block, unless the message begins with it."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(prefix):
            raise
        raise InputError(f"{prefix}{error}") from None


def resume_hint(folder: object) -> str:
    """Return `; resume with: ` and the command that resumes a training, ready to copy."""
    return f"; resume with: unjam train --resume {shlex.quote(str(folder))}"
