"""The report: one HTML page with everything in it, no network needed."""

import base64
import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from zlib import compress

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from unjam import __version__
from unjam.files import DAMAGED, check_folder, write_whole
from unjam.measures.statistics import estimate_of
from unjam.measures.table import headings_of, table_of
from unjam.reports.figures import (
    colour_table,
    data_uri,
    learning_curve,
    over_time,
    short,
    speed_scale,
    time_split,
)
from unjam.reports.film import split_lines
from unjam.reports.lanes import drawn_by_lane, space_time_of
from unjam.reports.model import errors, examples, model_section, trust, waves
from unjam.reports.results import Results, Shown, command_to_repeat, damaged, read_results
from unjam.reports.story import (
    against_people,
    baseline_of_columns,
    cards_of,
    columns_of,
    episodes_as_csv,
    lead_of,
    names_of,
    notes_of,
    title_of,
)
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.record import shared_columns

MOST_PANELS = 6
MOST_FRAMES = 600
"""of a replay: between two, vehicles go straight on"""
MOST_CELLS = 600_000
"""vehicles times frames of a replay's drivers together: some three megabytes"""
NO_VALUE = 65535
"""stands for NaN among the numbers of a replay"""
REPLAY_SECONDS = 0.5
"""time between two frames of the replay [s]"""


def write_report(folders: Sequence[Path], target: Path) -> Path:
    """Write the report of one folder of results, or a comparison of several; return its path.

    Raises:
        InputError: a folder holds no results.
        DiskError: the page cannot be written, or there is no folder for it.
    """
    check_folder(target)
    results = [read_results(folder) for folder in folders]
    try:
        page = render(results)
    except DAMAGED as error:
        raise damaged(_damaged_of(folders, results), error) from error
    write_whole(target, page)
    return target


def _damaged_of(folders: Sequence[Path], results: Sequence[Results]) -> Path:
    """Return the first folder whose results cannot be shown alone."""
    for folder, found in zip(folders, results, strict=True):
        try:
            render([found])
        except DAMAGED:
            return folder
    return folders[0]


def filled(template: str, **values: Any) -> str:
    """Return a page of the folder `page/`, with the style of all, as text: what `values` say is escaped."""
    loader = PackageLoader("unjam.reports", "page")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    style = Markup(page_part("report.css"))
    return environment.get_template(template).render(version=__version__, style=style, **values)


def page_part(name: str) -> str:
    """Return a file of the folder `page/`."""
    return (files("unjam.reports") / "page" / name).read_text(encoding="utf-8")


def render(results: Sequence[Results]) -> str:
    """Return the page as text."""
    columns = columns_of(results)
    panels = [replace(column.shown, driver=column.name) for column in columns if column.shown is not None]
    panels = panels[:MOST_PANELS]
    single = results[0] if len(results) == 1 else None
    sources = list(zip(names_of(results), results, strict=True))
    counts = [len(column.rows) for column in columns]
    rows, baseline = {column.name: column.rows for column in columns}, baseline_of_columns(results)
    drawn = [", ".join(f"{key} {value:g} m" for key, value in episode.drawn.items()) for episode in panels]
    return filled(
        "report.html",
        title=title_of(results),
        single=single is not None,
        leads=[(name, lead_of(result)) for name, result in sources],
        notes=[(name, note) for name, result in sources for note in notes_of(result)],
        cards=cards_of(single) if single else [],
        pictures={name: data_uri(figure) for name, figure in _pictures(results, panels).items()},
        panels=panels,
        drawn=list(dict.fromkeys(drawn)),
        by_lane=drawn_by_lane(panels),
        against=against_people(columns),
        episodes_csv=episodes_as_csv(columns),
        downloads=Markup(page_part("downloads.js")),
        model=model_section(single) if single else None,
        columns=columns,
        episodes=list(dict.fromkeys((min(counts), max(counts)))),
        headings=headings_of(rows, baseline),
        baseline=baseline,
        table=table_of(rows, baseline),
        sources=[(name, result, command_to_repeat(result)) for name, result in sources],
        script=Markup(page_part("replay.js")),
        replay_data=Markup(json.dumps(replay_data(panels)).replace("<", "\\u003c")),
    )


def _pictures(results: Sequence[Results], panels: Sequence[Shown]) -> dict[str, Figure]:
    """Return the pictures that there are, by name."""
    pictures: dict[str, Figure] = {}
    if panels:
        pictures |= {"space_time": space_time_of(panels), "over_time": over_time(panels)}
    named = zip(names_of(results), results, strict=True)
    runs = {name: result.progress for name, result in named if result.progress}
    if runs:
        pictures["learning_curve"] = learning_curve(runs, _references(results))
    if len(results) == 1 and results[0].progress:
        progress, model = results[0].progress, results[0].model
        pictures["time_split"] = time_split(progress)
        if model is not None and "waves" in model:
            pictures["model_waves"] = waves(model)
        elif model is not None:
            pictures["model_examples"] = examples(model)
            pictures["model_errors"] = errors(model)
            pictures["model_trust"] = trust(progress, model)
    return pictures


