"""A folder that somebody else has made names Python code: it runs only where its user says so."""

from pathlib import Path

import pytest

from tests.conftest import strangers_driver
from tests.controller.test_file import residual
from tests.system.conftest import Run
from tests.system.test_wrong_inputs import one_line
from tests.training.test_run import small_config
from tests.worlds.sumo.user_networks import straight
from unjam.cli import CODE_RUNNING_COMMANDS
from unjam.controller import controller_bytes
from unjam.training.config import to_toml
from unjam.training.run_folder import create_run_folder
from unjam.training.train import train
from unjam.trust import TRUSTED_VARIABLE

DRIVER = "def gentle(state):\n    return 0.1 * (state.leader_speed - state.speed)\n"
ROAD = ("ring", "--set", "horizon=20", "--set", "warmup=0")
DRIVE = ("drive", *ROAD, "--episodes", "1", "--workers", "1", "--no-report", "--driver")
KINDS = "trpo.target_kl=0.1,0.2"
VERBS = {
    "drive": (*DRIVE, "run"),
    "drive beside another": (*DRIVE, "pi+run"),
    "watch": ("watch", *ROAD, "--driver", "run", "--video", "film.gif"),
    "assess": ("assess", "straight.sumocfg", "-d", "run", "--shares", "0.5", "--set", "horizon=20"),
    "train on it": ("train", "ring", "--expert", "run", "--steps", "100"),
    "train as it": ("train", "--config", "run/config.toml", "--out", "new"),
    "train beside it": ("train", "--config", "run/best.toml", "--out", "new"),
    "go on": ("train", "--resume", "run"),
    "search": ("search", "ring", "--expert", "run", "--vary", KINDS, "--out", "new"),
    "search as it": ("search", "--config", "run/config.toml", "--vary", KINDS, "--out", "new"),
    "evaluate": ("evaluate", "run", "--episodes", "1"),
    "model": ("model", "run"),
    "export": ("export", "run", "--to", "it.unjam"),
    "certify": ("certify", "run"),
    "verify": ("verify", "run"),
}


@pytest.fixture
def ran(tmp_path: Path) -> Path:
    """What appears when the code runs that the folder `run` names, which somebody else has made."""
    run, code, ran = tmp_path / "run", tmp_path / "run" / "code.py", tmp_path / "ran"
    create_run_folder(run, small_config(expert=f"{code}:gentle", road__horizon=20))
    (run / "best.toml").write_text((run / "config.toml").read_text())
    code.write_text(DRIVER)
    driver = residual(strangers_driver(code, f"open({str(ran)!r}, 'w').close()\n"))
    (run / "controller.unjam").write_bytes(controller_bytes(driver, {}))
    return ran


@pytest.mark.long
@pytest.mark.parametrize("verb", VERBS)
def test_code_that_a_folder_names_does_not_run(verb: str, unjam: Run, tmp_path: Path, ran: Path) -> None:
    straight(tmp_path, '<vehicle id="a" type="car" route="along" depart="0"/>')
    done = unjam(*VERBS[verb], pictures=False)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert one_line(done.stderr), done.stderr
    assert f"{str(tmp_path / 'run' / 'code.py')!r}" in done.stderr
    assert done.stderr.endswith("it runs only with --trust-code\n")
    assert not ran.exists()


@pytest.mark.long
@pytest.mark.parametrize("verb", ["drive", "watch", "go on", "evaluate"])
def test_code_that_its_user_trusts_runs(verb: str, unjam: Run, ran: Path) -> None:
    done = unjam(*VERBS[verb], "--trust-code", pictures=False)
    assert done.returncode == 0, done.stderr
    assert ran.exists()


def test_certify_goes_on_to_what_it_needs_where_the_code_is_trusted(unjam: Run, ran: Path) -> None:
    done = unjam(*VERBS["certify"], "--trust-code")
    assert (done.returncode, done.stdout, one_line(done.stderr)) == (2, "", True), done.stderr
    assert "a controller without its safety filter and sample is not allowed" in done.stderr
    assert ran.exists()


def test_every_verb_that_can_be_told_so_knows_how_to_trust_code() -> None:
    assert {words[0] for words in VERBS.values()} == {verb.__name__ for verb in CODE_RUNNING_COMMANDS}


def test_code_that_ran_is_trusted_until_it_changes(unjam: Run, tmp_path: Path, ran: Path) -> None:
    assert unjam(*DRIVE, "run", "--trust-code").returncode == 0
    ran.unlink()
    assert unjam(*DRIVE, "run").returncode == 0
    assert ran.exists()
    code = tmp_path / "run" / "code.py"
    code.write_text(f"{code.read_text()}# changed\n")
    ran.unlink()
    for arguments in (VERBS["drive"], VERBS["go on"]):
        done = unjam(*arguments)
        assert (done.returncode, one_line(done.stderr)) == (2, True), done.stderr
    assert not ran.exists()


def test_the_same_code_in_another_folder_is_not_trusted(unjam: Run, tmp_path: Path, ran: Path) -> None:
    assert unjam(*DRIVE, "run/code.py:gentle").returncode == 0
    ran.unlink()
    (tmp_path / "run").rename(tmp_path / "other")
    config = tmp_path / "other" / "config.toml"
    config.write_text(config.read_text().replace(str(tmp_path / "run"), str(tmp_path / "other")))
    assert unjam("train", "--resume", "other").returncode == 2
    assert not ran.exists()


def test_folders_are_listed_and_reported_without_their_code(unjam: Run, ran: Path) -> None:
    listed = unjam("runs", "--under", ".")
    assert listed.returncode == 0, listed.stderr
    assert "run" in listed.stdout
    assert not ran.exists()


@pytest.mark.long
def test_who_names_his_own_code_is_asked_for_nothing(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(DRIVER)
    (tmp_path / "small.toml").write_text(to_toml(small_config(road__horizon=20)))
    named = ("--config", "small.toml", "--expert", "mine.py:gentle", "--out", "run")
    for arguments in (("train", *named), (*DRIVE, "run")):
        done = unjam(*arguments, pictures=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.usefixtures("without_pictures")
def test_own_code_runs_to_the_end_where_nothing_can_be_remembered(
    my_drivers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNJAM_STATE", str(my_drivers / "no folder"))
    monkeypatch.setenv(TRUSTED_VARIABLE, "")
    trained = train(small_config(expert=f"{my_drivers}:gentle", road__horizon=20), tmp_path / "run")
    assert trained.controller.is_file()
