import base64
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from IPython.core.formatters import DisplayFormatter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image

from tests.reports.open_roads import merge_episode, plot_episode_of, user_episode
from unjam.measures.statistics import estimate
from unjam.reports.figures import (
    CAV_PLOT_COLOR,
    LINE_COLORS,
    MAX_PLOT_TIMES,
    data_uri,
    last_vehicle_figure,
    learning_curve_figure,
    png_bytes,
    speed_colors,
    svg_bytes,
    time_series_figure,
    training_time_figure,
)
from unjam.reports.results import PlotEpisode
from unjam.reports.space_time import speed_field, speed_scale, trajectory_figure
from unjam.text import printable

LENGTH = 120.0


def make_episode(
    driver: str = "pi", speed: float = 4.0, steps: int = 300, vehicles: int = 5, **changes: Any
) -> PlotEpisode:
    """Vehicles on a ring at about `speed`, increasing with time and with the number of the vehicle."""
    speeds = speed + np.linspace(0, 1, steps + 1)[:, None] + 0.1 * np.arange(vehicles)
    positions = np.arange(vehicles) * LENGTH / vehicles + np.cumsum(speeds, axis=0) * 0.1
    angles = np.linspace(0, 2 * np.pi, 41)
    radius = LENGTH / (2 * np.pi)
    values: dict[str, Any] = {
        "control_step": 0.1,
        "loop_length": LENGTH,
        "crossings": [],
        "limit_speed": 6.5,
        "drawn_values": {"length": LENGTH},
        "vehicle_ids": [f"human_{n}" for n in range(vehicles - 1)] + ["cav_0"],
        "cav_ids": ["cav_0"],
        "speeds": speeds.astype(np.float32),
        "positions": positions.astype(np.float32),
        "gaps": np.full_like(speeds, 7.5, np.float32) + np.arange(vehicles, dtype=np.float32),
        "outline": np.column_stack([angles * radius, radius * np.cos(angles), radius * np.sin(angles)]),
        "branches": [],
        "backlog": np.zeros(0, np.float32),
        "lane_lines": np.zeros((0, 2), np.float32),
        "poses": np.zeros((0, 0, 3), np.float32),
    }
    return PlotEpisode(driver=driver, **{**values, **changes})


def panels_of(figure: Figure) -> list[Axes]:
    """Return the visible panels, without the color bar."""
    return [axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<colorbar>"]


def lines_of(axes: Axes) -> list[LineCollection]:
    return [collection for collection in axes.collections if isinstance(collection, LineCollection)]


def fields_of(axes: Axes) -> list[QuadMesh]:
    return [collection for collection in axes.collections if isinstance(collection, QuadMesh)]


def drawn_lines(axes: Axes) -> list[Line2D]:
    """Return the lines of a panel, without those for the legend only."""
    return [line for line in axes.lines if len(np.asarray(line.get_xdata()))]


def behind_recording(driver: str, scale: float, base: float = 20.0) -> PlotEpisode:
    """A platoon of two vehicles whose last one has `scale` times the wave of the recorded vehicle."""
    wave = np.sin(2.0 * np.pi * np.arange(601) / 300.0)[:, None]
    speeds, recorded = base + wave * [scale, 1.0], base + 2.0 * wave
    positions, ahead = np.cumsum(speeds, axis=0) * 0.1 + [0.0, 30.0], np.cumsum(recorded, axis=0) * 0.1 + 60.0
    road: dict[str, Any] = {"outline": np.zeros((0, 3)), "loop_length": float("nan"), "limit_speed": float("nan")}
    road |= {"lane_lines": np.array([[-60.0, 0.0], [0.0, 0.0]]), "poses": np.zeros((601, 2, 3))}
    motion: dict[str, Any] = {
        "speeds": speeds,
        "positions": positions,
        "replayed_motion": np.stack([ahead, recorded], -1),
    }
    return make_episode(driver, vehicles=2, steps=600, **road, **motion)


def drivers(count: int) -> list[PlotEpisode]:
    return [make_episode(f"driver {number}", 2.0 + number) for number in range(count)]


@pytest.mark.parametrize("count", [1, 4, 6, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3, 5))])
def test_trajectory_figure_has_a_panel_for_each_driver(count: int) -> None:
    panels = panels_of(trajectory_figure(drivers(count)))
    assert [axes.get_title(loc="left") for axes in panels] == [f"driver {number}" for number in range(count)]


