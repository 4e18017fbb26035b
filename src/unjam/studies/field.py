"""Models of drivers on field data: one step ahead, and driving on behind a recorded leader.

The data are the user's files: the reconstructed NGSIM I-80 as leader-follower pairs with a published split,
and OpenACC's AstaZero platoons, as plain tables (`unjam.following.loaders`). AstaZero has no published split;
here one day (or platoon) is for learning, another for judging.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.files import to_json, write_whole
from unjam.following.calibration import SEARCHED, CalibrationSettings, calibrate, calibrate_each
from unjam.following.loaders import Reading, read_pairs
from unjam.following.networks import (
    Known,
    MultiStepSettings,
    NetworkSettings,
    fit_multi_step,
    fit_one_step,
    on_rows,
)
from unjam.following.open_loop import (
    Bounds,
    Model,
    always,
    idm_follow,
    one_step_error,
    open_loop,
    personal_idm,
    with_residual,
)
from unjam.following.pairs import Pair, Stretches, moments_of, of_split, split_by_trajectory, stretches_of
from unjam.physics.idm import PAPER_IDM, parameter_rows
from unjam.reports.figures import INK, LINES, STYLE, new_figure, png_bytes
from unjam.studies.parts import OnProgress, Part, measure_parts
from unjam.studies.study import Table, about_study

LIMITS: Bounds = (-4.0, 2.0)
SEEDS = {"ngsim": 3, "astazero": 1}
STRETCH = 120.0
"""longest stretch that is driven on in [s]"""
ROWS_APART = {"ngsim": 1, "astazero": 5}
"""every so many-th row is learned from, one step ahead: neighbours hardly differ"""
ONE_STEP = NetworkSettings(rate=1e-3, epochs=40, patience=8)
MULTI_STEP = MultiStepSettings()
DRAWS = 2000
"""of the bootstrap over trajectories"""
GIVEN: dict[str, Bounds | None] = {"paper's IDM": None, "paper's IDM, clipped": LIMITS}
KNOWN: dict[str, Bounds | None] = {"knowledge, paper's IDM": None, "knowledge, paper's IDM clipped": LIMITS}
"""the paper's IDM within these limits, alone and below a network"""
CALIBRATION = CalibrationSettings(limits=LIMITS, seconds=STRETCH)
CALIBRATED = {
    "IDM, every moment": replace(CALIBRATION, every="moment"),
    "IDM": CALIBRATION,
    "IDM, headway kept": replace(CALIBRATION, kept_headway=(0.0, 1.0)),
}
NETWORKS = ("vanilla", *KNOWN, "knowledge, IDM")
MULTI_STEPS = ("IDM + multi-step", "IDM, headway kept + multi-step")
OWN = {"IDM, own headway": ("time_headway",), "IDM, all own": SEARCHED}
"""what is each driver's own, calibrated on the first half of each test trajectory: judged on the second
halves alone"""
PUBLISHED = 3.64
"""error of the gap of a calibrated IDM on the published test pairs of NGSIM [m]"""
NAMES = {
    "paper's IDM": "paper's IDM",
    "IDM": "IDM, calibrated",
    "IDM, headway kept": "IDM, calibrated, headway kept",
    "vanilla": "network alone",
    "knowledge, paper's IDM": "paper's IDM + residual",
    "knowledge, paper's IDM clipped": "paper's IDM, clipped + residual",
    "knowledge, IDM": "calibrated IDM + residual",
    "IDM + multi-step": "calibrated IDM + multi-step residual",
    "IDM, headway kept + multi-step": "headway kept + multi-step residual",
}
"""of the models that are shown, from below to above"""
TESTS = {"test": "the 20 published test pairs", "others": "218 other drivers"}
SHOWN = {"gap": (2.0, 12.0), "one_step": (0.4, 1.9)}
"""errors beyond this leave the picture, and are written at its edge [m, m/s2]"""


@dataclass(frozen=True)
class Data:
    """A data set, split into who is learned from and who judges."""

    learn: list[Pair]
    test: dict[str, list[Pair]]
    """by name; the main one is `test`"""
    longest: float | None = STRETCH
    """longest stretch of open loop [s]: an AstaZero drive lasts twenty minutes; None: all of it"""


@dataclass(frozen=True)
class Task:
    """One model on one data set."""

    data: str
    """in DATA"""
    file: str
    model: str
    seed: int = 0

    @property
    def name(self) -> str:
        """A name for its file."""
        plain = self.model.replace(", ", "-").replace(" + ", "-").replace(" ", "-").replace("'", "")
        return f"{self.data}-{plain}-{self.seed}"


def _ngsim(path: Path) -> Data:
    pairs = read_pairs(path, "table", Reading(driver=("period", "follower"))).pairs
    tests = {"test": of_split(pairs, "paper_test"), "others": of_split(pairs, "extra")}
    return Data(of_split(pairs, "paper_train"), tests, longest=None)


