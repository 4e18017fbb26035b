"""Errors of SUMO in the first episode end a command with one line."""

from pathlib import Path

import pytest

from tests.system.conftest import Run
from tests.worlds.sumo.user_networks import straight

LATE = (
    '<flow id="f" type="car" from="road" to="road" begin="0" end="690" period="9"/>'
    '<trip id="w" type="car" from="road" to="road" depart="690"/>'
    '<trip id="v" type="car" from="road" to="road" depart="700" departPos="nowhere"/>'
)
"""an invalid trip late in a file: SUMO reads 200 s ahead"""
EARLY = '<vehicle id="v" type="car" route="along" depart="1"/>'


@pytest.mark.parametrize(
    ("demand", "options", "message"),
    [
        pytest.param(LATE, "", "Invalid departPos definition for trip 'v'", id="late in a file"),
        pytest.param(EARLY, '<step-method.ballistic value="maybe"/>', "maybe", id="an option"),
    ],
)
@pytest.mark.parametrize("command", [["drive", "--episodes", "40"], ["assess", "--penetration-rates", "0.3"]])
def test_an_error_of_sumo_ends_a_command_at_once(
    command: list[str], demand: str, options: str, message: str, unjam: Run, tmp_path: Path
) -> None:
    file = straight(tmp_path, demand, end=1000.0, step=1.0, options=options)
    ran = unjam(command[0], file, *command[1:], "--workers", "2", "--json")
    assert ran.returncode == 2, ran.stderr
    assert message in ran.stderr.splitlines()[-1]
    assert ran.stderr.count("unjam: ") == 1
