"""All commands with SUMO."""

import json
import re
import shlex
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.faults.processes import SETTINGS, TINY
from tests.recordings.synthetic_trajectories import write_table
from tests.system.conftest import UNJAM, Run
from tests.worlds.sumo.user_networks import game, straight
from unjam.controller.file import load_controller, packaged_file
from unjam.drivers.safety import Actuator
from unjam.drivers.wrappers import FilteredDriver

SMALL = ["--length", "60", "--vehicles", "5", "--set", "horizon=80"]
TINY_RUN = [
    *["train", "ring", "--length", "60", "--vehicles", "5", "--set", "scenario_options.horizon=80", "--workers", "1"],
    *["--set", "trpo.steps_per_iteration=160", "--set", "evaluation.episodes=2"],
    *["--set", 'evaluation.baselines=["human"]'],
    *["--set", "evaluation.validation_episodes=1", "--set", "evaluation.validation_interval=2"],
]

CALM = """
def gentle(state):
    return 0.1 * (state.leader_speed - state.speed)

def calm(outcome):
    return {"speed": outcome.speeds.mean(1)}
"""

REQUIRED_METRICS = [
    "mean_speed",
    "mean_speed_steady",
    "speed_std_fleet",
    "speed_std_cav",
    "cav_mean_speed",
    "return",
    "return_eq16",
    "mean_abs_accel",
    "collisions",
    "min_ttc",
    "fuel_ml_per_km",
    "outflow_veh_per_h",
    "insertion_backlog_veh",
    "shield_override_share",
    "speed_limit_ratio",
    "speed_limit_ratio_steady",
]

COMMANDS = [
    "runs",
    "scenarios",
    "drivers",
    "drive",
    "assess",
    "benchmark",
    "calibrate",
    "train",
    "evaluate",
    "model",
    "fit-drivers",
    "tune",
]
COMMANDS += ["new", "report", "reproduce", "search", "export", "keys", "sign", "verify", "watch", "bench", "doctor"]


def document(ran: subprocess.CompletedProcess[str]) -> Any:
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


@pytest.mark.slow
def test_train_on_several_roads_prints_a_table_for_each(unjam: Run, tmp_path: Path) -> None:
    mixture = tmp_path / "mixture.toml"
    mixture.write_text('[[tasks]]\nscenario_options = {length = [70, 70]}\n[[tasks]]\nname = "short"\n')
    command = [*TINY_RUN, "--config", mixture, "--steps", 160, "--out", tmp_path / "run"]
    ran = unjam(*command, pictures=False)
    assert ran.returncode == 0, ran.stderr
    assert [line for line in ran.stdout.splitlines() if line in ("ring:", "short:")] == ["ring:", "short:"]
    assert ran.stdout.count("Return difference to its expert") == 2
    assert ran.stdout.count("2 paired seeds") == 2 * len(("pi", "trained"))
    assert {"ring", "short", "report.html"} <= {path.name for path in (tmp_path / "run").iterdir()}


