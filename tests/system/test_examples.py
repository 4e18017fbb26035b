import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("name", "argument", "words"),
    [
        ("train_ppo.py", 100, "over 3 episodes"),
        ("plain_loop.py", 2, "episode 1: return"),
    ],
)
def test_the_examples_run(name: str, argument: int, words: str, tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / name), str(argument)]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    assert words in ran.stdout
