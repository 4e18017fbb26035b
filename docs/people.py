"""Tables of human drivers, from results/figure-6.json and results/field.json."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from tables import results_part
from verdicts import Finding, Values, compare_values, judge_differences, list_values

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
"""labels of the models of the field study, by name"""
FEW_DATA = (0.01, 0.1)
COMPARED_MODELS = "knowledge, IDM", "IDM"
"""the calibrated IDM with a residual, and without"""


def read_rows(name: str) -> pd.DataFrame:
    """Return the rows of a part of a results file, FILE/PART."""
    return pd.DataFrame(results_part(name)["rows"])


def figure_6_rows(**selected: Any) -> pd.DataFrame:
    """Return the rows of the study of Fig. 6 that have the given values, ordered by size, network and repeat."""
    rows = read_rows("figure-6/figure-6")
    for name, value in selected.items():
        rows = rows[rows[name] == value]
    return rows.sort_values(["size", "network", "repeat"])


def error_table(driver: str, is_long: bool = False, name: str = "driver_error") -> pd.DataFrame:
    """Return the mean error and its standard deviation over the repeats, by size and network."""
    rows = figure_6_rows(driver=driver, split="trajectories", is_long=is_long)
    table = []
    for size, size_rows in rows[rows["network"] != "nearest row"].groupby("size"):
        cells: dict[str, Any] = {"share of the data": f"{100 * size:g} %"}
        for network, repeats in size_rows.groupby("network"):
            cells[NETWORKS[str(network)]] = f"{repeats[name].mean():.4f} ± {repeats[name].std(ddof=0):.4f}"
        table.append({**cells, "repeats": int(size_rows["repeat"].nunique())})
    return pd.DataFrame(table)


def split_table() -> pd.DataFrame:
    """Return the error on the test rows by split of the data."""
    rows = figure_6_rows(driver="other", is_long=False)
    rows = rows[rows["size"].isin([0.01, 0.1, 1.0])]
    headings = {"trajectories": "by trajectory", "rows": "row by row", "released": "as the released code"}
    table = []
    for (size, network), fits in rows.groupby(["size", "network"]):
        cells: dict[str, Any] = {"share of the data": f"{100 * size:g} %", "": NETWORKS[str(network)]}
        for split, heading in headings.items():
            split_errors = fits[fits["split"] == split]["error"]
            cells[heading] = f"{split_errors.mean():.4f}" if len(split_errors) else "–"
        table.append(cells)
    return pd.DataFrame([row for row in table if row["row by row"] != "–"])


def field_table(data: str, test: str, models: Sequence[str] = tuple(MODELS)) -> pd.DataFrame:
    """Return the errors of models on a test set, with confidence intervals and the range over seeds."""
    rows = read_rows("field/field")
    rows = rows[(rows["data_set"] == data) & (rows["test"] == test)]
    table = []
    for model in models:
        model_rows = rows[rows["model"] == model]
        if model_rows.empty:
            continue
        table.append(
            {
                "": MODELS[model],
                "error of the simulated gap [m]": _error_text(model_rows, "gap"),
                "error of the simulated speed [m/s]": f"{model_rows['speed'].mean():.2f}",
                "end in a collision": f"{100 * model_rows['collision_share'].mean():.0f} %",
                "one step [m/s²]": f"{model_rows['one_step'].mean():.3f}",
            }
        )
    return pd.DataFrame(table)


def _error_text(rows: pd.DataFrame, name: str) -> str:
    values = rows[name]
    low, high = np.array(rows[f"{name}_interval"].tolist()).mean(0)
    seeds = f"; seeds {values.min():.2f} to {values.max():.2f}" if len(rows) > 1 else ""
    return f"{values.mean():.2f} [{low:.2f}, {high:.2f}]{seeds}"


def ring_table() -> pd.DataFrame:
    """Return speeds, waves and collisions on the ring, by model of the human drivers and driver of the CAV."""
    table = []
    for (humans, driver), episodes in read_rows("field/ring").groupby(["humans", "driver"], sort=False):
        table.append(
            {
                "human drivers": humans,
                "CAV": {"human": "none", "pi": "PI", "trained": "PI + residual"}[str(driver)],
                "mean speed, steady [m/s]": _mean_text(episodes["mean_speed_steady"], 2),
                "speed std across vehicles, steady [m/s]": _mean_text(episodes["speed_std_fleet_steady"], 2),
                "wave speed [m/s]": _mean_text(episodes["wave_speed"], 1),
                "collisions": int(episodes["collisions"].sum()),
            }
        )
    return pd.DataFrame(table)


def _mean_text(values: pd.Series, digits: int) -> str:
    mean = estimate([float("nan") if value is None else float(value) for value in values])
    return str(estimate_cell(mean, digits, len(values))) if mean.count else "no wave"


def people_claims() -> pd.DataFrame:
    """Return the claims of the paper about the network with IDM, with verdicts and measurements."""
    findings = {
        "faster convergence": _passes_to_low_loss(),
        "lower loss": _final_loss("training_loss"),
        "substantially lower loss (here: the part above the noise by at least 10 %)": _final_loss(
            "training_loss", least=10.0, is_above_noise=True
        ),
        "lower loss in validation": _final_loss("validation_loss"),
        "lower error at every size of the data": _judge_sizes("other", lambda errors: errors),
        "the same with few data, in other settings": _few_data_errors(),
        "the same with data of the very IDM in the model (it does not say of which driver)": _judge_sizes(
            "same", lambda errors: errors
        ),
        "smaller spread at every size (here: distance of the error from the median of its repeats)": _judge_sizes(
            "other", lambda errors: abs(errors - errors.median())
        ),
        "it captures what real drivers do (here: better than without IDM)": _one_step_errors(),
        "the residual improves on IDM, one step": _residual_gain("one_step", "error of one step", "m/s²"),
        "the residual improves on IDM, simulated": _residual_gain("gap", "error of the simulated gap", "m"),
    }
    return pd.DataFrame(
        {"the paper": words, "here": verdict, "number": number} for words, (verdict, number) in findings.items()
    )


def _networks(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the rows of the networks with and without IDM."""
    labels = {"knowledge": "with IDM", "vanilla": "without"}
    return {label: rows[rows["network"] == network] for network, label in labels.items()}


