"""Tables of human drivers, from results/figure-6.json and results/field.json."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from tables import results_part
from verdicts import Finding, Values, compare, judge, list_values

from unjam.measures.metric_table import estimate_cell
from unjam.measures.statistics import estimate, estimate_over_trainings, linearized_ratio
from unjam_paper.study import interval_text

NETWORKS = {"knowledge": "IDM + residual", "vanilla": "network alone", "nearest row": "nearest row"}
MODELS = {
    "paper's IDM": "paper's IDM",
    "paper's IDM, clipped": "the same, clipped",
    "IDM, samples weighted equally": "IDM, calibrated, all samples weighted equally",
    "IDM": "IDM, calibrated, all trajectories weighted equally",
    "IDM, initial headway weighted": "the same, initial headway weighted",
    "vanilla": "network alone",
    "knowledge, paper's IDM": "paper's IDM + residual",
    "knowledge, paper's IDM clipped": "paper's IDM, clipped + residual",
    "knowledge, IDM": "calibrated IDM + residual",
    "IDM + multi-step": "calibrated IDM + multi-step residual",
    "IDM, initial headway weighted + multi-step": "initial headway weighted + multi-step residual",
    "IDM, personal time headway": "calibrated IDM, personal time headway",
    "IDM, all parameters personal": "IDM, all parameters personal",
}

FEW_DATA = (0.01, 0.1)
COMPARED_MODELS = "knowledge, IDM", "IDM"
"""the calibrated IDM with a residual, and without"""


def rows_of(name: str) -> pd.DataFrame:
    """Return the rows of a part of a results file, FILE/PART."""
    return pd.DataFrame(results_part(name)["rows"])


def figure_6(**chosen: Any) -> pd.DataFrame:
    """Return the rows of the study of Fig. 6 with these values, by size, network, repeat."""
    rows = rows_of("figure-6/figure-6")
    for name, value in chosen.items():
        rows = rows[rows[name] == value]
    return rows.sort_values(["size", "network", "repeat"])


def errors(driver: str, is_long: bool = False, name: str = "driver_error") -> pd.DataFrame:
    """Return the mean error and its standard deviation over the repeats, by size and network."""
    rows = figure_6(driver=driver, split="trajectories", is_long=is_long)
    table = []
    for size, found in rows[rows["network"] != "nearest row"].groupby("size"):
        cells: dict[str, Any] = {"share of the data": f"{100 * size:g} %"}
        for network, here in found.groupby("network"):
            cells[NETWORKS[str(network)]] = f"{here[name].mean():.4f} ± {here[name].std(ddof=0):.4f}"
        table.append({**cells, "repeats": int(found["repeat"].nunique())})
    return pd.DataFrame(table)


def leaks() -> pd.DataFrame:
    """Return the error on the test rows by split of the data."""
    rows = figure_6(driver="other", is_long=False)
    rows = rows[rows["size"].isin([0.01, 0.1, 1.0])]
    words = {"trajectories": "by trajectory", "rows": "row by row", "released": "as the released code"}
    table = []
    for (size, network), found in rows.groupby(["size", "network"]):
        cells: dict[str, Any] = {"share of the data": f"{100 * size:g} %", "": NETWORKS[str(network)]}
        for split, heading in words.items():
            here = found[found["split"] == split]["error"]
            cells[heading] = f"{here.mean():.4f}" if len(here) else "–"
        table.append(cells)
    return pd.DataFrame([row for row in table if row["row by row"] != "–"])


def field(data: str, test: str, models: Sequence[str] = tuple(MODELS)) -> pd.DataFrame:
    """Return errors on a test set: of a single seed with its interval, of several their mean and range."""
    rows = rows_of("field/field")
    rows = rows[(rows["data_set"] == data) & (rows["test"] == test)]
    table = []
    for model in models:
        found = rows[rows["model"] == model]
        if found.empty:
            continue
        table.append(
            {
                "": MODELS[model],
                "error of the simulated gap [m]": _cell(found, "gap"),
                "error of the simulated speed [m/s]": f"{found['speed'].mean():.2f}",
                "end in a collision": f"{100 * found['collision_share'].mean():.0f} %",
                "one step [m/s²]": f"{found['one_step'].mean():.3f}",
            }
        )
    return pd.DataFrame(table)


def _cell(found: pd.DataFrame, name: str) -> str:
    values = found[name]
    low, high = np.array(found[f"{name}_interval"].tolist()).mean(0)
    seeds = f"; seeds {values.min():.2f} to {values.max():.2f}" if len(found) > 1 else ""
    return f"{values.mean():.2f} [{low:.2f}, {high:.2f}]{seeds}"


def gap_error(model: str, data: str = "ngsim", test: str = "test") -> float:
    """Return the error of the gap, mean over seeds [m]."""
    rows = rows_of("field/field")
    chosen = (rows["data_set"] == data) & (rows["test"] == test) & (rows["model"] == model)
    return float(rows[chosen]["gap"].mean())


def ring() -> pd.DataFrame:
    """Return what happens on the ring, by human drivers and driver of the CAV."""
    table = []
    for (humans, driver), found in rows_of("field/ring").groupby(["humans", "driver"], sort=False):
        table.append(
            {
                "human drivers": humans,
                "CAV": {"human": "none", "pi": "PI", "trained": "PI + residual"}[str(driver)],
                "mean speed, steady [m/s]": _mean(found["mean_speed_steady"], 2),
                "speed std across vehicles, steady [m/s]": _mean(found["speed_std_fleet_steady"], 2),
                "wave speed [m/s]": _mean(found["wave_speed"], 1),
                "collisions": int(found["collisions"].sum()),
            }
        )
    return pd.DataFrame(table)


def _mean(values: pd.Series, digits: int) -> str:
    found = estimate([float("nan") if value is None else float(value) for value in values])
    return str(estimate_cell(found, digits, len(values))) if found.count else "no wave"


def people_claims() -> pd.DataFrame:
    """Return the claims of the paper about the knowledge network, and the measurements."""
    findings = {
        "faster convergence": _passes(),
        "lower loss": _final_loss("training_loss"),
        "substantially lower loss (here: the part above the noise by at least 10 %)": _final_loss(
            "training_loss", least=10.0, is_above_noise=True
        ),
        "lower loss in validation": _final_loss("validation_loss"),
        "lower error at every size of the data": _errors("other", lambda errors: errors),
        "the same with few data, in other settings": _other_settings(),
        "the same with data of the very IDM in the model (it does not say of which driver)": _errors(
            "same", lambda errors: errors
        ),
        "smaller spread at every size (here: distance of the error from the median of its repeats)": _errors(
            "other", lambda errors: abs(errors - errors.median())
        ),
        "it captures what real drivers do (here: better than without IDM)": _one_step(),
        "the residual improves on IDM, one step": _residual_gain("one_step", "error of one step", "m/s²"),
        "the residual improves on IDM, simulated": _residual_gain("gap", "error of the simulated gap", "m"),
    }
    return pd.DataFrame(
        {"the paper": words, "here": verdict, "number": number} for words, (verdict, number) in findings.items()
    )


def _networks(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the rows with and without IDM."""
    labels = {"knowledge": "with IDM", "vanilla": "without"}
    return {label: rows[rows["network"] == network] for network, label in labels.items()}