@pytest.mark.long
def test_a_run_that_names_files_is_usable_in_a_process_with_another_working_folder(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(CALM)
    command = [*TINY_RUN, "--expert", "mine.py:gentle", "--reward", "./mine.py:calm", "--set", "model.model_ratio=0"]
    document(unjam(*command, "--steps", 160, "--out", "runs/a", "--json", pictures=False))
    (tmp_path / "elsewhere").mkdir()
    evaluated = document(unjam("evaluate", "../runs/a", "--episodes", 1, "--json", cwd=tmp_path / "elsewhere"))
    assert {"mine.py:gentle", "trained"} <= {entry["driver"] for entry in evaluated["drivers"]}


@pytest.mark.slow
def test_drive_prints_one_json_document(unjam: Run) -> None:
    command = ("drive", "ring", "--driver", "pi", "--episodes", 2, "--seed", 7, *SMALL, "--json")
    (found,) = document(unjam(*command, pictures=False))["drivers"]
    assert (found["scenario"], found["driver"]) == ("ring", "pi")
    assert [row["seed"] for row in found["episodes"]] == [7, 8]
    for row in found["episodes"]:
        assert row["status"] == "completed"
        assert row["steps"] == 80
        assert set(REQUIRED_METRICS) <= set(row)
    assert set(REQUIRED_METRICS) <= set(found["mean"])
    speeds = [row["mean_speed"] for row in found["episodes"]]
    assert found["mean"]["mean_speed"] == pytest.approx(sum(speeds) / 2)


def test_drive_prints_a_table_and_the_path_of_a_report(unjam: Run, tmp_path: Path) -> None:
    ran = unjam("drive", "ring", "-d", "human", "-d", "pi:window=10", *SMALL, "--out", "mine")
    assert ran.returncode == 0, ran.stderr
    verdict, *differences, header = ran.stdout.partition("feasible  ")[0].splitlines()[:5]
    lines = ran.stdout.splitlines()[5:]
    assert verdict.startswith("pi:window=10: ")
    labels = [line.split("  ")[1] for line in differences]
    assert labels == ["mean speed", "flow", "speed std across vehicles, steady"]
    assert header.split() == ["metric", "unit", "human", "pi:window=10"]
    assert len(lines) < 12
    assert "all metrics, with differences: --all" in ran.stderr
    assert "report: mine/report.html" in ran.stderr
    assert (tmp_path / "mine" / "report.html").is_file()


@pytest.mark.slow
def test_drive_prints_all_metrics_on_demand(unjam: Run) -> None:
    ran = unjam("drive", "ring", "-d", "human", "-d", "pi:window=10", *SMALL, "--no-report", "--all")
    assert ran.returncode == 0, ran.stderr
    lines = ran.stdout.splitlines()
    header = next(line for line in lines if line.startswith("metric "))
    assert header.split() == ["metric", "unit", "human", "pi:window=10", "pi:window=10", "−", "human"]
    assert len(lines) >= len(REQUIRED_METRICS)


@pytest.mark.slow
def test_drive_counts_up_its_folders(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "runs" / "drive-ring-001").mkdir(parents=True)
    assert unjam("drive", "ring", "--driver", "pi", "-n", 1, *SMALL, pictures=False).returncode == 0
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["drive-ring-001", "drive-ring-002"]


@pytest.mark.slow
def test_drive_does_not_depend_on_the_number_of_workers(unjam: Run) -> None:
    one, two = (
        unjam("drive", "ring", "-d", "pi", "-n", 3, *SMALL, "--no-report", "--json", "--workers", workers)
        for workers in (1, 2)
    )
    assert one.stdout == two.stdout != ""


@pytest.mark.long
def test_drive_with_the_users_own_driver_and_reward(unjam: Run, my_drivers: Path) -> None:
    command = ("drive", "ring", "-d", "mine.py:gentle", "--reward", "mine.py:calm", "-n", 1, *SMALL, "--json")
    (found,) = document(unjam(*command, pictures=False))["drivers"]
    assert found["driver"] == "mine.py:gentle"
    assert found["mean"]["return"] > 0


@pytest.mark.slow
def test_drive_on_the_merge_has_flow_and_backlog(unjam: Run, tmp_path: Path) -> None:
    found = document(unjam("drive", "merge", "-d", "human", "-d", "pi", "-n", 1, "--set", "horizon=60", "--json"))
    human, pi = (entry["episodes"][0] for entry in found["drivers"])
    assert set(REQUIRED_METRICS) <= set(pi)
    assert (human["steps"], human["collisions"], pi["collisions"]) == (60, 0.0, 0.0)
    assert human["outflow_veh_per_h"] > 0
    assert min(human["insertion_backlog_veh"], pi["insertion_backlog_veh"]) >= 0
    assert "Speeds and waves over time" in (tmp_path / found["drivers"][0]["report"]).read_text()


@pytest.mark.slow
def test_drive_without_a_driver_compares_human_drivers_and_the_default_controller(unjam: Run, tmp_path: Path) -> None:
    common = [game(tmp_path, "ramp").name, "--penetration-rate", "0.3", "-n", 1, "--no-report"]
    common += ["--set", "horizon=60"]
    ran = unjam("drive", *common, pictures=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("unjam:best: ")
    assert re.search(r"^metric +unit +human +unjam:best", ran.stdout, re.MULTILINE)
    assert "limits the ACC" not in ran.stderr, "each CAV has an ACC"
    without = unjam("drive", *common, "-d", "unjam:best", pictures=False)
    assert "note: unjam:best limits the ACC of a " in " ".join(without.stderr.split())


@pytest.mark.slow
def test_drive_on_your_own_network(unjam: Run, tmp_path: Path) -> None:
    file = game(tmp_path, "ramp").name
    common = ["-n", 1, "--set", "horizon=150", "--json"]
    share = document(unjam("drive", file, "--penetration-rate", "0.3", "--driver", "pi", *common, pictures=False))
    (driven,) = share["drivers"]
    assert (share["scenario"], driven["episodes"][0]["status"]) == (file, "completed")
    assert driven["mean"]["mean_speed"] > 5
    assert (tmp_path / driven["report"]).is_file()
    types = document(unjam("drive", file, "--cav-types", "truck,passenger", "-d", "idm", *common, "--no-report"))
    assert types["drivers"][0]["episodes"][0]["steps"] == 150


ASSESS = ["assess", "straight.sumocfg", "--penetration-rates", "0,0.5", "-d", "acc", "--set", "horizon=120"]


@pytest.mark.slow
def test_assess_prints_text_and_json_and_writes_a_page(unjam: Run, tmp_path: Path) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="20" period="2"/>', length=100.0)
    ran = unjam(*ASSESS, "-n", 36, "--out", "answer")
    assert ran.returncode == 0, ran.stderr
    headline, acc_finding, *table = ran.stdout.splitlines()
    assert headline.startswith(("Recommended: ", "Not recommended: ", "Not yet known "))
    assert acc_finding.startswith("ACC vehicles alone ")
    assert [line.split()[:2] for line in table[1:4]] == [["none", "human"], ["50", "%"], ["50", "%"]]
    (finding,) = re.findall(r"^- acc at a penetration rate of 50 %: .*(?:\n  .*)*", ran.stdout, re.MULTILINE)
    before, _, after = ran.stderr.partition("a verdict needs at least 10 test seeds: 32 episodes, about ")
    assert "simulating the human baseline, seed 1 of 1" in before
    assert "3 test seeds: CI of travel time at most ±" in after
    assert ("for a verdict (" in after) == headline.startswith("Not yet known ")
    assert "report: answer/assessment.html" in ran.stderr
    found = document(unjam(*ASSESS, "-n", 36, "--json", pictures=False))
    assert found["folder"] == "runs/assess-straight-001"
    assert found["headline"] == headline
    assert [f"- {controller_result['summary']}" for controller_result in found["controller_results"]] == [
        " ".join(finding.split())
    ]
    names = {path.name for path in (tmp_path / "answer").iterdir()}
    assert names == {
        *("assessment.html", "assessment.json", "selection", "request.json", "episodes.jsonl"),
        *("evaluation.json", "episodes.parquet", "plot_episodes.safetensors"),
    }
    assert unjam("report", "answer", pictures=False).returncode == 0, "it can read the rows"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "first_words", "kept_names"),
    [
        ((*ASSESS, "-n", "5000", "--precision", "1e-9"), ("simulating", "a verdict needs"), ["request.json"]),
        (("drive", "ring", "-d", "pi", "-n", "5000"), ("driving",), None),
    ],
)
def test_an_interrupted_command_leaves_no_folder_but_what_resumes(
    arguments: Sequence[str], first_words: tuple[str, ...], kept_names: list[str] | None, unjam: Run, tmp_path: Path
) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="20" period="2"/>', length=100.0)
    command = [str(UNJAM), *arguments, "--out", "answer"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith(first_words)
        workers = children_of(process.pid)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10)
    assert process.returncode == 130
    assert errors.splitlines()[-1] == "unjam: interrupted"
    assert "Traceback" not in errors
    names = [path.name for path in (tmp_path / "answer").iterdir()] if (tmp_path / "answer").exists() else None
    assert names == kept_names
    assert ("resume with: unjam assess " in errors) == (names is not None)
    wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers))