def _full_data_rows() -> dict[str, pd.DataFrame]:
    """Return the repeats with all data, with and without IDM."""
    return _networks(figure_6_rows(driver="other", split="trajectories", is_long=False, size=1.0))


def _passes_to_low_loss() -> Finding:
    """Judge whether fewer passes are needed with IDM until the loss is 5 % above the noise."""
    passes = {}
    for label, rows in _full_data_rows().items():
        limit = 1.05 * float(rows["noise"].iloc[0]) ** 2
        curves = [np.array([*curve, -np.inf]) for curve in rows["training_loss"]]  # all passes if never
        passes[label] = np.array([np.argmax(curve <= limit) + 1 for curve in curves])
    verdict, numbers = compare_values(passes, "with IDM", larger=False, digits=1, unit="repeats")
    return verdict, f"passes to a loss 5 % above the noise: {numbers}"


def _final_loss(name: str, least: float = 0.0, is_above_noise: bool = False) -> Finding:
    """Judge whether the last loss, or its part above the noise, is smaller with IDM by at least a percentage."""
    data = _full_data_rows().values()
    noise = float(next(iter(data))["noise"].iloc[0]) ** 2 if is_above_noise else 0.0
    with_idm, without = (np.array([curve[-1] for curve in rows[name]]) - noise for rows in data)
    reduction = estimate_over_trainings((100 * linearized_ratio(without - with_idm, without)).tolist())
    beyond = replace(reduction, low=reduction.low - least, high=reduction.high - least)
    means = f"with IDM {with_idm.mean():.5f}, without {without.mean():.5f}"
    numbers = f"after the last pass [m²/s⁴]: {means}; smaller by {interval_text(asdict(reduction), 2)} %"
    return f"{judge_differences([beyond])} ({reduction.count} repeats)", numbers


