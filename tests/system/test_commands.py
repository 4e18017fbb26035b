"""Every verb, called as a user calls it, on the actual simulator."""

import json
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
from tests.paper.test_field import table
from tests.system.conftest import UNJAM, Run
from tests.worlds.sumo.user_networks import game, straight

SMALL = ["--length", "60", "--vehicles", "5", "--set", "horizon=80"]
TINY_RUN = [
    *["train", "ring", "--length", "60", "--vehicles", "5", "--set", "scenario_options.horizon=80", "--workers", "1"],
    *["--set", "trpo.steps_per_iteration=160", "--set", "evaluation.episodes=2"],
    *["--set", 'evaluation.baselines=["human"]'],
    *["--set", "evaluation.validation_episodes=1", "--set", "evaluation.validation_interval=2"],
]

METRICS_OF_THE_DESIGN = [
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

VERBS = [
    "runs",
    "scenarios",
    "drivers",
    "drive",
    "assess",
    "calibrate",
    "train",
    "evaluate",
    "model",
    "fit-drivers",
    "report",
]
VERBS += ["report", "reproduce", "search", "export", "keys", "sign", "verify", "watch", "bench", "doctor"]


def document(ran: subprocess.CompletedProcess[str]) -> Any:
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


@pytest.mark.long
def test_train_learns_on_several_roads_and_prints_a_table_for_each(unjam: Run, tmp_path: Path) -> None:
    mixture = tmp_path / "mixture.toml"
    mixture.write_text('[[tasks]]\nroad = {length = [70, 70]}\n[[tasks]]\nname = "short"\n')
    command = [*TINY_RUN, "--config", mixture, "--steps", 160, "--out", tmp_path / "run"]
    ran = unjam(*command, pictures=False)
    assert ran.returncode == 0, ran.stderr
    assert [line for line in ran.stdout.splitlines() if line in ("ring:", "short:")] == ["ring:", "short:"]
    assert ran.stdout.count("Beside people alone") == ran.stdout.count("Return beyond its expert") == 2
    assert {"ring", "short", "report.html"} <= {path.name for path in (tmp_path / "run").iterdir()}


def test_drive_prints_one_json_document(unjam: Run) -> None:
    command = ("drive", "ring", "--driver", "pi", "--episodes", 2, "--seed", 7, *SMALL, "--json")
    found = document(unjam(*command, pictures=False))
    assert (found["scenario"], found["driver"]) == ("ring", "pi")
    assert [row["seed"] for row in found["episodes"]] == [7, 8]
    for row in found["episodes"]:
        assert row["status"] == "completed"
        assert row["steps"] == 80
        assert set(METRICS_OF_THE_DESIGN) <= set(row)
    assert set(METRICS_OF_THE_DESIGN) <= set(found["mean"])
    speeds = [row["mean_speed"] for row in found["episodes"]]
    assert found["mean"]["mean_speed"] == pytest.approx(sum(speeds) / 2)


def test_drive_prints_a_table_and_the_path_of_a_report(unjam: Run, tmp_path: Path) -> None:
    ran = unjam("drive", "ring", "-d", "human", "-d", "pi:window=10", *SMALL, "--out", "mine")
    assert ran.returncode == 0, ran.stderr
    header, *lines = ran.stdout.splitlines()
    assert header.split() == ["metric", "unit", "human", "pi:window=10", "pi:window=10", "−", "human"]
    assert len(lines) >= len(METRICS_OF_THE_DESIGN)
    assert "report: mine/report.html" in ran.stderr
    assert (tmp_path / "mine" / "report.html").is_file()


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


def test_drive_with_the_users_own_driver_and_reward(unjam: Run, my_drivers: Path) -> None:
    command = ("drive", "ring", "-d", "mine.py:gentle", "--reward", "mine.py:calm", "-n", 1, *SMALL, "--json")
    found = document(unjam(*command, pictures=False))
    assert found["driver"] == "mine.py:gentle"
    assert found["mean"]["return"] > 0


@pytest.mark.slow
def test_drive_on_the_merge_tells_of_flow_and_backlog(unjam: Run, tmp_path: Path) -> None:
    found = document(unjam("drive", "merge", "-d", "human", "-d", "pi", "-n", 1, "--set", "horizon=60", "--json"))
    human, pi = (entry["episodes"][0] for entry in found["drivers"])
    assert set(METRICS_OF_THE_DESIGN) <= set(pi)
    assert (human["steps"], human["collisions"], pi["collisions"]) == (60, 0.0, 0.0)
    assert human["outflow_veh_per_h"] > 0
    assert min(human["insertion_backlog_veh"], pi["insertion_backlog_veh"]) >= 0
    assert "Speed, waves and queues over time" in (tmp_path / found["drivers"][0]["report"]).read_text()


@pytest.mark.long
def test_drive_without_a_name_compares_people_and_the_best_controller(unjam: Run, tmp_path: Path) -> None:
    common = [game(tmp_path, "ramp").name, "--cav-share", "0.3", "-n", 1, "--no-report"]
    common += ["--set", "horizon=60"]
    ran = unjam("drive", *common, pictures=False)
    assert ran.returncode == 0, ran.stderr
    assert "unjam:best beside people alone" in ran.stdout
    assert "holds back" not in ran.stderr, "each CAV has an ACC"
    without = unjam("drive", *common, "-d", "unjam:best", pictures=False)
    assert "note: unjam:best holds back a car's own ACC" in " ".join(without.stderr.split())


@pytest.mark.long
def test_drive_on_your_own_network(unjam: Run, tmp_path: Path) -> None:
    file = game(tmp_path, "ramp").name
    common = ["-n", 1, "--set", "horizon=150", "--json"]
    share = document(unjam("drive", file, "--cav-share", "0.3", "--driver", "pi", *common, pictures=False))
    assert (share["scenario"], share["episodes"][0]["status"]) == (file, "completed")
    assert share["mean"]["mean_speed"] > 5
    assert (tmp_path / share["report"]).is_file()
    types = document(unjam("drive", file, "--cav-types", "truck,passenger", "-d", "idm", *common, "--no-report"))
    assert types["episodes"][0]["steps"] == 150


QUESTION = ["assess", "straight.sumocfg", "--shares", "0,0.5", "-d", "acc", "--set", "horizon=120"]


@pytest.mark.long
def test_assess_answers_in_words_in_json_and_on_a_page(unjam: Run, tmp_path: Path) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="20" period="2"/>', length=100.0)
    ran = unjam(*QUESTION, "-n", 36, "--out", "said")
    assert ran.returncode == 0, ran.stderr
    answer, *shares = ran.stdout.splitlines()
    assert "recommended on this road" in answer
    starts = ("- acc at a penetration rate of 50 %: ", "- ACC vehicles alone at a penetration rate of 50 %: ")
    assert [line.startswith(start) for line, start in zip(shares, starts, strict=True)] == [True, True]
    assert "an episode of the human baseline took " in ran.stderr
    assert "test seeds: 10; travel time known to ±" in ran.stderr
    assert "report: said/assessment.html" in ran.stderr
    found = document(unjam(*QUESTION, "-n", 36, "--json", pictures=False))
    assert found["folder"] == "runs/assess-straight-001"
    assert found["headline"] == answer
    assert [f"- {each['words']}" for each in (*found["judged"], *found["acc"])] == shares
    kept = {path.name for path in (tmp_path / "said").iterdir()}
    assert kept == {
        *("assessment.html", "assessment.json", "choosing"),
        *("evaluation.json", "episodes.parquet", "shown.safetensors"),
    }
    assert unjam("report", "said", pictures=False).returncode == 0, "the rows are those of drive"


@pytest.mark.long
@pytest.mark.parametrize(
    ("question", "first_words"),
    [
        pytest.param(
            (*QUESTION, "-n", "5000", "--precision", "1e-9"), ("assessing", "an episode"), marks=pytest.mark.slow
        ),
        (("drive", "ring", "-d", "pi", "-n", "5000"), ("driving",)),
    ],
)
def test_what_is_interrupted_says_so_and_leaves_nothing(
    question: Sequence[str], first_words: tuple[str, ...], unjam: Run, tmp_path: Path
) -> None:
    straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="20" period="2"/>', length=100.0)
    command = [str(UNJAM), *question, "--out", "said"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith(first_words)
        workers = children_of(process.pid)
        process.send_signal(signal.SIGINT)
        _, words = process.communicate(timeout=10)
    assert process.returncode == 130
    assert words.splitlines()[-1] == "unjam: interrupted"
    assert "Traceback" not in words
    assert not (tmp_path / "said").exists()
    wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers))


