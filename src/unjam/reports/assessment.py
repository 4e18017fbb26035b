"""Page of an assessment: effects of ACC vehicles and controllers on a road, and the recommendation."""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count
from math import nan
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.errors import InputError
from unjam.files import INVALID_DATA_ERRORS, atomic_write, check_parent_folder, parse_json, to_json
from unjam.folders import open_folder
from unjam.measures.effect import FLOW_METRIC, MAX_FLOW_LOSS, TIME_METRIC
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import estimate_cell
from unjam.measures.recommendation import MIN_VERDICT_SEEDS
from unjam.measures.statistics import Estimate, format_difference, format_percent
from unjam.reports import figures, space_time
from unjam.reports.html import render_template
from unjam.reports.results import damaged_results_error, original_command, read_results, replace_null
from unjam.text import split_label

ASSESSMENT_FILE, ASSESSMENT_PAGE = "assessment.json", "assessment.html"
EFFECT_METRICS = (
    ("travel_time", "travel_time", "travel time, departure delay included", "s", 1),
    ("flow", "outflow_veh_per_h", "flow", "veh/h", 0),
    ("fuel", "fuel_ml_per_km", "fuel by emission model", "ml/km", 1),
    ("hard_braking", "human_braking_beyond_4_5", "human drivers' braking beyond 4.5 m/s²", "per million", 0),
)  # field of an effect, its metric, and its label, unit and number of decimals in tables
HUMAN_BASELINE_LABEL, ACC_LABEL = "human baseline", "ACC alone"
OPTION_HEADINGS = (
    *("CAVs", "driver", "travel time − human [s]", "travel time − ACC [s]"),
    *("flow − human [veh/h]", "flow − ACC [veh/h]", "feasibility", "verdict"),
)  # columns of the main table: differences to the human baseline and to ACC vehicles alone
ACC_DIFFERENCES = "difference_to_acc", "flow_difference_to_acc"
MISSING = Estimate(nan, nan, nan, 0)


def count_assessed_seeds(folder: Path, rates: Sequence[float], drivers: dict[str, Any]) -> int:
    """Return the number of test seeds of the assessment in a folder; 0 if rates or drivers (recipes by name) differ."""
    with suppress(InputError, *INVALID_DATA_ERRORS):
        document = parse_json((folder / ASSESSMENT_FILE).read_bytes())
        if (document["penetration_rates"], document["drivers"]) == ([*rates], json.loads(to_json(drivers))):
            return int(document["seeds"]["test"])
    return 0


def archive_assessment(folder: Path, rates: Sequence[float], drivers: dict[str, Any], seeds: int) -> Path | None:
    """Rename the files of an assessment with other rates or drivers, or with more test seeds; return a new path."""
    if not (folder / ASSESSMENT_FILE).is_file() or 0 < count_assessed_seeds(folder, rates, drivers) <= seeds:
        return None
    with open_folder(folder) as opened:
        stems = (f"{Path(ASSESSMENT_FILE).stem}-{index}" for index in count(1))
        new_stem = next(stem for stem in stems if not opened.mode(f"{stem}.json") and not opened.mode(f"{stem}.html"))
        # The document is renamed last: while it exists, the next call finds the assessment.
        renamed = {
            name: f"{new_stem}{Path(name).suffix}" for name in filter(opened.mode, (ASSESSMENT_PAGE, ASSESSMENT_FILE))
        }
        for name, new_name in renamed.items():
            opened.rename(name, new_name)
    return folder / next(iter(renamed.values()))


def write_assessment(folder: Path, target: Path) -> Path:
    """Write the page for a folder of `unjam assess`; return its path.

    Raise `InputError` if the folder contains no assessment, `DiskError` if the page cannot be written.
    """
    check_parent_folder(target)
    try:
        page = render_assessment(folder)
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(folder, error) from error
    atomic_write(target, page)
    return target