def test_trajectory_figure_of_three_drivers_has_one_row() -> None:
    figure = trajectory_figure(drivers(3))
    figure.draw_without_rendering()
    boxes = [axes.get_position() for axes in panels_of(figure)]
    assert len({round(box.y0, 3) for box in boxes}) == 1
    assert boxes[0].x0 < boxes[1].x0 < boxes[2].x0


@pytest.mark.parametrize("shown", [slice(0), slice(1, 2)])
def test_all_panels_have_one_scale_of_speed(shown: slice) -> None:
    episodes = drivers(3)
    fields = [field for axes in panels_of(trajectory_figure(episodes, episodes[shown])) for field in fields_of(axes)]
    assert len(fields) == (len(episodes[shown]) or 3)
    vmax = speed_scale(episodes).vmax
    assert {(field.norm.vmin, field.norm.vmax) for field in fields} == {(0.0, vmax)}


def test_speed_scale_starts_at_zero_and_is_never_empty() -> None:
    assert (speed_scale(drivers(2)).vmin, speed_scale(drivers(2)).vmax) == (0.0, 5.0)
    standing = make_episode(speeds=np.zeros((10, 5), np.float32))
    assert speed_scale([standing]).vmax == 1.0
    absent = make_episode(speeds=np.array([[2.5, np.nan]], np.float32))
    assert speed_scale([absent]).vmax == 3.0
    assert speed_scale([make_episode(speeds=np.full((10, 5), np.nan, np.float32))]).vmax == 1.0


def test_speed_scale_behind_recordings_starts_at_the_smallest_speed_of_all_panels() -> None:
    panels = [behind_recording("human", 2.0), behind_recording("pi", 1.0), behind_recording("acc", 1.0, 25.0)]
    assert (speed_scale(panels[:2]).vmin, speed_scale(panels[2:]).vmin) == (18.0, 23.0)
    fields = [field for axes in panels_of(trajectory_figure(panels)) for field in fields_of(axes)]
    assert {field.norm.vmin for field in fields} == {18.0}
    assert speed_scale([*panels, make_episode()]).vmin == 0.0


def test_a_few_fast_vehicles_do_not_stretch_the_speed_scale() -> None:
    speeds = np.full((100, 20), 8.0, np.float32)
    speeds[:10, 0] = 40.0
    assert speed_scale([make_episode(speeds=speeds), make_episode()]).vmax == 8.0


def test_speed_field_interpolates_between_vehicles() -> None:
    positions, speeds = np.array([[10.0, 30.0]]), np.array([[2.0, 4.0]])
    found = speed_field(positions, speeds, np.array([10.0, 15.0, 20.0, 30.0]), 0.0)
    assert found[:, 0].tolist() == [2.0, 2.5, 3.0, 4.0]


def test_speed_field_of_a_ring_is_continuous_at_its_seam() -> None:
    positions, speeds = np.array([[95.0, 5.0]]), np.array([[2.0, 4.0]])
    found = speed_field(positions, speeds, np.array([0.0, 97.5, 100.0]), 100.0)
    assert found[:, 0].tolist() == [3.0, 2.5, 3.0]


def test_speed_field_is_nan_far_from_vehicles() -> None:
    positions, speeds = np.array([[0.0, 400.0], [np.nan, np.nan]]), np.array([[5.0, 5.0], [np.nan, np.nan]])
    found = speed_field(positions, speeds, np.array([0.0, 16.0, 200.0, 400.0]), 0.0)
    assert np.isnan(found).tolist() == [[False, True], [False, True], [True, True], [False, True]]


def test_speed_field_of_a_full_ring_has_no_gaps() -> None:
    [panel] = panels_of(trajectory_figure([make_episode(vehicles=8)]))
    [field] = fields_of(panel)
    speeds = field.get_array()
    assert speeds is not None
    assert not np.ma.getmaskarray(speeds).any()


@pytest.mark.parametrize("steps", [300, 5000])
def test_trajectories_have_no_line_across_the_seam_of_the_ring(steps: int) -> None:
    [panel] = panels_of(trajectory_figure([make_episode(steps=steps, speed=6.0)]))
    for lines in lines_of(panel):
        segments = np.array(lines.get_segments())
        assert np.abs(np.diff(segments[:, :, 1], axis=1)).max() < LENGTH / 2
        assert segments[:, :, 1].min() >= 0
        assert segments[:, :, 1].max() <= LENGTH
    [still] = panels_of(trajectory_figure([make_episode(steps=steps, speed=0.0)]))
    assert len(segments_of(panel)) < len(segments_of(still)), "vehicles crossed the seam"


