"""Invalid input: one clear line, the right exit code, and no partial files."""

import os
import re
import resource
import subprocess
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from tests.controller.test_verify import HELD
from tests.system.conftest import UNJAM, Run
from unjam.controller import controller_bytes
from unjam.controller.file import WEIGHTS_PART
from unjam.drivers.registry import driver_recipe

SMALL = ["--length", "60", "--vehicles", "5", "--set", "horizon=60"]

INVALID: dict[str, tuple[str, list[str]]] = {
    "unknown command": ("fly", ["fly"]),
    "unknown option": ("--fast", ["drive ring --driver pi --fast"]),
    "no driver": ("--driver", ["watch ring"]),
    "a length without digits": ("meters, like 230 or 220-270", ["drive ring --driver pi --length ²"]),
    "a length of a thousand digits": ("meters", [f"drive ring --driver pi --length {'9' * 5000}"]),
    "a table that is a number": ("model", ["train on-ramp --set model=5"]),
    "a folder without a report": ("--no-report", ["drive ring --driver pi --no-report --out new"]),
    "nothing to vary": ("at least one key", ["search ring"]),
    "an invalid range": ("low < high", ["search ring --vary trpo.gamma=1..0"]),
    "unknown executor": ("'local', 'ray'", ["search ring --vary trpo.gamma=0.9..0.95 --executor cloud"]),
    "unknown scenario": ("ring, ring-warm, ring-jammed", ["drive nowhere --driver pi"]),
    "folder that cannot be made": ("allowed: a new folder", ["drive ring --driver pi --out /proc/unjam"]),
    "folder of a name too long": ("File name too long", [f"drive ring --driver pi --out {'a' * 300}"]),
    "unknown driver": ("human, idm, pi", ["drive ring --driver ghost"]),
    "unknown parameter of a driver": ("driver pi.ghost: unknown name", ["drive ring --driver pi:ghost=1"]),
    "text for a number": ("time_constant: 'fast'", ["drive ring --driver pi:time_constant=fast"]),
    "negative parameter": ("time_constant: -1", ["drive ring --driver pi:time_constant=-1"]),
    "controller for another control step": (
        "driver unjam:ring-tuned is not allowed on ring: its time_step is 0.1 s; allowed: 0.3 s, the control step",
        ["drive ring --driver pi --driver unjam:ring-tuned --set steps_per_control_step=3"],
    ),
    "no episodes": ("episodes", ["drive ring --driver pi --episodes 0"]),
    "text for a count": ("many", ["drive ring --driver pi --episodes many"]),
    "length that is not a number": ("length: '2x0'", ["drive ring --driver pi --length 2x0"]),
    "ring too short for its vehicles": (">= 154 m", ["drive ring --driver pi --length 30"]),
    "reversed range": ("length: 220 m", ["drive ring --driver pi --length 270-220"]),
    "one vehicle": ("vehicles: 1", ["drive ring --driver pi --vehicles 1"]),
    "more CAVs than vehicles": ("cavs: 23", ["drive ring --driver pi --cavs 23"]),
    "unknown key of a scenario": ("ghost: unknown name", ["drive ring --driver pi --set ghost=1"]),
    "text for a noise": ("noise: 'loud'", ["drive ring --driver pi --set noise=loud"]),
    "not a number": ("noise: nan", ["drive ring --driver pi --set noise=nan"]),
    "no horizon": ("horizon: 0", ["drive ring --driver pi --set horizon=0"]),
    "unknown actuation": ("actuation: 'wild'", ["drive ring --driver pi --set actuation=wild"]),
    "setting without a value": ("key=value", ["drive ring --driver pi --set horizon"]),
    "missing population": ("does not exist", ["drive ring --driver pi --humans none.json"]),
    "file that is not a population": ("not a population", ["drive ring --driver pi --humans mine.py"]),
    "missing trajectories": ("does not exist", ["fit-drivers none.csv"]),
    "trajectories selected by a word": (
        "--select: 'bad' is not allowed; allowed: key=value",
        ["fit-drivers none.csv --select bad"],
    ),
    "unknown reward": ("released, released-merge, eq16", ["drive ring --driver pi --reward gold"]),
    "reward that is not in the file": ("has no 'ghost'", ["drive ring --driver pi --reward mine.py:ghost"]),
    "reward that is NaN": (
        "reward mine.py:wrong_reward: step 0: term 'speed' is nan",
        ["drive ring --driver pi --reward mine.py:wrong_reward -n 1"],
    ),
    "driver file that is missing": ("is not a file", ["drive ring --driver none.py:gentle"]),
    "driver that is not in the file": ("has no 'ghost'", ["drive ring --driver mine.py:ghost"]),
    "driver file with an error in it": ("SyntaxError", ["drive ring --driver torn.py:gentle"]),
    "driver file that ends the program": ("SystemExit when loading it", ["drive ring --driver ends.py:gentle"]),
    "reward file that ends the program": (
        "SystemExit when loading it",
        ["drive ring --driver pi --reward ends.py:gentle"],
    ),
    "an endless episode": ("horizon: 1000000000", ["drive ring --driver pi --set horizon=1000000000"]),
    "another backend in the window": ("backend: 'batch'", ["watch ring -d pi --backend batch"]),
    "a backend that cannot tune": ("merge is not a ring", ["tune merge --backend batch"]),
    "a backend that cannot be watched": ("is not a ring", ["watch merge -d pi --backend batch --video a.gif"]),
    "two drivers in one window": ("driver: 'pi, acc'", ["watch ring -d pi -d acc --video video.gif"]),
    "report that overwrites another file": ("allowed: a file that ends in .html", ["report full --out mine.py"]),
    "certificate that overwrites another file": (
        "allowed: a file that ends in .html",
        ["certify torn.unjam --out mine.py"],
    ),
    "emissions of a user network": (
        "emission_class: it is not allowed",
        ["drive good.sumocfg --driver pi --penetration-rate 0.5 --set emission_class=zero"],
    ),
    "tuning a controller": ("expert: 'unjam:ring-best' is not", ["tune ring --expert unjam:ring-best"]),
    "driver that cannot be made": ("no battery", ["drive ring --driver mine.py:Raises"]),
    "driver that returns NaN": ("step 0: acceleration", ["drive ring --driver mine.py:broken"]),
    "driver that returns too many accelerations": ("one for each CAV", ["drive ring --driver mine.py:short"]),
    "driver that raises": ("mine.py:raises: ValueError: lost the map (line", ["drive ring --driver mine.py:raises"]),
    "controller that is missing": ("does not exist", ["drive ring --driver none.unjam"]),
    "file that is not a controller": ("not a controller", ["drive ring --driver torn.unjam"]),
    "folder that is not empty": ("full' is not empty", ["drive ring --driver pi --out full"]),
    "option without its value": ("Option '-d' requires an argument", ["drive ring -d"]),
    "flag with a value": ("--json", ["drive ring --json=5"]),
    "parameter as an option": ("parameters of scenarios: --set actuator.delay=", ["drive ring --delay 0.4"]),
    "parameter as an option of a training": ("--set scenario_options.actuator.delay=", ["train ring --delay 0.4"]),
    "missing configuration": ("none.toml: No such file", ["train ring --config none.toml"]),
    "configuration that is not TOML": ("not TOML", ["train ring --config torn.toml"]),
    "unknown key of the configuration": ("ghost: unknown name", ["train ring --set ghost=1"]),
    "discount above one": ("trpo.gamma: 1.5", ["train ring --set trpo.gamma=1.5"]),
    "unknown preset": ("preset: 'ghost'", ["train ring --preset ghost"]),
    "unknown learner": ("agent: 'ghost'", ["train ring --agent ghost"]),
    "unknown expert": ("ghost", ["train ring --expert ghost"]),
    "exponent without an equilibrium": (
        "humans.exponent: 1e-300 is not allowed; allowed: greater than or equal to 0.1",
        ["drive ring --driver human --set humans.exponent=1e-300"],
    ),
    "too many trainings": ("seeds", ["reproduce theory --seeds 1000000000000"]),
    "negative seed": ("seed", ["train ring --seed -1"]),
    "tuning a family for a reward": ("reward: not allowed with rings", ["tune rings --reward eq16"]),
    "tuning a family whose roads become too short": ("length", ["tune rings --length 60"]),
    "tuning with too few steps": ("steps: 10", ["tune rings --steps 10"]),
    "training into a folder that is not empty": ("--resume full", ["train ring --out full"]),
    "resuming a folder that is not a run": ("not a run folder", ["train --resume full"]),
    "setting of an option": (
        "--set length: it is not allowed together with the option for it",
        ["drive ring --length 230 --set length=240"],
    ),
    "setting of an option of a training": (
        "--set scenario_options.length: it is not allowed together with the option for it",
        ["train ring --length 230 --set scenario_options.length=240"],
    ),
    "resuming with a preset": ("not allowed together with it", ["train --resume full --preset demo"]),
    "evaluating a folder that is not a run": ("not a run folder", ["evaluate full"]),
    "model of a folder that is not a run": ("not a run folder", ["model full"]),
    "model of a run without one": ("has no model", ["model model-free"]),
    "report of a missing folder": ("report: 'nowhere' is not a folder", ["report nowhere"]),
    "report of an empty folder": ("has no evaluation.json", ["report full"]),
    "report of damaged results": ("damaged", ["report damaged"]),
    "penetration rate above one": ("penetration_rate: 2", ["drive merge --driver pi --set penetration_rate=2"]),
    "no CAV": (
        "no CAV was on the road in 5 control steps",
        ["drive merge --driver pi --set penetration_rate=0 --set horizon=5"],
    ),
    "penetration rate on a closed road": (
        "penetration_rate: unknown name",
        ["drive ring --driver pi --penetration-rate 0.1"],
    ),
    "configuration that is missing": ("there is no such file", ["drive none.sumocfg --driver pi"]),
    "user network without CAVs": ("penetration_rate: 0.0", ["drive good.sumocfg --driver pi --penetration-rate 0"]),
    "unused vehicle type": (
        "no vehicle has the type 'tank'; allowed: car",
        ["drive good.sumocfg --driver pi --cav-types tank"],
    ),
    "network without a version": (
        "old.net.xml: the network has no version",
        ["drive old.sumocfg --driver pi --penetration-rate 0.5"],
    ),
    "network that is torn": ("torn.net.xml: cannot be read", ["drive torn.sumocfg --driver pi --penetration-rate 0.5"]),
    "training without CAVs": (
        "penetration_rate: 0.0",
        ["train good.sumocfg --steps 10 --set scenario_options.penetration_rate=0"],
    ),
    "assessing a built-in road": ("your own .sumocfg file", ["assess ring"]),
    "assessing a missing file": ("there is no such file", ["assess none.sumocfg"]),
    "penetration rates that are text": ("penetration_rates: 'few'", ["assess good.sumocfg --penetration-rates few"]),
    "assessing a penetration rate above one": (
        "penetration_rates: 2.0",
        ["assess good.sumocfg --penetration-rates 0.1,2"],
    ),
    "too few episodes to assess": ("episodes: 10 is not allowed; allowed: >= ", ["assess good.sumocfg -n 10"]),
    "assessing in no time": ("minutes: 0.0", ["assess good.sumocfg --minutes 0"]),
    "assessing human drivers as CAVs": ("driver: 'human'", ["assess good.sumocfg -d human"]),
    "assessing into a folder that is not empty": ("full' is not empty", ["assess good.sumocfg --out full"]),
    "calibrating a built-in road": (
        "scenario: 'ring' is not allowed; allowed: your own .sumocfg file",
        ["calibrate ring --detectors counts.csv"],
    ),
    "calibrating without measurements": ("'none.csv' is not a file", ["calibrate good.sumocfg --detectors none.csv"]),
    "measurements that are text": (
        "counts.csv: line 2: flow_veh_per_h: 'many' is not allowed; allowed: a number >= 0",
        ["calibrate good.sumocfg --detectors counts.csv"],
    ),
    "detector on a missing edge": (
        "edge: 'nowhere' is not allowed; allowed: one of good.net.xml",
        ["calibrate good.sumocfg --detectors astray.csv"],
    ),
    "calibrating an unknown factor": (
        "did you mean 'tau'",
        ["calibrate good.sumocfg --detectors counts.csv --vary tua=1..2"],
    ),
    "exporting to a file of another kind": ("ends in .unjam", ["export pi --out pi.zip"]),
    "exporting Python code": ("is Python code", ["export mine.py:gentle --out mine.unjam"]),
    "verifying a missing file": ("does not exist", ["verify none.unjam"]),
    "verifying a file that is not a controller": ("not a controller", ["verify torn.unjam"]),
    "driver of a long name": ("is not a file", [f"drive ring --driver {'a' * 300}.py:x"]),
    "driver file that is a link to itself": ("loop.py' is not a file", ["drive ring --driver loop.py:x"]),
    "network that is a link to itself": ("there is no such file", ["drive loop.sumocfg --driver pi"]),
    "trajectories that are a link to themselves": ("does not exist", ["fit-drivers loop.csv"]),
    "run that began in a link to itself": ("steps: 'many'", ["train --resume loop"]),
    "deeply nested configuration": ("not TOML", ["train ring --config nested.toml"]),
    "configuration with a number too long": ("not TOML", ["train ring --config number.toml"]),
    "number too long": ("steps: '999", [f"train ring --set steps={'9' * 5000}"]),
    "expert with a NUL in its path": (r"'a\x00.py:x' is not allowed", ["train ring --config nul.toml"]),
    "population that is a device": ("population: '/dev/zero'", ["drive ring --driver pi --humans /dev/zero"]),
    "key of too many parts": ("a key of more than 100 parts", ["train ring --config deep.toml"]),
    "hexadecimal number too long": ("steps: a number of 2000 bits", ["train ring --config long.toml"]),
    "network with a NUL in its path": (r"scenario: 'a\x00.sumocfg'", ["train --config nuls.toml"]),
    "weight of a reward too large": (
        "released: time_gap: 1",
        [f"drive ring --driver pi --reward released:time_gap=1{'0' * 400}"],
    ),
    "seed too large to tune with": ("less than or equal to 4294967295", ["tune ring --seed 4294967296"]),
    "text that is not UTF-8": ("allowed: text in UTF-8", ["drive ring --driver pi --out a\udcff"]),
    "weights that are complex": ("complex64", ["verify complex.unjam"]),
    "weights that are booleans": ("bool", ["verify boolean.unjam"]),
    "video of an unknown format": (".gif, .webp, .mp4", ["watch ring --driver pi --video video.avi"]),
}


