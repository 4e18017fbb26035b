import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.measures.test_metrics import LENGTH, episode_of
from tests.reports.test_model import facts_of, progress_of
from tests.reports.test_replay import decode
from unjam import __version__
from unjam.errors import DiskError, InputError
from unjam.files import to_json
from unjam.measures.metrics import METRICS, measure
from unjam.measures.statistics import Estimate, paired_difference
from unjam.measures.verdict import short_table_metrics
from unjam.reports.figures import learning_curve_figure
from unjam.reports.html import REPLAY_STEP, write_report_page
from unjam.reports.results import read_results
from unjam.reports.space_time import speed_scale
from unjam.text import printable
from unjam.training.evaluate import Evaluation, save_evaluation
from unjam.worlds.record import Episode, failed_episode

SPEEDS = {"human": 3.0, "pi": 4.0, "trained": 4.5, "follower-stopper": 3.5}


def make_driven_episode(speed: float, seed: int, steps: int = 60) -> Episode:
    """Vehicles with equal speeds except for a wave that grows with the seed."""
    times, vehicles = np.arange(steps + 1)[:, None], np.arange(6)
    speeds = speed + (0.5 + 0.1 * seed) * np.sin(times / 20 + vehicles)
    return episode_of(speeds, seed=(seed,), fuel=np.full((steps, 6), 300.0))


def results_in(folder: Path, *drivers: str, failing: int = 0, **metadata: Any) -> Path:
    """A folder of results like `unjam drive` writes."""
    episodes = {name: [make_driven_episode(SPEEDS.get(name, 4.0), seed) for seed in range(3)] for name in drivers}
    rows = {name: [measure(episode) for episode in found] for name, found in episodes.items()}
    for seed in range(failing):
        rows[drivers[-1]].append(measure(failed_episode((9, seed), "SUMO <cannot> start", "EpisodeError")))
    evaluation = Evaluation(rows, {name: found[0] for name, found in episodes.items()})
    manifest = {"unjam": __version__, "python": "3.11.2", "packages": {}, "started": "2026-01-02T03:04:05+00:00"}
    manifest["command"] = ["unjam", "drive", "ring", "--driver", *drivers]
    save_evaluation(folder, evaluation, {"scenario": "ring", "reward": "released", "manifest": manifest, **metadata})
    return folder


def run_in(folder: Path, scenario: str = "ring") -> Path:
    """A folder of results like `unjam train` writes."""
    results_in(folder, "human", "pi", "trained", scenario=scenario, trained="trained", expert="pi")
    rows = [
        {
            "iteration": number,
            "environment_steps": 12_000 * number,
            "return_mean": 90.0 + number,
            "return_expert": 100.0,
            "return_validation": 101.0 + number if number % 2 else None,
            "seconds": {"collect": 2.0, "update": 0.5},
        }
        for number in range(1, 5)
    ]
    (folder / "progress.jsonl").write_text("".join(to_json(row) + "\n" for row in rows))
    (folder / "config.toml").write_text(f'scenario = "{scenario}"\nsteps = 48000\n')
    return folder


