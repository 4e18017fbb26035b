"""Fig. 6 of the paper: whether a car-following model helps a network to learn car following, on synthetic data.

A network alone (`vanilla`) and a network that learns the residual of the paper's IDM (`knowledge`) are trained on
shares of a four-regime data set. Its driver is an IDM with other parameters (`other`) or the paper's IDM (`same`).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from unjam.following.four_regimes import MIN_REGIME_GAP, FourRegimesSettings, make_four_regimes
from unjam.following.leader_replay import add_residual, as_driver_model, idm_function
from unjam.following.networks import OneStepSettings, batched_network, fit_one_step
from unjam.physics.arrays import Floats, clamp_min
from unjam.physics.idm import PAPER_IDM, idm_acceleration
from unjam.recordings.trajectories import SPLITS, FollowingSamples, following_samples, select_splits, split_by_driver
from unjam.reports.figures import LINE_COLORS, PLOT_STYLE, TEXT_COLOR, new_figure
from unjam_paper.results_file import read_part, write_part
from unjam_paper.study import Study, StudyFolder, Table

SplitKind = Literal["trajectories", "rows", "released"]
"""How test rows are separated from training rows. `trajectories`: whole trajectories are drawn. `rows`: single rows are
drawn, so that the rows 0.1 s before and after a test row can be training rows. `released`: as in the authors' code,
test rows are drawn from all rows, including training rows."""
SPLIT_SHARES = (0.7, 0.1, 0.2)
TRAINING_SIZES, LEAKING_SIZES = (0.01, 0.1, 0.3, 0.5, 1.0), (0.01, 0.1)
"""shares of the training rows, in general and for the splits `rows` and `released`"""
FIT_REPEATS, FEWER_REPEATS = 5, 3
LONG_PASS_REPEATS = 30
"""how often a pass of the long fits uses each row of 1 % of the data, for as many gradient steps as with 30 %"""
MAX_VALIDATION_ROWS = 5000
DATA_SETTINGS = {"other": FourRegimesSettings(), "same": FourRegimesSettings(driver=PAPER_IDM)}
FIGURE_6_NETWORKS = ("knowledge", "vanilla")
NEAREST_ROW = "nearest row"
"""name of a predictor without a network: it returns the acceleration of the most similar training row"""
NETWORK_COLORS = {"knowledge": LINE_COLORS[2], "vanilla": LINE_COLORS[1]}
NETWORK_LABELS = {"knowledge": "IDM + residual", "vanilla": "network alone"}


@dataclass(frozen=True)
class FourRegimeFit:
    """A fit of one network to a share of the training rows."""

    driver: str
    """a name in `DATA_SETTINGS`"""
    network: str
    """a name in `FIGURE_6_NETWORKS`, or `NEAREST_ROW`"""
    size: float
    """share of the training rows"""
    repeat: int
    split: SplitKind = "trajectories"
    is_long: bool = False
    """whether a pass uses each row `LONG_PASS_REPEATS` times"""

    @property
    def name(self) -> str:
        """Name of the entry with the result."""
        words = (self.driver, self.split, self.network.replace(" ", "-"), f"{100 * self.size:g}", f"{self.repeat}")
        return "-".join((*words, "is_long") if self.is_long else words)


class DataSplit(NamedTuple):
    """The rows of a split."""

    training: FollowingSamples
    validation: FollowingSamples
    test: FollowingSamples
    overlap: float
    """share of the test rows that are also training rows"""


def four_regime_fits() -> list[FourRegimeFit]:
    """Return all fits of the study, the most important ones first."""
    trajectories, both = get_args(SplitKind)[:1], FIGURE_6_NETWORKS
    plan: list[tuple[int, Sequence[SplitKind], Sequence[float], Sequence[str], str, bool]] = [
        (FIT_REPEATS, trajectories, TRAINING_SIZES, both, "other", False),
        (FEWER_REPEATS, trajectories, TRAINING_SIZES[:1], both, "other", True),
        (FEWER_REPEATS, trajectories, TRAINING_SIZES[:2], both, "same", False),
        (FEWER_REPEATS, ("rows", "released"), LEAKING_SIZES, both, "other", False),
        (1, get_args(SplitKind), (*LEAKING_SIZES, 1.0), (NEAREST_ROW,), "other", False),
    ]
    return [
        FourRegimeFit(driver, network, size, repeat, split, is_long)
        for repeats, splits, sizes, networks, driver, is_long in plan
        for repeat, split, size, network in product(range(repeats), splits, sizes, networks)
    ]


@cache
def split_rows(driver: str, split: SplitKind) -> DataSplit:
    """Return the rows for training, validation and test, the same in each call."""
    trajectories = make_four_regimes(DATA_SETTINGS[driver])
    if split == "trajectories":
        labeled = split_by_driver(trajectories, SPLIT_SHARES, seed=0)
        return DataSplit(*(following_samples(select_splits(labeled, name)) for name in SPLITS), overlap=0.0)
    rows, generator = following_samples(trajectories), np.random.default_rng(0)
    borders = np.round(np.cumsum(SPLIT_SHARES)[:-1] * len(rows)).astype(int)
    training, validation, test = np.split(generator.permutation(len(rows)), borders)
    if split == "released":
        test = generator.permutation(len(rows))[: len(test)]
    overlap = float(np.isin(test, training).mean())
    return DataSplit(rows.select(training), rows.select(validation), rows.select(test), overlap)


def measure_fit(fit: FourRegimeFit, workers: int = 1) -> dict[str, Any]:
    """Return the root mean square errors of a fit on the test rows [m/s2], and its losses.

    `error` refers to the data, `driver_error` to the mean acceleration of the driver of the data. `noise` is the error
    of this mean acceleration.
    """
    started = perf_counter()
    rows = split_rows(fit.driver, fit.split)
    generator = np.random.default_rng([fit.repeat, round(1000 * fit.size)])
    count = max(1, round(fit.size * len(rows.training)))
    training = rows.training.select(generator.permutation(len(rows.training))[:count])
    predict = _predict_nearest if fit.network == NEAREST_ROW else _predict_learned
    predicted, details = predict(fit, training, rows)
    average, data = average_acceleration(rows.test, DATA_SETTINGS[fit.driver]), rows.test.acceleration
    differences = {"error": predicted - data, "driver_error": predicted - average, "noise": average - data}
    errors = {name: float(np.sqrt(np.square(values).mean())) for name, values in differences.items()}
    seconds = perf_counter() - started
    return {**asdict(fit), "rows": count, "overlap": rows.overlap, **errors, "seconds": seconds, **details}


def average_acceleration(rows: FollowingSamples, settings: FourRegimesSettings) -> Floats:
    """Return the mean acceleration of the driver of the data over its noise [m/s2]; vehicles do not move backwards."""
    from scipy.stats import norm

    gap = clamp_min(rows.gap, MIN_REGIME_GAP)
    idm = idm_acceleration(rows.speed, rows.leader_speed, gap, settings.driver)
    lowest = -rows.speed / settings.time_step
    if settings.acceleration_noise == 0:
        return np.maximum(idm, lowest)
    margin = (idm - lowest) / settings.acceleration_noise
    return lowest + settings.acceleration_noise * (norm.pdf(margin) + margin * norm.cdf(margin))


def _predict_learned(fit: FourRegimeFit, training: FollowingSamples, rows: DataSplit) -> tuple[Floats, dict[str, Any]]:
    """Return the accelerations of the test rows by a trained network, and its losses."""
    base = idm_function(PAPER_IDM) if fit.network == "knowledge" else None
    if fit.is_long:
        training = training.select(np.tile(np.arange(len(training)), LONG_PASS_REPEATS))
    indices = np.random.default_rng(0).permutation(len(rows.validation))[:MAX_VALIDATION_ROWS]
    network, losses = fit_one_step(training, rows.validation.select(indices), base, OneStepSettings(), fit.repeat)
    model = add_residual(as_driver_model(base) if base else None, batched_network(network.to_numpy_network()))
    predicted = model(rows.test.speed[:1], rows.test.gap[:1])(*rows.test.inputs)
    loss_curves = {"training_loss": losses.training, "validation_loss": losses.validation}
    return predicted, {"epochs": len(losses.training), **loss_curves}


def _predict_nearest(fit: FourRegimeFit, training: FollowingSamples, rows: DataSplit) -> tuple[Floats, dict[str, Any]]:
    """Return the accelerations of the training rows with the most similar inputs; there are no losses."""
    from scipy.spatial import KDTree

    training_inputs, test_inputs = (np.column_stack(samples.inputs) for samples in (training, rows.test))
    scale = training_inputs.std(0)
    _, nearest = KDTree(training_inputs / scale).query(test_inputs / scale)
    return training.acceleration[np.asarray(nearest, np.int64)], {}


def _write_figure_6(study_folder: StudyFolder, seeds: int, folder: Path) -> None:
    rows = list(read_part(folder, "figure-6").values())
    for row in (row for row in rows if row["size"] != 1.0):
        for name in ("training_loss", "validation_loss"):
            row.pop(name, None)
    write_part(folder, "figure-6", {"rows": rows})


@rc_context(PLOT_STYLE)
def figure_6(rows: Table) -> Figure:
    """Draw the training loss, the error by share of the data, and the same with more gradient steps at 1 %."""
    main_rows = [row for row in rows if row["split"] == "trajectories" and row["driver"] == "other"]
    figure = new_figure(3.7, width=11)
    left, middle, right = figure.subplots(1, 3)
    _draw_losses(left, [row for row in main_rows if row["size"] == 1.0])
    _draw_errors(middle, [row for row in main_rows if not row["is_long"]], "200 passes, as in the paper")
    long_rows = [row for row in main_rows if row["is_long"] or row["size"] == 0.3]
    _draw_errors(right, long_rows, "at 1 % as many gradient steps as at 30 %")
    right.sharey(middle)
    middle.set_ylabel("error of the acceleration without noise [m/s²]")
    middle.legend()
    return figure


def _draw_losses(axes: Axes, rows: Table) -> None:
    for network, color in NETWORK_COLORS.items():
        for curve in (row["training_loss"] for row in rows if row["network"] == network):
            axes.plot(np.arange(1, len(curve) + 1), curve, color=color, lw=1.0, alpha=0.7)
    noise = next(row["noise"] for row in rows)
    axes.axhline(noise**2, color=TEXT_COLOR, lw=0.9, ls=":")
    axes.annotate("noise", (1.2, noise**2), va="bottom", fontsize=8, color=TEXT_COLOR)
    axes.set_xlabel("passes over all training rows")
    _set_log_axes(axes, "training loss [(m/s²)²]")


def _draw_errors(axes: Axes, rows: Table, title: str) -> None:
    fits = pd.DataFrame(rows).assign(share=lambda fits: 100 * fits["size"])
    for network, color in NETWORK_COLORS.items():
        errors: Any = fits[fits["network"] == network].groupby("share")["driver_error"]
        mean, std = errors.mean(), errors.std(ddof=0)
        style = {"color": color, "lw": 1.5, "marker": "o", "ms": 4, "capsize": 3}
        axes.errorbar(mean.index, mean, std, label=NETWORK_LABELS[network], **style)
    axes.set_xlabel("share of the training rows [%]")
    _set_log_axes(axes, title)
    ticks = sorted(fits["share"].unique())
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def _set_log_axes(axes: Axes, title: str) -> None:
    """Make both axes logarithmic, with several numbers per decade on the vertical axis."""
    axes.set(title=title, xscale="log", yscale="log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 4.0, 6.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


FIGURE_6 = Study(
    title="networks that learn car following, with and without a car-following model",
    make_parts=lambda study_folder, seeds: {
        f"figure-6/{fit.name}": (measure_fit, (fit,)) for fit in four_regime_fits()
    },
    write=_write_figure_6,
    minutes=25.0,
    figures={"figure-6": lambda folder: figure_6(read_part(folder, "figure-6")["rows"])},
)