def render_assessment(folder: Path) -> str:
    """Return the page of an assessment as text."""
    path = folder / ASSESSMENT_FILE
    if not path.is_file():
        raise InputError(f"report: {str(folder)!r} has no {ASSESSMENT_FILE}")
    assessment, results = parse_assessment(json.loads(path.read_text())), read_results(folder)
    labels = {"human": HUMAN_BASELINE_LABEL}
    panels = [
        replace(episode, driver=labels.get(episode.driver, episode.driver))
        for episode in results.plot_episodes.values()
    ]
    first_rows = [rows[0] if (rows := results.rows.get(driver)) else None for driver in results.plot_episodes]
    times = [f"{row[TIME_METRIC]:.1f} s" if row else "not measured" for row in first_rows]
    return render_template(
        "assessment.html",
        assessment=assessment,
        rates_without_controller=_rates_without_controller(assessment),
        option_headings=OPTION_HEADINGS,
        option_rows=option_rows(assessment),
        columns=[HUMAN_BASELINE_LABEL, *map(_option_label, _evaluated_options(assessment))],
        result_rows=_result_rows(assessment),
        candidate_rows=[_candidate_row(candidate) for candidate in assessment["candidates"]],
        effect_figure=figures.data_uri(effect_figure(assessment)),
        space_time=figures.data_uri(space_time.space_time_figure(panels)) if panels else "",
        panels=[f"{panel.driver}, {time}" for panel, time in zip(panels, times, strict=True)],
        has_lane_maps=space_time.has_lane_maps(panels),
        percent=format_percent,
        breakable=lambda label: Markup("<wbr>").join(split_label(label)),  # names of drivers may be long
        max_flow_loss=MAX_FLOW_LOSS,
        min_test_seeds=MIN_VERDICT_SEEDS,
        command=original_command(results),
    )


def _option_label(option: dict[str, Any]) -> str:
    return f"{format_percent(option['penetration_rate'])}: {option['driver']}"


def _rates_without_controller(assessment: dict[str, Any]) -> list[tuple[float, dict[str, Any]]]:
    """Return each penetration rate without an evaluated controller, with its fastest candidate."""
    evaluated = [result["penetration_rate"] for result in assessment["controller_results"]]
    return [
        (rate, min(candidates, key=lambda candidate: candidate["effect"]["travel_time"].mean))
        for rate in assessment["penetration_rates"]
        if rate not in evaluated
        and (
            candidates := [candidate for candidate in assessment["candidates"] if candidate["penetration_rate"] == rate]
        )
    ]


def parse_assessment(document: dict[str, Any]) -> dict[str, Any]:
    """Return the content of `assessment.json` with estimates as `Estimate`, and NaN instead of null."""

    def parse(value: Any, key: str = "effect") -> Any:
        if key == "effect":
            return {name: parse(entry, name) for name, entry in value.items()}
        return Estimate(**replace_null(value)) if isinstance(value, dict) else nan if value is None else value

    groups = {key: [*map(parse, document[key])] for key in ("controller_results", "acc_results", "candidates")}
    for result in groups["acc_results"]:
        result["driver"] = ACC_LABEL
    return {**document, **groups, "baseline": parse(document["baseline"])}


def option_rows(assessment: dict[str, Any]) -> list[list[str]]:
    """Return the cells of the main table below `OPTION_HEADINGS`: the human baseline, then a row for each option."""
    time, flow = (assessment["baseline"][metric].mean for metric in (TIME_METRIC, FLOW_METRIC))
    rows = [["none", HUMAN_BASELINE_LABEL, f"{time:.1f} s", "–", f"{flow:,.0f} veh/h", "–", "–", "–"]]
    for option in _evaluated_options(assessment):
        effect, acc_differences = option["effect"], [option.get(name, MISSING) for name in ACC_DIFFERENCES]
        times = [format_difference(change, 1) for change in (effect["travel_time"], acc_differences[0])]
        flows = [format_difference(change) for change in (effect["flow"], acc_differences[1])]
        verdicts = feasibility_text(effect), option.get("verdict", "–")
        rows.append([format_percent(option["penetration_rate"]), option["driver"], *times, *flows, *verdicts])
    return rows


def feasibility_text(effect: dict[str, Any]) -> str:
    """Return a text on the feasibility of the CAVs, and on more frequent hard braking by human drivers."""
    if effect["feasibility"] == FEASIBLE and effect["hard_braking"].mean > 0:
        return f"{FEASIBLE}, but human drivers brake hard more often in the mean"
    return effect["feasibility"] or "–"


