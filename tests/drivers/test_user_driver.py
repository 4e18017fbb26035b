from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from tests.conftest import random_network
from unjam import check_driver
from unjam.controller import make_driver
from unjam.drivers.check import random_state
from unjam.drivers.local_state import LocalState
from unjam.drivers.observation import FeatureArguments, as_features, compute_observation
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.registry import driver_from_recipe, driver_recipe, user_code_recipes
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.user_driver import FileDriver, FileReference, as_driver
from unjam.errors import InputError
from unjam.scenarios import Merge, make_scenario
from unjam.training.config import load_config
from unjam.training.run_folder import check_config
from unjam.worlds.backend import open_backend
from unjam.worlds.episode import run_episode
from unjam.worlds.reward import Outcome, make_reward


def test_a_function_becomes_a_driver(my_drivers: Path) -> None:
    driver = make_driver(f"{my_drivers}:gentle", 0.1)
    check_driver(driver)
    assert driver.requirements().needs_arrays


def test_a_class_takes_parameters_and_the_time_step(my_drivers: Path) -> None:
    driver = make_driver(f"{my_drivers}:Keeper:gain=0.5", 0.1)
    check_driver(driver)
    state = random_state(np.random.default_rng(0), 2)
    found, memory = driver.act(state, driver.initial_memory(2))
    np.testing.assert_allclose(found, 0.5 * (state.leader_gap - 10))
    assert set(memory) == {"last"}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nonesuch", "has no 'nonesuch'; it has: .*gentle"),
        ("NoMemory", r"has act\(\) but no initial_memory"),
        ("Raises", "RuntimeError when made: no battery"),
        ("not_callable", "neither a function nor a class"),
        ("gentle:gain=1", "takes no parameters"),
        ("Keeper:strength=1", "TypeError when made"),
    ],
)
def test_says_what_is_wrong_with_a_file(my_drivers: Path, name: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make_driver(f"{my_drivers}:{name}", 0.1)


def test_says_that_a_file_is_missing_or_fails(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a file"):
        make_driver(f"{tmp_path}/none.py:x", 0.1)
    (tmp_path / "syntax.py").write_text("def x(:")
    with pytest.raises(InputError, match="SyntaxError when loading"):
        make_driver(f"{tmp_path}/syntax.py:x", 0.1)


def test_a_file_may_import_its_neighbours(tmp_path: Path) -> None:
    (tmp_path / "my_gains_of_mine.py").write_text("GAIN = 0.25")
    (tmp_path / "main.py").write_text("from my_gains_of_mine import GAIN\ndef d(state): return GAIN * state.speed")
    driver = make_driver(f"{tmp_path}/main.py:d", 0.1)
    state = random_state(np.random.default_rng(0), 3)
    np.testing.assert_allclose(driver.act(state, {})[0], 0.25 * state.speed)


def test_a_users_driver_is_not_asked_while_no_cav_is_on_the_road(tmp_path: Path) -> None:
    file = tmp_path / "nearest.py"
    file.write_text("def nearest(state):\n    return state.speed * 0.0 + 0.001 * state.leader_gap.min()\n")
    lonely = Merge(cavs=1, standing_vehicles=0, horizon=60)
    episode = run_episode(lonely, FileDriver(file, "nearest"), (3,))
    (trajectory,) = episode.trajectories
    assert trajectory.start_step > 3
    np.testing.assert_allclose(trajectory.applied_acceleration, 0.001 * trajectory.states.leader_gap[:-1], atol=1e-12)


def test_files_of_two_folders_have_neighbours_of_the_same_name(tmp_path: Path) -> None:
    found = []
    for folder, gain in (("a", -0.1), ("b", 0.3)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "gains.py").write_text(f"GAIN = {gain}")
        (tmp_path / folder / "mine.py").write_text(
            "from gains import GAIN\ndef hold(state):\n    return GAIN + 0 * state.speed"
        )
        found.append(FileDriver(tmp_path / folder / "mine.py", "hold"))
    state = random_state(np.random.default_rng(0), 1)
    assert [driver.act(state, {})[0] for driver in found] == [-0.1, 0.3]


def test_code_that_changes_under_way_is_another_driver(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def go(state):\n    return 0.5 + 0.0 * state.speed\n")
    driver = make_driver(f"{file}:go", 0.1)
    recipe, arrays = driver_recipe(driver)
    assert driver_recipe(driver_from_recipe(recipe, arrays))[0] == recipe
    file.write_text(file.read_text().replace("0.5", "0.1"))
    assert driver_recipe(driver)[0] == recipe  # that of what drives, not of what the file has become
    with pytest.raises(InputError, match=r"mine\.py:go: its file has changed since"):
        driver_from_recipe(recipe, arrays)


@pytest.mark.parametrize(
    ("memory", "answer", "words"),
    [
        ("None", "state.speed, memory", r"initial_memory\(2\) returns the memory None; allowed: a dict of arrays"),
        (
            "{'x': 0.0}",
            "state.speed, memory",
            r"initial_memory\(2\) returns 0.0 as 'x' of the memory; allowed: arrays of",
        ),
        (
            "{'x': {'y': np.zeros(3)}}",
            "state.speed, memory",
            r".* returns an array of shape \(3,\) as 'x.y' of the memory; allowed: ",
        ),
        ("{}", "state.speed, None", r"act\(\) returns the memory None; allowed: a dict of arrays"),
        ("{}", "state.speed, {'x': 1}", r"act\(\) returns 1 as 'x' of the memory; allowed: arrays of shape \(2, ...\)"),
        ("{}", "0.3, {}", r"acceleration has shape \(\); allowed: \(2,\), one for each CAV"),
        ("{}", "[0.3], {}", r"acceleration has shape \(1,\); allowed: \(2,\), one for each CAV"),
        ("{}", "state.speed[:, None], {}", r"acceleration has shape \(2, 1\); allowed: \(2,\), one for each CAV"),
        ("{}", "'fast', {}", "acceleration is not numbers: 'fast'"),
        ("{}", "state.speed * 1j, {}", "acceleration is not numbers"),
        ("{}", "np.ma.masked_less(state.speed, 99), {}", "acceleration is not numbers"),
        ("{}", "np.array(['1', '2']), {}", "acceleration is not numbers"),
        ("{}", "np.array([1, 2], 'timedelta64[s]'), {}", "acceleration is not numbers"),
        ("{}", "state.speed", r"act\(\) returns .*; allowed: \(accelerations, memory\)"),
    ],
)
def test_what_a_users_driver_returns_has_one_definition(memory: str, answer: str, words: str, tmp_path: Path) -> None:
    methods = f"def initial_memory(self, n): return {memory}\n    def act(self, state, memory): return {answer}"
    (tmp_path / "mine.py").write_text(f"import numpy as np\nclass Mine:\n    {methods}\n")
    for repeated in (
        FileDriver(tmp_path / "mine.py", "Mine"),
        as_driver(FileReference(tmp_path / "mine.py", "Mine").load_object()),
    ):
        with pytest.raises(InputError, match=f"Mine: {words}"):
            repeated.act(random_state(np.random.default_rng(0), 2), repeated.initial_memory(2))


def test_a_list_of_accelerations_will_do(tmp_path: Path) -> None:
    (tmp_path / "lists.py").write_text("def d(state): return [0.25 for _ in state.speed]")
    driver = ResidualDriver(make_driver(f"{tmp_path}/lists.py:d", 0.1), random_network(scale=0.0), 1.0)
    state = random_state(np.random.default_rng(0), 3)
    np.testing.assert_allclose(driver.act(state, driver.initial_memory(3))[0], 0.25)


@pytest.mark.parametrize(("is_own", "expected"), [(True, ("", "loading\n")), (False, ("loading\n", ""))])
def test_only_the_command_line_keeps_what_a_file_prints_off_its_results(
    is_own: bool,
    expected: tuple[str, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("unjam.processes._is_command_line", is_own)
    path = tmp_path / "loud.py"
    path.write_text("print('loading')\n\ndef gentle(state):\n    return 0.0 * state.speed\n")
    FileReference(path, "gentle").load_object()
    assert tuple(capsys.readouterr()) == expected


CODE = """
from unjam.scenarios.ring import Ring

NUMBER = {0}

def number(rows):
    return NUMBER + 0.0 * rows[4]

class Road(Ring):
    horizon = NUMBER

class Simulator:
    number = NUMBER

    def supports(self, scenario):
        return ""

    def open(self, scenario, seed, options):
        raise NotImplementedError
"""
STATE = random_state(np.random.default_rng(0), 3)
OUTCOME = Outcome(np.ones((3, 2)), np.ones((3, 1)), np.ones((3, 1)), np.zeros(3, bool), np.zeros(3), np.ones((3, 1)))


def number_of_feature(file: str) -> Any:
    (made,) = as_features((f"{file}:number",))
    return compute_observation((made,), FeatureArguments(STATE, STATE.speed, PISaturation(), {}))[0, 0]


def number_of_policy(file: str) -> Any:
    driver = ResidualDriver(PISaturation(), random_network(1), 1.0, (f"{file}:number",))
    return driver.observation(STATE, driver.initial_memory(3))[0, 0]


def number_of_backend(file: str) -> Any:
    with open_backend(f"{file}:Simulator") as found:
        return cast(Any, found).number


NUMBERS: dict[str, Callable[[str], Any]] = {
    "feature": number_of_feature,
    "policy": number_of_policy,
    "reward": lambda file: make_reward(f"{file}:number")(OUTCOME)["reward"][0],
    "driver": lambda file: make_driver(f"{file}:number", 0.1).act(STATE, {})[0][0],
    "scenario": lambda file: make_scenario(f"{file}:Road").horizon,
    "backend": number_of_backend,
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_a_name_means_the_present_code_of_the_present_folder(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for number, folder in enumerate(("a", "b", "b"), 1):
        (tmp_path / folder).mkdir(exist_ok=True)
        monkeypatch.chdir(tmp_path / folder)
        Path("mine.py").write_text(CODE.format(number))
        found.append(NUMBERS[kind]("mine.py"))
    assert found == [1, 2, 3]


def test_a_policy_keeps_the_features_that_it_was_made_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(CODE.format(1))
    driver = ResidualDriver(PISaturation(), random_network(1), 1.0, ("mine.py:number",))
    recipe, arrays = driver_recipe(driver)
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert [user_code_recipe["path"] for user_code_recipe in user_code_recipes(recipe)] == [str(tmp_path / "mine.py")]
    assert driver_recipe(driver_from_recipe(recipe, arrays))[0] == recipe
    Path("mine.py").write_text(CODE.format(2))
    (tmp_path / "mine.py").write_text(CODE.format(3))
    assert driver.observation(STATE, driver.initial_memory(3))[0, 0] == 1
    with pytest.raises(InputError, match=r"mine\.py:number: its file has changed since"):
        driver_from_recipe(recipe, arrays)
    with pytest.raises(InputError, match="allowed: features whose files the recipe lists"):
        user_code_recipes({**recipe, "files": []})
    with pytest.raises(InputError, match=r"files: .* is not allowed; allowed: \['mine\.py:number'\], as in inputs"):
        driver_from_recipe({**recipe, "files": 2 * recipe["files"]}, arrays)


def jerk(outcome: Outcome) -> Any:
    return -np.abs(np.diff(outcome.accelerations, axis=0, prepend=outcome.accelerations[:1])).mean(-1)


def centered(rows: Any) -> Any:
    return rows[4] - rows[4].mean()


def cumulative(outcome: Outcome) -> Any:
    return {"fine": outcome.backlog, "sum": np.cumsum(outcome.speeds.mean(-1))}


def previous(state: LocalState) -> Any:
    return np.column_stack([state.speed, np.roll(state.speed, 1)])


@pytest.mark.parametrize(
    ("load", "function", "unit"),
    [
        (make_reward, jerk, "control steps"),
        (make_reward, centered, "control steps"),
        (make_reward, cumulative, "control steps"),
        (lambda each: as_features((each,)), centered, "CAVs"),
        (lambda each: as_features((each,)), previous, "CAVs"),
    ],
)
def test_functions_whose_rows_depend_on_each_other_are_refused(
    load: Callable[[Any], Any], function: Callable[[Any], Any], unit: str
) -> None:
    with pytest.raises(InputError, match=rf"{function.__name__}: {unit} influence each other; allowed: rows that are"):
        load(function)


@pytest.mark.parametrize(
    ("changes", "is_allowed"), [({"backend": "batch"}, False), ({"model.model_ratio": 0.0}, True), ({}, False)]
)
def test_an_expert_whose_cavs_influence_each_other_drives_no_batch(
    changes: dict[str, Any], is_allowed: bool, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def centered(state):\n    return 0.5 * (state.speed.mean() - state.speed)\n")
    config = load_config(changes={"expert": f"{file}:centered", **changes})
    words = r"driver mine\.py:centered: CAVs influence each other; allowed: rows that are computed independently"
    with nullcontext() if is_allowed else pytest.raises(InputError, match=words):
        check_config(config)
