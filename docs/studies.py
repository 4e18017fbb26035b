"""Tables of the studies that `unjam reproduce` made, from files under results/."""

import shlex
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
from tables import RESULTS, driver_rows, metric_table, results_part

from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL, use_no_break_spaces
from unjam.measures.statistics import estimate_over_trainings
from unjam_paper.comparison import COMPARISON_METRICS, estimate_metrics
from unjam_paper.feasible import GAP_PI_IDEAL_LABEL, GAP_PI_JAMMED_LABEL
from unjam_paper.results_file import read_parts
from unjam_paper.studies import STUDIES
from unjam_paper.study import STUDY_ROADS, UNFILTERED_ROADS, DriverComparison, interval_text, number_text
from unjam_paper.variants import REFERENCE_DRIVERS, TUNED_REFERENCES, VARIANTS

JAM_FREE_SPEED = 15.0
"""mean speed from which on an episode on the merge has no jam at its end [m/s]"""
PAPER_COLUMNS = {"reward": "return", "speed": "CAV's speed [m/s]", "std": "its std [m/s]"}


def page_table(study: str, name: str) -> pd.DataFrame:
    """Return a table of a study from its stored results."""
    return STUDIES[study].tables[name](RESULTS / f"{study}.json")


def study_rows(study: str, road: str) -> list[dict[str, Any]]:
    """Return the rows of the table of a study on a road, compared with the best tuned expert.

    Trainings have the present label of their variant. Intervals of older results, which are percentiles, are computed
    again from the gains of the trainings if the results contain these.
    """
    rows = results_part(f"{study}/table")
    for row in rows:
        if row["is_learned"]:
            row["name"] = VARIANTS[row["variant"]].label
        if "gains" in row and "smallest" not in row["gain_over_best_expert"]:
            row["gain_over_best_expert"] = asdict(estimate_over_trainings(row["gains"]))
            row["probability_of_improvement"] = {"mean": row["probability_of_improvement"]["mean"]}
    rows = [row for row in rows if row["road"] == road]
    has_tuned_experts = any(row["name"].startswith("tuned ") for row in rows)
    part = f"tuned-on-{road}"
    if has_tuned_experts or part not in read_parts(RESULTS / "experts.json"):
        return rows
    return add_tuned_experts(rows, driver_rows(f"experts/{part}"))


