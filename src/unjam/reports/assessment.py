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
from unjam.files import check_folder, write_whole
from unjam.measures.effect import FLOW_LOST, LEAST_JUDGED, percent
from unjam.measures.statistics import Estimate, signed
from unjam.measures.table import cell_of
from unjam.reports.figures import INK, LINES, STYLE, data_uri, new_figure
from unjam.reports.html import filled, page_part
from unjam.reports.lanes import drawn_by_lane, space_time_of
from unjam.reports.results import command_to_repeat, read_results

ASSESSMENT_FILE, ASSESSMENT_PAGE = "assessment.json", "assessment.html"
EFFECTS = (
    ("travel_time", "travel_time", "travel time, waiting included", "s", 1),
    ("flow", "throughput_veh_per_h", "flow", "veh/h", 0),
    ("fuel", "fuel_ml_per_km", "fuel", "ml/km", 1),
    ("hard_braking", "people_beyond_4_5", "human drivers' braking beyond 4.5 m/s²", "per million", 0),
)
"""field of an effect, its metric, and how tables show the difference: name, unit, digits"""
ALONE = "human baseline"


def write_assessment(folder: Path, target: Path) -> Path:
    """Write the page of a folder of `unjam assess`; return its path.

    Raises:
        InputError: the folder holds no assessment.
        DiskError: the page cannot be written, or there is no folder for it.
    """
    check_folder(target)
    write_whole(target, render_assessment(folder))
    return target


def render_assessment(folder: Path) -> str:
    """Return the page as text."""
    path = folder / ASSESSMENT_FILE
    if not path.is_file():
        raise InputError(f"report: {str(folder)!r} has no {ASSESSMENT_FILE}")
    found, results = json.loads(path.read_text()), read_results(folder)
    judged, tried = found["judged"], found["tried"]
    for each in judged:
        each["beyond_acc"] = _estimate(each["beyond_acc"])
    for each in (*judged, *found["acc"], *tried):
        each["effect"] = {key: _estimate(value) for key, value in each["effect"].items()}
    panels = [replace(shown, driver=_named(shown.driver)) for shown in results.shown.values()]
    return filled(
        "assessment.html",
        found=found,
        without=_without(found),
        cards=_cards(found),
        columns=[ALONE, *(f"{percent(each['share'])}: {each['driver']}" for each in _columns(found))],
        table=_table(found),
        tried=[_tried(each) for each in tried],
        effects=data_uri(effects(found)),
        space_time=data_uri(space_time_of(panels)) if panels else "",
        panels=[panel.driver for panel in panels],
        by_lane=drawn_by_lane(panels),
        downloads=Markup(page_part("downloads.js")),
        percent=percent,
        named=breakable,
        most_lost=FLOW_LOST,
        least=LEAST_JUDGED,
        command=command_to_repeat(results),
    )


def breakable(text: str) -> Markup:
    """Return a name that may be broken after each of its signs: those of drivers are long."""
    return Markup("<wbr>").join(re.split(r"(?<=[:,=_])", text))


def _named(label: str) -> str:
    """Return what the page calls a driver: without CAVs it is the human baseline."""
    return ALONE if label == "human" else label


def _estimate(value: Any) -> Any:
    """Return what JSON says of an estimate as one; other values as they are, NaN for null."""
    if isinstance(value, dict):
        mean, low, high = (nan if value[key] is None else value[key] for key in ("mean", "low", "high"))
        return Estimate(mean, low, high, value["count"])
    return nan if value is None else value


def _without(found: dict[str, Any]) -> list[tuple[float, dict[str, Any]]]:
    """Return the penetration rates without a tested controller, with the quickest that was tried there."""
    judged = [each["share"] for each in found["judged"]]
    return [
        (share, min(tried, key=lambda each: each["effect"]["travel_time"].mean))
        for share in found["shares"]
        if share not in judged and (tried := [each for each in found["tried"] if each["share"] == share])
    ]


