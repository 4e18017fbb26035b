import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest

from tests.pictures import empty_pictures
from tests.training.test_run import small_config
from unjam.adapters import onnx_driver
from unjam.adapters.stable_baselines3_export import stable_baselines3_bytes
from unjam.adapters.stable_baselines3_file import read_policy
from unjam.controller import certificate, load_controller, packaged_file, string_stability
from unjam.controller.file import (
    GRAPH_PART,
    MANIFEST_PART,
    MAX_SAMPLE_STEPS,
    SAMPLE_PART,
    WEIGHTS_PART,
    controller_bytes,
    read_controller,
    read_sample,
    replay_states,
    unpack_parts,
)
from unjam.controller.verify import verify_controller_file
from unjam.drivers import PISaturation, ResidualDriver
from unjam.drivers.car_following import Constant
from unjam.drivers.registry import driver_from_recipe, driver_recipe
from unjam.drivers.safety import STANDARD_ACTUATOR, Actuator
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError
from unjam.measures.metrics import measure
from unjam.onnx_models import remove_texts
from unjam.scenarios import Ring
from unjam.training.export import export_controller
from unjam.training.run_folder import controller_origin
from unjam.training.train import train
from unjam.worlds.episode import run_episode


def manifest_of(path: Path) -> dict[str, Any]:
    return json.loads(unpack_parts(path)[MANIFEST_PART])


def export_reckless(road: Ring, file: Path) -> Path:
    source = file.with_name("source.unjam")
    source.write_bytes(controller_bytes(Constant(1.0), controller_origin(road, Constant(1.0))))
    return export_controller(source, file).file


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    with empty_pictures():
        train(small_config(steps=300, model__model_ratio=0.0), folder)
    return folder


@pytest.fixture(scope="module")
def exported_file(run: Path) -> Path:
    return export_controller(run, run.parent / "ring.unjam").file


