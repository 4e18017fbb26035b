"""Tables of the studies that `unjam reproduce` made, from files under results/."""

import shlex
from dataclasses import asdict
from typing import Any

import pandas as pd
from tables import RESULTS, metrics_of, results_part
from tables import rows_of as rows_of_file

from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import with_no_break_spaces
from unjam.measures.statistics import estimate_over_trainings
from unjam_paper.comparison import COMPARISON_METRICS, estimate_metrics
from unjam_paper.results_file import read_parts
from unjam_paper.studies import STUDIES
from unjam_paper.study import STUDY_ROADS, UNFILTERED_ROADS, interval_text, number_text
from unjam_paper.variants import REFERENCE_DRIVERS, TUNED_REFERENCES, VARIANTS

FREE = 15.0
"""mean speed of an episode on the merge in which no jam stayed [m/s]"""
PAPER = {"reward": "return", "speed": "CAV's speed [m/s]", "std": "its std [m/s]"}


def page_table(study: str, name: str) -> pd.DataFrame:
    """Return a table that a study itself makes for its page."""
    return STUDIES[study].tables[name](RESULTS / f"{study}.json")


def rows_of(study: str, road: str) -> list[dict[str, Any]]:
    """Return the rows of a study's table on a road, compared with the best tuned expert.

    Tables of before have percentile intervals: they are made again from the trainings' gains, where these are.
    """
    rows = results_part(f"{study}/table")
    for row in rows:
        if "gains" in row and "smallest" not in row["gain_over_best_expert"]:
            row["gain_over_best_expert"] = asdict(estimate_over_trainings(row["gains"]))
            row["probability_of_improvement"] = {"mean": row["probability_of_improvement"]["mean"]}
    rows = [row for row in rows if row["road"] == road]
    known = any(row["name"].startswith("tuned ") for row in rows)
    later = f"tuned-on-{road}"
    if known or later not in read_parts(RESULTS / "experts.json"):
        return rows
    return beside_tuned(rows, rows_of_file(f"experts/{later}"))