@pytest.fixture
def files(tmp_path: Path, my_drivers: Path) -> None:
    (tmp_path / "torn.py").write_text("def gentle(state:\n")
    (tmp_path / "ends.py").write_text("def gentle(state):\n    return 0.0\n\nraise SystemExit(0)\n")
    (tmp_path / "torn.unjam").write_bytes(b"PK\x03\x04 not really")
    (tmp_path / "torn.toml").write_text("scenario = ring\n")
    networks = {"good": '<net version="1.20"/>', "old": "<net/>", "torn": '<net version="1.20"><edge'}
    for name, network in networks.items():
        (tmp_path / f"{name}.net.xml").write_text(network)
        (tmp_path / f"{name}.rou.xml").write_text('<routes><vType id="car"/><trip id="a" type="car"/></routes>')
        (tmp_path / f"{name}.sumocfg").write_text(
            f'<configuration><net-file value="{name}.net.xml"/><route-files value="{name}.rou.xml"/></configuration>'
        )
    head = "edge,position,begin,end,flow_veh_per_h,speed"
    for name, row in {"counts": "a,1,0,60,many,20", "astray": "nowhere,1,0,60,900,20"}.items():
        (tmp_path / f"{name}.csv").write_text(f"{head}\n{row}\n")
    (tmp_path / "nested.toml").write_text("a = " + "[" * 100_000)
    (tmp_path / "number.toml").write_text("steps = " + "9" * 5000)
    (tmp_path / "deep.toml").write_text(f"a{'.a' * 50_000} = 1")
    (tmp_path / "long.toml").write_text(f"steps = 0x{'f' * 500}")
    (tmp_path / "nuls.toml").write_text('scenario = "a\\u0000.sumocfg"')
    (tmp_path / "nul.toml").write_text('expert = "a\\u0000.py:x"')
    for name, kind in {"complex": np.complex64, "boolean": np.bool_}.items():
        (tmp_path / f"{name}.unjam").write_bytes(with_weights_of(kind))
    for name in ("loop.py", "loop.sumocfg", "loop.csv", "self"):
        (tmp_path / name).symlink_to(name)
    (tmp_path / "loop").mkdir()
    (tmp_path / "loop" / "config.toml").write_text('steps = "many"')
    (tmp_path / "loop" / "manifest.json").write_text('{"start_folder": "../self"}')
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "precious.txt").write_text("keep me")
    (tmp_path / "model-free").mkdir()
    (tmp_path / "model-free" / "config.toml").write_text("[model]\nmodel_ratio = 0.0\n")
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "evaluation.json").write_text('{"rows": [')


