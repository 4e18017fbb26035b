"""The report: one HTML page that works offline."""

import base64
import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from zlib import compress

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError
from markupsafe import Markup
from matplotlib.figure import Figure

from unjam import __version__
from unjam.files import INVALID_DATA_ERRORS, atomic_write, check_parent_folder
from unjam.measures.metric_table import HUMAN_LABEL, metric_table
from unjam.measures.statistics import Estimate, metric_estimate, paired_difference
from unjam.measures.verdict import short_table_metrics
from unjam.reports import figures, space_time, summary
from unjam.reports.model import error_figure, example_figure, model_section, rollout_figure, wave_figure
from unjam.reports.results import PlotEpisode, Results, damaged_results_error, original_command, read_results
from unjam.reports.summary import ReportColumn
from unjam.reports.video import split_lines
from unjam.scenarios.road import format_drawn_values
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.text import printable
from unjam.worlds.record import assign_columns

MAX_PANELS = 6  # maximum number of drivers in space-time diagrams and the replay
NamedResults = Sequence[tuple[str, Results]]
"""results of folders with the names of the folders"""
MAX_REPLAY_FRAMES = 600
"""maximum number of frames of a replay, which interpolates between frames"""
MAX_REPLAY_VALUES = 600_000
"""maximum of vehicles times frames of all drivers of a replay; about three megabytes"""
MAX_MERGE_DISTANCE = 50.0
"""maximum distance from a merge to the vehicle that marks its place in the plane [m]"""
REPLAY_NAN = 65535  # code of NaN in the arrays of a replay
WAVE_VARIANCE_RATIO = 0.9  # a replay starts when the variance of speeds reaches this ratio of its maximum
REPLAY_STEP = 0.5  # time between two frames of the replay [s]


def write_report_page(folders: Sequence[Path], target: Path) -> Path:
    """Write the report of one folder of results, or a comparison of several; return its path.

    Raise `InputError` if a folder contains no results, `DiskError` if the page cannot be written.
    """
    check_parent_folder(target)
    results = [read_results(folder) for folder in folders]
    try:
        page = render_report(results)
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(_damaged_folder(results), error) from error
    atomic_write(target, page)
    return target


def _damaged_folder(results: Sequence[Results]) -> Path:
    """Return the first folder for which a report cannot be rendered."""
    for result in results:
        try:
            render_report([result])
        except INVALID_DATA_ERRORS:
            return result.folder
    return results[0].folder


