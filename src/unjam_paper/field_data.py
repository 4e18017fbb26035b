"""Car-following models on field data: errors one step ahead, and in a simulation behind the recorded leader.

The user supplies the data as plain tables (`unjam.following.loaders`): the reconstructed NGSIM I-80 data as
leader-follower pairs with a published split, and the AstaZero platoons of OpenACC. AstaZero has no published split;
here one day or platoon is for training and another for testing.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.following.calibration import CALIBRATED_PARAMETERS, CalibrationSettings, calibrate_groups, calibrate_idm
from unjam.following.leader_replay import (
    AccelerationBounds,
    DriverModel,
    add_residual,
    as_driver_model,
    idm_function,
    individual_idm,
    one_step_error,
    simulate_followers,
)
from unjam.following.loaders import ReadOptions, read_trajectories
from unjam.following.networks import (
    CalibratedTrajectories,
    MultiStepSettings,
    NetworkSettings,
    batched_network,
    fit_multi_step,
    fit_one_step,
)
from unjam.following.trajectories import (
    FollowingTrajectory,
    Segments,
    following_samples,
    make_segments,
    select_splits,
    split_by_driver,
)
from unjam.physics.idm import PAPER_IDM, stack_idm_parameters
from unjam.reports.figures import LINE_COLORS, PLOT_STYLE, TEXT_COLOR, new_figure
from unjam_paper.results_file import measure_parts, write_figure, write_part
from unjam_paper.study import Table, study_manifest

ACCELERATION_LIMITS: AccelerationBounds = (-4.0, 2.0)
TRAINING_SEED_COUNTS, ROW_STRIDES = {"ngsim": 3, "astazero": 1}, {"ngsim": 1, "astazero": 5}
"""number of trainings of each network, and stride of its training samples, because neighboring samples hardly differ"""
MAX_SEGMENT_SECONDS = 120.0
"""maximum duration of a simulated segment [s]"""
ONE_STEP_SETTINGS = NetworkSettings(learning_rate=1e-3, epochs=40, patience=8)
MULTI_STEP_SETTINGS = MultiStepSettings()
BOOTSTRAP_DRAWS = 2000
PAPER_IDM_MODELS = {"paper's IDM": None, "paper's IDM, clipped": ACCELERATION_LIMITS}
KNOWLEDGE_MODELS = {"knowledge, paper's IDM": None, "knowledge, paper's IDM clipped": ACCELERATION_LIMITS}
"""limits of the acceleration of the paper's IDM, alone and as the base of a network [m/s2]; None: no limits"""
FIELD_CALIBRATION = CalibrationSettings(limits=ACCELERATION_LIMITS, segment_seconds=MAX_SEGMENT_SECONDS)
WEIGHTED_MODEL = "IDM, initial headway weighted"
CALIBRATED_MODELS = {
    "IDM, samples weighted equally": replace(FIELD_CALIBRATION, weighting="sample"),
    "IDM": FIELD_CALIBRATION,
    WEIGHTED_MODEL: replace(FIELD_CALIBRATION, initial_headway_weight=(0.0, 1.0)),
}
ONE_STEP_MODELS = ("vanilla", *KNOWLEDGE_MODELS, "knowledge, IDM")
MULTI_STEP_SUFFIX = " + multi-step"
MULTI_STEP_MODELS = (f"IDM{MULTI_STEP_SUFFIX}", f"{WEIGHTED_MODEL}{MULTI_STEP_SUFFIX}")
PERSONAL_MODELS = {
    "IDM, personal time headway": ("time_headway",),
    "IDM, all parameters personal": CALIBRATED_PARAMETERS,
}
"""parameters that are calibrated to the first half of a driver's test trajectory; the second half is the test"""
PUBLISHED_GAP_ERROR = 3.64
"""gap error of a calibrated IDM on the published test pairs of NGSIM [m]"""
MODEL_LABELS = {
    "paper's IDM": "paper's IDM",
    "IDM": "IDM, calibrated",
    WEIGHTED_MODEL: "IDM, calibrated, initial headway weighted",
    "vanilla": "network alone",
    "knowledge, paper's IDM": "paper's IDM + residual",
    "knowledge, paper's IDM clipped": "paper's IDM, clipped + residual",
    "knowledge, IDM": "calibrated IDM + residual",
    MULTI_STEP_MODELS[0]: "calibrated IDM + multi-step residual",
    MULTI_STEP_MODELS[1]: "initial headway weighted + multi-step residual",
}
"""models of the figure, from top to bottom"""
TEST_SET_LABELS = {"test": "the 20 published test pairs", "other drivers": "218 other drivers"}
ERROR_AXIS_LIMITS = {"gap": (2.0, 12.0), "one_step": (0.4, 1.9)}
"""limits of the axes of the figure [m, m/s2]; larger errors are written as numbers at its edge"""


