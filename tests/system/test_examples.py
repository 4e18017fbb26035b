import os
import re
import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import unjam
from tests.controller.test_file import residual
from tests.controller.test_sample import perceived
from tests.drivers.test_experts import EXPERTS
from tests.worlds.sumo.user_networks import straight
from unjam.adapters import onnx_driver
from unjam.controller import controller_bytes, packaged_file
from unjam.controller.file import SAMPLE_PART, replay_states, sample_bytes
from unjam.drivers import LACC, Driver, FollowerStopper, LocalState, Pacer, PISaturation
from unjam.drivers.local_state import MAX_OBSERVED_GAP
from unjam.drivers.registry import driver_from_name, is_serializable
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.wrappers import FilteredDriver, HistoryDriver, MixedDriver
from unjam.worlds.sumo.networks import sumo_program

EXAMPLES = Path(__file__).parents[2] / "examples"


VIDEO_WRITER = """
class ImageSequenceClip:
    def __init__(self, frames, fps):
        self.frames = frames

    def write_videofile(self, path, **options):
        open(path, "w").write(f"{len(self.frames)} frames")
"""
"""stands for moviepy, which only encodes the frames"""


def run_example(folder: Path, name: str, *arguments: str) -> str:
    """Return what an example prints, on both streams."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    paths = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": paths}
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout + ran.stderr


def test_all_examples_are_run_by_a_test() -> None:
    tests = "".join(file.read_text() for file in Path(__file__).parents[1].rglob("test_*.py"))
    assert not [file.name for file in EXAMPLES.glob("*.py") if file.name not in tests]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("train_ppo.py 100", "over 3 episodes"),
        ("plain_loop.py 1", "episode 0: return"),
        ("sb3_vectorized.py 20000", "19,200 steps: mean speed"),
        ("sb3_vectorized.py 1400 --algorithm sac", "1,408 steps in"),
        ("shared_policy.py 1 60", "update 0: "),
        ("offline_dataset.py 1 100", "600 transitions, observations (600, 5)"),
        ("training_logger.py 2000", "steps, return"),
        ("differentiable_ring.py --updates 2 --episodes 2", "paired difference"),
    ],
)
def test_the_examples_run(command: str, words: str, tmp_path: Path) -> None:
    assert words in run_example(tmp_path, *command.split())


@pytest.mark.slow
def test_the_example_of_wrappers_records_the_first_episode(tmp_path: Path) -> None:
    package = tmp_path / "moviepy/video/io"
    package.mkdir(parents=True)
    (package / "ImageSequenceClip.py").write_text(VIDEO_WRITER)
    printed = run_example(tmp_path, "gymnasium_wrappers.py", "12")
    assert "at most 12 steps, observations of shape (6,)" in printed
    assert printed.count("at the time 1.00 of the horizon") == 2
    assert [(path.name, path.read_text()) for path in (tmp_path / "videos").glob("*.mp4")] == [
        ("ring-episode-0.mp4", "13 frames")
    ]


@pytest.mark.slow
def test_the_policy_of_the_single_file_drives_as_onnx_and_enters_the_benchmark(tmp_path: Path) -> None:
    printed = run_example(tmp_path, "ppo_single_file.py", "5")
    assert "m/s in 64 episodes" in printed
    assert "warning" not in printed.lower()
    assert "torchvision" not in printed
    assert b"site-packages" not in (tmp_path / "policy.onnx").read_bytes(), "a path of this machine"
    result = unjam.drive("ring", str(tmp_path / "policy.onnx"), episodes=1, scenario_options={"horizon": 100})
    assert result.mean["collisions"] == 0
    driver = onnx_driver(tmp_path / "policy.onnx")
    assert driver.action_repeat == 10
    assert is_serializable(driver)  # as all drivers that the benchmark runs in batches


UNREAD = "human", "gap-maker"
"""the simulator itself, and a driver that sets the time headway of the ACC of its vehicle"""
WITHOUT_UNJAM = """
import json, sys

class NoUnjam:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("unjam", "torch", "safetensors", "pydantic", "gymnasium"):
            raise ImportError(f"{name} is not there")

sys.meta_path.insert(0, NoUnjam())
sys.path.insert(0, sys.argv[1])
from run_controller import Controller, State
for path in sys.argv[2:]:
    controller = Controller(path)
    rows = zip(*(controller.sample[name].tolist() for name in State._fields))
    print(json.dumps([controller.act(*row) for row in rows]))
