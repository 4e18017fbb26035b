"""Python code that a foreign folder names runs only if the user trusts it."""

from pathlib import Path

import pytest

from tests.conftest import unrun_driver
from tests.controller.test_file import residual
from tests.system.conftest import Run
from tests.system.test_invalid_inputs import one_line
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
VARY = "trpo.target_kl=0.1,0.2"
COMMANDS = {
    "drive": (*DRIVE, "run"),
    "drive together with another": (*DRIVE, "pi+run"),
    "watch": ("watch", *ROAD, "--driver", "run", "--video", "video.gif"),
    "assess": ("assess", "straight.sumocfg", "-d", "run", "--penetration-rates", "0.5", "--set", "horizon=20"),
    "train with it as expert": ("train", "ring", "--expert", "run", "--steps", "100"),
    "train with its configuration": ("train", "--config", "run/config.toml", "--out", "new"),
    "train with its best configuration": ("train", "--config", "run/best.toml", "--out", "new"),
    "train with it as agent": ("train", "--config", "run/agent.toml", "--out", "new"),
    "train with a name that leads through a missing folder": ("train", "--config", "run/indirect.toml", "--out", "new"),
    "resume": ("train", "--resume", "run"),
    "search": ("search", "ring", "--expert", "run", "--vary", VARY, "--out", "new"),
    "search with its configuration": ("search", "--config", "run/config.toml", "--vary", VARY, "--out", "new"),
    "evaluate": ("evaluate", "run", "--episodes", "1"),
    "model": ("model", "run"),
    "export": ("export", "run", "--out", "it.unjam"),
    "certify": ("certify", "run"),
    "verify": ("verify", "run"),
    "benchmark": ("benchmark", "run", "--suite", "closed-roads-v1", "--out", "new.json"),
}


@pytest.fixture
def ran(tmp_path: Path) -> Path:
    """Return a file that appears if the code runs that the foreign folder `run` names."""
    run, code, ran = tmp_path / "run", tmp_path / "run" / "code.py", tmp_path / "ran"
    create_run_folder(run, small_config(expert=f"{code}:gentle", scenario_options__horizon=20))
    (run / "best.toml").write_text((run / "config.toml").read_text())
    (run / "agent.toml").write_text(to_toml(small_config(agent=f"{code}:Agent")))
    (run / "indirect.toml").write_text(to_toml(small_config(expert=f"{run / 'none' / '..' / 'code.py'}:gentle")))
    code.write_text(DRIVER)
    driver = residual(unrun_driver(code, f"open({str(ran)!r}, 'w').close()\n"))
    (run / "controller.unjam").write_bytes(controller_bytes(driver, {}))
    return ran


@pytest.mark.long
@pytest.mark.parametrize("command", COMMANDS)
def test_untrusted_code_does_not_run(command: str, unjam: Run, tmp_path: Path, ran: Path) -> None:
    straight(tmp_path, '<vehicle id="a" type="car" route="along" depart="0"/>')
    done = unjam(*COMMANDS[command], pictures=False)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert one_line(done.stderr), done.stderr
    assert f"{str(tmp_path / 'run' / 'code.py')!r}" in done.stderr
    assert done.stderr.endswith("it runs only with --trust-code\n")
    assert not ran.exists()


@pytest.mark.long
@pytest.mark.parametrize("command", ["drive", "watch", "resume", "evaluate"])
def test_trusted_code_runs(command: str, unjam: Run, ran: Path) -> None:
    done = unjam(*COMMANDS[command], "--trust-code", pictures=False)
    assert done.returncode == 0, done.stderr
    assert ran.exists()


def test_certify_of_trusted_code_checks_its_requirements(unjam: Run, ran: Path) -> None:
    done = unjam(*COMMANDS["certify"], "--trust-code")
    assert (done.returncode, done.stdout, one_line(done.stderr)) == (2, "", True), done.stderr
    assert "a controller without safety filter and sample is not allowed" in done.stderr
    assert ran.exists()


def test_all_commands_that_run_code_are_tested() -> None:
    assert {words[0] for words in COMMANDS.values()} == CODE_RUNNING_COMMANDS


def test_code_that_ran_is_trusted_until_it_changes(unjam: Run, tmp_path: Path, ran: Path) -> None:
    assert unjam(*DRIVE, "run", "--trust-code").returncode == 0
    ran.unlink()
    assert unjam(*DRIVE, "run").returncode == 0
    assert ran.exists()
    code = tmp_path / "run" / "code.py"
    code.write_text(f"{code.read_text()}# changed\n")
    ran.unlink()
    for arguments in (COMMANDS["drive"], COMMANDS["resume"]):
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


def test_listing_folders_does_not_run_their_code(unjam: Run, ran: Path) -> None:
    listed = unjam("runs", "--folder", ".")
    assert listed.returncode == 0, listed.stderr
    assert "run" in listed.stdout
    assert not ran.exists()


@pytest.mark.long
def test_code_that_the_user_names_is_trusted(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(DRIVER)
    (tmp_path / "small.toml").write_text(to_toml(small_config(scenario_options__horizon=20)))
    named = ("--config", "small.toml", "--expert", "mine.py:gentle", "--out", "run")
    for arguments in (("train", *named), (*DRIVE, "run")):
        done = unjam(*arguments, pictures=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.usefixtures("without_pictures")
def test_own_code_runs_without_a_state_folder(
    my_drivers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNJAM_STATE", str(my_drivers / "no folder"))
    monkeypatch.setenv(TRUSTED_VARIABLE, "")
    trained = train(small_config(expert=f"{my_drivers}:gentle", scenario_options__horizon=20), tmp_path / "run")
    assert trained.controller.is_file()


@pytest.mark.parametrize("command", ["compare", "progress", "remove"])
def test_runs_on_foreign_roads_are_listed_and_removed_if_they_are_trusted(
    command: str, unjam: Run, tmp_path: Path
) -> None:
    for name in ("first", "second"):
        create_run_folder(tmp_path / name, small_config())
        (tmp_path / name / "road.py").write_text(
            "from unjam.scenarios import Ring\n\nclass Own(Ring):\n    title = 'own'\n"
        )
        config = tmp_path / name / "config.toml"
        config.write_text(
            config.read_text().replace('scenario = "ring"', f'scenario = "{tmp_path / name}/road.py:Own"')
        )
    names = ("first",) if command == "progress" else ("first", "second")
    options = ("--yes",) if command == "remove" else ()
    refused = unjam("runs", command, *names, *options)
    assert (refused.returncode, one_line(refused.stderr)) == (2, True), refused.stderr
    assert "--trust-code" in refused.stderr
    done = unjam("runs", command, *names, *options, "--trust-code")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "first" / "config.toml").exists() == (command != "remove")
    assert (tmp_path / "first" / "road.py").exists()  # unjam did not write it
