"""The page of an assessment: what ACC vehicles and controllers change on a road, and what is recommended."""

import json
import re
from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.errors import InputError
from unjam.files import atomic_write, check_parent_folder
from unjam.measures.effect import MAX_FLOW_LOSS, MIN_VERDICT_SEEDS, format_percent
from unjam.measures.metric_table import estimate_cell
from unjam.measures.statistics import Estimate, format_difference
from unjam.reports.figures import LINE_COLORS, PLOT_STYLE, TEXT_COLOR, data_uri, new_figure
from unjam.reports.html import read_page_file, render_template
from unjam.reports.lanes import has_lane_maps, space_time_figure
from unjam.reports.results import original_command, read_results

ASSESSMENT_FILE, ASSESSMENT_PAGE = "assessment.json", "assessment.html"
EFFECT_METRICS = (
    ("travel_time", "travel_time", "travel time, waiting included", "s", 1),
    ("flow", "outflow_veh_per_h", "flow", "veh/h", 0),
    ("fuel", "fuel_ml_per_km", "fuel", "ml/km", 1),
    ("hard_braking", "people_beyond_4_5", "human drivers' braking beyond 4.5 m/s²", "per million", 0),
)
"""field of an effect, its metric, and how tables show the difference: name, unit, digits"""
HUMAN_BASELINE_LABEL = "human baseline"


def write_assessment(folder: Path, target: Path) -> Path:
    """Write the page of a folder of `unjam assess`; return its path.

    Raises:
        InputError: the folder holds no assessment.
        DiskError: the page cannot be written, or there is no folder for it.
    """
    check_parent_folder(target)
    atomic_write(target, render_assessment(folder))
    return target


def render_assessment(folder: Path) -> str:
    """Return the page as text."""
    path = folder / ASSESSMENT_FILE
    if not path.is_file():
        raise InputError(f"report: {str(folder)!r} has no {ASSESSMENT_FILE}")
    found, results = json.loads(path.read_text()), read_results(folder)
    judged, tried = found["judged"], found["tried"]
    for each in judged:
        each["difference_to_acc"] = _parse_estimate(each["difference_to_acc"])
    for each in (*judged, *found["acc"], *tried):
        each["effect"] = {key: _parse_estimate(value) for key, value in each["effect"].items()}
    panels = [replace(shown, driver=_driver_label(shown.driver)) for shown in results.plot_episodes.values()]
    return render_template(
        "assessment.html",
        found=found,
        without=_rates_without_controller(found),
        cards=_key_figures(found),
        columns=[
            HUMAN_BASELINE_LABEL,
            *(f"{format_percent(each['share'])}: {each['driver']}" for each in _evaluated_options(found)),
        ],
        table=_result_rows(found),
        tried=[_tuning_row(each) for each in tried],
        effects=data_uri(effect_figure(found)),
        trajectory_figure=data_uri(space_time_figure(panels)) if panels else "",
        panels=[panel.driver for panel in panels],
        by_lane=has_lane_maps(panels),
        downloads=Markup(read_page_file("downloads.js")),
        percent=format_percent,
        named=breakable_label,
        most_lost=MAX_FLOW_LOSS,
        least=MIN_VERDICT_SEEDS,
        command=original_command(results),
    )


def breakable_label(text: str) -> Markup:
    """Return a name that may be broken after each of its signs: those of drivers are long."""
    return Markup("<wbr>").join(re.split(r"(?<=[:,=_])", text))


def _driver_label(label: str) -> str:
    """Return what the page calls a driver: without CAVs it is the human baseline."""
    return HUMAN_BASELINE_LABEL if label == "human" else label


def _parse_estimate(value: Any) -> Any:
    """Return what JSON says of an estimate as one; other values as they are, NaN for null."""
    if isinstance(value, dict):
        mean, low, high = (nan if value[key] is None else value[key] for key in ("mean", "low", "high"))
        return Estimate(mean, low, high, value["count"])
    return nan if value is None else value


def _rates_without_controller(assessment: dict[str, Any]) -> list[tuple[float, dict[str, Any]]]:
    """Return the penetration rates without a tested controller, with the quickest that was tried there."""
    judged = [each["share"] for each in assessment["judged"]]
    return [
        (share, min(tried, key=lambda each: each["effect"]["travel_time"].mean))
        for share in assessment["shares"]
        if share not in judged and (tried := [each for each in assessment["tried"] if each["share"] == share])
    ]