@pytest.mark.long
def test_a_failed_episode_does_not_stop_the_others(unjam: Run, my_drivers: Path) -> None:
    command = ("drive", "ring", "-d", "pi", "-d", "mine.py:broken", "-n", 1, *SMALL, "--json")
    ran = unjam(*command, pictures=False)
    assert ran.returncode == 2
    pi, broken = json.loads(ran.stdout)["drivers"]
    assert pi["episodes"][0]["status"] == "completed"
    assert broken["episodes"][0]["status"] == "failed"
    assert "step 0" in broken["episodes"][0]["reason"]


def test_scenarios_and_drivers_are_listed(unjam: Run) -> None:
    assert set(document(unjam("scenarios", "--json"))) >= {"ring", "ring-warm", "ring-jammed"}
    ring = document(unjam("scenarios", "ring", "--json"))
    assert ring["parameters"]["vehicles"] == 22
    assert "ring of 220-270 m" in unjam("scenarios").stdout
    drivers = document(unjam("drivers", "--json"))
    assert set(drivers) >= {"human", "idm", "pi", "follower-stopper", "constant"}
    assert all(row["description"] for driver in drivers.values() for row in driver["parameters"])
    assert document(unjam("drivers", "pi", "--json")) == {"pi": drivers["pi"]}
    described = unjam("drivers", "unjam:ring-best").stdout
    assert "pi-from-gap:window=" in described
    assert "Source: Stern et al. 2018" in unjam("drivers", "pi").stdout
    refused = unjam("drivers", "nonesuch")
    assert refused.returncode == 2
    assert "'nonesuch' is not allowed; allowed: human" in refused.stderr