def render_template(template: str, **values: Any) -> str:
    """Return a page of the folder `page/` as `printable` text, with common style and script; values are escaped.

    Figures, JSON and `data:` addresses are inserted as they are: their texts must be printable before.
    """
    options: dict[str, Any] = {"undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=PackageLoader("unjam.reports", "page"), autoescape=True, **options)
    common = {"version": __version__, "style": _page_file("report.css"), "downloads": _page_file("downloads.js")}
    try:
        return printable(environment.get_template(template).render(**common, **values))
    except UndefinedError as error:  # damaged values have other types than the template expects
        raise AttributeError(str(error)) from error


def _page_file(name: str) -> Markup:
    return Markup((files("unjam.reports") / "page" / name).read_text(encoding="utf-8"))


def render_report(results: Sequence[Results]) -> str:
    """Return the report page as text."""
    columns = summary.report_columns(results)
    panels = [replace(column.episode, driver=column.name) for column in columns if column.episode is not None]
    panels = panels[:MAX_PANELS]
    replay_panels = [panel for panel in panels if panel.has_poses]
    single_result = results[0] if len(results) == 1 else None
    sources = list(zip(summary.folder_names(results), results, strict=True))
    counts = [len(column.rows) for column in columns]
    rows, baseline = {column.name: column.rows for column in columns}, summary.common_baseline(results)
    first_network = "" if baseline else summary.first_network_column(results)
    if first_network in rows:
        other_networks = {name for name in rows if name.endswith(f": {HUMAN_LABEL}")} - {first_network}
        columns = [
            summary.compare_networks(column, rows[first_network]) if column.name in other_networks else column
            for column in columns
        ]
    headings, table = metric_table(rows, baseline)
    drawn_values = (", ".join(format_drawn_values(episode.drawn_values)) for episode in panels)
    return render_template(
        "report.html",
        title=summary.report_title(results),
        single=single_result is not None,
        verdicts=[column.verdict for column in columns if column.verdict is not None],
        baseline_name=summary.name_baselines(results),
        first_network=first_network if first_network in rows else "",
        findings=[(name, finding) for name, result in sources if (finding := summary.main_finding(result))],
        warning=summary.mismatch_warning(results),
        command_differences=[] if single_result else summary.command_differences(results),
        notes=[(name, note) for name, result in sources for note in summary.report_notes(result)],
        cards=summary.key_figures(single_result) if single_result else [],
        figures={name: figures.data_uri(figure) for name, figure in _report_figures(sources, columns, panels).items()},
        panels=panels,
        space_time=[figures.data_uri(space_time.space_time_figure(panels, [panel])) for panel in panels],
        has_cavs=any(panel.controlled_columns for panel in panels),
        replay_panels=replay_panels,
        road_values=list(dict.fromkeys(drawn_values)),
        has_lane_maps=space_time.has_lane_maps(panels),
        baseline_differences=summary.baseline_differences(columns),
        episodes_csv=summary.episodes_as_csv(columns),
        model=model_section(single_result) if single_result else None,
        columns=columns,
        episode_counts=list(dict.fromkeys((min(counts), max(counts)))),
        headings=headings,
        short_table=metric_table(rows, "", short_table_metrics(rows)),
        baseline=baseline,
        table=table,
        sources=[(name, result, original_command(result)) for name, result in sources],
        script=_page_file("replay.js"),
        drivers_without_replay=[panel.driver for panel in panels if not panel.has_poses],
        replay_data=Markup(json.dumps(replay_data(replay_panels)).replace("<", "\\u003c")),
    )


def _report_figures(
    sources: NamedResults, columns: Sequence[ReportColumn], panels: Sequence[PlotEpisode]
) -> dict[str, Figure]:
    """Return the figures of the report for which there are data, by the name in the page."""
    report_figures: dict[str, Figure] = {}
    if panels:
        report_figures["time_series"] = figures.time_series_figure(panels)
    if any(panel.has_recorded_leader for panel in panels):
        report_figures["last_vehicle"] = figures.last_vehicle_figure(panels)
    if runs := {name: result.progress for name, result in sources if result.progress}:
        test_returns, reference = _test_returns(sources, columns)
        report_figures["learning_curve"] = figures.learning_curve_figure(
            runs, _expert_returns(sources), test_returns, reference
        )
    if len(sources) == 1 and sources[0][1].progress:
        progress, model = sources[0][1].progress, sources[0][1].model
        report_figures["training_time"] = figures.training_time_figure(progress)
        if model is not None and "waves" in model:
            report_figures["model_waves"] = wave_figure(model)
        elif model is not None:
            report_figures |= {"model_examples": example_figure(model), "model_errors": error_figure(model)}
            report_figures["model_rollouts"] = rollout_figure(progress, model)
    return report_figures


def _test_returns(sources: NamedResults, columns: Sequence[ReportColumn]) -> tuple[dict[str, Estimate], str]:
    """Return estimates of the return on test seeds by driver, and the label of a driver.

    For a single training, the estimates are differences to its expert, which is the driver of the label. They exclude
    human drivers, because their large difference would stretch the axis. Otherwise the label is empty.
    """
    rows = {column.name: column.rows for column in columns}
    expert = sources[0][1].metadata.get("expert", "")
    if len(sources) > 1 or expert not in rows:
        return {name: metric_estimate(driver_rows, "return") for name, driver_rows in rows.items()}, ""
    names = [name for name in rows if name not in (expert, HUMAN_LABEL)]
    return {name: paired_difference(rows[name], rows[expert], "return") for name in names}, expert


def _expert_returns(sources: NamedResults) -> dict[str, float]:
    """Return the validation return of each expert, which is the first point of the learning curve of its run."""
    returns: dict[str, float] = {}
    has_several_roads = len({result.metadata.get("scenario") for _, result in sources}) > 1
    for _, result in sources:
        if result.progress and (expert := result.metadata.get("expert", "none")) != "none":
            road = f" ({result.metadata.get('scenario')})" if has_several_roads else ""
            returns.setdefault(f"{figures.short_label(expert)}{road}", result.progress[0]["return_expert"])
    return returns


def replay_data(panels: Sequence[PlotEpisode]) -> dict[str, Any]:
    """Return the data for the replay on the page: positions and speeds, one frame for each `REPLAY_STEP` at most.

    With many vehicles there are fewer frames, to limit the size of the page.
    """
    if not panels:
        return {"drivers": []}
    duration = max(episode.times[-1] for episode in panels)
    vehicle_count = sum(int((~np.isnan(episode.speeds)).sum(axis=1).max()) for episode in panels)
    max_frames = min(MAX_REPLAY_FRAMES, max(1, MAX_REPLAY_VALUES // max(1, vehicle_count)))
    step = max(REPLAY_STEP, duration / max_frames, *(episode.control_step for episode in panels))
    frame_count = 1 + int(duration / step + 1e-9)
    platoon_length = max((-panel.lane_lines[:, 0].min() for panel in panels if panel.has_recorded_leader), default=0.0)
    scale = space_time.speed_scale(panels)
    tracks = ((printable(panel.driver), _replay_track(panel, step, frame_count, platoon_length)) for panel in panels)
    return {
        "step": step,
        "frames": frame_count,
        "start": round(_wave_time(panels[0]), 1),
        "min_speed": scale.vmin,
        "max_speed": scale.vmax,
        "colors": figures.speed_colors(),
        "vehicle_length": VEHICLE_LENGTH,
        "no_value": REPLAY_NAN,
        "drivers": [{"name": name, **track} for name, track in tracks],
    }


def _wave_time(episode: PlotEpisode) -> float:
    """Return the first time with a large wave [s]: the variance of speeds is near its maximum."""
    count = np.sum(~np.isnan(episode.speeds), axis=1)
    mean = np.nansum(episode.speeds, axis=1) / count.clip(1)
    variance = np.nansum((episode.speeds - mean[:, None]) ** 2, axis=1) / count.clip(1)
    return float(episode.times[(variance >= WAVE_VARIANCE_RATIO * variance.max()).argmax()])


def _replay_track(episode: PlotEpisode, step: float, frame_count: int, platoon_length: float) -> dict[str, Any]:
    """Return the positions and speeds of the vehicles, and the lines of the road.

    Positions are along the loop on a closed road, and in the plane on other roads. A line has rows (position along a
    loop, or 0 on other roads; x; y) [m]. After an early end the vehicles stand still. Behind a recorded vehicle, the
    line has the length of the longest platoon of all drivers, `platoon_length` [m].
    """
    snapshots = np.round(np.arange(frame_count) * step / episode.control_step).astype(int)
    snapshots = snapshots.clip(max=len(episode.speeds) - 1)
    speeds = episode.speeds[snapshots]
    if episode.is_closed:
        return {
            "vehicles": speeds.shape[1],
            "cavs": episode.controlled_columns,
            "loop_length": episode.loop_length,
            "speeds": [_encode_array(speeds)],
            "positions": [_encode_array(episode.positions[snapshots])],
            "lines": [np.round(episode.outline, 2).tolist()],
            "merges": [],
        }
    vehicles = np.flatnonzero(~np.isnan(speeds).all(axis=0))
    is_present, is_cav = ~np.isnan(speeds[:, vehicles]), np.isin(vehicles, episode.controlled_columns)
    first, last = is_present.argmax(axis=0), frame_count - 1 - is_present[::-1].argmax(axis=0)
    columns = assign_columns(first, last, is_cav.tolist())
    values = np.concatenate([episode.poses[snapshots], speeds[..., None]], axis=-1)
    packed = np.full((frame_count, int(columns.max(initial=-1)) + 1, 4), np.nan, np.float32)
    for vehicle, column, present in zip(vehicles, columns, is_present.T, strict=True):
        packed[present, column] = values[present, vehicle]
    lines = split_lines(episode.lane_lines)
    if episode.has_recorded_leader:
        lines = [np.array([[-platoon_length, 0.0], [0.0, 0.0]])]
    return {
        "vehicles": packed.shape[1],
        "cavs": np.unique(columns[is_cav]).tolist(),
        "loop_length": None,
        "speeds": [_encode_array(packed[..., 3])],
        "poses": [_encode_array(packed[..., axis]) for axis in range(3)],
        "lines": [np.column_stack([np.zeros(len(line)), line]).round(1).tolist() for line in lines],
        "merges": _merge_points(episode),
    }


def _merge_points(episode: PlotEpisode) -> list[list[float]]:
    """Return the points (x, y) where ramps join [m], from the vehicle that was nearest to each merge."""
    points = []
    for position in episode.merge_positions:
        distance = np.abs(episode.positions - position)
        if np.isfinite(distance).any() and np.nanmin(distance) <= MAX_MERGE_DISTANCE:
            nearest = np.unravel_index(np.nanargmin(distance), distance.shape)
            points.append(episode.poses[nearest][:2].round(1).tolist())
    return points


def _encode_array(array: np.ndarray) -> dict[str, Any]:
    """Return values of shape (frames, columns) in the compressed format of the page.

    Values are quantized to 65,534 steps of a range that has all values and zero (5 cm on three kilometers), and NaN
    becomes `REPLAY_NAN`. The differences of each frame to the previous frame, modulo 65,536, are compressed with zlib
    and encoded as base64.
    """
    low, high = float(np.nanmin(array, initial=0.0)), float(np.nanmax(array, initial=0.0))
    scale = (high - low) / (REPLAY_NAN - 1) or 1.0
    steps = np.where(np.isnan(array), REPLAY_NAN, np.round((array - low) / scale)).astype(np.int64)
    changes = np.diff(steps, axis=0, prepend=0).astype("<u2")
    return {"low": low, "scale": scale, "data": base64.b64encode(compress(changes.tobytes(), 9)).decode()}
