import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.conftest import Run
from unjam.cli.drive import watch_in_window
from unjam.drivers import PISaturation
from unjam.scenarios import Ring
from unjam.worlds.episode import run_episode

XVFB = shutil.which("Xvfb")
needs_display = pytest.mark.skipif(XVFB is None, reason="no Xvfb found: apt-get install xvfb")
WATCH = ("watch", "ring", "--driver", "pi", "--set", "horizon=50")
RING = Ring(length=(230, 230), horizon=30)


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """Start a virtual display."""
    assert XVFB is not None
    reader, writer = os.pipe()
    command = [XVFB, "-displayfd", str(writer), "-screen", "0", "1024x768x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[writer], stderr=subprocess.DEVNULL)
    os.close(writer)
    with open(reader) as number:
        yield f":{number.readline().strip()}"
    server.terminate()
    server.wait(timeout=20)


@pytest.mark.long
@needs_display
def test_watching_in_the_window_ends_after_the_episode(unjam: Run, display: str) -> None:
    done = unjam(*WATCH, "--pace", "1000", "--json", environment={"DISPLAY": display})
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["driver"] == "pi"
    assert (document["episode"]["status"], document["episode"]["steps"]) == ("completed", 50)


@needs_display
def test_window_shows_the_episode_of_the_seed(display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", display)
    watched = watch_in_window(RING, PISaturation(), (4,), pace=1000.0)
    assert watched.speeds.tolist() == run_episode(RING, PISaturation(), (4,)).speeds.tolist()


@needs_display
@pytest.mark.slow
def test_window_runs_at_the_requested_pace(display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", display)
    started = time.monotonic()
    watch_in_window(RING, PISaturation(), (0,), pace=1.0)
    assert time.monotonic() - started > 0.9 * 30 * 0.1


def test_a_missing_display_is_refused_with_a_remedy(unjam: Run) -> None:
    done = unjam(*WATCH, environment={"DISPLAY": ""})
    assert done.returncode == 3
    assert done.stdout == ""
    [line] = done.stderr.splitlines()
    assert line.startswith("unjam: watch: no display")
    assert "--video" in line


@pytest.mark.long
def test_a_video_needs_no_display(unjam: Run, tmp_path: Path) -> None:
    done = unjam(*WATCH, "--video", "out.gif", environment={"DISPLAY": ""})
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "video: out.gif"
    assert (tmp_path / "out.gif").stat().st_size > 10_000


def test_a_video_that_cannot_be_written_is_refused(unjam: Run) -> None:
    done = unjam(*WATCH, "--video", "nowhere/out.gif")
    assert done.returncode == 74
    assert "Traceback" not in done.stderr
    assert "nowhere/out.gif" in done.stderr.splitlines()[-1]