@pytest.mark.parametrize("name", INVALID)
@pytest.mark.usefixtures("files")
def test_invalid_input_is_refused_in_one_line_with_exit_code_2(name: str, unjam: Run, tmp_path: Path) -> None:
    message, (line,) = INVALID[name]
    ran = unjam(*line.split())
    assert ran.returncode == 2, ran.stderr
    assert message in ran.stderr
    assert one_line(ran.stderr)
    assert ran.stdout == ""
    assert (tmp_path / "full" / "precious.txt").read_text() == "keep me"
    assert not list(tmp_path.rglob("*.part"))


def with_weights_of(kind: type) -> bytes:
    parts = {WEIGHTS_PART: save({name: array.astype(kind) for name, array in driver_recipe(HELD)[1].items()})}
    return controller_bytes(HELD, {}, parts)


@pytest.mark.long
def test_special_files_are_not_written_to(unjam: Run, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.html")
    assert unjam("drive", "ring", "--driver", "pi", *SMALL, "--out", "new", pictures=False).returncode == 0
    ran = unjam("report", "new", "--out", "pipe.html", pictures=False)
    assert ran.returncode == 74
    assert one_line(ran.stderr)
    assert (tmp_path / "pipe.html").is_fifo()


def test_names_with_brackets_and_dollars_are_printed_unchanged(unjam: Run) -> None:
    out = "x$HOME[b][bold]"
    ran = unjam("drive", "ring", "--driver", "pi", *SMALL, "--out", out, pictures=False)
    assert (ran.returncode, f"report: {out}/report.html" in ran.stderr) == (0, True), ran.stderr
    train = ["train", "ring", "--config", f"{out}.toml"]
    assert f"config file {out}.toml" in unjam(*train).stderr
    assert out in unjam("runs", "--folder", out).stderr


def test_the_densest_ring_runs(unjam: Run) -> None:
    dense = ["--vehicles", "22", "--length", "154", "--set", "horizon=5", "--no-report"]
    ran = unjam("drive", "ring", "--driver", "pi", *dense, "--json")
    assert ran.returncode == 0, ran.stderr


def test_a_closed_standard_output_is_no_error(unjam: Run, tmp_path: Path) -> None:
    script = tmp_path / "closed.sh"
    script.write_text(f"{UNJAM} scenarios >&-\n")
    ran = subprocess.run(["sh", script], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


def test_too_few_file_descriptors_are_reported_in_one_line(unjam: Run) -> None:
    def limit_descriptors() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (16, 16))

    ran = unjam("drive", "ring", "--driver", "pi", *SMALL, "--workers", "4", "-n", "4", preexec_fn=limit_descriptors)
    assert ran.returncode == 2
    assert one_line(ran.stderr), ran.stderr
    assert "Too many open files" in ran.stderr


def one_line(stderr: str) -> bool:
    """Return whether standard error is one message; on a slow machine lines of progress precede it."""
    lines = [line for line in stderr.strip().splitlines() if not re.fullmatch(r"[^:]+: [\d,]+ of [\d,]+ \w+", line)]
    return len(lines) == 1 and lines[0].startswith("unjam: ") and "Traceback" not in stderr


def test_there_are_enough_invalid_inputs() -> None:
    assert len(INVALID) >= 30


def test_missing_sumo_has_exit_code_3_and_a_remedy(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "libsumo").mkdir()
    (tmp_path / "libsumo" / "__init__.py").write_text("raise ImportError('libproj.so.25: cannot open')")
    ran = unjam("drive", "ring", "--driver", "pi", environment={"PYTHONPATH": str(tmp_path)})
    assert ran.returncode == 3
    assert one_line(ran.stderr)
    assert "libproj.so.25" in ran.stderr
    assert "pip install libsumo" in ran.stderr


def test_doctor_reports_missing_parts(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "libsumo").mkdir()
    (tmp_path / "libsumo" / "__init__.py").write_text("raise ImportError('gone')")
    ran = unjam("doctor", environment={"PYTHONPATH": str(tmp_path)})
    assert ran.returncode == 3
    assert "missing an episode in a worker: libsumo cannot be imported (gone)" in ran.stdout


@pytest.mark.long
def test_a_full_disk_has_exit_code_74(unjam: Run, tmp_path: Path) -> None:
    def little_space() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    unjam("drive", "ring", "--driver", "pi", *SMALL, "--no-report")  # so that the network exists
    ran = unjam("drive", "ring", "--driver", "pi", *SMALL, "--out", "new", preexec_fn=little_space)
    assert ran.returncode == 74, ran.stderr
    assert one_line(ran.stderr)
    assert "cannot write" in ran.stderr
    assert not list((tmp_path / "new").rglob("*.part"))


@pytest.mark.slow
def test_a_read_only_cache_has_exit_code_74(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ran = unjam("drive", "ring", "--driver", "pi", environment={"UNJAM_CACHE": str(tmp_path / "file")})
    assert ran.returncode == 74, ran.stderr
    assert one_line(ran.stderr)


@pytest.mark.slow
def test_a_full_disk_in_training_leaves_a_complete_checkpoint(unjam: Run, tmp_path: Path) -> None:
    def little_space() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (90_000, 90_000))

    train = [
        "train",
        "ring",
        *SMALL[:4],
        "--set",
        "scenario_options.horizon=60",
        "--set",
        "trpo.steps_per_iteration=120",
    ]
    train += ["--set", "evaluation.episodes=1", "--set", "evaluation.validation_episodes=1"]
    assert unjam(*train, "--steps", 240, "--out", "run").returncode == 0
    next((tmp_path / "run" / "checkpoint").glob("000001-*")).unlink()
    before = (tmp_path / "run" / "progress.jsonl").read_text()
    ran = unjam("train", "--resume", "run", "--steps", 100_000, preexec_fn=little_space)
    assert ran.returncode == 74, ran.stderr
    assert (tmp_path / "run" / "progress.jsonl").read_text().startswith(before)
    assert unjam("train", "--resume", "run", "--steps", 360).returncode == 0
