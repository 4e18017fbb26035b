"""The command line: `unjam COMMAND`. Related commands share a module of this package."""

import logging
import os
import signal
import sys
import warnings
from importlib import import_module
from io import TextIOWrapper
from itertools import pairwise
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from unjam import __version__, errors
from unjam.child_processes import isolate_children, isolate_matplotlib
from unjam.cli.options import with_trust_option
from unjam.errors import InputError, UnjamError, invalid_value, missing_package_error, unknown_name
from unjam.interruptions import TerminationSignal, mark_as_handled, raise_signals
from unjam.plugins import load_plugins, plugin_names
from unjam.processes import exit_with_parent, mark_as_command_line
from unjam.text import printable

INTERRUPTED_EXIT_CODE = 130
COMMANDS = {
    **{"scenarios": "unjam.cli.catalog", "drivers": "unjam.cli.catalog", "new": "unjam.cli.new"},
    **{"drive": "unjam.cli.drive", "assess": "unjam.cli.drive", "benchmark": "unjam.cli.benchmark"},
    **{"calibrate": "unjam.cli.calibration", "train": "unjam.cli.train", "evaluate": "unjam.cli.runs"},
    **{"model": "unjam.cli.runs", "fit-drivers": "unjam.cli.calibration", "report": "unjam.cli.runs"},
    **{"tune": "unjam.cli.calibration", "search": "unjam.cli.train", "export": "unjam.cli.controllers"},
    **{"certify": "unjam.cli.controllers", "keys": "unjam.cli.controllers", "sign": "unjam.cli.controllers"},
    **{"verify": "unjam.cli.controllers", "watch": "unjam.cli.drive", "bench": "unjam.cli.diagnostics"},
    **{"doctor": "unjam.cli.diagnostics", "runs": "unjam.cli.runs"},
}
"""module of each command, which defines NAME_command"""
CODE_RUNNING_COMMANDS = {
    *("drive", "assess", "benchmark", "train", "evaluate", "model", "search", "export", "certify", "verify", "watch")
}
"""commands with the option --trust-code, because they read folders that can name Python code"""


class _CommandGroup(TyperGroup):
    """Commands of unjam and of plugins, imported on demand."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        finally:
            mark_as_handled()  # what follows only prints the error, and typer replaces a signal by an exit code

    def list_commands(self, ctx: Any) -> list[str]:
        return [*COMMANDS, *plugin_names("unjam.commands")]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in COMMANDS:
            command = getattr(import_module(COMMANDS[cmd_name]), f"{cmd_name.replace('-', '_')}_command")
        elif plugins := load_plugins("unjam.commands", cmd_name):
            command = plugins[cmd_name]
        else:
            raise unknown_name("command", cmd_name, self.list_commands(ctx))
        if isinstance(command, typer.Typer):
            return typer.main.get_command(command)
        command_app = typer.Typer(rich_markup_mode="markdown", add_completion=False)
        command_app.command(cmd_name)(with_trust_option(command) if cmd_name in CODE_RUNNING_COMMANDS else command)
        return typer.main.get_command(command_app)


app = typer.Typer(
    name="unjam",
    cls=_CommandGroup,
    help="Train, compare and ship controllers for automated vehicles that dissolve stop-and-go waves.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog="Exit codes: 0 success, 1 failure, 2 invalid input, 3 missing part, 74 disk error, 129/130/143 stopped.",
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        print(f"unjam {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


class _LineFormatter(logging.Formatter):
    """Formats a log message as one line without the control characters that names in files can have."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(" ".join(super().format(record).split()))


def _format_warning(message: Warning | str, category: type[Warning], *location: Any) -> str:
    """Return a warning without control characters and without its location in the code."""
    return printable(f"{category.__name__}: {' '.join(str(message).split())}\n")


TOO_LITTLE_MEMORY = "memory: there is not enough for this command"


def main() -> None:
    """Run the command line; print every error that a user can correct as one line, and exit with its code."""
    for stream, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, stream) is None:  # else the next file that is opened replaces a closed stream
            setattr(sys, stream, open(os.devnull, mode))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # characters outside of the encoding must not end a command
            stream.reconfigure(errors="replace")
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_LineFormatter())
    warnings.formatwarning = _format_warning
    mark_as_command_line()
    raise_signals()
    isolate_children()
    isolate_matplotlib()
    sys.exit(_run_app())


def _run_app() -> int:
    try:
        exit_with_parent(signal.SIGTERM)
        for text in sys.argv[1:]:
            if any("\ud800" <= letter <= "\udfff" for letter in text):  # bytes that are not UTF-8
                raise invalid_value("arguments", text, "text in UTF-8")
        code = _call_app()
        # typer returns this code without a message
        return _print_error("interrupted", code) if code == INTERRUPTED_EXIT_CODE else code
    except UnjamError as error:
        return _print_error(str(error), error.exit_code)
    except ImportError as error:
        missing = missing_package_error(error)
        return _print_error(str(missing), missing.exit_code)
    except OSError as error:
        if error.errno in errors.DISK_ERRNOS:
            return _print_error(str(errors.disk_error(error, error.filename or "output")), 74)
        if error.filename is None and not _has_working_folder():
            return _print_error("working folder: it was removed; allowed: an existing folder", InputError.exit_code)
        return _print_error(f"{error.filename or 'system'}: {error.strerror or error}", InputError.exit_code)
    except RecursionError:
        return _print_error("input: it is nested too deeply", InputError.exit_code)
    except OverflowError as error:
        return _print_error(f"input: a number is too large: {error}", InputError.exit_code)
    except MemoryError:
        return _print_error(TOO_LITTLE_MEMORY, InputError.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return _print_error("interrupted", INTERRUPTED_EXIT_CODE)
    except TerminationSignal as error:
        return _print_error("terminated", 128 + error.signum)
    except Exception as error:
        if isinstance(error, RuntimeError) and "start new thread" in str(error):
            return _print_error(TOO_LITTLE_MEMORY, InputError.exit_code)
        if hasattr(error, "format_message"):
            return _print_error(_usage_text(error), InputError.exit_code)
        raise


def _call_app() -> int:
    """Run the command and return its exit code; raise an interruption even if another error has replaced it."""
    try:
        return app(standalone_mode=False) or 0
    except Exception as error:
        cause: BaseException | None = error
        while cause := cause.__cause__ or cause.__context__:  # Python replaces errors while it defines classes
            if isinstance(cause, KeyboardInterrupt | TerminationSignal):
                raise cause from None
        raise


def _usage_text(error: Any) -> str:
    """Return the message of an error by typer, with the value of the wrong option, or a hint at a setting."""
    option_names = getattr(getattr(error, "param", None), "opts", ())
    values = [f"; given: {value!r}" for word, value in pairwise(sys.argv) if word in option_names and value]
    command: Any = getattr(getattr(error, "ctx", None), "command", None)
    known_options = [name for parameter in getattr(command, "params", ()) for name in parameter.opts]
    if "--set" in known_options and getattr(error, "option_name", "--set") not in known_options:
        from unjam.cli.catalog import suggest_setting  # imported late: it imports all scenarios

        return error.format_message() + suggest_setting(error.option_name, command.name)
    return "".join([error.format_message(), *values[:1]])


def _has_working_folder() -> bool:
    try:
        return os.path.isdir(os.getcwd())
    except FileNotFoundError:
        return False


def _print_error(message: str, code: int) -> int:
    """Print an error as one line; return the exit code."""
    mark_as_handled()
    try:
        print(f"unjam: {printable(' '.join(message.split()))}", file=sys.stderr)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    return code
