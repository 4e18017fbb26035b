"""Tables of the documentation, made from the files under results/."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from unjam.measures.feasibility import overall_feasibility
from unjam.measures.metric_table import choose_baseline, estimate_cell, use_no_break_spaces
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate, metric_estimate, paired_difference
from unjam.reports.model import error_text
from unjam_paper.results_file import read_part

RESULTS = Path(__file__).parent.parent / "results"
NUMBERS = re.compile(r"[-+−–±.,%\s\[\]]*\d[-+−–±.,%\s\[\]\d]*")
"""pattern of the content of columns that are aligned to the right"""
NOTE_TERMS = {
    "also beside the acceleration lane": "also next to the acceleration lane",
    "` as it is": "` with default parameters",
    "One law": "One formula",
    "longer tuned law": "longer tuned formula",
    "no single law": "no single formula",
    "No single law": "No single formula",
    "make one law suit": "make one formula suit",
    "Memory of the policy: one look": "Memory of the policy: one observation",
    "twelve looks, a second apart": "twelve observations, 1 s apart",
    "twelve looks, five seconds apart": "twelve observations, 5 s apart",
    "among drivers with": "in traffic of human drivers with",
    "from nothing, paid for the distance": "without an expert, reward: distance",
    "What ends a wave soonest leaves a slower flow": "The setting that dissolves a wave first makes traffic slower",
    "A trade between roads, no gain": "Gains on some roads equal losses on others",
    "Less is lost, nothing is gained": "The loss is smaller, without a gain",
    "The queue meets its own tail": "The queue closes around the loop",
}
"""glossary terms for expressions in `results/research-notes.json`"""


def results_part(name: str) -> Any:
    """Return a part of a results file; its name is FILE/PART."""
    file, _, part = name.partition("/")
    return read_part(RESULTS / f"{file}.json", part)


def driver_rows(name: str) -> dict[str, list[dict]]:
    """Return the rows of a part of a results file, FILE/PART, by driver; null is NaN."""
    rows: dict[str, list[dict]] = {}
    for row in results_part(name)["rows"]:
        rows.setdefault(row["driver"], []).append(
            {key: float("nan") if value is None else value for key, value in row.items()}
        )
    return rows


def metric_table(name: str, metrics: Sequence[str], compared: bool = True) -> pd.DataFrame:
    """Return a table of a part of a results file: a row per driver, mean and 95 % interval per metric.

    With `compared`, the last column is the difference of the first metric to the human baseline, or, without one, to
    the best expert.
    """
    table = {}
    by_driver = driver_rows(name)
    baseline = choose_baseline(by_driver) if compared else ""
    for driver, rows in by_driver.items():
        cells = {}
        for metric in metrics:
            value, info = metric_estimate(rows, metric), METRICS[metric]
            heading = f"{info.label} [{info.unit}]" if info.unit else info.label
            cells[heading] = str(estimate_cell(value, info.digits, len(rows))) if value.count else "never"
        first = METRICS[metrics[0]]
        if "human" in by_driver and len(by_driver) > 1 and "cav_max_braking" in rows[0]:
            cells["feasible"] = overall_feasibility(rows)
        if baseline:
            difference = paired_difference(rows, by_driver[baseline], metrics[0])
            text = "" if driver == baseline else str(estimate_cell(difference, first.digits, sign="+"))
            cells[f"{first.label} − {baseline}"] = text
        table[driver] = cells
    return pd.DataFrame.from_dict(table, orient="index")


def metric_mean(name: str, driver: str, metric: str) -> float:
    """Return the mean of one metric of one driver in a part of a results file."""
    return metric_estimate(driver_rows(name)[driver], metric).mean


def batch_size_table() -> pd.DataFrame:
    """Return vehicle steps per second by number of rings in a batch, device and model of human drivers."""
    columns = {}
    for name in ("cpu", "gpu"):
        measured = results_part(f"batch/sizes-{name}")
        for humans, batches in measured["batches"].items():
            columns[f"{measured['device']}, {humans} [million/s]"] = {
                batch["rings"]: f"{batch['vehicle_steps_per_s'] / 1e6:,.1f}" for batch in batches
            }
    table = pd.DataFrame(columns).fillna("")
    table.insert(0, "rings per batch", [f"{rings:,}" for rings in table.index])
    return table


def knowledge_rows(road: str) -> pd.DataFrame:
    """Return the results on prior knowledge on a road, a row for each model, number of steps and seed."""
    rows = results_part("model/knowledge")["rows"]
    return pd.json_normalize([row for row in rows if row["road"] == road])


def knowledge_table(road: str, columns: dict[str, str], ranges: bool = True) -> pd.DataFrame:
    """Return errors by prior knowledge and number of steps: mean, and with `ranges` the range over the seeds.

    `columns` has the headings of the shown errors by name.
    """
    table = []
    for (steps, model), rows in knowledge_rows(road).groupby(["steps", "model"], sort=False):
        cells = {road: f"{steps:,} steps" if steps else "no data", "": model}
        for name, heading in columns.items():
            values = rows[name]
            cells[heading] = error_text(values.mean())
            if ranges and len(values) > 1:
                cells[heading] += f" [{error_text(values.min())}, {error_text(values.max())}]"
        table.append(cells)
    return pd.DataFrame(table).sort_values(road, key=lambda texts: texts.map(_count_in_text), kind="stable")


def knowledge_gain_table(roads: Sequence[str], columns: dict[str, str]) -> pd.DataFrame:
    """Return the reduction of errors by IDM + residual relative to networks alone, paired on the same data.

    Brackets contain the number of seeds with a reduction.
    """
    table = []
    for road in roads:
        rows = knowledge_rows(road)
        for steps, step_rows in rows[rows["steps"] > 0].groupby("steps"):
            cells = {"road": road, "environment steps": f"{steps:,}"}
            for name, heading in columns.items():
                errors = step_rows.pivot(index="seed", columns="model", values=name)
                reduction = 1.0 - errors["IDM + residual"] / errors["networks alone"]
                cells[heading] = f"{100 * reduction.mean():+.0f} % [{(reduction > 0).sum()} of {len(reduction)}]"
            table.append(cells)
    return pd.DataFrame(table)


def road_model_table(road: str) -> pd.DataFrame:
    """Return the mean errors of whole-road models by prior knowledge of human drivers and amount of data.

    Columns are one-step errors, and differences between episodes in the model and the environment: of the mean speed,
    and of the standard deviation of speeds in the second half, with PI and with a CAV that follows as a human driver.
    Brackets contain the range over the seeds.
    """
    rows = results_part("model/whole_roads")["rows"]
    drivers = {"PI": "PI", "CAV that follows as a human driver": "as a human driver"}
    metrics = {"speed": ("speed", "m/s", 2), "wave": ("spread", "m/s", 2)}
    return _model_error_table([row for row in rows if row["road"] == road], drivers, metrics)


def on_ramp_model_table() -> pd.DataFrame:
    """Return the same as `road_model_table` for models of the on-ramp, with differences of travel time and flow."""
    rows = results_part("model/on_ramps")["rows"]
    drivers = {"expert of the data": "the expert", "human baseline": "human baseline"}
    metrics = {"travel_time": ("travel time", "s", 1), "outflow_veh_per_h": ("flow", "veh/h", 0)}
    return _model_error_table(rows, drivers, metrics)


Metrics = dict[str, tuple[str, str, int]]
"""label, unit and digits of metrics"""


def _model_error_table(rows: list[dict], drivers: dict[str, str], metrics: Metrics) -> pd.DataFrame:
    """Return a table of the models in `rows`, compared with the environment, the row without prior knowledge.

    `drivers` has labels by driver. Models in which half of the episodes or more end in a collision have no differences.
    """
    (actual,) = (row for row in rows if not row["known"])
    models, table = pd.DataFrame([row for row in rows if row["known"]]), []
    for (known, steps), seeds in models.groupby(["known", "steps"], sort=False):
        cells = {"prior knowledge": known, "environment steps": f"{steps:,}" if steps else "none"}
        cells["one-step error [m/s]"] = f"{seeds['step_error'].mean():.4f}"
        for driver, label in drivers.items():
            for name, (heading, unit, digits) in metrics.items():
                valid = [episodes for episodes in seeds[driver] if 2 * episodes["collisions"] < len(episodes[name])]
                differences = [np.mean(episodes[name]) - np.mean(actual[driver][name]) for episodes in valid]
                cells[f"{heading}, {label} [{unit}]"] = _range_text(differences, digits) if valid else "–"
        collisions = sum(episodes["collisions"] for driver in drivers for episodes in seeds[driver])
        episode_count = len(drivers) * len(seeds) * len(actual[driver][name])
        cells["episodes with collisions"] = f"{collisions} of {episode_count}"
        table.append(cells)
    return pd.DataFrame(table)


RETURN_COLUMNS = {
    "return": ("return", 0),
    "cav_mean_speed": ("CAV's speed [m/s]", 2),
    "speed_std_cav": ("its std over time [m/s]", 2),
}


def driver_return_table(name: str, columns: dict[str, str], selected: dict[str, tuple]) -> pd.DataFrame:
    """Return returns and speeds of drivers that do not learn, from a part of `results/research-notes.json`.

    `columns` has the headings of the entries that identify a row, `selected` the values of entries in the shown rows.
    """
    rows = results_part(f"research-notes/{name}")["rows"]
    return pd.DataFrame(
        {heading: row[key] for key, heading in columns.items()}
        | {heading: estimate_cell(Estimate(**row[key]), digits) for key, (heading, digits) in RETURN_COLUMNS.items()}
        for row in rows
        if all(row[key] in values for key, values in selected.items())
    )


def _range_text(values: Sequence[float], digits: int = 2) -> str:
    mean, low, high = (
        f"{round(value, digits) + 0.0:+.{digits}f}" for value in (np.mean(values), min(values), max(values))
    )
    return mean if low == high else f"{mean} [{low}, {high}]"


def _count_in_text(text: str) -> int:
    """Return the number with the digits in a text; 0 without digits."""
    return int("".join(digit for digit in text if digit.isdigit()) or 0)


def memory_table() -> pd.DataFrame:
    """Return the explained variance of properties of a ring by memory of the policy, on training and unseen rings."""
    explained = results_part("research-notes/memory")["explained"]
    training_rings, unseen_rings = next(iter(explained.values()))
    rows = []
    for memory, by_rings in explained.items():
        row = {"memory": memory}
        for target in by_rings[training_rings]:
            for rings, heading in ((training_rings, "training"), (unseen_rings, "unseen")):
                share = by_rings[rings][target]
                row[f"{target}, {heading}"] = f"{share['mean']:.2f} [{share['low']:.2f}, {share['high']:.2f}]"
        rows.append(row)
    return pd.DataFrame(rows)


def note_tables() -> dict[str, pd.DataFrame]:
    """Return the negative results, a table for each topic."""
    tables: dict[str, list[dict[str, str]]] = {}
    for row in results_part("research-notes/notes"):
        number = "–" if row["mean"] is None else f"{row['mean']:,g}"
        if row["low"] is not None:
            number += f" [{row['low']:,g}, {row['high']:,g}]"
        tables.setdefault(row["topic"], []).append(
            {
                "experiment": _in_glossary_terms(row["experiment"]),
                "measured": row["metric"],
                "number": number,
                "based on": _in_glossary_terms(row["basis"]),
                "conclusion": _in_glossary_terms(row["conclusion"]),
                "source": row["source"],
            }
        )
    return {topic: pd.DataFrame(rows) for topic, rows in tables.items()}


def _in_glossary_terms(text: str) -> str:
    for old_term, term in NOTE_TERMS.items():
        text = text.replace(old_term, term)
    return text


def networks_table() -> pd.DataFrame:
    """Return the comparison of the human baseline with plain SUMO on public networks, a row for each network."""
    rows = {}
    for name, network in results_part("networks/networks").items():
        cells = {"simulated [s]": f"{network['seconds']:.0f}"}
        if "refused" in network:
            rows[name] = {**cells, "result": f"refused: {network['refused']}"}
            continue
        baseline, plain = network["human_baseline"], network["plain_sumo"]
        counts = {
            label: f"{baseline[key]:.{digits}f} / {plain[key]:.{digits}f}"
            for key, label, digits in (
                ("departures", "departures", 0),
                ("arrivals", "arrivals", 0),
                ("travel_time", "mean travel time [s]", 1),
                ("teleports", "teleports", 0),
            )
        }
        rows[name] = {
            **cells,
            **counts,
            "result": f"{network['different_trips']} trips differ",
            "CPU time": f"{baseline['seconds'] / plain['seconds']:.1f} x ({plain['seconds']:.1f} s)",
            "memory [MB]": f"{baseline['megabytes']:.0f} / {plain['megabytes']:.0f}",
        }
    return pd.DataFrame.from_dict(rows, orient="index").fillna("")


def soak_table() -> pd.DataFrame:
    """Return the faults of the last soak test: what was injected, how often, and the outcomes."""
    table = []
    for row in results_part("soak/rows"):
        outcomes = [f"{count:,}: {outcome}" for outcome, count in row["happened"].items()]
        facts = [f"{name}: {value}" for name, value in row["facts"].items()]
        table.append(
            {
                "what was injected": row["about"],
                "how often": f"{row['injected']:,}",
                "what happened": "; ".join([*outcomes, *facts]),
            }
        )
    return pd.DataFrame(table)


def soak_origin() -> str:
    """Return SUMO version, commits and date of the results of the soak test."""
    manifest = results_part("soak/manifest")
    commits = dict.fromkeys(row["commit"] for row in results_part("soak/rows"))
    return f"SUMO {manifest['packages']['libsumo']}, commit {', '.join(commits)}, {manifest['started'][:10]}"


@dataclass(frozen=True)
class Picture:
    """A figure of a page: the name of its file, and its alternative text."""

    name: str
    figure: Figure
    alt: str


def show(table: pd.DataFrame, index: bool = False, digits: int = 3) -> str:
    """Return a table in Markdown, with breaks after commas of parameters, but not in commands and intervals."""
    texts = table.map(lambda cell: _cell_text(cell, digits))
    if index:
        texts.insert(0, "", [_cell_text(name, digits) for name in table.index], allow_duplicates=True)
    return markdown_table(texts)


def _cell_text(cell: Any, digits: int) -> str:
    text = f"{cell:.{digits}f}" if isinstance(cell, float) else str(cell)
    text = text.replace("\n", " ").replace("|", r"\|")
    if not text.startswith("`"):
        text = re.sub(r",(?=\w+=)", ", ", text)
    return re.sub(r"\[[^\[\]]*\]", lambda match: use_no_break_spaces(match[0]), text)


def markdown_table(texts: pd.DataFrame) -> str:
    """Return a table of texts in Markdown, with columns of numbers aligned to the right."""
    columns = (texts.iloc[:, index] for index in range(texts.shape[1]))
    rules = ["--:" if NUMBERS.fullmatch("".join(column)) else "---" for column in columns]
    lines = [texts.columns, rules, *texts.itertuples(index=False, name=None)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