def _all_data() -> dict[str, pd.DataFrame]:
    """Return the repeats with all data with and without IDM."""
    return _networks(figure_6(driver="other", split="trajectories", is_long=False, size=1.0))


def _passes() -> Finding:
    passes = {}
    for label, found in _all_data().items():
        limit = 1.05 * float(found["noise"].iloc[0]) ** 2
        curves = [np.array([*curve, -np.inf]) for curve in found["training_loss"]]  # all passes if never
        passes[label] = np.array([np.argmax(curve <= limit) + 1 for curve in curves])
    verdict, numbers = compare(passes, "with IDM", larger=False, digits=1, unit="repeats")
    return verdict, f"passes to a loss 5 % above the noise: {numbers}"


def _final_loss(name: str, least: float = 0.0, is_above_noise: bool = False) -> Finding:
    """Judge whether the loss after the last pass, or its part above the noise, is smaller with IDM, by a percentage."""
    data = _all_data().values()
    noise = float(next(iter(data))["noise"].iloc[0]) ** 2 if is_above_noise else 0.0
    own, other = (np.array([curve[-1] for curve in found[name]]) - noise for found in data)
    reduction = estimate_over_trainings((100 * linearized_ratio(other - own, other)).tolist())
    beyond = replace(reduction, low=reduction.low - least, high=reduction.high - least)
    means = f"with IDM {own.mean():.5f}, without {other.mean():.5f}"
    numbers = f"after the last pass [m²/s⁴]: {means}; smaller by {interval_text(asdict(reduction), 2)} %"
    return f"{judge([beyond])} ({reduction.count} repeats)", numbers


