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
from unjam.files import INVALID_DATA_ERRORS, atomic_write, check_parent_folder
from unjam.measures.metric_table import metric_table, table_headings
from unjam.measures.statistics import metric_estimate
from unjam.reports.figures import (
    color_table,
    data_uri,
    learning_curve_figure,
    short_label,
    speed_scale,
    time_series_figure,
    training_time_figure,
)
from unjam.reports.lanes import has_lane_maps, space_time_figure
from unjam.reports.model import error_figure, example_figure, model_section, rollout_figure, wave_figure
from unjam.reports.results import PlotEpisode, Results, damaged_results_error, original_command, read_results
from unjam.reports.summary import (
    baseline_differences,
    common_baseline,
    episodes_as_csv,
    folder_names,
    key_figures,
    main_finding,
    report_columns,
    report_notes,
    report_title,
)
from unjam.reports.video import split_lines
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.record import assign_columns

MAX_PANELS = 6
MAX_REPLAY_FRAMES = 600
"""of a replay: between two, vehicles go straight on"""
MAX_REPLAY_VALUES = 600_000
"""vehicles times frames of a replay's drivers together: some three megabytes"""
REPLAY_NAN = 65535
"""stands for NaN among the numbers of a replay"""
REPLAY_STEP = 0.5
"""time between two frames of the replay [s]"""


def write_report_page(folders: Sequence[Path], target: Path) -> Path:
    """Write the report of one folder of results, or a comparison of several; return its path.

    Raises:
        InputError: a folder holds no results.
        DiskError: the page cannot be written, or there is no folder for it.
    """
    check_parent_folder(target)
    results = [read_results(folder) for folder in folders]
    try:
        page = render_report(results)
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(_damaged_folder(folders, results), error) from error
    atomic_write(target, page)
    return target


def _damaged_folder(folders: Sequence[Path], results: Sequence[Results]) -> Path:
    """Return the first folder whose results cannot be shown alone."""
    for folder, found in zip(folders, results, strict=True):
        try:
            render_report([found])
        except INVALID_DATA_ERRORS:
            return folder
    return folders[0]


def render_template(template: str, **values: Any) -> str:
    """Return a page of the folder `page/`, with the style of all, as text: what `values` say is escaped."""
    loader = PackageLoader("unjam.reports", "page")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    style = Markup(read_page_file("report.css"))
    return environment.get_template(template).render(version=__version__, style=style, **values)


def read_page_file(name: str) -> str:
    """Return a file of the folder `page/`."""
    return (files("unjam.reports") / "page" / name).read_text(encoding="utf-8")


def render_report(results: Sequence[Results]) -> str:
    """Return the page as text."""
    columns = report_columns(results)
    panels = [replace(column.episode, driver=column.name) for column in columns if column.episode is not None]
    panels = panels[:MAX_PANELS]
    single = results[0] if len(results) == 1 else None
    sources = list(zip(folder_names(results), results, strict=True))
    counts = [len(column.rows) for column in columns]
    rows, baseline = {column.name: column.rows for column in columns}, common_baseline(results)
    drawn = [", ".join(f"{key} {value:g} m" for key, value in episode.drawn_values.items()) for episode in panels]
    return render_template(
        "report.html",
        title=report_title(results),
        single=single is not None,
        leads=[(name, main_finding(result)) for name, result in sources],
        notes=[(name, note) for name, result in sources for note in report_notes(result)],
        cards=key_figures(single) if single else [],
        pictures={name: data_uri(figure) for name, figure in _report_figures(results, panels).items()},
        panels=panels,
        drawn=list(dict.fromkeys(drawn)),
        by_lane=has_lane_maps(panels),
        against=baseline_differences(columns),
        episodes_csv=episodes_as_csv(columns),
        downloads=Markup(read_page_file("downloads.js")),
        model=model_section(single) if single else None,
        columns=columns,
        episodes=list(dict.fromkeys((min(counts), max(counts)))),
        headings=table_headings(rows, baseline),
        baseline=baseline,
        table=metric_table(rows, baseline),
        sources=[(name, result, original_command(result)) for name, result in sources],
        script=Markup(read_page_file("replay.js")),
        replay_data=Markup(json.dumps(replay_data(panels)).replace("<", "\\u003c")),
    )


def _report_figures(results: Sequence[Results], panels: Sequence[PlotEpisode]) -> dict[str, Figure]:
    """Return the pictures that there are, by name."""
    pictures: dict[str, Figure] = {}
    if panels:
        pictures |= {"trajectory_figure": space_time_figure(panels), "time_series_figure": time_series_figure(panels)}
    named = zip(folder_names(results), results, strict=True)
    runs = {name: result.progress for name, result in named if result.progress}
    if runs:
        pictures["learning_curve_figure"] = learning_curve_figure(runs, _reference_returns(results))
    if len(results) == 1 and results[0].progress:
        progress, model = results[0].progress, results[0].model
        pictures["training_time_figure"] = training_time_figure(progress)
        if model is not None and "waves" in model:
            pictures["model_waves"] = wave_figure(model)
        elif model is not None:
            pictures["model_examples"] = example_figure(model)
            pictures["transition_model_errors"] = error_figure(model)
            pictures["model_trust"] = rollout_figure(progress, model)
    return pictures