def _judge_sizes(driver: str, statistic: Callable[[pd.Series], pd.Series]) -> Finding:
    """Judge a statistic of the errors of the repeats with and without IDM, by size of the data."""
    by_size = figure_6_rows(driver=driver, split="trajectories", is_long=False).groupby("size")
    return _judge_errors(
        {
            f"{100 * size:g} %": {
                label: statistic(fits["driver_error"]).to_numpy() for label, fits in _networks(rows).items()
            }
            for size, rows in by_size
        }
    )


def _judge_errors(errors_by_setting: dict[str, Values]) -> Finding:
    """Judge for each setting whether the errors of the repeats are smaller with IDM."""
    numbers, settings = list[str](), dict[str, list[str]]()
    for setting, values in errors_by_setting.items():
        verdict, text = compare_values(values, "with IDM", larger=False, digits=4, unit="repeats")
        settings.setdefault(verdict, []).append(setting)
        numbers.append(f"{setting}: {text}")
    verdict = "; ".join(f"{verdict} at {', '.join(names)}" for verdict, names in settings.items())
    return verdict, f"[m/s²] {'. '.join(numbers)}"


def _few_data_errors() -> Finding:
    """Judge the errors with few data, with other splits of the data, and with more gradient steps."""
    settings = {"split by rows": ("rows", False), "the authors' split": ("released", False)}
    settings["more gradient steps"] = "trajectories", True
    errors_by_setting = dict[str, Values]()
    for (what, (split, is_long)), size in product(settings.items(), FEW_DATA):
        networks = _networks(figure_6_rows(driver="other", split=split, is_long=is_long, size=size))
        values = {label: rows["driver_error"].to_numpy() for label, rows in networks.items()}
        if all(len(each) > 1 for each in values.values()):
            errors_by_setting[f"{100 * size:g} % {what}"] = values
    return _judge_errors(errors_by_setting)


def _one_step_errors() -> Finding:
    """Judge whether a network has smaller errors of one step with the IDM of the paper than without."""
    values = {
        "with IDM": _errors_by_seed("one_step", "knowledge, paper's IDM clipped"),
        "without": _errors_by_seed("one_step", "vanilla"),
    }
    verdict, numbers = compare_values(values, "with IDM", larger=False, digits=3)
    unclipped = _errors_by_seed("one_step", "knowledge, paper's IDM").mean()
    alone = _errors_by_seed("one_step", "paper's IDM, clipped").mean()
    what = f"IDM of the paper, clipped (alone {alone:.3f}; with IDM, not clipped: {unclipped:.2f})"
    return verdict, f"error of one step, 218 drivers of NGSIM, {what} [m/s²]: {numbers}"


def _residual_gain(name: str, what: str, unit: str) -> Finding:
    """Judge whether a residual reduces an error of the calibrated IDM."""
    residual, idm = (_errors_by_seed(name, model) for model in COMPARED_MODELS)
    values = {"with the residual": residual, "calibrated IDM alone": np.full(len(residual), idm.mean())}
    verdict, numbers = compare_values(values, "with the residual", larger=False, digits=2)
    intervals = (_interval_over_drivers(name, model) for model in COMPARED_MODELS)
    over_drivers = (f"[{low:.2f}, {high:.2f}]" for low, high in intervals)
    alone = list_values({"network alone": _errors_by_seed(name, "vanilla").mean()}, 2)
    note = f"intervals over drivers {' and '.join(over_drivers)}; {alone}"
    return verdict, f"{what}, 218 drivers of NGSIM [{unit}]: {numbers}; {note}"


def _interval_over_drivers(name: str, model: str) -> tuple[float, float]:
    """Return the interval of an error over the 218 other drivers, mean over the seeds."""
    low, high = np.array(_other_drivers(model)[f"{name}_interval"].tolist()).mean(0)
    return float(low), float(high)


def _errors_by_seed(name: str, model: str) -> np.ndarray:
    """Return the error of a model on the 218 other drivers, for each seed."""
    return _other_drivers(model)[name].to_numpy()


def _other_drivers(model: str) -> pd.DataFrame:
    rows = read_rows("field/field")
    rows = rows[(rows["data_set"] == "ngsim") & (rows["test"] == "other drivers") & (rows["model"] == model)]
    return rows.sort_values("seed")
