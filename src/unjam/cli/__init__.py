"""The command line: `unjam VERB`. Verbs that are about the same share a file of this package."""

import os
import signal
import sys
from itertools import pairwise
from types import FrameType
from typing import Annotated

import typer

from unjam import __version__
from unjam.child_processes import isolate_children
from unjam.cli.calibrate import calibrate_command
from unjam.cli.catalog import drivers_command, fit_drivers_command, scenarios_command
from unjam.cli.diagnostics import bench_command, doctor_command
from unjam.cli.drive import assess_command, drive_command, watch_command
from unjam.cli.options import with_trust_option
from unjam.cli.results import (
    certify_command,
    evaluate_command,
    export_command,
    model_command,
    report_command,
    verify_command,
)
from unjam.cli.runs import runs_app
from unjam.cli.sign import keys_command, sign_command
from unjam.cli.train import reproduce_command, search_command, train_command
from unjam.cli.tune import tune_command
from unjam.errors import DISK_ERRNOS, InputError, UnjamError, disk_error, invalid_value, missing_package_error
from unjam.processes import exit_with_parent, mark_as_command_line

INTERRUPTED_EXIT_CODE = 130

app = typer.Typer(
    name="unjam",
    help="Train, compare and ship controllers for automated vehicles that dissolve stop-and-go waves.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong input, 3 missing part, 74 disk, 129/130/143 stopped.",
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        print(f"unjam {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


CODE_RUNNING_COMMANDS = (
    drive_command,
    assess_command,
    train_command,
    evaluate_command,
    model_command,
    search_command,
    export_command,
    certify_command,
    verify_command,
    watch_command,
)
"""verbs that take folders which can name Python code"""
for verb in (
    *(
        scenarios_command,
        drivers_command,
        drive_command,
        assess_command,
        calibrate_command,
        train_command,
        evaluate_command,
        model_command,
        fit_drivers_command,
    ),
    *(
        report_command,
        tune_command,
        search_command,
        reproduce_command,
        export_command,
        certify_command,
        keys_command,
        sign_command,
        verify_command,
        watch_command,
        bench_command,
        doctor_command,
    ),
):
    app.command()(with_trust_option(verb) if verb in CODE_RUNNING_COMMANDS else verb)
app.add_typer(runs_app)


class _Terminated(BaseException):
    """The process was asked to end (SIGTERM), or its terminal is gone (SIGHUP)."""


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise _Terminated(signum)


def main() -> None:
    """Run the command line; every error that a user can mend is one line and an exit code."""
    mark_as_command_line()
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP, and under nohup nobody wants to be told
        signum = getattr(signal, name, None)
        if signum is not None and signal.getsignal(signum) != signal.SIG_IGN:
            signal.signal(signum, _terminate)
    exit_with_parent(signal.SIGTERM)
    isolate_children()
    sys.exit(_run_app())


def _run_app() -> int:
    try:
        for text in sys.argv[1:]:
            if any("\ud800" <= letter <= "\udfff" for letter in text):  # bytes that are no letters
                raise invalid_value("arguments", text, "text in UTF-8")
        code = app(standalone_mode=False) or 0
        return (
            _print_error("interrupted", code) if code == INTERRUPTED_EXIT_CODE else code
        )  # which typer says without a word
    except UnjamError as error:
        return _print_error(str(error), error.exit_code)
    except ModuleNotFoundError as error:
        missing = missing_package_error(error)
        return _print_error(str(missing), missing.exit_code)
    except OSError as error:
        if error.errno in DISK_ERRNOS:
            return _print_error(str(disk_error(error, error.filename or "output")), 74)
        if error.filename is None and not _has_working_folder():
            return _print_error("working folder: it was removed; allowed: one that is there", InputError.exit_code)
        return _print_error(f"{error.filename or 'system'}: {error.strerror or error}", InputError.exit_code)
    except RecursionError:
        return _print_error("input: it is nested too deep", InputError.exit_code)
    except OverflowError as error:
        return _print_error(f"input: a number is too large: {error}", InputError.exit_code)
    except MemoryError:
        return _print_error("memory: there is not enough for this", InputError.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return _print_error("interrupted", INTERRUPTED_EXIT_CODE)
    except _Terminated as ended:
        return _print_error("terminated", 128 + ended.args[0])
    except Exception as error:
        if hasattr(error, "format_message"):  # what typer says of a wrong command line
            return _print_error(f"{error.format_message()}{_given_value(error)}", 2)  # pyright: ignore[reportAttributeAccessIssue]
        raise


def _has_working_folder() -> bool:
    """Return whether the folder still is there that this process works in."""
    try:
        return os.path.isdir(os.getcwd())
    except FileNotFoundError:
        return False


def _given_value(error: Exception) -> str:
    """Return what was given for the option that is wrong: typer's own words leave it out."""
    for option in getattr(getattr(error, "param", None), "opts", []):
        for word, following in pairwise([*sys.argv, ""]):
            if word == option and following:
                return f"; given: {following!r}"
    return ""


def _print_error(message: str, code: int) -> int:
    """Print one line of error; return the exit code."""
    try:
        print(f"unjam: {' '.join(message.split())}", file=sys.stderr)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    return code