def _reference_returns(results: Sequence[Results]) -> dict[str, float]:
    """Return the returns of drivers that do not learn.

    The expert's is that on the validation seeds, from which the curve starts; the others were never driven
    there, and have those of the held-out seeds.
    """
    found: dict[str, float] = {}
    several = len({result.metadata.get("scenario") for result in results}) > 1
    for result in results:
        expert = result.metadata.get("expert", "none")
        where = f" ({result.metadata.get('scenario')})" if several else ""
        if result.progress and expert != "none":
            found.setdefault(f"{short_label(expert)}, validation{where}", result.progress[0]["return_expert"])
        for label, rows in result.rows.items():
            if label not in (result.trained_label, expert):
                found.setdefault(f"{short_label(label)}, held-out{where}", metric_estimate(rows, "return").mean)
    return found


def replay_data(panels: Sequence[PlotEpisode]) -> dict[str, Any]:
    """Return what the page's replay needs: positions and speeds at a few frames a second.

    Of a crowd there are fewer frames, for the page has to be sent.
    """
    if not panels:
        return {"drivers": []}
    longest = max(episode.times[-1] for episode in panels)
    crowd = sum(int((~np.isnan(episode.speeds)).sum(axis=1).max()) for episode in panels)
    most = min(MAX_REPLAY_FRAMES, max(1, MAX_REPLAY_VALUES // max(1, crowd)))
    step = max(REPLAY_STEP, longest / most, *(episode.control_step for episode in panels))
    frames = 1 + int(longest / step + 1e-9)
    return {
        "step": step,
        "frames": frames,
        "start": 0,
        "fastest": speed_scale(panels).vmax,
        "colours": color_table(),
        "vehicle_length": VEHICLE_LENGTH,
        "no_value": REPLAY_NAN,
        "drivers": [{"name": episode.driver, **_replay_track(episode, step, frames)} for episode in panels],
    }


def _replay_track(episode: PlotEpisode, step: float, frames: int) -> dict[str, Any]:
    """Return where the vehicles are and how fast, along a loop or on the plane, and the road's lines.

    A line is rows (coordinate along the road, x, y) [m]. An episode that ended before stays as at its end.
    """
    moments = np.round(np.arange(frames) * step / episode.control_step).astype(int)
    moments = moments.clip(max=len(episode.speeds) - 1)
    speeds = episode.speeds[moments]
    if episode.is_closed:
        return {
            "vehicles": speeds.shape[1],
            "cavs": episode.cav_columns,
            "loop_length": episode.loop_length,
            "speeds": [_encode_array(speeds)],
            "positions": [_encode_array(episode.positions[moments])],
            "lines": [np.round(episode.outline, 2).tolist()],
        }
    vehicles = np.flatnonzero(~np.isnan(speeds).all(axis=0))
    there, is_cav = ~np.isnan(speeds[:, vehicles]), np.isin(vehicles, episode.cav_columns)
    first, last = there.argmax(axis=0), frames - 1 - there[::-1].argmax(axis=0)
    columns = assign_columns(first, last, is_cav.tolist())
    values = np.concatenate([episode.poses[moments], speeds[..., None]], axis=-1)
    packed = np.full((frames, int(columns.max(initial=-1)) + 1, 4), np.nan, np.float32)
    for vehicle, column, present in zip(vehicles, columns, there.T, strict=True):
        packed[present, column] = values[present, vehicle]
    lines = split_lines(episode.lane_lines)
    return {
        "vehicles": packed.shape[1],
        "cavs": np.unique(columns[is_cav]).tolist(),
        "loop_length": None,
        "speeds": [_encode_array(packed[..., 3])],
        "places": [_encode_array(packed[..., axis]) for axis in range(3)],
        "lines": [np.column_stack([np.zeros(len(line)), line]).round(1).tolist() for line in lines],
    }


def _encode_array(array: np.ndarray) -> dict[str, Any]:
    """Return values of shape (frames, columns) for the page: a twentieth of what they take in memory.

    They are 65,534 steps from the lowest to the highest, `REPLAY_NAN` for NaN; each frame is the difference to
    the one before, modulo 65,536, in zlib's format, as base64. On three kilometres a step is 5 cm.
    """
    low, high = (float(end(array, initial=0.0)) for end in (np.nanmin, np.nanmax))
    scale = (high - low) / (REPLAY_NAN - 1) or 1.0
    steps = np.where(np.isnan(array), REPLAY_NAN, np.round((array - low) / scale)).astype(np.int64)
    changes = np.diff(steps, axis=0, prepend=0).astype("<u2")
    return {"low": low, "scale": scale, "data": base64.b64encode(compress(changes.tobytes(), 9)).decode()}