assert not {"unjam", "torch", "safetensors"} & set(sys.modules)
"""


def write_controller(driver: Driver, path: Path, states: LocalState, limit: float = 1.0) -> Path:
    about = {"time_step": 0.1, "action_limit": 1.5}
    path.write_bytes(controller_bytes(driver, about, {SAMPLE_PART: sample_bytes(driver, states, limit)}))
    return path


@pytest.mark.slow
def test_the_plain_reader_drives_as_unjam_without_it(tmp_path: Path) -> None:
    drivers = [driver_from_name(name, 0.1) for name in EXPERTS if name.partition(":")[0] not in UNREAD]
    drivers += [
        Pacer(use_tuned=True, time_constant=1.0),
        residual(PISaturation(), hold=10),
        residual(Pacer(lap_time=40.0), hold=3, outputs=2),
        residual(residual(residual(FollowerStopper(), 1, hold=3), 2), 3, hold=5),
        residual(HistoryDriver(PISaturation(), 0.1), hold=10),
        residual(FilteredDriver(PISaturation(), 1.0, SafetyFilter(), 0.1), hold=10),
        residual(PISaturation(), hold=10, parts=("merge_proximity", "distance_to_merge")),
        FilteredDriver(residual(PISaturation(), hold=10), 1.0, SafetyFilter(gap_error=0.5), 0.1),
        FilteredDriver(driver_from_name("constant:acceleration=1", 0.1), 1.5, SafetyFilter(time_gap=0.0), 0.1),
        FilteredDriver(residual(PISaturation(), hold=10), 1.0, SafetyFilter(), 0.1, Actuator(delay=0.2, lag=0.3)),
    ]
    states = perceived(700)
    paths = [write_controller(driver, tmp_path / f"{number}.unjam", states) for number, driver in enumerate(drivers)]
    command = [sys.executable, "-I", "-c", WITHOUT_UNJAM, str(EXAMPLES), *map(str, paths)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    for driver, line in zip(drivers, ran.stdout.splitlines(), strict=True):
        limit = 6.0 if isinstance(driver, FilteredDriver) else getattr(driver, "action_limit", 1.5)
        found = np.array(line.strip("[]").split(","), float)
        np.testing.assert_allclose(found, replay_states(driver, states, limit), rtol=0, atol=1e-9, err_msg=str(driver))


def run_comparison(path: Path) -> subprocess.CompletedProcess[str]:
    """What the plain reader says of a file, as a program of its own."""
    command = [sys.executable, "-E", "-s", str(EXAMPLES / "run_controller.py"), str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_the_plain_reader_compares_itself_with_the_recorded_sample(tmp_path: Path) -> None:
    path = write_controller(residual(PISaturation()), tmp_path / "it.unjam", perceived())
    ran = run_comparison(path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith("40 control steps, at most ")
    other = path.read_bytes().replace(b'"action_repeat": 1,', b'"action_repeat": 2,')
    path.write_bytes(other)
    assert run_comparison(path).returncode != 0


def test_without_a_map_the_plain_reader_holds_back_for_reported_congestion_alone(tmp_path: Path) -> None:
    states = perceived(700)._replace(distance_to_merge=None)
    driver = driver_from_name("jam-ahead", 1.0)
    path = write_controller(driver, tmp_path / "it.unjam", states, limit=1.5)
    wanted = replay_states(driver, states, 1.5)
    assert 0.1 < np.mean(wanted < 1.5) < 0.9
    ran = run_comparison(path)
    assert (ran.returncode, ran.stderr) == (0, "")


def test_the_plain_reader_says_what_it_cannot_read(tmp_path: Path) -> None:
    asks = run_comparison(write_controller(driver_from_name("gap-maker", 0.1), tmp_path / "asks.unjam", perceived()))
    assert asks.stderr.endswith("ValueError: a driver of the kind gap-maker is not read here; read it with unjam\n")
    ran = run_comparison(
        write_controller(MixedDriver((PISaturation(), PISaturation())), tmp_path / "it.unjam", perceived())
    )
    assert ran.stderr.endswith("ValueError: a driver of the kind mixed is not read here; read it with unjam\n")


def test_the_plain_reader_drives_by_what_has_no_sample_and_says_so() -> None:
    ran = run_comparison(packaged_file("ring-tuned"))
    assert ran.returncode == 1
    assert "it can drive, but has no sample to compare with" in ran.stderr
    assert "Traceback" not in ran.stderr


STEP_OF_A_SECOND = """
import sys
from types import SimpleNamespace
sys.path.insert(0, sys.argv[1])
from traci_client import Controller, drive
sumo = SimpleNamespace(simulation=SimpleNamespace(getDeltaT=lambda: 1.0), vehicle=None)
drive(sumo, Controller(sys.argv[2]), "me")
"""


def test_a_controller_is_not_driven_in_longer_steps_than_its_filter_allows_for() -> None:
    command = [sys.executable, "-c", STEP_OF_A_SECOND, str(EXAMPLES), str(packaged_file("ring-tuned"))]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 1
    assert ran.stderr.endswith("it decides every 0.1 s: start SUMO with --step-length 0.1\n")


@pytest.mark.parametrize(
    ("name", "words"),
    [("figure-eight-best", "pacer"), ("on-ramp-tuned", "jam-ahead"), ("best", "adaptive-acc|jam-ahead|pacer")],
)
def test_a_controller_that_looks_farther_than_the_client_tells_is_refused(name: str, words: str) -> None:
    command = [sys.executable, "-c", STEP_OF_A_SECOND, str(EXAMPLES), str(packaged_file(name))]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 1
    assert re.search(f"looks at more than leader and follower: .*({words})|not read here", ran.stderr)


def test_the_plain_reader_is_short() -> None:
    lines = [
        len((EXAMPLES / name).read_text().splitlines())
        for name in ("run_controller.py", "plain_experts.py", "plain_safety.py")
    ]
    assert max(lines) < 240
    assert lines[0] < 135


def free_port() -> int:
    with socket.socket() as opened:
        opened.bind(("127.0.0.1", 0))
        return opened.getsockname()[1]


@pytest.mark.long
def test_the_client_drives_a_vehicle_of_a_running_sumo(tmp_path: Path) -> None:
    """What SUMO recorded is what the driver answers to what SUMO recorded."""
    road = straight(
        tmp_path,
        '<vehicle id="ahead" type="van" route="along" depart="0" departPos="60" speedFactor="0.6"/>'
        '<vehicle id="me" type="van" route="along" depart="1" departPos="30" departSpeed="5"/>'
        '<vehicle id="behind" type="car" route="along" depart="2" departPos="0" departSpeed="5"/>',
        length=500.0,
    )
    driver = residual(LACC(time_gap=2.0, lag=0.5), hold=4, parts=("local", "expert_acceleration"))
    driver = replace(driver, network=replace(driver.network, authority=0.2))
    path, port = write_controller(driver, tmp_path / "it.unjam", perceived()), free_port()
    record = tmp_path / "record.xml"
    sumo = [sumo_program("sumo"), "-c", str(road), "--remote-port", str(port), "--no-step-log"]
    sumo += ["--fcd-output", str(record), "--precision", "9"]
    for name in ("traci_client.py", "run_controller.py", "plain_experts.py", "plain_safety.py"):
        shutil.copy(EXAMPLES / name, tmp_path)
    with subprocess.Popen(sumo, stdout=subprocess.DEVNULL) as running:
        try:
            client = [sys.executable, "traci_client.py", str(path), str(port), "me"]
            ran = subprocess.run(client, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
            assert ran.returncode == 0, ran.stderr
            running.wait(timeout=20)
        finally:
            running.kill()
    moments = [
        {each.get("id"): (float(each.get("pos", "")), float(each.get("speed", ""))) for each in moment}
        for moment in ElementTree.parse(record).getroot()
    ]
    rows = [moment for moment in moments if "me" in moment]
    assert f"me: {len(rows)} control steps" in ran.stdout
    states = LocalState(*np.array([perceived_in(moment) for moment in rows]).T)
    done = np.diff(states.speed) / 0.1
    assert np.ptp(done) > 0.5
    assert {"ahead", "behind"} <= rows[len(rows) // 2].keys()
    np.testing.assert_allclose(done, replay_states(driver, states, 1.0)[:-1], rtol=0, atol=1e-5)


def perceived_in(moment: dict[str | None, tuple[float, float]]) -> tuple[float, ...]:
    """The local state of `me` at a moment of SUMO's record; vans are 7 m long."""
    position, speed = moment["me"]
    seen = []
    for name, direction in (("ahead", 1.0), ("behind", -1.0)):
        place, pace = moment.get(name, (np.inf, 0.0))
        gap = abs(place - position) - 7.0
        seen += [pace if gap < MAX_OBSERVED_GAP else speed, min(gap, MAX_OBSERVED_GAP)]
        assert (place - position) * direction > 7.0 or place == np.inf
    return speed, *seen, np.nan, np.nan
