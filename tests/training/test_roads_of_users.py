"""A run holds its road: another content of the road's file, or another folder, does not change it silently."""

from pathlib import Path

import pytest

from tests.training.test_run import small_config
from unjam.errors import InputError
from unjam.scenarios import make_scenario
from unjam.training.config import load_config, to_toml
from unjam.training.fingerprint import check_file_hashes, fingerprint
from unjam.training.run_folder import create_run_folder, read_config

ROADS = {
    "ring": ('kind = "ring"\nlength = 120\nvehicles = 9\nhorizon = 100\n', {"cavs": 2}),
    "motorway": (
        "length = 3500\ninflow = 2800\n[[ramps]]\nposition = 1000\n[[ramps]]\nposition = 2400\n",
        {"ramps.0.inflow": 333, "horizon": 60},
    ),
}


@pytest.mark.parametrize("kind", ROADS)
def test_a_run_holds_the_content_of_a_toml_road(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text, options = ROADS[kind]
    file = tmp_path / "my road.toml"
    file.write_text(text)
    expected = make_scenario(str(file), options)
    given = {"scenario": str(file), **{f"scenario_options.{name}": value for name, value in options.items()}}
    create_run_folder(tmp_path / "run", load_config(changes=given))
    file.unlink()
    monkeypatch.chdir(tmp_path / "run")
    assert read_config(tmp_path / "run").make_scenario() == expected


def test_tasks_hold_the_content_of_toml_roads_and_have_their_names(tmp_path: Path) -> None:
    (tmp_path / "my road.toml").write_text(ROADS["ring"][0])
    config = tmp_path / "mixture.toml"
    config.write_text(f'[[tasks]]\nscenario = "{tmp_path / "my road.toml"}"\n[[tasks]]\nscenario = "ring"\n')
    roads = load_config(config).task_configs()
    assert list(roads) == ["my-road", "ring"]
    assert roads["my-road"].make_scenario() == make_scenario(str(tmp_path / "my road.toml"))
    assert "my road.toml" not in to_toml(load_config(config))


@pytest.mark.parametrize("definition", ["road = Ring({})", "def road():\n    return Ring({})"])
def test_another_road_in_the_python_file_of_a_run_is_refused(definition: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"

    def write(length: int) -> None:
        settings = f"length=({length}, {length}), vehicles=5"
        file.write_text(f"from unjam.scenarios import Ring\n\n{definition.format(settings)}\n")

    write(120)
    config = small_config(scenario=f"{file}:road", scenario_options={})
    stored = fingerprint(config)
    check_file_hashes(stored, fingerprint(config), "evaluate")
    write(300)
    with pytest.raises(InputError, match=r"evaluate: .*mine\.py has changed since the checkpoint"):
        check_file_hashes(stored, fingerprint(config), "evaluate")
