"""What SUMO refuses in the first episode ends a command with one line, whatever it was asked for."""

from pathlib import Path

import pytest

from tests.system.conftest import Run
from tests.worlds.sumo.user_networks import straight

LATE = (
    '<flow id="f" type="car" from="road" to="road" begin="0" end="690" period="9"/>'
    '<trip id="w" type="car" from="road" to="road" depart="690"/>'
    '<trip id="v" type="car" from="road" to="road" depart="700" departPos="nowhere"/>'
)
"""a trip that is broken late in a file: SUMO reads 200 s ahead"""
EARLY = '<vehicle id="v" type="car" route="along" depart="1"/>'


@pytest.mark.parametrize(
    ("demand", "options", "words"),
    [
        pytest.param(LATE, "", "Invalid departPos definition for trip 'v'", id="late in a file"),
        pytest.param(EARLY, '<step-method.ballistic value="maybe"/>', "maybe", id="an option"),
    ],
)
@pytest.mark.parametrize("verb", [["drive", "--episodes", "40"], ["assess", "--shares", "0.3"]])
def test_what_sumo_refuses_ends_a_command_at_once(
    verb: list[str], demand: str, options: str, words: str, unjam: Run, tmp_path: Path
) -> None:
    file = straight(tmp_path, demand, end=1000.0, step=1.0, options=options)
    ran = unjam(verb[0], file, *verb[1:], "--workers", "2", "--json")
    assert ran.returncode == 2, ran.stderr
    assert words in ran.stderr.splitlines()[-1]
    assert ran.stderr.count("unjam: ") == 1