def test_an_episode_that_fails_keeps_the_others(unjam: Run, my_drivers: Path) -> None:
    command = ("drive", "ring", "-d", "pi", "-d", "mine.py:broken", "-n", 1, *SMALL, "--json")
    ran = unjam(*command, pictures=False)
    assert ran.returncode == 2
    pi, broken = json.loads(ran.stdout)["drivers"]
    assert pi["episodes"][0]["status"] == "completed"
    assert broken["episodes"][0]["status"] == "failed"
    assert "step 0" in broken["episodes"][0]["reason"]


def test_scenarios_and_drivers_list_what_there_is(unjam: Run) -> None:
    assert set(document(unjam("scenarios", "--json"))) >= {"ring", "ring-warm", "ring-jammed"}
    ring = document(unjam("scenarios", "ring", "--json"))
    assert ring["parameters"]["vehicles"] == 22
    assert "ring of 220-270 m" in unjam("scenarios").stdout
    drivers = document(unjam("drivers", "--json"))
    assert set(drivers) >= {"human", "idm", "pi", "follower-stopper", "constant"}
    assert all(row["about"] for driver in drivers.values() for row in driver["parameters"])


@pytest.mark.parametrize("name", ["ring", "figure-eight", "merge"])
def test_a_scenario_is_drawn_with_its_vehicles(name: str, unjam: Run, tmp_path: Path) -> None:
    assert unjam("scenarios", name, "--picture", "road.png").returncode == 0
    picture = np.asarray(Image.open(tmp_path / "road.png"))
    red = (picture[..., 0] > 180) & (picture[..., 1] < 90)
    assert picture.shape == (640, 640, 3)
    assert red.sum() > 5
    if name == "ring":
        assert unjam("scenarios", name, "--picture", "road.bmp").returncode == 2