def beside_tuned(rows: list[dict[str, Any]], tuned: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return a table's rows as beyond the best tuned expert, which was driven later, on the same seeds.

    Episodes of its trainings are not kept, so intervals are over the trainings' means alone.
    """
    metric = next(row["gain_reference"]["metric"] for row in rows if row["is_learned"])
    names = {name: label for label, name in TUNED_REFERENCES[rows[0]["road"]].items()}
    driven = [
        {"name": names[name], "is_learned": False, "trainings": 0, **estimate_metrics(found, COMPARISON_METRICS)}
        for name, found in tuned.items()
        if name in names
    ]
    best = max(driven, key=lambda row: row[metric]["mean"])
    before = next(row for row in rows if row.get("best_expert"))
    more = best[metric]["mean"] - before[metric]["mean"]
    if more <= 0:
        return rows
    learned = [
        {**row, "gain_over_best_expert": asdict(estimate_over_trainings([gain - more for gain in row["gains"]]))}
        for row in rows
        if row["is_learned"]
    ]
    others = [{**row, "best_expert": False, "gain_over_best_expert": None} for row in rows if not row["is_learned"]]
    driven = [{**row, "best_expert": row is best} for row in driven]
    return [*others, *driven, *({**row, "probability_of_improvement": None} for row in learned)]


def beyond_own_expert(rows: dict[str, dict[str, Any]], name: str, expert: str) -> dict[str, Any]:
    """Return what the trainings of a row earn beyond an expert of their table, over the trainings' means."""
    row = rows[name]
    metric, best = row["gain_reference"]["metric"], row["gain_reference"]["expert"]
    more = rows[best][metric]["mean"] - rows[expert][metric]["mean"]
    return asdict(estimate_over_trainings([gain + more for gain in row["gains"]]))


def paper_convention(study: str, road: str) -> pd.DataFrame:
    """Return a table in the paper's convention: the paper's numbers, and ours without and with the safety filter."""
    with_filter = {row["name"]: row for row in rows_of(study, road)}
    unfiltered = f"{study}-unfiltered", UNFILTERED_ROADS.get(road, "")
    is_measured = (RESULTS / f"{unfiltered[0]}.json").is_file()
    versions = {"without filter": {row["name"]: row for row in rows_of(*unfiltered)}} if is_measured else {}
    versions["with filter" if road in UNFILTERED_ROADS else "ours"] = with_filter
    table = []
    for name, row in with_filter.items():
        cells, reported = {"": name}, row.get("paper") or {}
        for key, heading in PAPER.items():
            digits = 0 if key == "reward" else 2
            cells[f"{heading}, paper"] = f"{reported[key]:.{digits}f}" if key in reported else ""
            for label, rows in versions.items():
                ours = rows[name]["paper_convention"][key]
                text = f"{ours['mean']:.{digits}f} ± {ours['std']:.{digits}f}"
                cells[f"{heading}, {label}"] = with_no_break_spaces(text)
        table.append(cells)
    return pd.DataFrame(table)


COLUMNS = {
    "return": ("return", 0),
    "return, Eq. 16": ("return_eq16", 0),
    "mean speed [m/s]": ("mean_speed", 2),
    "steady [m/s]": ("mean_speed_steady", 2),
    "of the limit, steady": ("speed_limit_ratio_steady", 3),
    "std across vehicles [m/s]": ("speed_std_fleet", 2),
    "min time gap [s]": ("min_time_gap", 2),
    "hardest braking [m/s²]": ("cav_max_braking", 1),
    "leave [veh/h]": ("outflow_veh_per_h", 0),
    "wait [veh]": ("insertion_backlog_veh", 0),
}
"""what the honest tables show: a metric and its digits"""
OF_THE_RING = ("return", "mean speed [m/s]", "of the limit, steady", "std across vehicles [m/s]")
OF_THE_RING += ("min time gap [s]",)
OF_THE_EIGHT = ("return", "return, Eq. 16", "mean speed [m/s]", "steady [m/s]", "std across vehicles [m/s]")
OF_THE_ON_RAMP = ("return", "mean speed [m/s]", "leave [veh/h]", "min time gap [s]")
OF_THE_MERGE = ("return", "mean speed [m/s]", "steady [m/s]", "leave [veh/h]", "wait [veh]")


def honest(study: str, road: str, columns: tuple[str, ...] = OF_THE_RING, names: tuple[str, ...] = ()) -> pd.DataFrame:
    """Return a table in the honest convention, of the drivers of these names or of all."""
    table = []
    for row in rows_of(study, road):
        if names and row["name"] not in names:
            continue
        beyond, better = row.get("gain_over_best_expert"), row.get("probability_of_improvement")
        cells = {
            "": f"{row['name']}{' (best expert)' if row.get('best_expert') else ''}",
            "trainings": row["trainings"] or "",
        }
        for name in columns:
            key, digits = COLUMNS[name]
            cells[name] = number_text(row[key]["mean"], digits)
        if "feasibility" in row:
            cells["feasible"] = _feasibility(row["feasibility"])
        nothing = beyond is None or row.get("best_expert")
        cells["difference to best expert"] = "" if nothing else interval_text(beyond, 0, "+")
        cells["probability of improvement"] = (
            "" if better is None else interval_text({"low": None, "high": None, **better}, 2)
        )
        table.append(cells)
    return pd.DataFrame(table)


def without_filter(study: str, road: str, columns: tuple[str, ...] = OF_THE_RING) -> pd.DataFrame:
    """Return the table of `honest` without the safety filter: of the paper's expert and of all that learn."""
    names = f"{study}-unfiltered", UNFILTERED_ROADS[road]
    learned = tuple(row["name"] for row in rows_of(*names) if row["is_learned"])
    return honest(*names, (*columns, "hardest braking [m/s²]"), ("PI (paper)", "tuned PI", *learned))


def _feasibility(verdicts: str | list[str]) -> str:
    """Return whether a driver is feasible, or how many trainings are; a dash for the human baseline."""
    if isinstance(verdicts, str):
        return {"": "–", FEASIBLE: "yes"}.get(verdicts, "no")
    return f"{verdicts.count(FEASIBLE)} of {len(verdicts)}"


def merge_capacity() -> pd.DataFrame:
    """Return how people alone fare on the merge, by how many want to enter and how the road begins."""
    names = ("mean_speed", "mean_speed_steady", "outflow_veh_per_h", "insertion_backlog_veh")
    tables = []
    for part in read_parts(RESULTS / "research-notes.json"):
        if not part.startswith("merge-capacity-"):
            continue
        standing, inflow = (int(number) for number in part.split("-")[-2:])
        table = metrics_of(f"research-notes/{part}", names)
        table.insert(0, "highway [veh/h]", f"{inflow:,}")
        table.insert(0, "start", f"{standing} standing" if standing else "empty")
        tables.append(table)
    return pd.concat(tables)


def closing_absorber() -> pd.DataFrame:
    """Return what closing up is worth to the jam absorber, and in how many episodes no jam stays."""
    names = ("return", "mean_speed", "mean_speed_steady", "outflow_veh_per_h", "insertion_backlog_veh")
    table = metrics_of("research-notes/merge-closing", names)
    table["without a jam"] = [
        f"{sum(row['mean_speed'] > FREE for row in rows)} of {len(rows)}"
        for rows in rows_of_file("research-notes/merge-closing").values()
    ]
    return table


def commands() -> pd.DataFrame:
    """Return the command that repeats the training of a row with the first seed, by study and road."""
    table = {}
    for name, study in STUDIES.items():
        for run in study.make_runs(1):
            variant, road = VARIANTS[run.variant], STUDY_ROADS[run.road]
            words = ["unjam", "train", str(road["scenario"]), "--preset", variant.preset, "--seed", "0"]
            words += ["--steps", str(variant.steps)] if variant.steps else []
            changes = {key: value for key, value in road.items() if key != "scenario"} | dict(variant.changes)
            for key, value in changes.items():
                words += ["--set", f"{key}={value}"]
            said = {"study": name, "road": run.road, "row": variant.label, "command": f"`{shlex.join(words)}`"}
            table.setdefault(run.name, said)
    return pd.DataFrame(table.values())


def drivers() -> pd.DataFrame:
    """Return how drivers that do not learn are named on the command line."""
    on_all = [{"row": label, "`--driver`": f"`{name}`", "on": ""} for label, name in REFERENCE_DRIVERS.items()]
    tuned = [
        {"row": label, "`--driver`": f"`{name}`", "on": road}
        for road, found in TUNED_REFERENCES.items()
        for label, name in found.items()
    ]
    return pd.DataFrame([*on_all, *tuned])