def test_only_the_cav_is_marked() -> None:
    episode = make_episode(vehicles=6)
    [panel] = panels_of(trajectory_figure([episode]))
    marks = marks_of(panel)
    assert marks[0, 0, 1] == pytest.approx(episode.positions[0, 5] % LENGTH, abs=1e-3)
    assert len(marks) == steps_within_seam(episode)[5]
    assert len(segments_of(panel)) == steps_within_seam(episode).sum()


def test_every_cav_is_marked() -> None:
    episode = make_episode(cav_ids=["human_0", "cav_0"])
    [panel] = panels_of(trajectory_figure([episode]))
    assert len(episode.cav_columns) == 2
    assert len(marks_of(panel)) == steps_within_seam(episode)[list(episode.cav_columns)].sum()


def test_only_long_episodes_are_thinned_out() -> None:
    def points(steps: int) -> int:
        [panel] = panels_of(trajectory_figure([make_episode(steps=steps, speed=0.0, vehicles=2)]))
        return len(lines_of(panel)[0].get_segments())

    assert points(50) == 50
    assert MAX_PLOT_TIMES * 0.9 < points(6000) < MAX_PLOT_TIMES * 2


def test_trajectory_figure_covers_the_episode_and_the_ring() -> None:
    [panel] = panels_of(trajectory_figure([make_episode(steps=300)]))
    assert panel.get_xlim() == pytest.approx((0, 30))
    assert panel.get_ylim() == pytest.approx((0, LENGTH))


def test_trajectory_figure_covers_episodes_of_different_length() -> None:
    for episodes in (
        [make_episode(), make_episode("crashed", steps=50)],
        [make_episode("crashed", steps=50), make_episode()],
    ):
        panels = panels_of(trajectory_figure(episodes))
        assert all(panel.get_xlim() == pytest.approx((0, 30)) for panel in panels)


def test_trajectory_figure_covers_rings_of_different_length() -> None:
    for episodes in (
        [make_episode(), make_episode(loop_length=90.0)],
        [make_episode(loop_length=90.0), make_episode()],
    ):
        panels = panels_of(trajectory_figure(episodes))
        assert all(panel.get_ylim() == pytest.approx((0, LENGTH)) for panel in panels)


def test_time_series_have_a_line_of_each_driver_in_each_panel() -> None:
    episodes = drivers(3)
    panels = [drawn_lines(axes) for axes in panels_of(time_series_figure(episodes))]
    for number, episode in enumerate(episodes):
        cav = episode.cav_columns[0]
        expected = (episode.speeds[:, cav], episode.gaps[:, cav], episode.speeds.std(axis=1))
        for lines, values in zip(panels, expected, strict=True):
            np.testing.assert_allclose(np.asarray(lines[number].get_ydata()), values, rtol=1e-4)
            assert lines[number].get_color() == LINE_COLORS[number]


def test_time_series_of_human_drivers_alone_are_those_of_all_vehicles() -> None:
    humans = replace(make_episode(), driver="human")
    mean, waves = panels_of(time_series_figure([humans]))
    assert (mean.get_ylabel(), waves.get_ylabel()) == ("mean speed [m/s]", "speed std across\nvehicles [m/s]")
    np.testing.assert_allclose(np.asarray(mean.lines[0].get_ydata()), humans.speeds.mean(axis=1), rtol=1e-4)
    assert len(panels_of(time_series_figure([humans, make_episode()]))) == 3


def test_time_series_have_drivers_and_limit_in_the_legend() -> None:
    figure = time_series_figure(drivers(2))
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["driver 0", "driver 1", "limit speed"]
    limit = panels_of(figure)[0].lines[-1]
    assert set(np.asarray(limit.get_ydata())) == {6.5}


