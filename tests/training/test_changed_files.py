"""No result mixes two versions of a user's network: a file that changes while a command runs ends it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from optuna.distributions import FloatDistribution

from tests.training.test_assess import FLOW, HELD
from tests.training.test_run import small_config
from tests.worlds.sumo.user_networks import straight
from unjam.controller import make_driver
from unjam.errors import InputError
from unjam.scenarios import Ring, make_scenario
from unjam.scenarios.user_network import load_user_network
from unjam.training.assess import assess
from unjam.training.assessment_request import make_request
from unjam.training.calibrate import FACTOR_RANGES, calibrate, load_corridor
from unjam.training.drive import drive
from unjam.training.search_space import SearchSpace
from unjam.training.train import Trainer, train, train_in_process
from unjam.training.tune import tune
from unjam.worlds.record import Episode
from unjam.worlds.sumo.detectors import DetectorPool
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

DETECTORS = "edge,position,begin,end,flow_veh_per_h,speed\nroad,100,0,30,1800,10\n"
SHORT: dict[str, Any] = {"horizon": 60}
CommandRunner = Callable[[str, Path, Callable[[], None]], object]
"""runs a command on a network with results in a folder, and calls the function while it runs"""


def run_drive(file: str, out: Path, change: Callable[[], None]) -> None:
    drive(file, "acc", 2, scenario_options={**HELD, "penetration_rate": 0.5}, out=out, progress=lambda *_: change())


def run_assess(file: str, out: Path, change: Callable[[], None]) -> None:
    with WorkerPool(1) as workers:
        assess(make_request(file, [0.5], 40, 0.02, None, ["acc"], HELD), out, workers, on_stage=lambda *_: change())


def run_tune(file: str, out: Path, change: Callable[[], None]) -> None:
    roads = {"mine": make_scenario(file, {**HELD, "penetration_rate": 1.0, "horizon": 40})}
    with WorkerPool(1) as workers:
        space: SearchSpace = {"time_gap": FloatDistribution(1.0, 2.0)}
        tune(roads, "acc", space, 9000, out, workers, on_message=lambda _: change())


def run_calibrate(file: str, out: Path, change: Callable[[], None]) -> None:
    detectors = Path(file).with_name("detectors.csv")
    detectors.write_text(DETECTORS)
    space = {"tau": FACTOR_RANGES["tau"]}
    with DetectorPool(1) as pool:
        calibrate(load_corridor(file, detectors), out, pool, space, 3, 1, on_message=lambda _: change())


def run_training(file: str, out: Path, change: Callable[[], None]) -> None:
    options = {**HELD, "penetration_rate": 1.0, "horizon": 100}
    config = small_config(scenario=file, scenario_options=options, model__model_ratio=0.0)
    train(config, out, on_iteration=lambda _: change() is None)


@pytest.mark.parametrize("run", [run_drive, run_assess, run_tune, run_calibrate, run_training])
def test_command_ends_if_a_file_of_the_network_changes(run: CommandRunner, tmp_path: Path) -> None:
    file = straight(tmp_path, FLOW, length=200.0, end=30.0)
    demand = file.with_name("demand.rou.xml")

    def change() -> None:
        demand.write_text(demand.read_text().replace('period="2"', 'period="9"'))

    with pytest.raises(InputError, match=r"^demand\.rou\.xml: has changed since the start; allowed"):
        run(str(file), tmp_path / "out", change)
    assert 'period="9"' in demand.read_text()


def drive_with_reward(reward: str, out: Path, change: Callable[[], None]) -> None:
    drive("ring", "pi", 2, scenario_options=SHORT, reward=reward, out=out, workers=1, progress=lambda *_: change())


def tune_with_reward(reward: str, out: Path, change: Callable[[], None]) -> None:
    space: SearchSpace = {"time_constant": FloatDistribution(1.0, 2.0)}
    with WorkerPool(1) as workers:
        tune({"ring": Ring(**SHORT)}, "pi", space, 9000, out, workers, reward, on_message=lambda _: change())


def train_with_reward(reward: str, out: Path, change: Callable[[], None]) -> None:
    config = small_config(scenario_options=SHORT, reward=reward, model__model_ratio=0.0)
    train(config, out, on_iteration=lambda _: change() is None)


def write_reward(folder: Path, value: float) -> Path:
    file = folder / "reward.py"
    file.write_text(f"def constant(outcome):\n    return 0.0 * outcome.speeds.mean(-1) + {value}\n")
    return file


@pytest.mark.parametrize("run", [drive_with_reward, tune_with_reward, train_with_reward])
def test_command_ends_if_the_code_of_a_reward_changes(run: CommandRunner, tmp_path: Path) -> None:
    file = write_reward(tmp_path, 1.0)
    with pytest.raises(InputError, match=r"^(train: .*)?reward\.py.* has changed since"):
        run(f"{file}:constant", tmp_path / "out", lambda: write_reward(tmp_path, 7.0) and None)
    assert not (tmp_path / "out" / "evaluation.json").exists()


def test_tuning_ends_if_the_code_of_its_expert_changes(tmp_path: Path) -> None:
    file, text = tmp_path / "own.py", "class Follower:\n    def __init__(self, gain=1.0): self.gain = gain\n"
    act = "    def act(self, state, memory): return self.gain * (state.leader_speed - state.speed), memory\n"
    file.write_text(text + act + "    def initial_memory(self, n): return {}\n")
    space: SearchSpace = {"gain": FloatDistribution(0.1, 0.5)}

    def change(message: str) -> None:
        file.write_text(file.read_text() + "\n# changed\n")

    with WorkerPool(1) as workers, pytest.raises(InputError, match=r"own\.py.* has changed since"):
        tune({"ring": Ring(**SHORT)}, f"{file}:Follower", space, 9000, tmp_path / "out", workers, on_message=change)


def test_code_that_changes_for_a_moment_is_refused_by_the_worker_that_reads_it(tmp_path: Path) -> None:
    reward = f"{write_reward(tmp_path, 1.0)}:constant"
    tasks = [EpisodeTask(Ring(**SHORT), make_driver("pi", 0.1), (seed,), reward) for seed in range(3)]

    def change(index: int, episode: Episode) -> Episode:
        write_reward(tmp_path, 7.0 if index == 0 else 1.0)
        return episode

    with WorkerPool(1) as workers:
        first, second, third = workers.run_and_map(tasks, change)
    assert [first.error, third.error] == ["", ""]
    assert "reward.py: has changed since the start" in second.reason


def test_command_goes_on_if_the_content_is_the_same(tmp_path: Path) -> None:
    file = straight(tmp_path, FLOW, length=200.0, end=30.0)
    run_drive(str(file), tmp_path / "out", file.touch)
    assert (tmp_path / "out" / "evaluation.json").is_file()


@pytest.mark.long
def test_a_training_is_not_evaluated_on_files_that_changed_after_its_last_iteration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, learn = straight(tmp_path, FLOW), Trainer.train

    def learn_and_change(trainer: Trainer) -> None:
        learn(trainer)
        demand = tmp_path / "demand.rou.xml"
        demand.write_text(demand.read_text() + " ")

    monkeypatch.setattr(Trainer, "train", learn_and_change)
    options = {**HELD, "penetration_rate": 1.0, "horizon": 100}
    config = small_config(scenario=str(file), scenario_options=options, model__model_ratio=0.0)
    with pytest.raises(InputError, match=r"^demand\.rou\.xml: has changed since the start"):
        train_in_process(config, tmp_path / "out")
    assert not (tmp_path / "out" / "evaluation.json").exists()


def test_command_ends_if_a_recording_is_added(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()

    def add(name: str) -> None:
        (folder / name).write_text("time,speed\n" + "".join(f"{0.1 * step:.1f},10\n" for step in range(100)))

    add("a.csv")
    options = {"recordings": str(folder)}
    with pytest.raises(InputError, match=r"^b\.csv: has changed since the start"):
        drive("recorded", "pi", 2, scenario_options=options, workers=1, progress=lambda *_: add("b.csv"))


def test_detectors_that_change_while_the_network_is_read_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, detectors = straight(tmp_path, FLOW), tmp_path / "detectors.csv"
    detectors.write_text(DETECTORS)

    def load_slowly(*arguments: Any) -> Any:
        detectors.write_text(DETECTORS.replace("1800", "1200"))
        return load_user_network(*arguments)

    monkeypatch.setattr("unjam.training.calibrate.load_user_network", load_slowly)
    with pytest.raises(InputError, match=r"detectors\.csv: has changed since the start"):
        load_corridor(str(file), detectors)