def add_tuned_experts(rows: list[dict[str, Any]], tuned: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the rows of a table with tuned experts that were evaluated later on the same seeds.

    Differences of trainings refer to the best tuned expert. The results do not contain the episodes of trainings, so
    that confidence intervals are over the means of trainings only.
    """
    metric = next(row["gain_reference"]["metric"] for row in rows if row["is_learned"])
    names = {name: label for label, name in TUNED_REFERENCES[rows[0]["road"]].items()}
    tuned_rows = [
        {"name": names[name], "is_learned": False, "trainings": 0, **estimate_metrics(episodes, COMPARISON_METRICS)}
        for name, episodes in tuned.items()
        if name in names
    ]
    best = max(tuned_rows, key=lambda row: row[metric]["mean"])
    previous_best = next(row for row in rows if row.get("best_expert"))
    increase = best[metric]["mean"] - previous_best[metric]["mean"]
    if increase <= 0:
        return rows
    learned = [
        {**row, "gain_over_best_expert": asdict(estimate_over_trainings([gain - increase for gain in row["gains"]]))}
        for row in rows
        if row["is_learned"]
    ]
    others = [{**row, "best_expert": False, "gain_over_best_expert": None} for row in rows if not row["is_learned"]]
    tuned_rows = [{**row, "best_expert": row is best} for row in tuned_rows]
    return [*others, *tuned_rows, *({**row, "probability_of_improvement": None} for row in learned)]


def difference_to_expert(rows: dict[str, dict[str, Any]], name: str, expert: str) -> dict[str, Any]:
    """Return the difference of the return of trainings to an expert of their table, with a CI over the trainings."""
    row = rows[name]
    metric, best = row["gain_reference"]["metric"], row["gain_reference"]["expert"]
    best_gain = rows[best][metric]["mean"] - rows[expert][metric]["mean"]
    return asdict(estimate_over_trainings([gain + best_gain for gain in row["gains"]]))


def jammed_ring_table() -> pd.DataFrame:
    """Return differences of the tuned formula and of residuals on the jammed ring with usual cars, by length."""
    parts, trainings = _jammed_ring()
    formula, residuals = "tuned formula", "residuals"
    columns = {
        f"{formula} − human [m/s]": ([GAP_PI_JAMMED_LABEL], HUMAN_LABEL, "mean_speed", 2),
        f"{residuals} − {formula}: return": (trainings, GAP_PI_JAMMED_LABEL, "return", 0),
        "speed [m/s]": (trainings, GAP_PI_JAMMED_LABEL, "mean_speed", 3),
        "speed, steady [m/s]": (trainings, GAP_PI_JAMMED_LABEL, "mean_speed_steady", 3),
        f"{residuals} − formula for ideal cars: return": (trainings, GAP_PI_IDEAL_LABEL, "return", 0),
        "speed, so compared [m/s]": (trainings, GAP_PI_IDEAL_LABEL, "mean_speed", 3),
    }
    roads = {f"{length} m": [part] for length, part in parts.items()} | {"these six": [*parts.values()]}
    return pd.DataFrame(
        {"length": length, **{name: DriverComparison(road).difference(*column) for name, column in columns.items()}}
        for length, road in roads.items()
    )


def jammed_ring_text() -> str:
    """Return how the gains of residuals on the jammed ring with usual cars are distributed over the episodes."""
    parts, trainings = _jammed_ring()
    comparison, texts = DriverComparison([*parts.values()]), list[str]()
    for label, name in ((GAP_PI_JAMMED_LABEL, "this formula"), (GAP_PI_IDEAL_LABEL, "the formula for ideal cars")):
        gains = comparison.values(trainings, "return") - comparison.values([label], "return")
        means = np.sort(gains.mean(1).ravel())
        texts.append(
            f"Compared with {name}, the return differs by {np.median(means):+.0f} in the median episode, and is larger "
            f"in {100 * (gains > 0).mean():.0f} % of the episodes of single controllers. Ten of {len(means)} episodes "
            f"carry {100 * means[-10:].sum() / means.sum():.0f} % of the mean."
        )
    return " ".join(texts)


def _jammed_ring() -> tuple[dict[str, Any], list[str]]:
    """Return the results on the jammed ring with usual cars by length, and the labels of the trainings."""
    parts = results_part("feasible-ring/ring-jammed-usual-car")
    return parts, [label for label in parts["220"] if label.startswith("training ")]


def paper_convention_table(study: str, road: str) -> pd.DataFrame:
    """Return the numbers of the paper, and the numbers in its convention without and with the safety filter."""
    with_filter = {row["name"]: row for row in study_rows(study, road)}
    unfiltered = f"{study}-unfiltered", UNFILTERED_ROADS.get(road, "")
    is_measured = (RESULTS / f"{unfiltered[0]}.json").is_file()
    versions = {"without filter": {row["name"]: row for row in study_rows(*unfiltered)}} if is_measured else {}
    versions["with filter" if road in UNFILTERED_ROADS else "unjam"] = with_filter
    table = []
    for name, row in with_filter.items():
        cells, reported = {"": name}, row.get("paper") or {}
        for key, heading in PAPER_COLUMNS.items():
            digits = 0 if key == "reward" else 2
            cells[f"{heading}, paper"] = f"{reported[key]:.{digits}f}" if key in reported else ""
            for label, rows in versions.items():
                measured = rows[name]["paper_convention"][key]
                text = f"{measured['mean']:.{digits}f} ± {measured['std']:.{digits}f}"
                cells[f"{heading}, {label}"] = use_no_break_spaces(text)
        table.append(cells)
    return pd.DataFrame(table)


COLUMNS = {
    "return": ("return", 0),
    "return, Eq. 16": ("return_eq16", 0),
    "mean speed [m/s]": ("mean_speed", 2),
    "steady [m/s]": ("mean_speed_steady", 2),
    "speed / limit, steady": ("speed_limit_ratio_steady", 3),
    "std across vehicles [m/s]": ("speed_std_fleet", 2),
    "min time gap [s]": ("min_time_gap", 2),
    "max braking [m/s²]": ("cav_max_braking", 1),
    "outflow [veh/h]": ("outflow_veh_per_h", 0),
    "insertion backlog [veh]": ("insertion_backlog_veh", 0),
}
"""metric and digits of the columns of `evaluation_table`, by heading"""
RING_COLUMNS = ("return", "mean speed [m/s]", "speed / limit, steady", "std across vehicles [m/s]")
RING_COLUMNS += ("min time gap [s]",)
FIGURE_EIGHT_COLUMNS = ("return", "return, Eq. 16", "mean speed [m/s]", "steady [m/s]", "std across vehicles [m/s]")
ON_RAMP_COLUMNS = ("return", "mean speed [m/s]", "outflow [veh/h]", "min time gap [s]")
MERGE_COLUMNS = ("return", "mean speed [m/s]", "steady [m/s]", "outflow [veh/h]", "insertion backlog [veh]")


def evaluation_table(
    study: str, road: str, columns: tuple[str, ...] = RING_COLUMNS, names: tuple[str, ...] = ()
) -> pd.DataFrame:
    """Return the metrics of deterministic controllers on test seeds, of the drivers with these names or of all."""
    table = []
    for row in study_rows(study, road):
        if names and row["name"] not in names:
            continue
        gain, probability = row.get("gain_over_best_expert"), row.get("probability_of_improvement")
        cells = {
            "": f"{row['name']}{' (best expert)' if row.get('best_expert') else ''}",
            "trainings": row["trainings"] or "",
        }
        for name in columns:
            key, digits = COLUMNS[name]
            cells[name] = number_text(row[key]["mean"], digits)
        if "feasibility" in row:
            cells["feasible"] = _feasibility_text(row["feasibility"])
        has_difference = gain is not None and not row.get("best_expert")
        cells["difference to best expert"] = interval_text(gain, 0, "+") if has_difference else ""
        cells["probability of improvement"] = (
            "" if probability is None else interval_text({"low": None, "high": None, **probability}, 2)
        )
        table.append(cells)
    return pd.DataFrame(table)


def unfiltered_table(study: str, road: str, columns: tuple[str, ...] = RING_COLUMNS) -> pd.DataFrame:
    """Return the `learned_table` of a study without the safety filter."""
    return learned_table(f"{study}-unfiltered", UNFILTERED_ROADS[road], columns)


def learned_table(study: str, road: str, columns: tuple[str, ...] = RING_COLUMNS) -> pd.DataFrame:
    """Return the `evaluation_table` of PI, tuned experts and trainings, with braking."""
    learned = tuple(row["name"] for row in study_rows(study, road) if row["is_learned"])
    drivers = ("PI (paper)", "tuned PI", "tuned pacer", *learned)
    return evaluation_table(study, road, (*columns, "max braking [m/s²]"), drivers)


def _feasibility_text(verdicts: str | list[str]) -> str:
    """Return whether a driver is feasible, or how many trainings are feasible; a dash for the human baseline."""
    if isinstance(verdicts, str):
        return {"": "–", FEASIBLE: "yes"}.get(verdicts, "no")
    return f"{verdicts.count(FEASIBLE)} of {len(verdicts)}"


def merge_capacity_table() -> pd.DataFrame:
    """Return the metrics of human-only traffic on the merge by inflow and initial state."""
    names = ("mean_speed", "mean_speed_steady", "outflow_veh_per_h", "insertion_backlog_veh")
    tables = []
    for part in read_parts(RESULTS / "research-notes.json"):
        if not part.startswith("merge-capacity-"):
            continue
        standing, inflow = (int(number) for number in part.split("-")[-2:])
        table = metric_table(f"research-notes/{part}", names)
        table.insert(0, "highway [veh/h]", f"{inflow:,}")
        table.insert(0, "start", f"{standing} standing" if standing else "empty")
        tables.append(table)
    return pd.concat(tables)


def closing_absorber_table() -> pd.DataFrame:
    """Return the metrics of the jam absorber with and without closing gaps, and its episodes that end without a jam."""
    names = ("return", "mean_speed", "mean_speed_steady", "outflow_veh_per_h", "insertion_backlog_veh")
    table = metric_table("research-notes/merge-closing", names)
    table["without a jam"] = [
        f"{sum(row['mean_speed'] > JAM_FREE_SPEED for row in rows)} of {len(rows)}"
        for rows in driver_rows("research-notes/merge-closing").values()
    ]
    return table


def command_table() -> pd.DataFrame:
    """Return for each study, road and row the command that repeats the training with the first seed."""
    table = {}
    for name, study in STUDIES.items():
        for run in study.make_runs(1):
            variant, road = VARIANTS[run.variant], STUDY_ROADS[run.road]
            words = ["unjam", "train", str(road["scenario"]), "--preset", variant.preset, "--seed", "0"]
            words += ["--steps", str(variant.steps)] if variant.steps else []
            changes = {key: value for key, value in road.items() if key != "scenario"} | dict(variant.changes)
            for key, value in changes.items():
                words += ["--set", f"{key}={value}"]
            cells = {"study": name, "road": run.road, "row": variant.label, "command": f"`{shlex.join(words)}`"}
            table.setdefault(run.name, cells)
    return pd.DataFrame(table.values())


def driver_name_table() -> pd.DataFrame:
    """Return the command-line names of drivers that do not learn."""
    for_all_roads = [{"row": label, "`--driver`": f"`{name}`", "on": ""} for label, name in REFERENCE_DRIVERS.items()]
    tuned = [
        {"row": label, "`--driver`": f"`{name}`", "on": road}
        for road, experts in TUNED_REFERENCES.items()
        for label, name in experts.items()
    ]
    return pd.DataFrame([*for_all_roads, *tuned])