def test_last_vehicles_are_drawn_with_the_recorded_vehicle_and_its_amplification() -> None:
    panels = [behind_recording("human", 2.0), behind_recording("pi", 1.0)]
    figure = last_vehicle_figure([make_episode("ring"), *panels])
    (axes,), [legend] = panels_of(figure), figure.legends
    last, damped, recorded = (np.asarray(line.get_ydata()) for line in drawn_lines(axes))
    np.testing.assert_allclose([np.ptp(last), np.ptp(damped), np.ptp(recorded)], [4.0, 2.0, 4.0], rtol=1e-3)
    assert [text.get_text() for text in legend.get_texts()] == [
        "human: amplification 1.00 (periods of 20 to 60 s: 1.00)",
        "pi: amplification 0.50 (periods of 20 to 60 s: 0.50)",
        "recorded vehicle",
    ]


def row(number: int, validation: float | None = None, **changes: Any) -> dict[str, Any]:
    usual = {"iteration": number, "environment_steps": 12_000 * number, "return_mean": 90.0 + number}
    usual |= {"return_expert": 100.0, "return_validation": validation}
    return {**usual, "seconds": {"collect": 2.0, "update": 0.5}, **changes}


RUN = [row(1), row(2, 104.0), row(3), row(4, 108.0)]


def test_learning_curve_starts_at_step_zero_with_the_expert() -> None:
    [axes] = panels_of(learning_curve_figure({"ring-001": RUN}, {"pi": 100.0}, {}))
    training, validation, expert = axes.lines
    assert np.asarray(validation.get_xydata()).tolist() == [[0.0, 100.0], [24.0, 104.0], [48.0, 108.0]]
    assert np.asarray(training.get_xydata()).tolist() == [[12.0, 91.0], [24.0, 92.0], [36.0, 93.0], [48.0, 94.0]]
    assert expert.get_label() == "pi, validation seeds"
    assert set(np.asarray(expert.get_ydata())) == {100.0}
    (kept,) = axes.collections
    assert np.asarray(kept.get_offsets()).tolist() == [[48.0, 108.0]]


def test_returns_on_test_seeds_have_a_panel_of_their_own() -> None:
    returns = {"human": estimate([-2479.0] * 3), "trained": estimate([100.0, 110.0, 120.0]), "one": estimate([7.0])}
    above, below = learning_curve_figure({"ring-001": RUN}, {"pi": 100.0}, returns).axes
    labels = [str(line.get_label()) for line in above.lines]
    assert [label.split(",")[0].rpartition(" ")[2] for label in labels] == ["seeds", "seeds", "pi"]
    assert not any("test" in label for label in labels)
    assert above.get_ylim()[0] > 0
    assert "test seeds" in below.get_xlabel()
    assert [text.get_text() for text in below.get_yticklabels()] == list(returns)
    means = [float(np.asarray(line.get_xdata())[0]) for line in below.lines if line.get_marker() == "o"]
    assert means == [found.mean for found in returns.values()]


@pytest.mark.parametrize(
    "draw",
    [
        lambda: learning_curve_figure({"ring-001": RUN}, {}, {}),
        lambda: time_series_figure([make_episode()]),
        lambda: trajectory_figure([make_episode()]),
    ],
)
def test_notebooks_display_figures(draw: Callable[[], Figure]) -> None:
    formats, _ = DisplayFormatter().format(draw())  # pyright: ignore[reportGeneralTypeIssues]
    assert formats["image/png"].startswith(b"\x89PNG")


def test_learning_curve_without_validation_shows_training() -> None:
    rows = [row(number, return_expert=None) for number in (1, 2)]
    [axes] = panels_of(learning_curve_figure({"ring-001": rows}, {}, {}))
    assert len(np.asarray(axes.lines[0].get_xydata())) == 2
    assert len(np.asarray(axes.lines[1].get_xydata())) == 0


def test_several_runs_have_different_labels_and_colors() -> None:
    figure = learning_curve_figure({"a": RUN, "b": RUN}, {"pi": 100.0}, {})
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label.split(":")[0] for label in labels] == ["a", "a", "b", "b", "pi, validation seeds"]
    lines = panels_of(figure)[0].lines
    assert lines[1].get_color() != lines[3].get_color()


def test_learning_curve_has_all_runs() -> None:
    [axes] = panels_of(learning_curve_figure({f"run-{number}": RUN for number in range(9)}, {}, {}))
    assert len(axes.lines) == 2 * 9


def test_learning_curve_has_all_experts() -> None:
    experts = {f"driver {number}": 90.0 + number for number in range(7)}
    [axes] = panels_of(learning_curve_figure({"ring-001": RUN}, experts, {}))
    assert [line.get_label() for line in axes.lines[2:]] == [f"{name}, validation seeds" for name in experts]