def _result_rows(assessment: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of the table of results on test seeds: the human baseline, then differences to it."""
    options = _evaluated_options(assessment)
    effects = [option["effect"] for option in options]
    baseline = assessment["baseline"]
    verdicts = [option.get("verdict", "–") for option in options]
    relative_times = [f"{100 * effect['travel_time'].mean / effect['baseline_travel_time']:+.1f}" for effect in effects]
    acc_differences = [format_difference(option.get("difference_to_acc", MISSING), 1) for option in options]
    contacts = [f"{effect['collisions']:+.0f}" for effect in effects]
    metric_rows = []
    for field, metric, *heading, digits in EFFECT_METRICS:
        human = estimate_cell(baseline[metric], digits).mean
        metric_rows.append((*heading, human, [format_difference(effect[field], digits) for effect in effects]))
    baseline_contacts = f"{baseline['collisions'].mean * baseline['collisions'].count:.0f}"
    rows = (
        ("verdict", "", "", verdicts),
        ("feasibility", "", "", [feasibility_text(effect) for effect in effects]),
        metric_rows[0],
        ("travel time, relative to the human baseline", "%", "", relative_times),
        ("travel time, compared with ACC vehicles", "s", "", acc_differences),
        *metric_rows[1:],
        ("vehicles in collisions, all episodes", "", baseline_contacts, contacts),
        ("test seeds", "", str(assessment["seeds"]["test"]), [str(effect["travel_time"].count) for effect in effects]),
    )
    return [{"label": label, "unit": unit, "cells": [human, *cells]} for label, unit, human, cells in rows]


def _evaluated_options(assessment: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the results of ACC vehicles and controllers on test seeds, ordered by penetration rate."""
    options = [*assessment["acc_results"], *assessment["controller_results"]]
    return sorted(options, key=lambda option: option["penetration_rate"])


def _candidate_row(option: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a candidate in the table of results on tuning seeds."""
    effect = option["effect"]
    cells = [format_difference(effect[name], digits) for name, digits in (("travel_time", 1), ("flow", 0), ("fuel", 1))]
    cells += [f"{effect['collisions']:.0f}", str(effect["travel_time"].count)]
    texts = [effect["feasibility"] or "–", option["rejection_reason"] or "selected"]
    return {"label": _option_label(option), "cells": cells, "texts": texts}


@rc_context(figures.PLOT_STYLE)
def effect_figure(assessment: dict[str, Any]) -> Figure:
    """Draw the effect of each driver at each penetration rate, in percent of the human baseline.

    Marks of tuning seeds are pale, those of test seeds opaque; lines are confidence intervals.
    """
    drivers = list(dict.fromkeys([*(result["driver"] for result in assessment["acc_results"]), *assessment["drivers"]]))
    rates = assessment["penetration_rates"]
    figure = figures.new_figure(4.0)
    panels = figure.subplots(1, 2)
    quantities = (("travel_time", "baseline_travel_time", "travel time"), ("flow", "baseline_flow", "flow"))
    for axes, (field, baseline, label) in zip(panels, quantities, strict=True):
        axes.axhline(0, color=figures.TEXT_COLOR, lw=0.9)
        groups = (("candidates", 0.35, 4, 0.0), ("acc_results", 1.0, 6, 0.06), ("controller_results", 1.0, 6, 0.06))
        for group, alpha, size, shift in groups:
            for option in assessment[group]:
                index, effect = drivers.index(option["driver"]), option["effect"]
                x = rates.index(option["penetration_rate"]) + 0.7 * ((index + 0.5) / len(drivers) - 0.5) + shift
                scale = 100.0 / effect[baseline] if effect[baseline] else nan  # no vehicle arrived in a short episode
                style = {"color": figures.LINE_COLORS[(index + 1) % len(figures.LINE_COLORS)], "alpha": alpha}
                axes.plot([x] * 2, [scale * effect[field].low, scale * effect[field].high], lw=1.6, **style)
                axes.plot(x, scale * effect[field].mean, "o", ms=size, **style)
        axes.set_ylabel(f"{label} compared with human baseline [%]")
        axes.set_xticks(range(len(rates)), [format_percent(rate) for rate in rates])
        axes.set(xlim=(-0.5, len(rates) - 0.5), xlabel="penetration rate")
        axes.grid(False, axis="x")
    for index, name in enumerate(drivers):
        panels[0].plot([], [], "o-", color=figures.LINE_COLORS[(index + 1) % len(figures.LINE_COLORS)], label=name)
    figure.legend(loc="outside upper left", ncols=4)
    return figure