def _cards(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return label, value and detail of key figures: human baseline, and change by the recommended CAVs."""
    best = found["recommended"]
    effect = next((each["effect"] for each in found["judged"] if best and each["share"] == best["share"]), {})
    cards = []
    for field, metric, label, unit, digits in EFFECTS[:3]:
        mean = found["people"][metric]["mean"]
        detail = f"{ALONE}; recommended: {signed(effect[field], digits)}" if effect else ALONE
        cards.append((label, "–" if mean is None else f"{mean:.{digits}f} {unit}", detail))
    return cards


def _table(found: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of the test seeds: the human baseline in absolute numbers, then differences to it."""
    judged = _columns(found)
    verdicts = ("no" if each.get("reasons") else "yes" if "reasons" in each else "–" for each in judged)
    beyond = (signed(each["beyond_acc"], 1) if "beyond_acc" in each else "–" for each in judged)
    rows: list[tuple[str, str, list[str]]] = [
        ("recommended", "", ["", *verdicts]),
        ("feasible", "", ["", *(each["effect"]["drivable"] or "–" for each in judged)]),
    ]
    for field, metric, label, unit, digits in EFFECTS:
        people = _estimate(found["people"][metric])
        cells = [signed(each["effect"][field], digits) for each in judged]
        rows.append((label, unit, [cell_of(people, digits).mean, *cells]))
    relative = [
        f"{100 * each['effect']['travel_time'].mean / each['effect']['people_time']:+.1f}" for each in judged
    ]
    rows.insert(3, ("travel time, relative to the human baseline", "%", ["", *relative]))
    rows.insert(4, ("travel time, compared with ACC vehicles", "s", ["", *beyond]))
    people = _estimate(found["people"]["collisions"])
    more = [f"{each['effect']['collisions']:+.0f}" for each in judged]
    rows.append(("vehicles in collisions, all episodes", "", [f"{people.mean * people.count:.0f}", *more]))
    seeds = [found["seeds"]["judging"], *(each["effect"]["travel_time"].count for each in judged)]
    rows.append(("test seeds", "", [str(count) for count in seeds]))
    return [{"label": label, "unit": unit, "cells": cells} for label, unit, cells in rows]


def _columns(found: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what was tested: ACC vehicles and the controller of each penetration rate."""
    return sorted([*found["acc"], *found["judged"]], key=lambda each: each["share"])


def _tried(each: dict[str, Any]) -> dict[str, Any]:
    """Return the row of an option on the tuning seeds."""
    effect = each["effect"]
    said = each["set_aside"] or "chosen"
    return {
        "label": f"{percent(each['share'])}: {each['driver']}",
        "cells": [
            signed(effect["travel_time"], 1),
            signed(effect["flow"]),
            signed(effect["fuel"], 1),
            f"{effect['collisions']:.0f}",
            str(effect["travel_time"].count),
        ],
        "words": [effect["drivable"] or "–", said],
    }


@rc_context(STYLE)
def effects(found: dict[str, Any]) -> Figure:
    """Draw what each driver changes at each penetration rate, in per cent of the human baseline.

    Pale on tuning seeds, full on test seeds; a line is an interval. Above zero is longer, and more.
    """
    drivers = list(dict.fromkeys([*(each["driver"] for each in found["acc"]), *found["drivers"]]))
    shares = found["shares"]
    figure = new_figure(4.0)
    panels = figure.subplots(1, 2)
    kinds = (("travel_time", "people_time", "travel time"), ("flow", "people_flow", "flow"))
    for axes, (field, people, label) in zip(panels, kinds, strict=True):
        axes.axhline(0, color=INK, lw=0.9)
        for group, alpha in (("tried", 0.35), ("acc", 1.0), ("judged", 1.0)):
            for each in found[group]:
                number, effect = drivers.index(each["driver"]), each["effect"]
                place = shares.index(each["share"]) + 0.7 * ((number + 0.5) / len(drivers) - 0.5)
                scale = 100.0 / effect[people] if effect[people] else nan  # nobody left in so short a time
                place += 0.0 if group == "tried" else 0.06
                look = {"color": LINES[(number + 1) % len(LINES)], "alpha": alpha}
                axes.plot(
                    [place] * 2, [scale * effect[field].low, scale * effect[field].high], lw=1.6, **look
                )
                axes.plot(place, scale * effect[field].mean, "o", ms=4 if group == "tried" else 6, **look)
        axes.set_ylabel(f"{label} compared with human baseline [%]")
        axes.set_xticks(range(len(shares)), [percent(share) for share in shares])
        axes.set_xlim(-0.5, len(shares) - 0.5)
        axes.set_xlabel("penetration rate")
        axes.grid(False, axis="x")
    for number, name in enumerate(drivers):
        panels[0].plot([], [], "o-", color=LINES[(number + 1) % len(LINES)], label=name)
    figure.legend(loc="outside upper left", ncols=4)
    return figure