def test_training_time_has_a_bar_for_each_part() -> None:
    [axes] = panels_of(training_time_figure(RUN))
    bars = [(bar.get_x(), bar.get_width()) for bar in axes.patches]  # pyright: ignore[reportAttributeAccessIssue]
    assert bars == [(0.0, 8.0), (8.0, 2.0)]
    labels = [text.get_text() for text in axes.figure.legends[0].get_texts()]
    assert labels == ["collect 8 s", "update 2 s"]


def test_colors_get_brighter_with_speed() -> None:
    table = speed_colors()
    assert len(table) == 32
    light = [0.299 * int(code[1:3], 16) + 0.587 * int(code[3:5], 16) + 0.114 * int(code[5:], 16) for code in table]
    assert all(np.diff(light) > 0)


def content(uri: str) -> tuple[str, bytes]:
    head, _, data = uri.partition(",")
    return head, base64.b64decode(data)


FIGURES: Sequence[Callable[[], Figure]] = (
    lambda: trajectory_figure(drivers(2)),
    lambda: time_series_figure(drivers(2)),
    lambda: last_vehicle_figure([behind_recording("pi", 1.0)]),
    lambda: learning_curve_figure({"ring-001": RUN}, {"pi": 100.0}, {"pi": estimate([9.0, 10.0, 12.0])}),
    lambda: training_time_figure(RUN),
)


@pytest.mark.long
@pytest.mark.parametrize("draw", FIGURES)
def test_the_same_figure_has_the_same_bytes(draw: Callable[[], Figure]) -> None:
    assert data_uri(draw()) == data_uri(draw())
    assert data_uri(draw()) != data_uri(trajectory_figure(drivers(1)))


@pytest.mark.parametrize("draw", FIGURES)
def test_texts_are_legible_at_the_smallest_width_on_the_page(draw: Callable[[], Figure]) -> None:
    figure, page = draw(), files("unjam.reports") / "page" / "report.css"
    figure.draw_without_rendering()
    [min_width] = re.findall(r"\.picture img {.*min-width: (\d+)px", page.read_text())
    pixels = int(min_width) / (72 * figure.get_figwidth())
    sizes = [float(text.get_fontsize()) for text in figure.findobj(Text) if text.get_text()]
    assert min(sizes) * pixels >= 8


def count_cav_pixels(image: Image.Image) -> int:
    pixels = np.asarray(image.convert("RGB")).astype(int)
    rgb = [int(CAV_PLOT_COLOR[start : start + 2], 16) for start in (1, 3, 5)]
    return (np.abs(pixels - rgb).max(axis=-1) < 30).sum()


def test_a_png_keeps_the_color_of_cavs() -> None:
    image = Image.open(io.BytesIO(png_bytes(trajectory_figure([make_episode()]))))
    assert image.format == "PNG"
    assert image.width > 1000
    assert count_cav_pixels(image) > 100


def test_a_data_uri_is_an_svg() -> None:
    head, data = content(data_uri(training_time_figure(RUN)))
    assert head == "data:image/svg+xml;base64"
    assert ElementTree.fromstring(data).tag == "{http://www.w3.org/2000/svg}svg"


def test_vehicles_are_rasterized_in_the_svg() -> None:
    episode = make_episode()
    _, data = content(data_uri(trajectory_figure([episode])))
    images = [
        Image.open(io.BytesIO(base64.b64decode(found)))
        for found in re.findall(rb'data:image/png;base64,([^"]+)"', data)
    ]
    largest = max(images, key=lambda image: image.width)
    assert largest.width > 800
    assert count_cav_pixels(largest) > 100
    assert all(len(image.getcolors() or ()) <= 256 for image in images), "to limit the size of the page"
    assert data.count(b"<path") < 500, "vehicles are not drawn as paths"


def steps_within_seam(episode: PlotEpisode) -> np.ndarray:
    """Return the number of steps of each vehicle that do not cross the seam, shape (N,)."""
    return (np.abs(np.diff(episode.positions % LENGTH, axis=0)) < LENGTH / 2).sum(axis=0)


def marks_of(axes: Axes) -> np.ndarray:
    """Return the ends of all lines in the color of CAVs, shape (n, 2, 2)."""
    marked = [lines for lines in lines_of(axes) if to_hex(np.asarray(lines.get_color())[0]) == CAV_PLOT_COLOR]
    assert len(marked) == 1
    return np.concatenate([np.array(lines.get_segments()).reshape(-1, 2, 2) for lines in marked])