@pytest.mark.parametrize("name", ["ring", "figure-eight", "merge"])
def test_a_scenario_is_drawn_with_its_vehicles(name: str, unjam: Run, tmp_path: Path) -> None:
    assert unjam("scenarios", name, "--picture", "road.png").returncode == 0
    picture = np.asarray(Image.open(tmp_path / "road.png"))
    red = (picture[..., 0] > 180) & (picture[..., 1] < 90)
    assert picture.shape == (640, 640, 3)
    assert red.sum() > 5
    if name == "ring":
        assert unjam("scenarios", name, "--picture", "road.bmp").returncode == 2


def test_doctor_finds_all_parts(unjam: Run) -> None:
    found = document(unjam("doctor", "--json"))
    assert found["ok"] is True
    assert {"netconvert", "an episode in a worker"} <= {check["name"] for check in found["checks"]}


@pytest.mark.slow
def test_train_resume_drive_and_export(unjam: Run, tmp_path: Path) -> None:
    trained = document(unjam(*TINY_RUN, "--steps", 320, "--out", "run", "--json", pictures=False))
    run = tmp_path / "run"
    assert {"human", "pi", "trained"} == set(trained["drivers"])
    progress = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["environment_steps"] for row in progress] == [160, 320]

    resumed = document(unjam("train", "--resume", "run", "--steps", 480, "--json"))
    assert resumed["folder"] == "run"
    progress = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["environment_steps"] for row in progress] == [160, 320, 480]

    assert "A trained residual on pi".lower() in (run / "report.html").read_text().lower()
    (driven,) = document(unjam("drive", "ring", "--driver", "run", *SMALL, "-n", 1, "--json", pictures=False))[
        "drivers"
    ]
    assert driven["episodes"][0]["status"] == "completed"

    exported = document(unjam("export", "run", "--out", "ring.unjam", "--json"))
    assert exported == {
        **{"file": "ring.unjam", "onnx": None, "stable_baselines3": None},
        **{"driver": "pi + residual, filtered", "control_steps": 80},
    }
    verified = document(unjam("verify", "ring.unjam", "--json"))
    status = {part["part"]: part["status"] for part in verified["parts"]}
    assert verified["ok"] is True
    assert (status["sample"], status["graph"], status["origin"]) == ("checked", "absent", "stated")
    assert "checked sample: 80 control steps" in unjam("verify", "ring.unjam").stdout
    (tmp_path / "ring.onnx").write_text("of another controller")
    ran = unjam("export", "run", "--out", "ring.unjam")
    assert "ring.unjam: " in ran.stdout
    assert "note: ring.onnx is not the graph of this controller" in ran.stderr
    drive = ("drive", "ring", "--driver", "ring.unjam", *SMALL, "-n", 1, "--json")
    (repeated,) = document(unjam(*drive, pictures=False))["drivers"]
    assert repeated["mean"] == driven["mean"]


