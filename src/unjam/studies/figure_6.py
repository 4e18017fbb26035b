"""Fig. 6 of the paper: does knowledge of car following help a network to learn it? On made-up data.

A network alone (`vanilla`) and one that learns what the paper's IDM leaves (`knowledge`) are trained on
shares of the four-regime set, and judged on trajectories that neither has seen, the same for all. The paper
is silent on who made its data. Here it is either a driver of other parameters than the paper's IDM (`other`),
or that very IDM (`same`), so that the base is the truth.
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

from unjam.files import to_json, write_whole
from unjam.following.four_regimes import SMALLEST_GAP, FourRegimes, four_regimes
from unjam.following.networks import NetworkSettings, fit_one_step, on_rows
from unjam.following.open_loop import always, idm_follow, with_residual
from unjam.following.pairs import SPLITS, Floats, Moments, moments_of, of_split, split_by_trajectory
from unjam.physics.arrays import at_least
from unjam.physics.idm import PAPER_IDM, idm_acceleration
from unjam.reports.figures import INK, LINES, STYLE, new_figure, png_bytes
from unjam.studies.parts import OnProgress, Part, measure_parts
from unjam.studies.study import Study, Table, about_study

Split = Literal["trajectories", "rows", "released"]
"""How test rows are kept from training: `trajectories`: none of their trajectory is in it. `rows`: rows are
drawn one by one, so that a test row's neighbours, 0.1 s before and after, are. `released`: as the authors'
code, test rows are drawn from all rows, also from those of training."""
SHARES = (0.7, 0.1, 0.2)
SIZES = (0.01, 0.1, 0.3, 0.5, 1.0)
REPEATS = 5
LONGER = 30
"""at 1 % of the data the networks are also trained with each row so often in a pass: as many gradient steps
as at 30 %"""
VALIDATION_ROWS = 5000
"""that judge each pass"""
FEWER_REPEATS = 3
LEAKING_SIZES = (0.01, 0.1)
SETTINGS = {"other": FourRegimes(), "same": FourRegimes(driver=PAPER_IDM)}
NETWORKS = ("knowledge", "vanilla")
NEAREST = "nearest row"
"""no network: it answers what the most similar row of training did"""
COLOURS = {"knowledge": LINES[2], "vanilla": LINES[1]}
LABELS = {"knowledge": "IDM + residual", "vanilla": "network alone"}


@dataclass(frozen=True)
class Task:
    """One fit."""

    driver: str
    """a name in SETTINGS"""
    network: str
    """in NETWORKS, or NEAREST"""
    size: float
    """share of the training rows"""
    repeat: int
    split: Split = "trajectories"
    longer: bool = False
    """whether each row is in a pass `LONGER` times"""

    @property
    def name(self) -> str:
        """A name for its file."""
        words = [self.driver, self.split, self.network.replace(" ", "-"), f"{100 * self.size:g}"]
        return "-".join([*words, f"{self.repeat}", *(["longer"] if self.longer else [])])


class Parted(NamedTuple):
    """The rows of a split."""

    training: Moments
    validation: Moments
    test: Moments
    overlap: float
    """share of the test rows that are also training rows"""


def tasks(repeats: int = REPEATS) -> list[Task]:
    """Return all fits of the study, the most telling first."""

    def fits(
        count: int,
        sizes: Sequence[float],
        networks: Sequence[str] = NETWORKS,
        splits: Sequence[Split] = ("trajectories",),
        driver: str = "other",
        longer: bool = False,
    ) -> list[Task]:
        found = product(range(count), splits, sizes, networks)
        return [Task(driver, net, size, repeat, split, longer) for repeat, split, size, net in found]

    fewer = min(FEWER_REPEATS, repeats)
    return [
        *fits(repeats, SIZES),
        *fits(fewer, SIZES[:1], longer=True),
        *fits(fewer, SIZES[:2], driver="same"),
        *fits(fewer, LEAKING_SIZES, splits=("rows", "released")),
        *fits(1, (*LEAKING_SIZES, 1.0), networks=(NEAREST,), splits=get_args(Split)),
    ]


@cache
def parted(driver: str, split: Split) -> Parted:
    """Return the rows for training, validation and test, always the same."""
    pairs = four_regimes(SETTINGS[driver])
    if split == "trajectories":
        chosen = split_by_trajectory(pairs, SHARES, seed=0)
        return Parted(*(moments_of(of_split(chosen, name)) for name in SPLITS), overlap=0.0)
    rows, generator = moments_of(pairs), np.random.default_rng(0)
    borders = np.round(np.cumsum(SHARES)[:-1] * len(rows)).astype(int)
    training, validation, test = np.split(generator.permutation(len(rows)), borders)
    if split == "released":
        test = generator.permutation(len(rows))[: len(test)]
    overlap = float(np.isin(test, training).mean())
    return Parted(rows.some(training), rows.some(validation), rows.some(test), overlap)


def measure(task: Task) -> dict[str, Any]:
    """Return a fit's errors on the test rows [m/s2], and its losses.

    `error` is against what happened, noise included; `error_of_driver` against what the driver does there on
    average; `noise` is the former of somebody who knows the latter.
    """
    started = perf_counter()
    rows = parted(task.driver, task.split)
    generator = np.random.default_rng([task.repeat, round(1000 * task.size)])
    count = max(1, round(task.size * len(rows.training)))
    training = rows.training.some(generator.permutation(len(rows.training))[:count])
    if task.network == NEAREST:
        predicted, facts = _nearest(training, rows.test), {}
    else:
        predicted, facts = _learned(task, training, rows)
    average = average_acceleration(rows.test, SETTINGS[task.driver])
    return {
        **asdict(task),
        "rows": count,
        "overlap": rows.overlap,
        "error": _root(predicted - rows.test.acceleration),
        "error_of_driver": _root(predicted - average),
        "noise": _root(average - rows.test.acceleration),
        "seconds": perf_counter() - started,
        **facts,
    }


def average_acceleration(rows: Moments, settings: FourRegimes) -> Floats:
    """Return what the driver of the data does on average, over the noise, in each row [m/s2].

    That is its IDM, but for those who nearly stand: as nobody drives backwards, noise only lets them start.
    """
    from scipy.stats import norm

    gap = at_least(rows.gap, SMALLEST_GAP)
    wanted = idm_acceleration(rows.speed, rows.leader_speed, gap, settings.driver)
    least = -rows.speed / settings.step
    if settings.noise == 0:
        return np.maximum(wanted, least)
    above = (wanted - least) / settings.noise
    return least + settings.noise * (norm.pdf(above) + above * norm.cdf(above))


def _learned(task: Task, training: Moments, rows: Parted) -> tuple[Floats, dict[str, Any]]:
    base = idm_follow(PAPER_IDM) if task.network == "knowledge" else None
    if task.longer:
        training = training.some(np.tile(np.arange(len(training)), LONGER))
    judges = np.random.default_rng(0).permutation(len(rows.validation))[:VALIDATION_ROWS]
    validation, test = rows.validation.some(judges), rows.test
    network, losses = fit_one_step(training, validation, base, NetworkSettings(), task.repeat)
    model = with_residual(always(base) if base else None, on_rows(network.as_driver()))
    predicted = model(test.speed[:1], test.gap[:1])(test.speed, test.leader_speed, test.gap)
    facts = {"training_loss": losses.training, "validation_loss": losses.validation}
    return predicted, {"epochs": len(losses.training), **facts}


def _nearest(training: Moments, test: Moments) -> Floats:
    """Return the acceleration of the training row that is most similar to each test row."""
    from scipy.spatial import KDTree

    seen, wanted = (np.column_stack([rows.speed, rows.leader_speed, rows.gap]) for rows in (training, test))
    scale = seen.std(0)
    _, places = KDTree(seen / scale).query(wanted / scale)
    return training.acceleration[np.asarray(places, np.int64)]


def _root(error: Floats) -> float:
    return float(np.sqrt(np.square(error).mean()))


def run(
    folder: Path, workers: int = 2, on_progress: OnProgress = lambda name: None, repeats: int = REPEATS
) -> None:
    """Measure what is missing, and write `figure-6.json` and `figure-6.png` into `folder`.

    The study goes on where it was stopped: what is measured lies in `folder/parts`.
    """
    about = about_study(folder)
    parts: dict[str, Part] = {task.name: (measure, (task,)) for task in tasks(repeats)}
    rows = measure_parts(folder / "parts", parts, workers, on_progress)
    kept = [  # losses of the whole data alone
        {key: value for key, value in row.items() if row["size"] == 1.0 or not key.endswith("_loss")}
        for row in rows
    ]
    write_whole(folder / "figure-6.json", to_json({"manifest": about, "rows": kept}, indent=1))
    write_whole(folder / "figure-6.png", png_bytes(picture(rows), small=False))


@rc_context(STYLE)
def picture(rows: Table) -> Figure:
    """Return training loss, error by the share of the data, and the same with more gradient steps."""
    main = [row for row in rows if row["split"] == "trajectories" and row["driver"] == "other"]
    figure = new_figure(3.7, width=11)
    left, middle, right = figure.subplots(1, 3)
    _losses(left, [row for row in main if row["size"] == 1.0])
    _errors(middle, [row for row in main if not row["longer"]], "200 passes, as in the paper")
    longer = [row for row in main if row["longer"] or row["size"] == 0.3]
    _errors(right, longer, "at 1 % as many gradient steps as at 30 %")
    right.sharey(middle)
    middle.set_ylabel("error of the acceleration, noise aside [m/s²]")
    middle.legend()
    return figure


def _losses(axes: Axes, rows: Table) -> None:
    for network, colour in COLOURS.items():
        for curve in (row["training_loss"] for row in rows if row["network"] == network):
            axes.plot(np.arange(1, len(curve) + 1), curve, color=colour, lw=1.0, alpha=0.7)
    noise = next(row["noise"] for row in rows)
    axes.axhline(noise**2, color=INK, lw=0.9, ls=":")
    axes.annotate("noise", (1.2, noise**2), va="bottom", fontsize=8, color=INK)
    axes.set_xlabel("passes over all training rows")
    _logarithmic(axes, "training loss [(m/s²)²]")


def _errors(axes: Axes, rows: Table, title: str) -> None:
    fits = pd.DataFrame(rows).assign(share=lambda fits: 100 * fits["size"])
    for network, colour in COLOURS.items():
        errors: Any = fits[fits["network"] == network].groupby("share")["error_of_driver"]
        mean, spread = errors.mean(), errors.std(ddof=0)
        look = {"color": colour, "lw": 1.5, "marker": "o", "ms": 4, "capsize": 3}
        axes.errorbar(mean.index, mean, spread, label=LABELS[network], **look)
    axes.set_xlabel("share of the training rows [%]")
    _logarithmic(axes, title)
    ticks = sorted(fits["share"].unique())
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def _logarithmic(axes: Axes, title: str) -> None:
    """Make both axes logarithmic, the vertical one with numbers that can be read within a decade."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 4.0, 6.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_title(title)


FIGURE_6 = Study(
    "networks that learn how people drive, with knowledge and without",
    lambda seeds: [],
    lambda studies, seeds, folder, workers: run(folder, workers),
    minutes=25.0,
)