class Page(HTMLParser):
    """Tags and texts of a page, as a browser parses them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: dict[str, list[str]] = {}
        self._open_tag = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        self._open_tag = tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.texts.setdefault(self._open_tag, []).append(data.strip())

    def of(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def drivers(self) -> list[str]:
        """The columns of the last table, that of all metrics."""
        heads = self.texts["th"]
        first = len(heads) - heads[::-1].index("metric")
        return heads[first : heads.index("feasible", first)]

    @property
    def replay(self) -> dict[str, Any]:
        [data] = [text for text in self.texts["script"] if text.startswith("{")]
        return json.loads(data)


def page_of(*folders: Path) -> tuple[str, Page]:
    target = folders[0].parent / "page.html"
    assert write_report_page(folders, target) == target
    text = target.read_text(encoding="utf-8")
    return text, Page(text)


@pytest.fixture(autouse=True)
def without_figures(request: pytest.FixtureRequest) -> None:
    """Draw figures only for tests of the page that contains them."""
    if "written" not in request.fixturenames:
        request.getfixturevalue("without_pictures")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_in(tmp_path_factory.mktemp("html") / "ring-001")


@pytest.fixture(scope="module")
def written(run: Path) -> tuple[str, Page]:
    return page_of(run)


def test_page_loads_nothing_from_elsewhere(written: tuple[str, Page]) -> None:
    text, page = written
    loading = {"src", "srcset", "data", "poster", "action", "formaction", "background"}
    for tag, attributes in page.tags:
        for name in loading & attributes.keys():
            assert attributes[name].startswith("data:"), (tag, name)
    assert not page.of("link")
    assert not page.of("iframe")
    assert not any("src" in attributes for attributes in page.of("script"))
    for style in page.texts["style"]:
        assert not re.search(r"@import|url\(", style)
    for script in page.texts["script"]:
        assert not re.search(r"fetch\(|XMLHttpRequest|WebSocket|importScripts|\bimport\b", script)
    assert not re.search(r"https?://", re.sub(r'title="[^"]*"|<dd>.*?</dd>', "", text)), (
        "only definitions cite their sources"
    )


def test_figures_of_the_page_load_nothing(written: tuple[str, Page]) -> None:
    _, page = written
    drawings = [base64.b64decode(image["src"].partition(",")[2]) for image in page.of("img")]
    assert drawings
    for drawing in drawings:
        assert not re.search(rb'(href|src)="(?!#|data:)', drawing)


def test_report_of_a_run_has_each_figure_once(written: tuple[str, Page]) -> None:
    _, page = written
    assert len({image["src"] for image in page.of("img")}) == len(page.of("img")) == 3 + 3  # three drivers
    assert all(len(image["alt"]) > 20 for image in page.of("img"))
    assert all(image["src"].startswith("data:image/svg+xml;base64,") for image in page.of("img"))
    assert not page.of("source")


def test_report_of_a_drive_has_no_learning_curve(tmp_path: Path) -> None:
    _, page = page_of(results_in(tmp_path / "drive", "human", "pi"))
    assert len(page.of("img")) == 2 + 1
    assert "Training" not in page.texts["h2"]


def test_learning_curve_has_lines_of_drivers_that_do_not_learn(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []

    def spy(runs: dict[str, Any], experts: dict[str, float], returns: dict[str, Estimate], expert: str) -> Figure:
        drawn.append((list(runs), experts, {label: found.mean for label, found in returns.items()}, expert))
        return learning_curve_figure(runs, experts, returns, expert)

    monkeypatch.setattr("unjam.reports.figures.learning_curve_figure", spy)
    write_report_page([run], tmp_path / "page.html")
    found = read_results(run)
    differences = {"trained": paired_difference(found.rows["trained"], found.rows["pi"], "return").mean}
    # The line of the expert is its return on the validation seeds, where the curve starts.
    experts = {"pi": found.progress[0]["return_expert"]}
    assert drawn[0] == (["ring-001"], experts, pytest.approx(differences), "pi")


def test_page_has_its_version_and_the_command_to_reproduce_it(written: tuple[str, Page]) -> None:
    text, page = written
    assert f"unjam {__version__}" in text
    assert any("unjam drive ring --driver human pi trained" in code for code in page.texts["code"])
    assert any("steps = 48000" in code for code in page.texts["code"])
    assert "2026-01-02" in text


def test_table_has_the_means_of_the_rows(written: tuple[str, Page], run: Path) -> None:
    _, page = written
    assert page.drivers[:3] == ["human", "pi", "trained"]
    rows = read_results(run).rows
    for name in ("mean_speed", "speed_std_fleet", "fuel_ml_per_km"):
        metric = METRICS[name]
        for driver in ("human", "pi", "trained"):
            mean = np.mean([row[name] for row in rows[driver]])
            assert f"{mean:.{metric.digits}f}" in page.texts["b"]


def test_a_report_of_human_drivers_alone_says_nothing_about_cavs(tmp_path: Path) -> None:
    text, page = page_of(results_in(tmp_path / "drive", "human"))
    shown = re.sub(r'<style>.*?</style>|<script.*?</script>|href="[^"]*"', "", text, flags=re.DOTALL)
    assert not re.search(r"CAV(?!s</)", re.sub(r'title="[^"]*"|<dd>.*?</dd>', "", shown))
    assert "feasible" not in page.texts["th"]


def test_names_of_drivers_are_escaped(tmp_path: Path) -> None:
    names = ["<b>x", "a&b", '"quoted"', "</script><script>document.title='x'</script>", "<!--<script>", "ünïcode"]
    text, page = page_of(results_in(tmp_path / "drive", *names))
    assert len(page.of("script")) == 3
    row = measure(make_driven_episode(4.0, 0))
    defined = [name for name in METRICS if np.isfinite(row[name])]
    shown = set(defined) & set(short_table_metrics({"x": [row]}))
    assert len(page.of("b")) == len(names) * (len(defined) + len(shown) + 2)  # and the verdict in both tables
    assert page.drivers[:6] == names
    assert [driver["name"] for driver in page.replay["drivers"]] == names
    data = text.partition('type="application/json">')[2].partition("</script>")[0]
    assert json.loads(data) == page.replay
    assert "<!--" not in data, "a browser would find another end of the script"


def test_texts_of_a_folder_are_escaped(tmp_path: Path) -> None:
    folder = results_in(tmp_path / "a <i>b", "pi", failing=1, scenario="<u>ring\u202egnir")
    (folder / "config.toml").write_text('expert = "<s>"\n')
    text, page = page_of(folder, results_in(tmp_path / "c", "pi"))
    assert not page.of("i")[1:]  # the first is the scale of the page itself
    for tag in ("u", "s", "cannot"):
        assert not page.of(tag)
    assert "SUMO &lt;cannot&gt; start" in text
    assert "ring?gnir" in text, "bidirectional marks would turn the text around"
    assert "\u202e" not in text


def test_names_have_no_hidden_characters_in_data_of_a_page(tmp_path: Path) -> None:
    text, page = page_of(results_in(tmp_path / "drive", "human", "p\u202ei\x1b[31m"))
    assert [driver["name"] for driver in page.replay["drivers"]] == ["human", "p?i?[31m"]
    [csv] = [unquote(link["href"]) for link in page.of("a") if "text/csv" in link["href"]]
    assert "p?i?[31m" in csv
    assert text == printable(text)
    assert csv == printable(csv)


def test_failed_episodes_are_listed_with_their_reason(tmp_path: Path) -> None:
    text, _ = page_of(results_in(tmp_path / "drive", "human", "pi", failing=2))
    assert "Failed episodes" in text
    assert "pi seed [9, 0]" in text
    assert "pi seed [9, 1]" in text
    assert "3 of 5" in text, "a cell has its number of episodes"


def numbers(data: list[dict[str, Any]], vehicles: int) -> np.ndarray:
    return decode({"vehicles": vehicles, "positions": data}, "positions")


def test_replay_has_positions_and_speeds(written: tuple[str, Page], run: Path) -> None:
    replay, plot_episodes = written[1].replay, read_results(run).plot_episodes
    assert [driver["name"] for driver in replay["drivers"]] == list(plot_episodes)
    stride = round(REPLAY_STEP / 0.1)
    assert replay["step"] == pytest.approx(REPLAY_STEP)
    for driver in replay["drivers"]:
        episode = plot_episodes[driver["name"]]
        np.testing.assert_allclose(numbers(driver["positions"], 6), episode.positions[::stride], atol=0.01)
        np.testing.assert_allclose(numbers(driver["speeds"], 6), episode.speeds[::stride], atol=0.001)
        assert replay["frames"] == len(episode.positions[::stride])
        assert episode.cav_columns == [0]
        assert driver["cavs"] == ([] if driver["name"] == "human" else [0])
        assert driver["loop_length"] == LENGTH
        np.testing.assert_allclose(driver["lines"], [episode.outline], atol=0.006)
    assert replay["max_speed"] == speed_scale(list(plot_episodes.values())).vmax


def save_driven(folder: Path, **episodes: Episode) -> Path:
    """Write a folder of results with one episode each."""
    evaluation = Evaluation({name: [measure(found)] for name, found in episodes.items()}, episodes)
    save_evaluation(folder, evaluation, {"scenario": "ring", "reward": "released", "manifest": {}})
    return folder


@pytest.mark.long
def test_replay_is_not_truncated_by_a_collision(tmp_path: Path) -> None:
    crashed, complete = make_driven_episode(3.0, 0, steps=20), make_driven_episode(3.0, 0, steps=60)
    for number, episodes in enumerate(({"a": crashed, "b": complete}, {"a": complete, "b": crashed})):
        _, page = page_of(save_driven(tmp_path / str(number), **episodes))
        assert (page.replay["frames"] - 1) * page.replay["step"] == pytest.approx(6.0)


def test_replay_shows_roads_with_different_steps_at_the_same_times(tmp_path: Path) -> None:
    coarse, fine = (episode_of(np.full((round(4.0 / step) + 1, 3), 2.0), step=step, seed=(0,)) for step in (0.1, 0.05))
    replay = page_of(save_driven(tmp_path / "a", one=coarse, other=fine))[1].replay
    one, other = (numbers(driver["positions"], 3) for driver in replay["drivers"])
    np.testing.assert_allclose(one, other, atol=0.01)


def test_several_folders_are_compared(tmp_path: Path) -> None:
    folders = run_in(tmp_path / "ring-001"), run_in(tmp_path / "ring-002")
    text, page = page_of(*folders)
    assert page.texts["h1"] == ["ring: comparison of 2 results"]
    assert page.drivers[:4] == ["human", "pi", "ring-001: trained", "ring-002: trained"]
    assert [driver["name"] for driver in page.replay["drivers"]] == page.drivers[:4]
    assert page.texts["strong"] == ["pi", "ring-001: trained", "ring-002: trained"]
    [finding] = [text for text in page.texts["p"] if "Return difference" in text]
    assert "ring-001: Return difference to its expert" in finding
    assert "ring-002: Return difference to its expert" in finding
    assert page.texts["h3"] == ["ring-001", "ring-002"], "reproduction of each"
    assert text.count('alt="Return against') == 1, "one figure for both"


def test_a_comparison_of_drives_has_a_column_for_each(tmp_path: Path) -> None:
    _, page = page_of(results_in(tmp_path / "a", "pi"), results_in(tmp_path / "b", "pi"))
    assert page.texts["th"][1:3] == ["a: pi", "b: pi"]


def test_a_comparison_has_the_range_of_episode_counts(tmp_path: Path) -> None:
    text, _ = page_of(results_in(tmp_path / "drive", "human", "pi", failing=2))
    assert "Mean over 3 to 5 episodes" in text


def test_results_with_only_failed_episodes_have_a_page(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    rows = {"pi": [measure(failed_episode((0,), "no road", "EpisodeError"))]}
    save_evaluation(folder, Evaluation(rows, {}), {"scenario": "ring", "reward": "released", "manifest": {}})
    text, page = page_of(folder)
    assert "no road" in text
    assert not page.of("img")
    assert not re.search(r"\bnan\b", text)


@pytest.mark.usefixtures("without_pictures")
def test_report_of_a_run_with_a_learned_model_has_its_section(tmp_path: Path, written: tuple[str, Page]) -> None:
    folder = run_in(tmp_path / "model")
    (folder / "progress.jsonl").write_text("".join(to_json(row) + "\n" for row in progress_of()))
    (folder / "model.json").write_text(to_json(facts_of()))
    _, page = page_of(folder)
    assert "Learned model" in page.texts["h2"]
    assert "Learned model" not in written[1].texts["h2"]
    assert len(page.of("img")) == len(written[1].of("img")) + 3
    assert any("IDM alone, 10 s" in text for text in page.texts["th"])
    text = " ".join(page.texts["p"])
    assert "is 5.50 in the model" in text
    assert "so it is not informative" in text


def test_the_same_results_give_the_same_page(tmp_path: Path, written: tuple[str, Page], run: Path) -> None:
    write_report_page([run], tmp_path / "again.html")
    assert (tmp_path / "again.html").read_text(encoding="utf-8") == written[0]


def test_a_folder_without_results_is_refused_without_a_page(tmp_path: Path) -> None:
    good = results_in(tmp_path / "drive", "pi")
    with pytest.raises(InputError):
        write_report_page([good, tmp_path], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_a_page_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    good = results_in(tmp_path / "drive", "pi")
    with pytest.raises(DiskError, match="cannot write"):
        write_report_page([good], tmp_path / "nowhere" / "page.html")
