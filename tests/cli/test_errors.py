"""Errors that end a command: one line, and an exit code."""

from collections.abc import Callable

import pytest
import typer

from unjam import cli


def raising(error: BaseException) -> Callable[..., None]:
    def app(**options: object) -> None:
        raise error

    return app


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (typer.Abort(), 130, "interrupted"),
        (KeyboardInterrupt(), 130, "interrupted"),
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
