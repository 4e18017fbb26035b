from pathlib import Path

import pytest

from tests.studies.test_field import table
from unjam.errors import DiskError, InputError
from unjam.following.fit_from_files import fit_from_files

QUICK = {"calibration.generations": 2, "residual": False}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return Path(table(tmp_path / "data.parquet", [{"kind": kind} for kind in ("human", "human", "ACC")]))


def test_a_file_becomes_a_population(data: Path) -> None:
    found = fit_from_files([data], QUICK)
    assert len(found.population.drivers) == 3
    assert found.words == ["data.parquet: 3 trajectories with 723 of 723 rows"]
    assert found.population.about["data"] == ["data.parquet"]
    assert "one IDM for all" in found.verdict()[0]
    assert found.facts()["drivers"] == 3


def test_a_population_names_no_folder_of_the_machine(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["unjam", "fit-drivers", str(data)])
    command = fit_from_files([data], QUICK).population.about["manifest"]["command"]
    assert command == ["unjam", "fit-drivers", "data.parquet"]


def test_trajectories_can_be_chosen(data: Path) -> None:
    assert len(fit_from_files([data], QUICK, only={"kind": "human"}).population.drivers) == 2


def test_drivers_of_several_files_are_told_apart(data: Path, tmp_path: Path) -> None:
    other = Path(table(tmp_path / "other.parquet", [{}]))
    names = [one["name"] for one in fit_from_files([data, other], QUICK).population.details]
    assert names == ["data-0", "data-1", "data-2", "other-0"]


@pytest.mark.parametrize(
    ("changes", "more", "words"),
    [
        ({"calibration.speed": 2}, {}, "calibration.speed: unknown name"),
        ({}, {"only": {"kind": "robot"}}, "no trajectory has kind 'robot'; there are: ACC, human"),
        ({}, {"only": {"colour": "red"}}, "only: 'colour' is not allowed"),
        ({}, {"out": Path("drivers.toml")}, "out: 'drivers.toml' is not allowed"),
    ],
)
def test_wrong_input_is_one_line(data: Path, changes: dict, more: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        fit_from_files([data], {**QUICK, **changes}, **more)


def test_nothing_is_calibrated_that_cannot_be_written(data: Path, tmp_path: Path) -> None:
    with pytest.raises(DiskError):
        fit_from_files([data], QUICK, out=tmp_path / "gone" / "drivers.json")