@pytest.mark.slow
def test_a_trained_run_is_reported_evaluated_and_an_expert(unjam: Run, tmp_path: Path) -> None:
    document(unjam(*TINY_RUN, "--steps", 320, "--out", "run", "--json"))
    facts = document(unjam("model", "run", "--json"))
    assert (facts["iteration"], facts["report"]) == (2, "run/report.html")
    table = unjam("model", "run").stdout
    assert "leader speed" in table
    assert "bound C" in table
    assert "Learned model" in (tmp_path / "run" / "report.html").read_text()

    on_top = document(unjam(*TINY_RUN, "--steps", 160, "--expert", "run/controller.unjam", "--out", "second", "--json"))
    assert "pi + residual" in on_top["drivers"]
    both = document(unjam("report", "run", "second", "--out", "both.html", "--json"))
    assert (tmp_path / both["report"]).is_file()
    assert document(unjam("report", "run", "--json"))["report"] == "run/report.html"

    evaluated = document(unjam("evaluate", "run", "--episodes", 3, "--json"))
    assert {"idm", "constant", "trained"} <= {entry["driver"] for entry in evaluated["drivers"]}
    assert all(len(entry["episodes"]) == 3 for entry in evaluated["drivers"])
    assert [entry["driver"] for entry in evaluated["drivers"]][:1] == ["human"], "in the order of all tables"
    assert [entry["driver"] for entry in evaluated["drivers"]][-1:] == ["trained"]

    complete = (tmp_path / "run" / "evaluation.json").read_bytes()
    part = document(unjam("evaluate", "run", "-d", "idm", "-d", "human", "--episodes", 1, "--json"))
    assert [entry["driver"] for entry in part["drivers"]] == ["human", "idm", "pi", "trained"]
    assert "partial: compared with idm, human and the expert alone" in part["notes"]
    assert part["folder"] == "runs/evaluate-run-001"
    assert (tmp_path / "runs" / "evaluate-run-001" / "report.html").is_file()
    assert (tmp_path / "run" / "evaluation.json").read_bytes() == complete, "a part never replaces it"


@pytest.mark.slow
def test_train_without_an_expert(unjam: Run) -> None:
    found = document(unjam(*TINY_RUN, "--steps", 160, "--expert", "none", "--out", "alone", "--json"))
    assert found["gain"] is None


@pytest.mark.slow
def test_watch_writes_a_video_of_an_open_road(unjam: Run, tmp_path: Path) -> None:
    command = ("watch", "merge", "--set", "horizon=20", "--driver", "pi", "--video", "video.gif")
    ran = unjam(*command, environment={"DISPLAY": ""})
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "video.gif").read_bytes()[:4] == b"GIF8"


@pytest.mark.slow
def test_bench_prints_ratios(unjam: Run) -> None:
    found = document(unjam("bench", "--rounds", 1, "--json"))
    ratios = {part["name"]: part["ratio"] for part in found["parts"]}
    assert 0.0 < ratios["ring: run_episode"] < 1.0
    assert 0.0 < ratios["driving loop over TraCI"] < 1.0


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command: str, unjam: Run) -> None:
    ran = unjam(command, "--help")
    assert ran.returncode == 0
    assert f"unjam {command}" in ran.stdout
    assert "Example" in ran.stdout
    assert "--json" in ran.stdout


@pytest.mark.long
def test_shell_completion_knows_the_commands(unjam: Run) -> None:
    ran = unjam(
        environment={
            "_UNJAM_COMPLETE": "complete_bash",
            "COMP_WORDS": "unjam dri",
            "COMP_CWORD": "1",
            "_TYPER_COMPLETE_ARGS": "unjam dri",
        }
    )
    assert set(ran.stdout.split()) == {"drive", "drivers"}


def test_version(unjam: Run) -> None:
    import unjam as package

    assert unjam("--version").stdout.strip() == f"unjam {package.__version__}"