@pytest.mark.long
def test_export_has_the_controller_of_the_run(run: Path, exported_file: Path) -> None:
    made, kept = load_controller(exported_file), load_controller(run)
    assert isinstance(made, FilteredDriver)
    made = made.driver
    assert isinstance(made, ResidualDriver)
    assert isinstance(kept, ResidualDriver)
    for ours, theirs in zip(made.network.layers, kept.network.layers, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
    assert unpack_parts(exported_file).keys() == {MANIFEST_PART, WEIGHTS_PART, SAMPLE_PART}


def test_manifest_has_origin_and_metrics(run: Path, exported_file: Path) -> None:
    said = manifest_of(exported_file)
    assert said["run"] == {"scenario": "ring", "agent": "trpo", "seed": 0}
    assert said["scenario"]["vehicles"] == 8
    assert (said["time_step"], said["action_limit"], said["expert"]) == (0.1, 1.0, "pi")
    assert said["versions"]["libsumo"].startswith("1.28")
    rows = json.loads((run / "evaluation.json").read_text())["rows"]
    trained = [row["return"] for row in rows if row["driver"] == "trained"]
    metrics = said["metrics"]
    assert metrics["trained"]["episodes"] == len(trained) == 2
    assert metrics["trained"]["return"]["mean"] == pytest.approx(np.mean(trained))
    assert {"reward", "trained", "pi"} == metrics.keys()


def test_sample_has_the_local_states_of_an_episode(exported_file: Path) -> None:
    states, answers = read_sample(unpack_parts(exported_file)[SAMPLE_PART])
    assert len(answers) == 100  # the horizon of the run
    response = STANDARD_ACTUATOR.initial_state(states.speed[0], 0.1)
    for speed, command, following_speed in zip(states.speed, answers, states.speed[1:], strict=False):
        response = STANDARD_ACTUATOR.apply_command(command, speed, response, 0.1)
        assert following_speed - speed == pytest.approx(0.1 * response.acceleration, abs=1e-6)
    assert set(states.loop_length) <= set(range(120, 131))


def test_export_of_an_unevaluated_run_has_no_metrics(run: Path, tmp_path: Path) -> None:
    for name in ("config.toml", "controller.unjam"):
        (tmp_path / name).write_bytes((run / name).read_bytes())
    assert manifest_of(export_controller(tmp_path, tmp_path / "it.unjam").file)["metrics"] is None


@pytest.mark.slow
def test_exported_driver_has_step_and_bounds_of_the_scenario(tmp_path: Path) -> None:
    done = export_controller("pi:window=30", tmp_path / "pi.unjam", scenario="merge")
    assert load_controller(done.file) == PISaturation(window=30, time_step=1.0)
    said = manifest_of(done.file)
    assert (said["time_step"], said["action"]["high"]) == (1.0, 1.0)
    assert done.sample_steps <= MAX_SAMPLE_STEPS
    again = export_controller(done.file, tmp_path / "again.unjam", scenario="merge")
    assert load_controller(again.file) == load_controller(done.file)


@pytest.mark.slow
def test_graph_is_in_the_controller_and_in_its_own_file(run: Path, tmp_path: Path) -> None:
    done = export_controller(run, tmp_path / "ring.unjam", onnx=True)
    assert done.graph == tmp_path / "ring.onnx"
    described = onnx.load_model_from_string((tmp_path / "ring.onnx").read_bytes())
    assert described.graph.input[0].doc_string == "[m/s]"
    remove_texts(described)
    plain = onnx.load_model_from_string(unpack_parts(done.file)[GRAPH_PART])
    remove_texts(plain)
    assert described == plain


@pytest.mark.slow
def test_the_graph_describes_itself_and_drives_as_the_controller(run: Path, tmp_path: Path) -> None:
    done = export_controller(run, tmp_path / "ring.unjam", onnx=True)
    assert done.graph is not None
    states, answers = read_sample(unpack_parts(done.file)[SAMPLE_PART])
    driver = onnx_driver(done.graph)
    assert driver.limits is not None
    found = replay_states(driver, states, driver.limits.highest)
    np.testing.assert_allclose(found, answers, atol=1e-9)
    np.testing.assert_allclose(replay_states(driver_from_recipe(*driver_recipe(driver)), states, 1.0), found, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("agent", ["trpo", "ppo", "sac", "td3"])
def test_stable_baselines3_loads_the_residual(agent: str, run: Path, tmp_path: Path) -> None:
    from sb3_contrib import TRPO
    from stable_baselines3 import PPO, SAC, TD3

    controller, path = load_controller(run), tmp_path / "ring.zip"
    assert isinstance(controller, ResidualDriver)
    if agent == "trpo":  # that of the run
        assert export_controller(run, tmp_path / "ring.unjam", stable_baselines3=True).model == path
    else:
        path.write_bytes(stable_baselines3_bytes(controller, agent))
    algorithms: dict[str, Any] = {"trpo": TRPO, "ppo": PPO, "sac": SAC, "td3": TD3}
    model = algorithms[agent].load(path, device="cpu")
    made = gymnasium.make(
        "unjam/Ring-v0", length=(120, 120), vehicles=8, expert=model.unjam["expert"], features=model.unjam["features"]
    )
    assert (model.observation_space, model.action_space) == (made.observation_space, made.action_space)
    observations = np.random.default_rng(0).uniform(-2.0, 2.0, (50, controller.network.input_size)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(actions[:, 0], controller.network(observations.astype(np.float64)), atol=1e-5)
    assert np.abs(actions).max() > 0.0
    np.testing.assert_allclose(read_policy(path).predict(observations.astype(np.float64))[0], actions, atol=1e-5)


def test_a_formula_is_no_model_of_stable_baselines3(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="stable_baselines3: 'pi' is not allowed; allowed: a residual, such as a"):
        export_controller("pi", tmp_path / "pi.unjam", stable_baselines3=True)


@pytest.mark.parametrize(
    ("source", "to", "scenario", "words"),
    [
        ("pi", "it.zip", "", "a file that ends in .unjam"),
        ("ghost", "it.unjam", "", "driver: 'ghost' is not allowed"),
        ("pi", "it.unjam", "nowhere", "'nowhere' is not allowed"),
        ("human", "it.unjam", "", "the simulator drives this vehicle"),
        ("mine.py:gentle", "it.unjam", "", "mine.py is Python code"),
        ("none.unjam", "it.unjam", "", "does not exist"),
        (".", "it.unjam", "", "not a run folder"),
        (".", "it.unjam", "ring", "none for a run"),
    ],
)
@pytest.mark.usefixtures("my_drivers")
def test_impossible_export_is_refused(
    source: str, to: str, scenario: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        export_controller(source, to, scenario=scenario)
    assert words in str(caught.value)
    assert not Path(to).exists()


@pytest.mark.long
def test_failed_verification_keeps_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    to = tmp_path / "pi.unjam"
    export_controller("pi", to, scenario="ring")
    before = to.read_bytes()

    def refuse(path: Path) -> None:
        raise InputError(f"{path}: is another")

    monkeypatch.setattr("unjam.training.export.verify_controller_file", refuse)
    with pytest.raises(InputError, match="is another"):
        export_controller("idm", to, scenario="ring")
    assert [path.name for path in tmp_path.iterdir()] == ["pi.unjam"]
    assert to.read_bytes() == before


@pytest.mark.parametrize("actuator", [{}, {"delay": 0.2, "lag": 0.3}])
def test_an_exported_controller_drives_its_road_as_the_driver_that_the_road_filters(
    actuator: dict[str, float], tmp_path: Path
) -> None:
    file = tmp_path / "pi.unjam"
    road = replace(Ring(vehicles=9, length=(100, 100), horizon=600), actuator=Actuator(**actuator))
    driver = load_controller(export_reckless(road, file))
    assert isinstance(driver, FilteredDriver)
    assert driver.actuator == road.actuator
    inside, outside = (run_episode(road, each, (3,)) for each in (driver, driver.driver))
    np.testing.assert_array_equal(inside.speeds, outside.speeds)
    assert measure(outside)["filter_override_share"] > 0.0


def test_a_delay_of_parts_of_control_steps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"actuator.delay: 0.25 is not allowed; allowed: whole control steps of 0.1 s"):
        export_reckless(replace(Ring(), actuator=Actuator(delay=0.25)), tmp_path / "pi.unjam")


def test_graph_needs_all_inputs_of_the_driver(tmp_path: Path) -> None:
    file = tmp_path / "it.unjam"
    with pytest.raises(InputError, match="filtered is not allowed: ring does not provide allowed_speed"):
        export_controller("adaptive-acc", file, onnx=True, scenario="ring")
    assert not file.exists()


def test_exported_controller_file_keeps_its_origin(tmp_path: Path) -> None:
    shipped = manifest_of(packaged_file("figure-eight-tuned"))
    again = manifest_of(export_controller("unjam:figure-eight-tuned", tmp_path / "again.unjam").file)
    for name in ("scenario", "tuning", "expert", "versions"):
        assert again[name] == shipped[name]
    states, _ = read_sample(unpack_parts(tmp_path / "again.unjam")[SAMPLE_PART])
    assert len(states.speed) == MAX_SAMPLE_STEPS


@pytest.mark.long
def test_a_controller_of_a_users_road_is_certified_and_its_code_needs_trust(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, mark = tmp_path / "roads.py", tmp_path / "ran"
    code.write_text(
        "from pathlib import Path\nfrom unjam.scenarios import Ring\n"
        f"class Own(Ring):\n    title = 'own ring'\nPath({str(mark)!r}).touch()\n"
    )
    file = export_controller("idm", tmp_path / "own.unjam", scenario=f"{code}:Own").file
    monkeypatch.setattr(certificate, "ATTACK_POPULATION", 24)
    monkeypatch.setattr(certificate, "ATTACK_GENERATIONS", 3)
    monkeypatch.setattr(string_stability, "OSCILLATION_FREQUENCIES", np.geomspace(0.02, 0.5, 5))
    mark.unlink()
    assert certificate.make_certificate(read_controller(file))["worst_cases"]["contacts"] == 0
    assert {each.part: each.detail for each in verify_controller_file(file)}["road"].startswith("made for the own ring")
    monkeypatch.setenv("UNJAM_STATE", str(tmp_path / "of another user"))
    with pytest.raises(InputError, match=r"controller own\.unjam names Python code .*: it runs only with --trust-code"):
        export_controller(file, tmp_path / "again.unjam")
    assert not mark.exists()


@pytest.mark.parametrize(("option", "suffix"), [("onnx", ".onnx"), ("stable_baselines3", ".zip")])
def test_files_that_belong_to_no_controller_are_not_overwritten(
    option: str, suffix: str, run: Path, tmp_path: Path
) -> None:
    mine, options = tmp_path / f"mine{suffix}", dict[str, Any]({option: True})
    mine.write_text("mine")
    with pytest.raises(InputError, match=rf"out: .*mine\{suffix} exists and is no export of mine.unjam"):
        export_controller(run, tmp_path / "mine.unjam", **options)
    assert mine.read_text() == "mine"
    export_controller(run, tmp_path / "mine.unjam")
    with pytest.raises(InputError, match=rf"out: .*mine\{suffix} exists and is no export of mine.unjam"):
        export_controller(run, tmp_path / "mine.unjam", **options)
    assert mine.read_text() == "mine"
    mine.unlink()
    for _ in range(2):  # its own files are replaced
        export_controller(run, tmp_path / "mine.unjam", **options)
        assert mine.is_file()


@pytest.mark.parametrize(
    ("settings", "car"), [({}, (0.2, 0.3)), ({"actuator.delay": 0.4}, (0.4, 0.3)), ({"actuator.lag": 0.0}, (0.2, 0.0))]
)
def test_a_packaged_controller_for_ideal_cars_is_exported_with_the_filter_of_a_usual_car(
    settings: dict[str, Any], car: tuple[float, float], tmp_path: Path
) -> None:
    result = export_controller("unjam:ring-gap-tuned", tmp_path / "a.unjam", settings=settings)
    driver = read_controller(result.file).driver
    assert isinstance(driver, FilteredDriver)
    assert (driver.actuator.delay, driver.actuator.lag) == car
    assert result.actuator == driver.actuator.describe()