def _astazero(path: Path, kind: str, learn: tuple[str, ...], test: tuple[str, ...]) -> Data:
    reading = Reading(driver=("run", "follower"), kind=("acc", "setting"))
    pairs = [pair for pair in read_pairs(path, "table", reading).pairs if pair.kind == kind]
    learned, judged = ([pair for pair in pairs if pair.driver.startswith(runs)] for runs in (learn, test))
    return Data(learned, {"test": judged})


TEN, THREE = ("040719_platoon10-",), ("040719_platoon3-",)
FIRST_DAY = tuple(f"040719_platoon{number}-" for number in range(5, 10))
SECOND_DAY = ("050719_platoon1-", "050719_platoon2-")
DATA: dict[str, Callable[[Path], Data]] = {
    "ngsim": _ngsim,
    "astazero-human": partial(_astazero, kind="False-none", learn=TEN, test=THREE),
    "astazero-human-reversed": partial(_astazero, kind="False-none", learn=THREE, test=TEN),
    "astazero-acc": partial(_astazero, kind="True-min", learn=FIRST_DAY, test=SECOND_DAY),
}


@cache
def data_of(name: str, file: str) -> Data:
    """Return a data set, read once in a process."""
    return DATA[name](Path(file))


def tasks(files: dict[str, str]) -> list[Task]:
    """Return all models on all data; `files` are those of `ngsim` and `astazero`."""
    found = []
    for data in DATA:
        source = data.partition("-")[0]
        file, seeds = files[source], range(SEEDS[source])
        found += [Task(data, file, model) for model in (*GIVEN, *CALIBRATED, *OWN)]
        found += [Task(data, file, model, seed) for seed in seeds for model in NETWORKS]
        multi_steps = MULTI_STEPS if data == "ngsim" else MULTI_STEPS[1:]
        found += [Task(data, file, model, seed) for seed in seeds for model in multi_steps]
    return found


def measure(task: Task) -> dict[str, Any]:
    """Return what a model is worth on each test set, trajectory by trajectory."""
    data = data_of(task.data, task.file)
    own = task.model in OWN
    model, facts = _each(data, OWN[task.model]) if own else _made(task, data)
    tests = {**({} if own else data.test), "second halves": halves(data.test["test"])[1]}
    found = {name: judge(model, stretches_of(pairs, data.longest)) for name, pairs in tests.items()}
    return {"data": task.data, "model": task.model, "seed": task.seed, **facts, "tests": found}