def _errors(driver: str, statistic: Callable[[pd.Series], pd.Series]) -> Finding:
    """Judge a statistic of the errors of the repeats with and without IDM, by size of the data."""
    by_size = figure_6(driver=driver, split="trajectories", is_long=False).groupby("size")
    return _judge_errors(
        {
            f"{100 * size:g} %": {
                label: statistic(found["driver_error"]).to_numpy() for label, found in _networks(rows).items()
            }
            for size, rows in by_size
        }
    )


def _judge_errors(errors_by_setting: dict[str, Values]) -> Finding:
    """Judge for each setting whether the errors of the repeats are smaller with IDM."""
    numbers, settings = list[str](), dict[str, list[str]]()
    for setting, values in errors_by_setting.items():
        verdict, text = compare(values, "with IDM", larger=False, digits=4, unit="repeats")
        settings.setdefault(verdict, []).append(setting)
        numbers.append(f"{setting}: {text}")
    verdict = "; ".join(f"{verdict} at {', '.join(found)}" for verdict, found in settings.items())
    return verdict, f"[m/s²] {'. '.join(numbers)}"


def _other_settings() -> Finding:
    """Judge the errors with few data for other splits of the data, and with as many gradient steps as with 30 %."""
    settings = {"split by rows": ("rows", False), "the authors' split": ("released", False)}
    settings["more gradient steps"] = "trajectories", True
    found = dict[str, Values]()
    for (what, (split, is_long)), size in product(settings.items(), FEW_DATA):
        networks = _networks(figure_6(driver="other", split=split, is_long=is_long, size=size))
        values = {label: rows["driver_error"].to_numpy() for label, rows in networks.items()}
        if all(len(each) > 1 for each in values.values()):
            found[f"{100 * size:g} % {what}"] = values
    return _judge_errors(found)


def _one_step() -> Finding:
    values = {
        "with IDM": _of_seeds("one_step", "knowledge, paper's IDM clipped"),
        "without": _of_seeds("one_step", "vanilla"),
    }
    verdict, numbers = compare(values, "with IDM", larger=False, digits=3)
    unclipped = _of_seeds("one_step", "knowledge, paper's IDM").mean()
    alone = _of_seeds("one_step", "paper's IDM, clipped").mean()
    what = f"IDM of the paper, clipped (alone {alone:.3f}; with IDM, not clipped: {unclipped:.2f})"
    return verdict, f"error of one step, 218 drivers of NGSIM, {what} [m/s²]: {numbers}"


def _residual_gain(name: str, what: str, unit: str) -> Finding:
    own, idm = (_of_seeds(name, each) for each in COMPARED_MODELS)
    values = {"with the residual": own, "calibrated IDM alone": np.full(len(own), idm.mean())}
    verdict, numbers = compare(values, "with the residual", larger=False, digits=2)
    intervals = (_drivers_interval(name, each) for each in COMPARED_MODELS)
    over_drivers = (f"[{low:.2f}, {high:.2f}]" for low, high in intervals)
    alone = list_values({"network alone": _of_seeds(name, "vanilla").mean()}, 2)
    note = f"intervals over drivers {' and '.join(over_drivers)}; {alone}"
    return verdict, f"{what}, 218 drivers of NGSIM [{unit}]: {numbers}; {note}"


def _drivers_interval(name: str, model: str) -> tuple[float, float]:
    """Return the interval of an error over the 218 other drivers, mean over the seeds."""
    low, high = np.array(_other_drivers(model)[f"{name}_interval"].tolist()).mean(0)
    return float(low), float(high)


def _of_seeds(name: str, model: str) -> np.ndarray:
    """Return the error of a model on the 218 other drivers, for each seed."""
    return _other_drivers(model)[name].to_numpy()


def _other_drivers(model: str) -> pd.DataFrame:
    rows = rows_of("field/field")
    rows = rows[(rows["data_set"] == "ngsim") & (rows["test"] == "other drivers") & (rows["model"] == model)]
    return rows.sort_values("seed")