@pytest.mark.slow
@pytest.mark.parametrize(("sign", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
@pytest.mark.parametrize("road", ["ring", "figure-eight", "merge", "user-network"])
def test_a_stopped_run_leaves_no_process_and_can_be_resumed(
    sign: signal.Signals, code: int, road: str, unjam: Run, tmp_path: Path
) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>', length=300.0)
    tiny = [part for setting in SETTINGS for part in ("--set", setting)]
    command = [str(UNJAM), "train", *TINY[road], *tiny, "--workers", "1"]
    command += ["--steps", "1000000", "--out", "run"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        progress = tmp_path / "run" / "progress.jsonl"
        wait_until(lambda: progress.exists() and progress.read_text().count("\n") >= 2)
        workers = children_of(process.pid)
        assert workers
        process.send_signal(sign)
        _, errors = process.communicate(timeout=10)
    assert process.returncode == code
    assert "Traceback" not in errors
    assert "resume with: unjam train --resume run --workers 1\n" in errors
    wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers))
    last = json.loads(progress.read_text().splitlines()[-1])["environment_steps"]
    assert unjam("train", "--resume", "run", "--steps", last + 1).returncode == 0


@pytest.mark.slow
def test_a_stopped_search_says_how_it_is_continued(unjam: Run, tmp_path: Path) -> None:
    tiny = [part for setting in (*SETTINGS, "scenario_options.horizon=100") for part in ("--set", setting)]
    command = [str(UNJAM), "search", "ring", *tiny, "--vary", "trpo.target_kl=0.01,0.02", "--trials", "1"]
    progress = tmp_path / "runs/search-ring-001/trials/0000/progress.jsonl"
    with subprocess.Popen([*command, "--steps", "1000000"], cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        wait_until(progress.exists)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10)
    assert process.returncode == 130
    (plan,) = (line for line in errors.splitlines() if line.startswith("searching trpo.target_kl in 1 training, "))
    assert "into runs/search-ring-001; each: trpo on pi: ring, 1,000,000 environment steps" in plan
    (resume,) = (line for line in errors.splitlines() if line.startswith("resume with: unjam search "))
    words = shlex.split(resume.removeprefix("resume with: unjam "))
    assert words[-2:] == ["--out", "runs/search-ring-001"]
    before = progress.read_text().count("\n")
    with subprocess.Popen([str(UNJAM), *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        wait_until(lambda: progress.read_text().count("\n") > before)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=10)


def children_of(pid: int) -> list[int]:
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def wait_until(condition: Any, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timeout"
        time.sleep(0.05)


@pytest.mark.long
def test_a_closed_pipe_is_no_error(tmp_path: Path) -> None:
    command = [str(UNJAM), "scenarios", "ring"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert b"Traceback" not in process.stderr.read()


@pytest.mark.slow
def test_calibrated_human_drivers_in_drive_train_and_evaluate(unjam: Run, tmp_path: Path) -> None:
    write_table(tmp_path / "data.parquet", [{}, {}])
    found = document(unjam("fit-drivers", "data.parquet", "--set", "calibration.generations=2", "--json"))
    assert (found["drivers"], found["population"]) == (2, "drivers.json")
    humans = ["--humans", "drivers.json"]
    driven = [
        document(unjam("drive", "ring", "-d", "human", "-n", 1, *SMALL, *each, "--json"))["drivers"][0]
        for each in ([], humans)
    ]
    assert driven[0]["mean"]["mean_speed"] != driven[1]["mean"]["mean_speed"]
    ran = unjam(*TINY_RUN, "--steps", 160, "--out", "run", *humans, "--set", "model.base=population", "--json")
    assert document(ran)["controller"] == "run/controller.unjam"
    before = (tmp_path / "run" / "evaluation.json").read_bytes()
    document(unjam("evaluate", "run", "-n", 1, *humans, "--json"))
    assert (tmp_path / "runs" / "evaluate-run-001" / "evaluation.json").is_file()
    assert (tmp_path / "run" / "evaluation.json").read_bytes() == before
    evaluated = document(unjam("evaluate", "run", "-n", 1, *humans, "--out", "among", "--json"))
    assert "trained" in {entry["driver"] for entry in evaluated["drivers"]}
    assert (tmp_path / "among" / "report.html").is_file()


@pytest.mark.long
def test_packaged_controllers_are_certified_and_stay_as_they_are(unjam: Run, tmp_path: Path) -> None:
    file = packaged_file("ring-tuned")
    before = file.read_bytes()
    done = unjam("certify", "unjam:ring-tuned")
    assert "0 contacts" in done.stdout
    assert done.stdout.startswith("not string stable, in a vehicle with 0.2 s delay and 0.3 s lag: amplifies ")
    assert done.stdout.count(" m/s: gain ") == 3
    assert "not string stable" in (tmp_path / "ring-tuned.html").read_text()
    assert file.read_bytes() == before
    assert not file.with_suffix(".html").exists()


@pytest.mark.long
def test_controllers_are_certified_and_exported_for_another_car(unjam: Run, tmp_path: Path) -> None:
    car = ("--set", "actuator.delay=0.4", "--set", "actuator.lag=0.5")
    done = unjam("certify", "unjam:ring-tuned", *car)
    assert ", in a vehicle with 0.4 s delay and 0.5 s lag" in done.stdout.splitlines()[0]
    assert unjam("export", "unjam:ring-best", *car, "--out", "car.unjam").returncode == 0
    driver = load_controller(tmp_path / "car.unjam")
    assert isinstance(driver, FilteredDriver)
    assert driver.actuator == Actuator(0.4, 0.5)
    assert not isinstance(driver.driver, FilteredDriver)
    for wrong in (("certify", "car.unjam", *car), ("export", "pi", "--set", "actuator.delay=-1", "--out", "x.unjam")):
        refused = unjam(*wrong)
        assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
        assert "allowed" in refused.stderr