@dataclass(frozen=True)
class FieldData:
    """A data set, split into training and test trajectories."""

    training: list[FollowingTrajectory]
    test: dict[str, list[FollowingTrajectory]]
    """test sets by name; the main one is `test`"""
    max_segment: float | None = MAX_SEGMENT_SECONDS
    """maximum duration of a simulated segment [s]: an AstaZero drive lasts twenty minutes; None: no limit"""


@dataclass(frozen=True)
class FieldFit:
    """One model on one data set."""

    data_set: str
    """a name in `FIELD_DATA_LOADERS`"""
    file: str
    """path of the data"""
    model: str
    """name of the model"""
    seed: int = 0

    @property
    def name(self) -> str:
        """Name of the file with the result."""
        plain = self.model.replace(", ", "-").replace(" + ", "-").replace(" ", "-").replace("'", "")
        return f"{self.data_set}-{plain}-{self.seed}"


def _load_ngsim(path: Path) -> FieldData:
    trajectories = read_trajectories(path, "table", ReadOptions(driver_columns=("period", "follower"))).trajectories
    tests = {"test": select_splits(trajectories, "paper_test"), "other drivers": select_splits(trajectories, "extra")}
    return FieldData(select_splits(trajectories, "paper_train"), tests, max_segment=None)


def _load_astazero(path: Path, split: tuple[str, tuple[str, ...], tuple[str, ...]]) -> FieldData:
    kind, *runs = split
    reading = ReadOptions(driver_columns=("run", "follower"), kind_columns=("acc", "setting"))
    trajectories = [each for each in read_trajectories(path, "table", reading).trajectories if each.kind == kind]
    training, test = ([each for each in trajectories if each.driver.startswith(names)] for names in runs)
    return FieldData(training, {"test": test})


ASTAZERO_SPLITS = {
    "human": ("False-none", ("040719_platoon10-",), ("040719_platoon3-",)),
    "human-reversed": ("False-none", ("040719_platoon3-",), ("040719_platoon10-",)),
    "acc": (
        *("True-min", tuple(f"040719_platoon{number}-" for number in range(5, 10))),
        ("050719_platoon1-", "050719_platoon2-"),
    ),
}
"""kind of driver, training runs and test runs: platoons of ten and of three vehicles, or the platoons of two days"""
FIELD_DATA_LOADERS: dict[str, Callable[[Path], FieldData]] = {
    "ngsim": _load_ngsim,
    **{f"astazero-{name}": partial(_load_astazero, split=split) for name, split in ASTAZERO_SPLITS.items()},
}


@cache
def load_field_data(name: str, file: str) -> FieldData:
    """Return a data set, read once per process."""
    return FIELD_DATA_LOADERS[name](Path(file))


def field_fits(files: dict[str, str]) -> list[FieldFit]:
    """Return the fits of all models to all data sets; `files` has the paths of `ngsim` and `astazero`."""
    fits = []
    for data in FIELD_DATA_LOADERS:
        source = data.partition("-")[0]
        multi_step = MULTI_STEP_MODELS if data == "ngsim" else MULTI_STEP_MODELS[1:]
        models = [(model, 0) for model in (*PAPER_IDM_MODELS, *CALIBRATED_MODELS, *PERSONAL_MODELS)]
        for trained in (ONE_STEP_MODELS, multi_step):
            models += [(model, seed) for seed, model in product(range(TRAINING_SEED_COUNTS[source]), trained)]
        fits += [FieldFit(data, files[source], model, seed) for model, seed in models]
    return fits


def evaluate_fit(fit: FieldFit) -> dict[str, Any]:
    """Fit a model, and return its errors on each test set by trajectory."""
    data = load_field_data(fit.data_set, fit.file)
    own = fit.model in PERSONAL_MODELS
    model, facts = _fit_personal_idm(data, PERSONAL_MODELS[fit.model]) if own else _fit_model(fit, data)
    tests = {**({} if own else data.test), "second halves": split_halves(data.test["test"])[1]}
    found = {
        name: trajectory_errors(model, make_segments(trajectories, data.max_segment))
        for name, trajectories in tests.items()
    }
    return {"data_set": fit.data_set, "model": fit.model, "seed": fit.seed, **facts, "tests": found}