def halves(pairs: Sequence[Pair]) -> tuple[list[Pair], list[Pair]]:
    """Return the first and the second halves of trajectories."""
    first = [pair.part(0, len(pair.speed) // 2) for pair in pairs]
    return first, [pair.part(len(pair.speed) // 2, len(pair.speed)) for pair in pairs]


def judge(model: Model, stretches: Stretches) -> dict[str, list[float]]:
    """Return the errors of each trajectory: what intervals are made of."""
    drove = open_loop(model, stretches)
    owned = [stretches.owner == owner for owner in np.unique(stretches.owner)]

    def by_owner(values: np.ndarray) -> list[float]:
        return [float(np.average(values[own], weights=drove.moments[own])) for own in owned]

    return {
        "moments": [float(drove.moments[own].sum()) for own in owned],
        "gap_square": by_owner(drove.gap_square),
        "speed_square": by_owner(drove.speed_square),
        "one_step_square": by_owner(one_step_error(model, stretches)),
        "collided": [float(drove.collided[own].mean()) for own in owned],
    }


def _made(task: Task, data: Data) -> tuple[Model, dict[str, Any]]:
    """Return a model that was made from the data for learning, and how."""
    if task.model in GIVEN:
        return always(idm_follow(PAPER_IDM, GIVEN[task.model])), {}
    if task.model in CALIBRATED:
        found = calibrate(data.learn, CALIBRATED[task.model])
        return found.model(LIMITS), {"calibrated": asdict(found)}
    chosen = split_by_trajectory(data.learn, (0.8, 0.2, 0.0), seed=0)
    learn, validation = of_split(chosen, "train"), of_split(chosen, "validation")
    if task.model in MULTI_STEPS:
        # The base must not have seen who decides whether a residual is better than none.
        found = calibrate(learn, CALIBRATED[task.model.removesuffix(" + multi-step")])
        people, kept = found.parameters, found.kept_headway
        known, judges = (Known(pairs, [people] * len(pairs), kept) for pairs in (learn, validation))
        fitted = fit_multi_step(known, judges, LIMITS, MULTI_STEP, task.seed)
        best = int(np.argmin(fitted.validation)) * MULTI_STEP.validate_every
        facts = {"validation": fitted.validation, "best_step": best}
        return with_residual(found.model(LIMITS), on_rows(fitted.network.as_driver()), LIMITS), facts
    base = idm_follow(PAPER_IDM, KNOWN[task.model]) if task.model in KNOWN else None
    if task.model == "knowledge, IDM":
        base = idm_follow(calibrate(learn).parameters, LIMITS)
    apart = ROWS_APART[task.data.partition("-")[0]]
    rows, judges = (moments_of(pairs) for pairs in (learn, validation))
    rows, judges = (each.some(np.arange(0, len(each), apart)) for each in (rows, judges))
    network, losses = fit_one_step(rows, judges, base, ONE_STEP, task.seed)
    model = with_residual(always(base) if base else None, on_rows(network.as_driver()))
    return model, {"epochs": len(losses.training)}


def _each(data: Data, own: Sequence[str]) -> tuple[Model, dict[str, Any]]:
    """Return IDMs of which some parameters are calibrated on the first half of each test trajectory."""
    first, second = halves(data.test["test"])
    typical = calibrate(data.learn, CALIBRATED["IDM"]).parameters
    found = calibrate_each([[pair] for pair in first], typical, own, CALIBRATED["IDM"])
    rows = [found[number].parameters for number in stretches_of(second, data.longest).owner]
    return personal_idm(parameter_rows(rows), 0.0, LIMITS), {"calibrated": [asdict(one) for one in found]}


def run(
    folder: Path, ngsim: Path, astazero: Path, workers: int = 2, on_progress: OnProgress = lambda name: None
) -> None:
    """Measure what is missing, and write `field.json` and `field.png` into `folder`.

    The study goes on where it was stopped: what is measured lies in `folder/parts`.
    """
    about = about_study(folder)
    wanted = tasks({"ngsim": str(ngsim), "astazero": str(astazero)})
    parts: dict[str, Part] = {task.name: (measure, (task,)) for task in wanted}
    rows = summary(measure_parts(folder / "parts", parts, workers, on_progress))
    about["command"] = [about["command"][0], "FOLDER", ngsim.name, astazero.name]
    write_whole(folder / "field.json", to_json({"manifest": about, "rows": rows}, indent=1))
    write_whole(folder / "field.png", png_bytes(picture(rows), small=False))


def summary(parts: Table) -> Table:
    """Return a row for each model, test set and seed; intervals are from a bootstrap over trajectories."""
    rows = []
    for part in parts:
        facts = {key: value for key, value in part.items() if key != "tests"}
        rows += [{**facts, "test": test, **_estimates(found)} for test, found in part["tests"].items()]
    return rows


def _estimates(found: dict[str, list[float]]) -> dict[str, Any]:
    values = {name: np.array(each) for name, each in found.items()}
    weights = values["moments"]
    draws = np.random.default_rng(0).integers(len(weights), size=(DRAWS, len(weights)))
    each = np.sqrt(values["gap_square"])
    errors: dict[str, Any] = {"trajectories": len(weights), "collided": float(values["collided"].mean())}
    for name in ("gap", "speed", "one_step"):
        squares = values[f"{name}_square"] * weights
        drawn = np.sqrt(squares[draws].sum(1) / weights[draws].sum(1))
        errors[name] = float(np.sqrt(squares.sum() / weights.sum()))
        errors[f"{name}_interval"] = np.quantile(drawn, [0.025, 0.975]).tolist()
    errors["gap_of_trajectories"] = float(each.mean())
    errors["gap_each"] = [round(one, 3) for one in each.tolist()]
    return errors


@rc_context(STYLE)
def picture(rows: Table) -> Figure:
    """Return, for NGSIM, the errors of the simulated gap, and beside them those of one step."""
    figure = new_figure(4.2, width=11)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    styles = zip(TESTS.items(), (LINES[2], LINES[0]), (0.14, -0.14), strict=True)
    for (test, label), colour, shift in styles:
        judged = [row for row in rows if row["data"] == "ngsim" and row["test"] == test]
        for axes, name in ((left, "gap"), (right, "one_step")):
            _dots(axes, judged, name, colour, shift, label)
    left.axvline(PUBLISHED, color=INK, lw=0.9, ls=":")
    left.annotate("published", (PUBLISHED + 0.1, len(NAMES) - 0.45), fontsize=8, color=INK)
    left.set_yticks(range(len(NAMES)), list(NAMES.values())[::-1])
    left.set(xlim=SHOWN["gap"], ylim=(-0.6, len(NAMES) - 0.2), xlabel="error of the gap, driving on [m]")
    right.set(xlim=SHOWN["one_step"], xlabel="error of the acceleration, one step [m/s²]")
    left.plot([], [], "o", ms=4.5, color=INK, mfc="white", label="some collide")
    left.legend(loc="lower right")
    return figure


def _dots(axes: Axes, rows: Table, name: str, colour: str, shift: float, label: str | None) -> None:
    """Draw each seed as a dot with its interval; who collides has an open one."""
    most = SHOWN[name][1]
    for place, model in enumerate(reversed(NAMES)):
        found = [row for row in rows if row["model"] == model]
        for seed, row in enumerate(found):
            height = place + shift + 0.08 * (seed - (len(found) - 1) / 2)
            axes.plot(row[f"{name}_interval"], [height, height], color=colour, lw=1.2, alpha=0.6)
            face = "white" if row["collided"] else colour
            axes.plot(row[name], height, marker="o", ms=4.5, color=colour, mfc=face, label=label)
            label = None  # once is enough for the legend
        beyond = [row[name] for row in found if row[name] > most]
        if beyond:
            words = f"{sum(beyond) / len(beyond):.1f} →"
            axes.annotate(words, (most, place + shift), ha="right", va="bottom", fontsize=8, color=colour)
