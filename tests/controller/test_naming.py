import re
from pathlib import Path

import numpy as np
import pytest

from tests.controller.test_file import ABOUT, actions, residual, written
from unjam.controller import controller_bytes, make_driver
from unjam.drivers import IDM, PISaturation
from unjam.drivers.user_driver import FileDriver
from unjam.drivers.wrappers import MixedDriver
from unjam.errors import InputError


def test_a_run_folder_stands_for_its_controller(tmp_path: Path) -> None:
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(residual(IDM()), ABOUT))
    np.testing.assert_array_equal(actions(make_driver(str(tmp_path), 0.1)), actions(residual(IDM())))


def test_a_driver_is_made_from_its_name_file_or_path(
    tmp_path: Path, my_drivers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, controller_bytes(residual(IDM()), ABOUT))
    assert make_driver("pi", 0.1) == PISaturation()
    assert make_driver("pi", 0.5) == PISaturation(time_step=0.5)
    assert make_driver("pi:window=30,time_constant=0", 0.1) == PISaturation(window=30, time_constant=0)
    assert make_driver(f"{my_drivers}:gentle", 0.1) == FileDriver(my_drivers, "gentle")
    np.testing.assert_array_equal(actions(make_driver(str(path), 0.1)), actions(residual(IDM())))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pi").mkdir()  # a folder does not hide a driver of its name
    assert make_driver("pi", 0.1) == PISaturation()


@pytest.mark.parametrize("text", ["", "nonesuch", "runs/none", "pi:speed=1", "none.unjam", "pi:window=0"])
def test_what_names_no_driver_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        make_driver(text, 0.1)
    assert "\n" not in str(caught.value)


def test_several_joined_by_a_plus_share_the_cavs(tmp_path: Path) -> None:
    path = written(tmp_path, controller_bytes(residual(IDM()), ABOUT))
    made = make_driver(f"pi:window=1e+1+{path}", 0.1)
    assert isinstance(made, MixedDriver)
    assert made.drivers[0] == PISaturation(window=10)
    np.testing.assert_array_equal(actions(made.drivers[1]), actions(residual(IDM())))


@pytest.mark.parametrize("text", ["{}", "{}+pi+idm", "pi+{}", "{}+pi.py:gentle+{}", "idm+{}+pi:window=1e+1"])
@pytest.mark.parametrize("path", ["my+drivers/mine.py", "a+b.py", "pi.py"])
def test_a_plus_in_the_path_of_a_file_separates_no_drivers(
    path: str, text: str, tmp_path: Path, my_drivers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in map(Path, ("pi.py", path)):
        file.parent.mkdir(exist_ok=True)
        file.write_text(my_drivers.read_text())
    mine = FileDriver(Path(path), "gentle")
    drivers = {
        "{}": mine,
        "pi": PISaturation(),
        "idm": IDM(),
        "pi.py:gentle": FileDriver(Path("pi.py"), "gentle"),
        "pi:window=1e+1": PISaturation(window=10),
    }
    expected = tuple(drivers[part] for part in re.split(r"\+(?=\D)", text))
    made = make_driver(text.replace("{}", f"{path}:gentle"), 0.1)
    assert made == (expected[0] if len(expected) == 1 else MixedDriver(expected))
