"""What can go wrong, and the exit code that the command line gives it.

Every error that a user can cause or mend is one of these: one clear line, no traceback.
"""

import errno
import shlex
from collections.abc import Iterable
from difflib import get_close_matches


class UnjamError(Exception):
    """An error with one line that a user understands; `exit_code` is what the command line returns."""

    exit_code = 1


class InputError(UnjamError):
    """Wrong input: the message names the field, the value and what is allowed."""

    exit_code = 2


class NoCavError(InputError):
    """A driver had nobody to drive: by chance, or because too few vehicles are CAVs."""


class MissingPartError(UnjamError):
    """A program or package that is needed is not there: the message says how to get it."""

    exit_code = 3


TRAIN_PACKAGES = "torch", "stable_baselines3", "sb3_contrib", "onnx", "onnxscript", "onnxruntime"
"""packages of the extra `train`: what drives, measures and calibrates needs none of them"""


def missing_package_error(error: ModuleNotFoundError) -> MissingPartError:
    """Return the line for a package of the extra `train`; the error itself is raised for any other."""
    if error.name is None or error.name.partition(".")[0] not in TRAIN_PACKAGES:
        raise error
    return MissingPartError(f"{error.name} is not installed; what learns needs it: pip install 'unjam[train]'")


class DiskError(UnjamError):
    """The disk is full or cannot be written."""

    exit_code = 74


class EpisodeError(UnjamError):
    """An episode failed again and again: the message holds what is needed to repeat it."""


class SumoInputError(EpisodeError):
    """SUMO refuses the files that it was given, and says why."""

    exit_code = 2


class LostWorkerError(EpisodeError):
    """The process that ran an episode was lost, for whatever reason: the same may well run again."""


DISK_ERRNOS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS),
    *(errno.EACCES, errno.EPERM, errno.EIO, errno.ENOTDIR),
)


def disk_error(error: OSError, path: object) -> DiskError:
    """Return the one-line error for a failed write to `path`."""
    return DiskError(f"cannot write {path}: {error.strerror or error}")


def error_from_name(name: str, message: str) -> UnjamError:
    """Return the error that another process told of; of a kind that is not ours, it is an `UnjamError`."""
    known = UnjamError, InputError, EpisodeError
    kinds = {each.__name__: each for kind in known for each in kind.__subclasses__()}
    return kinds.get(name, UnjamError)(message)


def as_unjam_error(error: Exception) -> UnjamError:
    """Return any error as one of ours, to be told to another process."""
    if isinstance(error, OSError) and error.errno in DISK_ERRNOS:
        return disk_error(error, error.filename or "a temporary file")
    if isinstance(error, UnjamError):
        return error
    line = " ".join(str(error).split())
    if type(error).__module__.partition(".")[0] in ("libsumo", "traci"):
        return EpisodeError(f"SUMO cannot go on: {line}")
    return UnjamError(f"{type(error).__name__}: {line}")


def invalid_value(field: str, value: object, allowed: str) -> InputError:
    """Return the error for a wrong value, in the form that all of unjam uses."""
    return InputError(f"{field}: {value!r} is not allowed; allowed: {allowed}")


def unknown_name(field: str, value: object, names: Iterable[str]) -> InputError:
    """Return the error for a name that is not among `names`, with the one that may have been meant."""
    known = list(names)
    return invalid_value(field, value, f"{', '.join(known)}{spelling_hint(value, known)}")


def resume_hint(folder: object) -> str:
    """Return `; go on with: ` and the command that goes on with a training, to be copied."""
    return f"; go on with: unjam train --resume {shlex.quote(str(folder))}"


def spelling_hint(value: object, names: Iterable[str]) -> str:
    """Return `; did you mean 'ring'?`; empty where no name is like it."""
    close = get_close_matches(str(value), list(names), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