def test_doctor_finds_everything_here(unjam: Run) -> None:
    found = document(unjam("doctor", "--json"))
    assert found["ok"] is True
    assert {"netconvert", "an episode in a worker"} <= {check["name"] for check in found["checks"]}


@pytest.mark.long
def test_train_go_on_drive_and_export(unjam: Run, tmp_path: Path) -> None:
    trained = document(unjam(*TINY_RUN, "--steps", 320, "--out", "run", "--json", pictures=False))
    run = tmp_path / "run"
    assert {"human", "pi", "trained"} == set(trained["drivers"])
    progress = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["environment_steps"] for row in progress] == [160, 320]

    went_on = document(unjam("train", "--resume", "run", "--steps", 480, "--json"))
    assert went_on["folder"] == "run"
    progress = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["environment_steps"] for row in progress] == [160, 320, 480]

    assert "A trained residual on pi".lower() in (run / "report.html").read_text().lower()
    driven = document(unjam("drive", "ring", "--driver", "run", *SMALL, "-n", 1, "--json", pictures=False))
    assert driven["episodes"][0]["status"] == "completed"

    shipped = document(unjam("export", "run", "--to", "ring.unjam", "--json"))
    assert shipped == {"file": "ring.unjam", "onnx": None, "driver": "pi + residual, filtered", "decisions": 80}
    said = document(unjam("verify", "ring.unjam", "--json"))
    status = {each["part"]: each["status"] for each in said["parts"]}
    assert said["ok"] is True
    assert (status["sample"], status["graph"], status["origin"]) == ("checked", "absent", "stated")
    assert "checked sample: 80 decisions" in unjam("verify", "ring.unjam").stdout
    (tmp_path / "ring.onnx").write_text("of another controller")
    written = unjam("export", "run", "--to", "ring.unjam")
    assert "ring.unjam: " in written.stdout
    assert "ring.onnx was there before: it is not the graph of this controller" in written.stderr
    drive = ("drive", "ring", "--driver", "ring.unjam", *SMALL, "-n", 1, "--json")
    again = document(unjam(*drive, pictures=False))
    assert again["mean"] == driven["mean"]