def _references(results: Sequence[Results]) -> dict[str, float]:
    """Return the returns of drivers that do not learn.

    The expert's is that on the validation seeds, from which the curve starts; the others were never driven
    there, and have those of the held-out seeds.
    """
    found: dict[str, float] = {}
    several = len({result.about.get("scenario") for result in results}) > 1
    for result in results:
        expert = result.about.get("expert", "none")
        where = f" ({result.about.get('scenario')})" if several else ""
        if result.progress and expert != "none":
            found.setdefault(f"{short(expert)}, validation{where}", result.progress[0]["return_expert"])
        for label, rows in result.rows.items():
            if label not in (result.trained, expert):
                found.setdefault(f"{short(label)}, held-out{where}", estimate_of(rows, "return").mean)
    return found


def replay_data(panels: Sequence[Shown]) -> dict[str, Any]:
    """Return what the page's replay needs: positions and speeds at a few frames a second.

    Of a crowd there are fewer frames, for the page has to be sent.
    """
    if not panels:
        return {"drivers": []}
    longest = max(episode.times[-1] for episode in panels)
    crowd = sum(int((~np.isnan(episode.speeds)).sum(axis=1).max()) for episode in panels)
    most = min(MOST_FRAMES, max(1, MOST_CELLS // max(1, crowd)))
    step = max(REPLAY_SECONDS, longest / most, *(episode.step for episode in panels))
    frames = 1 + int(longest / step + 1e-9)
    return {
        "step": step,
        "frames": frames,
        "start": 0,
        "fastest": speed_scale(panels).vmax,
        "colours": colour_table(),
        "vehicle_length": VEHICLE_LENGTH,
        "no_value": NO_VALUE,
        "drivers": [{"name": episode.driver, **_replayed(episode, step, frames)} for episode in panels],
    }


def _replayed(episode: Shown, step: float, frames: int) -> dict[str, Any]:
    """Return where the vehicles are and how fast, along a loop or on the plane, and the road's lines.

    A line is rows (coordinate along the road, x, y) [m]. An episode that ended before stays as at its end.
    """
    moments = np.round(np.arange(frames) * step / episode.step).astype(int)
    moments = moments.clip(max=len(episode.speeds) - 1)
    speeds = episode.speeds[moments]
    if episode.closed:
        return {
            "vehicles": speeds.shape[1],
            "cavs": episode.cavs,
            "loop_length": episode.loop_length,
            "speeds": [_squeezed(speeds)],
            "positions": [_squeezed(episode.positions[moments])],
            "lines": [np.round(episode.outline, 2).tolist()],
        }
    vehicles = np.flatnonzero(~np.isnan(speeds).all(axis=0))
    there, is_cav = ~np.isnan(speeds[:, vehicles]), np.isin(vehicles, episode.cavs)
    first, last = there.argmax(axis=0), frames - 1 - there[::-1].argmax(axis=0)
    columns = shared_columns(first, last, is_cav.tolist())
    values = np.concatenate([episode.places[moments], speeds[..., None]], axis=-1)
    packed = np.full((frames, int(columns.max(initial=-1)) + 1, 4), np.nan, np.float32)
    for vehicle, column, present in zip(vehicles, columns, there.T, strict=True):
        packed[present, column] = values[present, vehicle]
    lines = split_lines(episode.lines)
    return {
        "vehicles": packed.shape[1],
        "cavs": np.unique(columns[is_cav]).tolist(),
        "loop_length": None,
        "speeds": [_squeezed(packed[..., 3])],
        "places": [_squeezed(packed[..., axis]) for axis in range(3)],
        "lines": [np.column_stack([np.zeros(len(line)), line]).round(1).tolist() for line in lines],
    }


def _squeezed(array: np.ndarray) -> dict[str, Any]:
    """Return values of shape (frames, columns) for the page: a twentieth of what they take in memory.

    They are 65,534 steps from the lowest to the highest, `NO_VALUE` for NaN; each frame is the difference to
    the one before, modulo 65,536, in zlib's format, as base64. On three kilometres a step is 5 cm.
    """
    low, high = (float(end(array, initial=0.0)) for end in (np.nanmin, np.nanmax))
    scale = (high - low) / (NO_VALUE - 1) or 1.0
    steps = np.where(np.isnan(array), NO_VALUE, np.round((array - low) / scale)).astype(np.int64)
    changes = np.diff(steps, axis=0, prepend=0).astype("<u2")
    return {"low": low, "scale": scale, "data": base64.b64encode(compress(changes.tobytes(), 9)).decode()}