def segments_of(axes: Axes) -> np.ndarray:
    """Return (time, position) of both ends of all lines of a panel, shape (n, 2, 2)."""
    return np.concatenate([np.array(lines.get_segments()).reshape(-1, 2, 2) for lines in lines_of(axes)])


@pytest.mark.long
@pytest.mark.parametrize("count", [1, 4, pytest.param(2, marks=pytest.mark.slow)])
def test_trajectory_figure_of_the_merge_has_panels_of_highway_and_ramp(count: int) -> None:
    episodes = [plot_episode_of(merge_episode(), f"driver {number}") for number in range(count)]
    figure = trajectory_figure(episodes)
    figure.draw_without_rendering()
    panels = panels_of(figure)
    assert len(panels) == 2 * count
    titles = [axes.get_title(loc="left") for axes in panels]
    assert sorted(title for title in titles if title) == [f"driver {number}" for number in range(count)]
    labels = {axes.get_ylabel() for axes in panels if axes.get_ylabel()}
    assert labels == {"highway [m]", "ramp [m]"}
    mains = [axes for axes, title in zip(panels, titles, strict=True) if title]
    ramps = [axes for axes, title in zip(panels, titles, strict=True) if not title]
    for main, ramp in zip(mains, ramps, strict=True):
        assert segments_of(main)[..., 1].min() < -600
        assert 80 < segments_of(main)[..., 1].max() <= 105
        assert -230 < segments_of(ramp)[..., 1].min() < -200
        assert segments_of(ramp)[..., 1].max() < 0
        assert main.get_xlim() == ramp.get_xlim() == pytest.approx((0, 100))


def test_vehicles_of_the_merge_are_in_one_panel_at_a_time() -> None:
    episode = plot_episode_of(merge_episode(), "pi")
    panels = panels_of(trajectory_figure([episode]))
    drawn_steps = sum(len(segments_of(axes)) for axes in panels)
    is_present = ~np.isnan(episode.positions)
    both_present = is_present[1:] & is_present[:-1]
    ramp = np.array(episode.branches) == "ramp"
    crossing = both_present & ramp & (episode.positions[1:] >= 0) & (episode.positions[:-1] < 0)
    assert crossing.any()
    assert drawn_steps == both_present.sum() - crossing.sum()


def test_cavs_of_the_merge_are_marked(tmp_path: Path) -> None:
    episode = plot_episode_of(merge_episode(), "pi")
    main, ramp = panels_of(trajectory_figure([episode]))
    is_present = ~np.isnan(episode.positions[:, list(episode.cav_columns)])
    assert len(marks_of(main)) == (is_present[1:] & is_present[:-1]).sum() > 0
    assert len(marks_of(ramp)) == 0


@pytest.mark.slow
def test_trajectory_figure_of_a_user_network_shows_the_route(tmp_path: Path) -> None:
    episode = plot_episode_of(user_episode(tmp_path), "pi")
    (panel,) = panels_of(trajectory_figure([episode]))
    assert panel.get_ylabel() == "position along the road [m]"
    assert segments_of(panel)[..., 1].min() == pytest.approx(np.nanmin(episode.positions), abs=5)
    low, high = panel.get_ylim()
    assert (low, high) == pytest.approx((np.nanmin(episode.positions), np.nanmax(episode.positions)))


def test_time_series_of_an_open_road_have_mean_speed_waves_and_backlog() -> None:
    episodes = [plot_episode_of(merge_episode(driver=driver), driver) for driver in ("human", "pi")]
    panels = panels_of(time_series_figure(episodes))
    assert [axes.get_ylabel().split()[0] for axes in panels] == ["mean", "speed", "insertion"]
    for number, episode in enumerate(episodes):
        expected = (np.nanmean(episode.speeds, 1), np.nanstd(episode.speeds, 1), episode.backlog)
        for axes, values in zip(panels, expected, strict=True):
            found = np.asarray(drawn_lines(axes)[number].get_ydata())
            np.testing.assert_allclose(found, values, rtol=1e-4)


def test_names_in_figures_have_neither_hidden_characters_nor_formulas() -> None:
    figure = time_series_figure([make_episode("p\u202ei\x1b $\\frac$")])
    text = svg_bytes(figure).decode()
    assert "p?i? $\\frac$" in text
    assert text == printable(text)
