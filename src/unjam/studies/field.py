"""Models of drivers on field data: one step ahead, and driving on behind a recorded leader.

The data are the user's files: the reconstructed NGSIM I-80 as leader-follower pairs with a published split,
and OpenACC's AstaZero platoons, as plain tables (`unjam.following.loaders`). AstaZero has no published split;
here one day (or platoon) is for learning, another for judging.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

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
    Follow,
    Limits,
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
from unjam.studies.parts import Part, Told, about_study, measure_parts, read_part

LIMITS: Limits = (-4.0, 2.0)
SEEDS = {"ngsim": 3, "astazero": 1}
STRETCH = 120.0
"""longest stretch of open loop [s]: an AstaZero drive lasts twenty minutes"""
ROWS_APART = {"ngsim": 1, "astazero": 5}
"""every so many-th row is learned from, one step ahead: neighbours hardly differ"""
ONE_STEP = NetworkSettings(rate=1e-3, epochs=40, patience=8)
MULTI_STEP = MultiStepSettings()
DRAWS = 2000
"""of the bootstrap over trajectories"""

IDMS = ("paper's IDM", "paper's IDM, clipped", "IDM, every moment", "IDM", "IDM, headway kept")
NETWORKS = ("vanilla", "knowledge, paper's IDM", "knowledge, paper's IDM clipped", "knowledge, IDM")
MULTI_STEPS = ("IDM + multi-step", "IDM, headway kept + multi-step")
OWN = {"IDM, own headway": ("time_headway",), "IDM, all own": SEARCHED}
"""what is each driver's own, calibrated on the first half of each test trajectory: judged on the second
halves alone"""


@dataclass(frozen=True)
class Data:
    """A data set, split into who is learned from and who judges."""

    learn: list[Pair]
    test: dict[str, list[Pair]]
    """by name; the first is the main one"""
    whole: bool = False
    """whether trajectories are judged whole, or in stretches"""


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
    others = of_split(pairs, "extra")
    return Data(
        of_split(pairs, "paper_train"), {"test": of_split(pairs, "paper_test"), "others": others}, True
    )


def _astazero(kind: str, learn: Sequence[str], test: Sequence[str]) -> Callable[[Path], Data]:
    def read(path: Path) -> Data:
        reading = Reading(driver=("run", "follower"), kind=("acc", "setting"))
        pairs = [pair for pair in read_pairs(path, "table", reading).pairs if pair.kind == kind]
        chosen = [
            [pair for pair in pairs if pair.driver.startswith(tuple(f"{run}-" for run in runs))]
            for runs in (learn, test)
        ]
        return Data(chosen[0], {"test": chosen[1]})

    return read


DATA: dict[str, Callable[[Path], Data]] = {
    "ngsim": _ngsim,
    "astazero-human": _astazero("False-none", ["040719_platoon10"], ["040719_platoon3"]),
    "astazero-human-reversed": _astazero("False-none", ["040719_platoon3"], ["040719_platoon10"]),
    "astazero-acc": _astazero(
        "True-min",
        [f"040719_platoon{number}" for number in range(5, 10)],
        ["050719_platoon1", "050719_platoon2"],
    ),
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
        found += [Task(data, file, model) for model in (*IDMS, *OWN)]
        found += [Task(data, file, model, seed) for seed in seeds for model in NETWORKS]
        multi_steps = MULTI_STEPS if data == "ngsim" else MULTI_STEPS[1:]
        found += [Task(data, file, model, seed) for seed in seeds for model in multi_steps]
    return found


def measure(task: Task) -> dict[str, Any]:
    """Return what a model is worth on each test set, trajectory by trajectory."""
    data = data_of(task.data, task.file)
    if task.model in OWN:
        model, facts = _each(data, OWN[task.model])
        judged = {"second halves": model}
    else:
        made, facts = _made(task, data)
        judged = dict.fromkeys([*data.test, "second halves"], made)
    tests = {**data.test, "second halves": halves(next(iter(data.test.values())))[1]}
    longest = None if data.whole else STRETCH
    found = {name: judge(model, stretches_of(tests[name], longest)) for name, model in judged.items()}
    return {"data": task.data, "model": task.model, "seed": task.seed, **facts, "tests": found}


def halves(pairs: Sequence[Pair]) -> tuple[list[Pair], list[Pair]]:
    """Return the first and the second halves of trajectories."""
    middles = [len(pair.speed) // 2 for pair in pairs]
    first = [pair.part(0, middle) for pair, middle in zip(pairs, middles, strict=True)]
    second = [pair.part(middle, len(pair.speed)) for pair, middle in zip(pairs, middles, strict=True)]
    return first, second


def judge(model: Model, stretches: Stretches) -> dict[str, list[float]]:
    """Return the errors of each trajectory: what intervals are made of."""
    drove, single = open_loop(model, stretches), one_step_error(model, stretches)
    owners = np.unique(stretches.owner)

    def by_owner(values: np.ndarray) -> list[float]:
        weights = drove.moments
        return [
            float(np.average(values[stretches.owner == owner], weights=weights[stretches.owner == owner]))
            for owner in owners
        ]

    return {
        "moments": [float(drove.moments[stretches.owner == owner].sum()) for owner in owners],
        "gap_square": by_owner(drove.gap_square),
        "speed_square": by_owner(drove.speed_square),
        "one_step_square": by_owner(single),
        "collided": [float(drove.collided[stretches.owner == owner].mean()) for owner in owners],
    }


def _made(task: Task, data: Data) -> tuple[Model, dict[str, Any]]:
    """Return a model that was made from the data for learning, and how."""
    if task.model == "paper's IDM":
        return always(idm_follow(PAPER_IDM)), {}
    if task.model == "paper's IDM, clipped":
        return always(idm_follow(PAPER_IDM, LIMITS)), {}
    if task.model in IDMS:
        found = calibrate(data.learn, _calibration(task.model))
        return found.model(LIMITS), {"calibrated": asdict(found)}
    chosen = split_by_trajectory(data.learn, (0.8, 0.2, 0.0), seed=0)
    learn, validation = of_split(chosen, "train"), of_split(chosen, "validation")
    if task.model in MULTI_STEPS:
        # The base must not have seen who decides whether a residual is better than none.
        found = calibrate(learn, _calibration(task.model.removesuffix(" + multi-step")))
        known, judges = (
            Known(pairs, [found.parameters] * len(pairs), found.kept_headway) for pairs in (learn, validation)
        )
        fitted = fit_multi_step(known, judges, LIMITS, MULTI_STEP, task.seed)
        best = int(np.argmin(fitted.validation)) * MULTI_STEP.validate_every
        facts = {"validation": fitted.validation, "best_step": best}
        return with_residual(found.model(LIMITS), on_rows(fitted.network.as_driver()), LIMITS), facts
    base = _base(task.model, learn)
    rows, judges = moments_of(learn), moments_of(validation)
    apart = ROWS_APART[task.data.partition("-")[0]]
    rows, judges = (each.some(np.arange(0, len(each), apart)) for each in (rows, judges))
    network, losses = fit_one_step(rows, judges, base, ONE_STEP, task.seed)
    model = with_residual(always(base) if base else None, on_rows(network.as_driver()))
    return model, {"epochs": len(losses.training)}


def _base(model: str, learn: Sequence[Pair]) -> Follow | None:
    if model == "knowledge, IDM":
        return idm_follow(calibrate(learn).parameters, LIMITS)
    limits = {"knowledge, paper's IDM": None, "knowledge, paper's IDM clipped": LIMITS}
    return idm_follow(PAPER_IDM, limits[model]) if model in limits else None


def _calibration(model: str) -> CalibrationSettings:
    settings = CalibrationSettings(limits=LIMITS, seconds=STRETCH)
    if model == "IDM, every moment":
        return replace(settings, every="moment")
    return replace(settings, kept_headway=(0.0, 1.0)) if "headway kept" in model else settings


def _each(data: Data, own: Sequence[str]) -> tuple[Model, dict[str, Any]]:
    """Return IDMs of which some parameters are calibrated on the first half of each test trajectory."""
    settings = _calibration("IDM")
    first, second = halves(next(iter(data.test.values())))
    typical = calibrate(data.learn, settings).parameters
    found = calibrate_each([[pair] for pair in first], typical, own, settings)
    longest = None if data.whole else STRETCH
    owner = stretches_of(second, longest).owner
    model = personal_idm(parameter_rows([found[number].parameters for number in owner]), 0.0, LIMITS)
    return model, {"calibrated": [asdict(one) for one in found]}


def run(folder: Path, ngsim: Path, astazero: Path, workers: int = 2, told: Told | None = None) -> None:
    """Measure what is missing, and write `field.json` and `field.png` into `folder`.

    The study goes on where it was stopped: what is measured lies in `folder/parts`.
    """
    about = about_study(folder)
    wanted = tasks({"ngsim": str(ngsim), "astazero": str(astazero)})
    parts: dict[str, Part] = {task.name: (measure, (task,)) for task in wanted}
    measure_parts(folder / "parts", parts, workers, told)
    rows = summary([read_part(folder / "parts", name) for name in parts])
    about["command"] = [about["command"][0], "FOLDER", ngsim.name, astazero.name]
    write_whole(folder / "field.json", to_json({"manifest": about, "rows": rows}, indent=1))
    from unjam.studies.field_picture import picture

    picture(rows).savefig(folder / "field.png", dpi=130)


def summary(parts: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each model, test set and seed; intervals are from a bootstrap over trajectories."""
    rows = []
    for part in parts:
        facts = {key: value for key, value in part.items() if key != "tests"}
        for test, found in part["tests"].items():
            rows.append({**facts, "test": test, **_estimates(found)})
    return rows


def _estimates(found: dict[str, list[float]]) -> dict[str, Any]:
    values = {name: np.array(each) for name, each in found.items()}
    draws = np.random.default_rng(0).integers(len(values["moments"]), size=(DRAWS, len(values["moments"])))
    errors: dict[str, Any] = {
        "trajectories": len(values["moments"]),
        "collided": float(values["collided"].mean()),
    }
    for name in ("gap", "speed", "one_step"):
        squares, weights = values[f"{name}_square"] * values["moments"], values["moments"]
        drawn = np.sqrt(squares[draws].sum(1) / weights[draws].sum(1))
        errors[name] = float(np.sqrt(squares.sum() / weights.sum()))
        errors[f"{name}_interval"] = [float(value) for value in np.quantile(drawn, [0.025, 0.975])]
    errors["gap_of_trajectories"] = float(np.sqrt(values["gap_square"]).mean())
    errors["gap_each"] = [round(float(value), 3) for value in np.sqrt(values["gap_square"])]
    return errors