@pytest.mark.slow
def test_a_trained_run_is_explained_compared_judged_anew_and_an_expert(unjam: Run, tmp_path: Path) -> None:
    document(unjam(*TINY_RUN, "--steps", 320, "--out", "run", "--json"))
    facts = document(unjam("model", "run", "--json"))
    assert (facts["iteration"], facts["report"]) == (2, "run/report.html")
    table = unjam("model", "run").stdout
    assert "leader's speed" in table
    assert "bound C" in table
    assert "The virtual environment" in (tmp_path / "run" / "report.html").read_text()

    on_top = document(unjam(*TINY_RUN, "--steps", 160, "--expert", "run/controller.unjam", "--out", "second", "--json"))
    assert "pi + residual" in on_top["drivers"]
    both = document(unjam("report", "run", "second", "--out", "both.html", "--json"))
    assert (tmp_path / both["report"]).is_file()
    assert document(unjam("report", "run", "--json"))["report"] == "run/report.html"

    judged = document(unjam("evaluate", "run", "--episodes", 3, "--json"))
    assert {"idm", "constant", "trained"} <= {entry["driver"] for entry in judged["drivers"]}
    assert all(len(entry["episodes"]) == 3 for entry in judged["drivers"])


@pytest.mark.slow
def test_train_without_an_expert(unjam: Run) -> None:
    found = document(unjam(*TINY_RUN, "--steps", 160, "--expert", "none", "--out", "alone", "--json"))
    assert found["gain"] is None


@pytest.mark.slow
def test_watch_writes_a_film_of_a_road_with_ends(unjam: Run, tmp_path: Path) -> None:
    command = ("watch", "merge", "--set", "horizon=20", "--driver", "pi", "--video", "film.gif")
    ran = unjam(*command, environment={"DISPLAY": ""})
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "film.gif").read_bytes()[:4] == b"GIF8"


@pytest.mark.slow
def test_bench_prints_ratios(unjam: Run) -> None:
    found = document(unjam("bench", "--rounds", 1, "--json"))
    assert 0.0 < found["over_bare"] < 1.0
    assert found["over_traci"] > 1.0
    assert [entry["vehicles"] for entry in found["scaling"]] == [22, 220, 2200]


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself_with_an_example(verb: str, unjam: Run) -> None:
    ran = unjam(verb, "--help")
    assert ran.returncode == 0
    assert f"unjam {verb}" in ran.stdout
    assert "Example" in ran.stdout
    assert "--json" in ran.stdout


def test_shell_completion_knows_the_verbs(unjam: Run) -> None:
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
@pytest.mark.parametrize("road", ["ring", "figure-eight", "merge", "own-network"])
def test_a_stopped_run_leaves_no_process_and_can_go_on(
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
        _, words = process.communicate(timeout=10)
    assert process.returncode == code
    assert "Traceback" not in words
    assert "go on with: unjam train --resume run --workers 1\n" in words
    wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers))
    last = json.loads(progress.read_text().splitlines()[-1])["environment_steps"]
    assert unjam("train", "--resume", "run", "--steps", last + 1).returncode == 0


def children_of(pid: int) -> list[int]:
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def wait_until(condition: Any, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def test_a_reader_who_leaves_early_is_no_error(tmp_path: Path) -> None:
    command = [str(UNJAM), "scenarios", "ring"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert b"Traceback" not in process.stderr.read()


@pytest.mark.slow
def test_calibrated_people_drive_on_a_road_and_judge_a_run_there(unjam: Run, tmp_path: Path) -> None:
    table(tmp_path / "data.parquet", [{}, {}])
    found = document(unjam("fit-drivers", "data.parquet", "--set", "calibration.generations=2", "--json"))
    assert (found["drivers"], found["population"]) == (2, "drivers.json")
    among = ["--humans", "drivers.json"]
    people = [document(unjam("drive", "ring", "-d", "human", "-n", 1, *SMALL, *each, "--json")) for each in ([], among)]
    assert people[0]["mean"]["mean_speed"] != people[1]["mean"]["mean_speed"]
    ran = unjam(*TINY_RUN, "--steps", 160, "--out", "run", *among, "--set", "model.base=population", "--json")
    assert document(ran)["controller"] == "run/controller.unjam"
    refused = unjam("evaluate", "run", *among)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    judged = document(unjam("evaluate", "run", "-n", 1, *among, "--out", "among", "--json"))
    assert "trained" in {entry["driver"] for entry in judged["drivers"]}
    assert (tmp_path / "among" / "report.html").is_file()