def split_halves(
    trajectories: Sequence[FollowingTrajectory],
) -> tuple[list[FollowingTrajectory], list[FollowingTrajectory]]:
    """Return the first and the second halves of trajectories."""
    first = [each.part(0, len(each.speed) // 2) for each in trajectories]
    return first, [each.part(len(each.speed) // 2, len(each.speed)) for each in trajectories]


def trajectory_errors(model: DriverModel, segments: Segments) -> dict[str, list[float]]:
    """Return the number of samples, the mean squared errors and the share of collisions of each trajectory."""
    simulated = simulate_followers(model, segments)
    owned = [segments.trajectory_index == owner for owner in np.unique(segments.trajectory_index)]

    def by_owner(values: np.ndarray) -> list[float]:
        return [float(np.average(values[own], weights=simulated.sample_counts[own])) for own in owned]

    return {
        "samples": [float(simulated.sample_counts[own].sum()) for own in owned],
        "gap_square": by_owner(simulated.gap_mse),
        "speed_square": by_owner(simulated.speed_mse),
        "one_step_square": by_owner(one_step_error(model, segments)),
        "collision_share": [float(simulated.has_collided[own].mean()) for own in owned],
    }


def _fit_model(fit: FieldFit, data: FieldData) -> tuple[DriverModel, dict[str, Any]]:
    """Return a model fitted to the training data, and facts about the fit."""
    if fit.model in PAPER_IDM_MODELS:
        return as_driver_model(idm_function(PAPER_IDM, PAPER_IDM_MODELS[fit.model])), {}
    if fit.model in CALIBRATED_MODELS:
        found = calibrate_idm(data.training, CALIBRATED_MODELS[fit.model])
        return found.model(ACCELERATION_LIMITS), {"calibrated": asdict(found)}
    chosen = split_by_driver(data.training, (0.8, 0.2, 0.0), seed=0)
    learn, validation = select_splits(chosen, "train"), select_splits(chosen, "validation")
    if fit.model in MULTI_STEP_MODELS:
        # The base must not be calibrated to the validation trajectories, which decide whether a residual is used.
        found = calibrate_idm(learn, CALIBRATED_MODELS[fit.model.removesuffix(MULTI_STEP_SUFFIX)])
        learning, checking = (
            CalibratedTrajectories(trajectories, [found.parameters] * len(trajectories), found.initial_headway_weight)
            for trajectories in (learn, validation)
        )
        fitted = fit_multi_step(learning, checking, ACCELERATION_LIMITS, MULTI_STEP_SETTINGS, fit.seed)
        best = int(np.argmin(fitted.validation_errors)) * MULTI_STEP_SETTINGS.validation_interval
        facts = {"validation": fitted.validation_errors, "best_step": best}
        residual = batched_network(fitted.network.to_numpy_network())
        return add_residual(found.model(ACCELERATION_LIMITS), residual, ACCELERATION_LIMITS), facts
    base = idm_function(PAPER_IDM, KNOWLEDGE_MODELS[fit.model]) if fit.model in KNOWLEDGE_MODELS else None
    if fit.model == "knowledge, IDM":
        base = idm_function(calibrate_idm(learn).parameters, ACCELERATION_LIMITS)
    stride = ROW_STRIDES[fit.data_set.partition("-")[0]]
    samples = (following_samples(trajectories) for trajectories in (learn, validation))
    rows, checking = (each.select(np.arange(0, len(each), stride)) for each in samples)
    network, losses = fit_one_step(rows, checking, base, ONE_STEP_SETTINGS, fit.seed)
    model = add_residual(as_driver_model(base) if base else None, batched_network(network.to_numpy_network()))
    return model, {"epochs": len(losses.training)}


def _fit_personal_idm(data: FieldData, personal_parameters: Sequence[str]) -> tuple[DriverModel, dict[str, Any]]:
    """Return IDMs with some parameters calibrated to the first half of each test trajectory, and their parameters."""
    first, second = split_halves(data.test["test"])
    typical = calibrate_idm(data.training, CALIBRATED_MODELS["IDM"]).parameters
    found = calibrate_groups([[each] for each in first], typical, personal_parameters, CALIBRATED_MODELS["IDM"])
    rows = [found[number].parameters for number in make_segments(second, data.max_segment).trajectory_index]
    model = individual_idm(stack_idm_parameters(rows), 0.0, ACCELERATION_LIMITS)
    return model, {"calibrated": [asdict(one) for one in found]}


def run_field_study(folder: Path, ngsim: Path, astazero: Path, workers: int = 2) -> None:
    """Measure the fits that are missing in `folder/parts`, and write `field.json` and `field.png`."""
    about = study_manifest(folder)
    fits = field_fits({"ngsim": str(ngsim), "astazero": str(astazero)})
    rows = field_rows(measure_parts(folder / "parts", {fit.name: (evaluate_fit, (fit,)) for fit in fits}, workers))
    about["command"] = [about["command"][0], "FOLDER", ngsim.name, astazero.name]
    write_part(folder, "field", {"manifest": about, "rows": rows})
    write_figure(folder, "field", field_figure(rows))


def field_rows(results: Table) -> Table:
    """Return a row for each model, test set and seed, with confidence intervals from a bootstrap over trajectories."""
    return [
        {**{key: value for key, value in part.items() if key != "tests"}, "test": test, **_bootstrap_errors(found)}
        for part in results
        for test, found in part["tests"].items()
    ]


def _bootstrap_errors(square_errors: dict[str, list[float]]) -> dict[str, Any]:
    values = {name: np.array(each) for name, each in square_errors.items()}
    weights = values["samples"]
    draws = np.random.default_rng(0).integers(len(weights), size=(BOOTSTRAP_DRAWS, len(weights)))
    errors: dict[str, Any] = {"trajectories": len(weights), "collision_share": float(values["collision_share"].mean())}
    for name in ("gap", "speed", "one_step"):
        squares = values[f"{name}_square"] * weights
        drawn = np.sqrt(squares[draws].sum(1) / weights[draws].sum(1))
        errors[name] = float(np.sqrt(squares.sum() / weights.sum()))
        errors[f"{name}_interval"] = np.quantile(drawn, [0.025, 0.975]).tolist()
    each = np.sqrt(values["gap_square"])
    return {**errors, "gap_of_trajectories": float(each.mean()), "gap_each": [round(one, 3) for one in each.tolist()]}


@rc_context(PLOT_STYLE)
def field_figure(rows: Table) -> Figure:
    """Draw the errors on NGSIM: of the simulated gap, and of the acceleration one step ahead."""
    figure = new_figure(4.2, width=11)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    styles = zip(TEST_SET_LABELS.items(), (LINE_COLORS[2], LINE_COLORS[0]), (0.14, -0.14), strict=True)
    for (test, label), color, shift in styles:
        tested = [row for row in rows if row["data_set"] == "ngsim" and row["test"] == test]
        for axes, name in ((left, "gap"), (right, "one_step")):
            _draw_seed_errors(axes, tested, name, color, shift, label)
    left.axvline(PUBLISHED_GAP_ERROR, color=TEXT_COLOR, lw=0.9, ls=":")
    left.annotate("published", (PUBLISHED_GAP_ERROR + 0.1, len(MODEL_LABELS) - 0.45), fontsize=8, color=TEXT_COLOR)
    left.set_yticks(range(len(MODEL_LABELS)), list(MODEL_LABELS.values())[::-1])
    left.set(
        xlim=ERROR_AXIS_LIMITS["gap"], ylim=(-0.6, len(MODEL_LABELS) - 0.2), xlabel="error of the simulated gap [m]"
    )
    right.set(xlim=ERROR_AXIS_LIMITS["one_step"], xlabel="error of the acceleration, one step [m/s²]")
    left.plot([], [], "o", ms=4.5, color=TEXT_COLOR, mfc="white", label="some collide")
    left.legend(loc="lower right")
    return figure


def _draw_seed_errors(axes: Axes, rows: Table, name: str, color: str, offset: float, label: str | None) -> None:
    """Draw each seed as a dot with its CI; the dot is open if some trajectories end in a collision."""
    limit = ERROR_AXIS_LIMITS[name][1]
    for place, model in enumerate(reversed(MODEL_LABELS)):
        found = [row for row in rows if row["model"] == model]
        for seed, row in enumerate(found):
            height = place + offset + 0.08 * (seed - (len(found) - 1) / 2)
            axes.plot(row[f"{name}_interval"], [height, height], color=color, lw=1.2, alpha=0.6)
            face = "white" if row["collision_share"] else color
            axes.plot(row[name], height, marker="o", ms=4.5, color=color, mfc=face, label=label)
            label = None  # once is enough for the legend
        outside = [row[name] for row in found if row[name] > limit]
        if outside:
            mean = f"{sum(outside) / len(outside):.1f} →"
            axes.annotate(mean, (limit, place + offset), ha="right", va="bottom", fontsize=8, color=color)