def _key_figures(assessment: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return label, value and detail of key figures: human baseline, and change by the recommended CAVs."""
    best = assessment["recommended"]
    effect = next((each["effect"] for each in assessment["judged"] if best and each["share"] == best["share"]), {})
    cards = []
    for field, metric, label, unit, digits in EFFECT_METRICS[:3]:
        mean = assessment["people"][metric]["mean"]
        detail = (
            f"{HUMAN_BASELINE_LABEL}; recommended: {format_difference(effect[field], digits)}"
            if effect
            else HUMAN_BASELINE_LABEL
        )
        cards.append((label, "–" if mean is None else f"{mean:.{digits}f} {unit}", detail))
    return cards


def _result_rows(assessment: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of the test seeds: the human baseline in absolute numbers, then differences to it."""
    judged = _evaluated_options(assessment)
    verdicts = ("no" if each.get("reasons") else "yes" if "reasons" in each else "–" for each in judged)
    beyond = (
        format_difference(each["difference_to_acc"], 1) if "difference_to_acc" in each else "–" for each in judged
    )
    rows: list[tuple[str, str, list[str]]] = [
        ("recommended", "", ["", *verdicts]),
        ("feasible", "", ["", *(each["effect"]["drivable"] or "–" for each in judged)]),
    ]
    for field, metric, label, unit, digits in EFFECT_METRICS:
        people = _parse_estimate(assessment["people"][metric])
        cells = [format_difference(each["effect"][field], digits) for each in judged]
        rows.append((label, unit, [estimate_cell(people, digits).mean, *cells]))
    relative = [
        f"{100 * each['effect']['travel_time'].mean / each['effect']['baseline_travel_time']:+.1f}" for each in judged
    ]
    rows.insert(3, ("travel time, relative to the human baseline", "%", ["", *relative]))
    rows.insert(4, ("travel time, compared with ACC vehicles", "s", ["", *beyond]))
    people = _parse_estimate(assessment["people"]["collisions"])
    more = [f"{each['effect']['collisions']:+.0f}" for each in judged]
    rows.append(("vehicles in collisions, all episodes", "", [f"{people.mean * people.count:.0f}", *more]))
    seeds = [assessment["seeds"]["judging"], *(each["effect"]["travel_time"].count for each in judged)]
    rows.append(("test seeds", "", [str(count) for count in seeds]))
    return [{"label": label, "unit": unit, "cells": cells} for label, unit, cells in rows]


def _evaluated_options(assessment: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what was tested: ACC vehicles and the controller of each penetration rate."""
    return sorted([*assessment["acc"], *assessment["judged"]], key=lambda each: each["share"])


def _tuning_row(option: dict[str, Any]) -> dict[str, Any]:
    """Return the row of an option on the tuning seeds."""
    effect = option["effect"]
    said = option["rejection_reasons"] or "chosen"
    return {
        "label": f"{format_percent(option['share'])}: {option['driver']}",
        "cells": [
            format_difference(effect["travel_time"], 1),
            format_difference(effect["flow"]),
            format_difference(effect["fuel"], 1),
            f"{effect['collisions']:.0f}",
            str(effect["travel_time"].count),
        ],
        "words": [effect["drivable"] or "–", said],
    }


@rc_context(PLOT_STYLE)
def effect_figure(assessment: dict[str, Any]) -> Figure:
    """Draw what each driver changes at each penetration rate, in per cent of the human baseline.

    Pale on tuning seeds, full on test seeds; a line is an interval. Above zero is longer, and more.
    """
    drivers = list(dict.fromkeys([*(each["driver"] for each in assessment["acc"]), *assessment["drivers"]]))
    shares = assessment["shares"]
    figure = new_figure(4.0)
    panels = figure.subplots(1, 2)
    kinds = (("travel_time", "baseline_travel_time", "travel time"), ("flow", "baseline_flow", "flow"))
    for axes, (field, people, label) in zip(panels, kinds, strict=True):
        axes.axhline(0, color=TEXT_COLOR, lw=0.9)
        for group, alpha in (("tried", 0.35), ("acc", 1.0), ("judged", 1.0)):
            for each in assessment[group]:
                number, effect = drivers.index(each["driver"]), each["effect"]
                place = shares.index(each["share"]) + 0.7 * ((number + 0.5) / len(drivers) - 0.5)
                scale = 100.0 / effect[people] if effect[people] else nan  # nobody left in so short a time
                place += 0.0 if group == "tried" else 0.06
                look = {"color": LINE_COLORS[(number + 1) % len(LINE_COLORS)], "alpha": alpha}
                axes.plot([place] * 2, [scale * effect[field].low, scale * effect[field].high], lw=1.6, **look)
                axes.plot(place, scale * effect[field].mean, "o", ms=4 if group == "tried" else 6, **look)
        axes.set_ylabel(f"{label} compared with human baseline [%]")
        axes.set_xticks(range(len(shares)), [format_percent(share) for share in shares])
        axes.set_xlim(-0.5, len(shares) - 0.5)
        axes.set_xlabel("penetration rate")
        axes.grid(False, axis="x")
    for number, name in enumerate(drivers):
        panels[0].plot([], [], "o-", color=LINE_COLORS[(number + 1) % len(LINE_COLORS)], label=name)
    figure.legend(loc="outside upper left", ncols=4)
    return figure
