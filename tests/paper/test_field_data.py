import json
from pathlib import Path

import pandas as pd
import pytest

from tests.following.synthetic_trajectories import idm_driver
from unjam.following.calibration import CalibrationSettings
from unjam.following.networks import MultiStepSettings, NetworkSettings
from unjam.physics.idm import IDMParameters
from unjam_paper import field_data
from unjam_paper.field_data import FIELD_DATA_LOADERS, FieldFit, evaluate_fit, field_rows, load_field_data, split_halves


def table(path: Path, groups: list[dict[str, object]]) -> str:
    """A file with a synthetic driver for each group of columns."""
    parts = []
    for number, columns in enumerate(groups):
        trajectory = idm_driver(IDMParameters(time_headway=0.9 + 0.05 * number), seed=number, seconds=24.0)
        times = [0.1 * step for step in range(len(trajectory.speed))]
        numbers = {"t": times, "v_foll": trajectory.speed, "v_lead": trajectory.leader_speed, "gap": trajectory.gap}
        parts.append(pd.DataFrame({"pair": number, **numbers}).assign(**columns))
    pd.concat(parts).to_parquet(path)
    return str(path)


@pytest.fixture
def ngsim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    quick = MultiStepSettings(hidden=(4,), segment_seconds=3.0, batch_size=4, gradient_steps=2, validation_interval=1)
    monkeypatch.setattr(field_data, "MULTI_STEP_SETTINGS", quick)
    monkeypatch.setattr(field_data, "ONE_STEP_SETTINGS", NetworkSettings(hidden=(4,), epochs=2))
    settings = dict.fromkeys(field_data.CALIBRATED_MODELS, CalibrationSettings(generations=2))
    monkeypatch.setattr(field_data, "CALIBRATED_MODELS", settings)
    splits = ["paper_train"] * 5 + ["paper_test"] * 2 + ["extra"]
    groups = [{"split": split, "period": 400, "follower": number} for number, split in enumerate(splits)]
    return table(tmp_path / "ngsim.parquet", groups)


@pytest.fixture
def astazero(tmp_path: Path) -> str:
    runs = [("040719_platoon10", False, "none"), ("040719_platoon3", False, "none")]
    runs += [("040719_platoon5", True, "min"), ("050719_platoon1", True, "min"), ("040719_platoon4", True, "max")]
    groups = [{"run": run, "follower": "Audi A6", "acc": acc, "setting": setting} for run, acc, setting in runs]
    return table(tmp_path / "astazero.parquet", groups)


def test_test_pairs_are_not_used_for_training(ngsim: str, astazero: str) -> None:
    found = load_field_data("ngsim", ngsim)
    assert (len(found.training), {name: len(trajectories) for name, trajectories in found.test.items()}) == (
        5,
        {"test": 2, "other drivers": 1},
    )
    for name in FIELD_DATA_LOADERS:
        data = load_field_data(name, ngsim if name == "ngsim" else astazero)
        training = {each.name for each in data.training}
        assert training
        for trajectories in data.test.values():
            assert trajectories
            assert not training & {each.name for each in trajectories}


@pytest.mark.parametrize(
    "model", ["paper's IDM", "IDM, initial headway weighted", "vanilla", "knowledge, IDM", "IDM + multi-step"]
)
def test_every_model_is_evaluated_on_every_test_set(ngsim: str, model: str) -> None:
    rows = field_rows([evaluate_fit(FieldFit("ngsim", ngsim, model))])
    assert [row["test"] for row in rows] == ["test", "other drivers", "second halves"]
    for row in rows:
        low, high = row["gap_interval"]
        assert low <= row["gap"] <= high
        assert len(row["gap_each"]) == row["trajectories"]


def test_personal_parameters_are_evaluated_on_second_halves_only(ngsim: str) -> None:
    rows = field_rows([evaluate_fit(FieldFit("ngsim", ngsim, "IDM, personal time headway"))])
    assert [row["test"] for row in rows] == ["second halves"]
    first, second = split_halves(load_field_data("ngsim", ngsim).training)
    assert len(first[0].speed) + len(second[0].speed) == len(load_field_data("ngsim", ngsim).training[0].speed)


def test_the_study_writes_results_and_a_figure(
    ngsim: str, astazero: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = [FieldFit("ngsim", ngsim, model) for model in ("paper's IDM", "IDM", "vanilla")]
    monkeypatch.setattr(field_data, "field_fits", lambda files: chosen)
    field_data.run_field_study(tmp_path / "out", Path(ngsim), Path(astazero), workers=1)
    document = json.loads((tmp_path / "out" / "field.json").read_text())
    assert len(document["rows"]) == 9
    assert str(tmp_path) not in json.dumps(document["manifest"])
    assert (tmp_path / "out" / "field.png").stat().st_size > 10_000
