"""Leaderboards: results of several drivers in one suite, as rows and as a figure."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.benchmarks.result import BenchmarkResult, read_result
from unjam.errors import InputError, prefix_errors
from unjam.measures.statistics import format_ci
from unjam.reports.figures import CAV_PLOT_COLOR, MUTED_COLOR, PLOT_STYLE, TEXT_COLOR, new_figure, short_label

HEADINGS = ("driver", "gain", "unseen", "worst road", "feasible", "steps")


def read_leaderboard(paths: Sequence[Path]) -> dict[str, BenchmarkResult]:
    """Return the results of files by label, the best first; raise `InputError` unless they are comparable."""
    results = list[BenchmarkResult]()
    for path in paths:
        results.append(result := read_result(path))
        with prefix_errors(f"{path}: "):
            result.check_comparable()
            if result.suite != (suite := results[0].suite):
                raise InputError(f"suite: {result.suite} is not allowed; allowed: {suite}, as in {paths[0]}")
    labels = _unique_labels([result.driver for result in results], [path.name for path in paths])
    return dict(sorted(zip(labels, results, strict=True), key=lambda entry: -entry[1].mean_gain().mean))


def _unique_labels(drivers: Sequence[str], files: Sequence[str]) -> list[str]:
    """Return short labels: the driver, with the file if several drivers have this label, with a number if needed."""
    labels, file_labels = ([short_label(text) for text in texts] for texts in (drivers, files))
    counts, pairs = Counter(labels), zip(labels, file_labels, strict=True)
    labels = [label if counts[label] == 1 else f"{label} ({file_label})" for label, file_label in pairs]
    is_unique = len(set(labels)) == len(labels)
    return labels if is_unique else [f"{number}. {label}" for number, label in enumerate(labels, 1)]


def leaderboard_rows(results: Mapping[str, BenchmarkResult]) -> list[tuple[str, ...]]:
    """Return a row of texts for `HEADINGS` for each result; gains have 95 % CIs over roads and seeds."""
    rows = list[tuple[str, ...]]()
    for label, result in results.items():
        mean, unseen = result.mean_gain(), result.mean_gain("unseen").mean
        (worst_road, worst), steps = result.worst_road, result.training_steps
        gains = f"{mean.mean:.2f}\n{format_ci(mean, '.2f')}", f"{unseen:.2f}", f"{worst:.2f}\n{worst_road}"
        count = f"{result.feasible_count} of {len(result.roads)}"
        rows.append((label, *gains, count, "" if steps is None else f"{steps / 1e6:.2g} M"))
    return rows


@rc_context(PLOT_STYLE)
def leaderboard_figure(results: Mapping[str, BenchmarkResult]) -> Figure:
    """Draw the mean gain of each result with its CI, and the gain on each road as a dot."""
    figure = new_figure(0.9 + 0.42 * len(results))
    axes = figure.subplots()
    for row, result in enumerate(results.values()):
        mean, by_road = result.mean_gain(), list(result.gains().values())
        axes.plot(by_road, [row] * len(by_road), "o", color=MUTED_COLOR, alpha=0.45, ms=5)
        axes.plot([mean.low, mean.high], [row, row], color=TEXT_COLOR, lw=2)
        axes.plot([mean.mean], [row], "D", color=CAV_PLOT_COLOR, ms=6)
    for reference in (0.0, 1.0):
        axes.axvline(reference, color=MUTED_COLOR, lw=0.8, ls=":")
    axes.set_yticks(range(len(results)), list(results))
    axes.invert_yaxis()
    suite = next(iter(results.values())).suite
    axes.set_xlabel(f"gain in {suite}: 0 is the human baseline, 1 the best tuned expert of each road")
    return figure
