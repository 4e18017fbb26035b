"""Errors that end a command: one line, and an exit code."""

from collections.abc import Callable

import pytest
import typer

from unjam import cli
from unjam.interruptions import TerminationSignal


def caused_by(cause: BaseException, as_context: bool) -> RuntimeError:
    error = RuntimeError("Error calling __set_name__ on 'property' instance")
    error.__cause__, error.__context__ = (None, cause) if as_context else (cause, None)
    return error


def raising(error: BaseException) -> Callable[..., None]:
    def app(**options: object) -> None:
        raise error

    return app


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (typer.Abort(), 130, "interrupted"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (caused_by(KeyboardInterrupt(), as_context=False), 130, "interrupted"),
        (caused_by(caused_by(KeyboardInterrupt(), as_context=False), as_context=True), 130, "interrupted"),
        (caused_by(TerminationSignal(15), as_context=False), 143, "terminated"),
        (MemoryError(), 2, "memory: there is not enough for this command"),
        (RuntimeError("can't start new thread"), 2, "memory: there is not enough for this command"),
        (RecursionError("maximum recursion depth exceeded"), 2, "input: it is nested too deeply"),
    ],
)
def test_an_error_is_one_line_with_its_exit_code(
    error: BaseException, code: int, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "app", raising(error))
    monkeypatch.setattr("sys.argv", ["unjam"])
    assert cli._run_app() == code
    assert capsys.readouterr().err == f"unjam: {line}\n"


def test_a_fault_of_the_package_itself_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "app", raising(RuntimeError("a fault")))
    monkeypatch.setattr("sys.argv", ["unjam"])
    with pytest.raises(RuntimeError, match="a fault"):
        cli._run_app()
