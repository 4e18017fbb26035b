"""The command line: `unjam VERB`. Verbs that are about the same share a file of this package."""

import os
import signal
import sys
from itertools import pairwise
from types import FrameType
from typing import Annotated

import typer

from unjam import __version__
from unjam.children import isolate_children
from unjam.cli.calibrate import calibrate
from unjam.cli.drive import assess, drive, watch
from unjam.cli.machine import bench, doctor
from unjam.cli.options import with_trust
from unjam.cli.parts import drivers, fit_drivers, scenarios
from unjam.cli.results import certify, evaluate, export, model, report, verify
from unjam.cli.runs import runs
from unjam.cli.sign import keys, sign
from unjam.cli.train import reproduce, search, train
from unjam.cli.tune import tune
from unjam.errors import DISK_ERRNOS, InputError, UnjamError, disk_error, without_train, wrong
from unjam.processes import end_with_parent, own_this_process

INTERRUPTED = 130

app = typer.Typer(
    name="unjam",
    help="Train, compare and ship controllers for automated vehicles that dissolve stop-and-go waves.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong input, 3 missing part, 74 disk, 129/130/143 stopped.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"unjam {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


MAY_RUN_CODE = (drive, assess, train, evaluate, model, search, export, certify, verify, watch)
"""verbs that take folders which can name Python code"""
for verb in (
    *(scenarios, drivers, drive, assess, calibrate, train, evaluate, model, fit_drivers),
    *(report, tune, search, reproduce, export, certify, keys, sign, verify, watch, bench, doctor),
):
    app.command()(with_trust(verb) if verb in MAY_RUN_CODE else verb)
app.add_typer(runs)


class _Terminated(BaseException):
    """The process was asked to end (SIGTERM), or its terminal is gone (SIGHUP)."""


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise _Terminated(signum)


def main() -> None:
    """Run the command line; every error that a user can mend is one line and an exit code."""
    own_this_process()
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP, and under nohup nobody wants to be told
        signum = getattr(signal, name, None)
        if signum is not None and signal.getsignal(signum) != signal.SIG_IGN:
            signal.signal(signum, _terminate)
    end_with_parent(signal.SIGTERM)
    isolate_children()
    sys.exit(_run())


def _run() -> int:
    try:
        for text in sys.argv[1:]:
            if any("\ud800" <= letter <= "\udfff" for letter in text):  # bytes that are no letters
                raise wrong("arguments", text, "text in UTF-8")
        code = app(standalone_mode=False) or 0
        return _say("interrupted", code) if code == INTERRUPTED else code  # which typer says without a word
    except UnjamError as error:
        return _say(str(error), error.exit_code)
    except ModuleNotFoundError as error:
        missing = without_train(error)
        return _say(str(missing), missing.exit_code)
    except OSError as error:
        if error.errno in DISK_ERRNOS:
            return _say(str(disk_error(error, error.filename or "output")), 74)
        if error.filename is None and not _is_somewhere():
            return _say("working folder: it was removed; allowed: one that is there", InputError.exit_code)
        return _say(f"{error.filename or 'system'}: {error.strerror or error}", InputError.exit_code)
    except RecursionError:
        return _say("input: it is nested too deep", InputError.exit_code)
    except OverflowError as error:
        return _say(f"input: a number is too large: {error}", InputError.exit_code)
    except MemoryError:
        return _say("memory: there is not enough for this", InputError.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return _say("interrupted", INTERRUPTED)
    except _Terminated as ended:
        return _say("terminated", 128 + ended.args[0])
    except Exception as error:
        if hasattr(error, "format_message"):  # what typer says of a wrong command line
            return _say(f"{error.format_message()}{_given(error)}", 2)  # pyright: ignore[reportAttributeAccessIssue]
        raise


def _is_somewhere() -> bool:
    """Return whether the folder still is there that this process works in."""
    try:
        return os.path.isdir(os.getcwd())
    except FileNotFoundError:
        return False


def _given(error: Exception) -> str:
    """Return what was given for the option that is wrong: typer's own words leave it out."""
    for option in getattr(getattr(error, "param", None), "opts", []):
        for word, following in pairwise([*sys.argv, ""]):
            if word == option and following:
                return f"; given: {following!r}"
    return ""


def _say(message: str, code: int) -> int:
    """Print one line of error; return the exit code."""
    try:
        print(f"unjam: {' '.join(message.split())}", file=sys.stderr)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    return code
