import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.pictures import empty_pictures
from tests.training.test_run import small_config
from unjam.controller import load_controller, packaged_file
from unjam.controller.file import (
    GRAPH_PART,
    MANIFEST_PART,
    MAX_SAMPLE_STEPS,
    SAMPLE_PART,
    WEIGHTS_PART,
    read_sample,
    unpack_parts,
)
from unjam.drivers import PISaturation, ResidualDriver
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError
from unjam.training.export import export_controller
from unjam.training.train import train


def manifest_of(path: Path) -> dict[str, Any]:
    return json.loads(unpack_parts(path)[MANIFEST_PART])


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
    np.testing.assert_allclose(np.diff(states.speed), 0.1 * answers[:-1], atol=1e-6)
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


@pytest.mark.long
def test_graph_is_in_the_controller_and_in_its_own_file(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    done = export_controller(run, tmp_path / "ring.unjam", onnx=True)
    assert done.graph == tmp_path / "ring.onnx"
    assert (tmp_path / "ring.onnx").read_bytes() == unpack_parts(done.file)[GRAPH_PART]


@pytest.mark.parametrize(
    ("source", "to", "scenario", "words"),
    [
        ("pi", "it.zip", "", "a file that ends in .unjam"),
        ("ghost", "it.unjam", "", "driver: 'ghost' is not allowed"),
        ("pi", "it.unjam", "nowhere", "'nowhere' is not allowed"),
        ("human", "it.unjam", "", "human is the simulator itself"),
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


def test_actuator_latency_with_a_filter_is_refused(tmp_path: Path) -> None:
    config = small_config(steps=100, model__model_ratio=0.0, scenario_options__actuator__lag=0.5)
    with empty_pictures():
        train(config, tmp_path / "late")
    with pytest.raises(InputError, match=r"export: actuator.delay 0, actuator.lag 0.5 is not allowed"):
        export_controller(tmp_path / "late", tmp_path / "late.unjam")


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
