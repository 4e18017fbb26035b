import csv
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, Request, Route, sync_playwright

import unjam
from tests.reports.test_assessment import HARMS, HELPS, assessment_folder
from unjam.measures.metrics import METRICS, Metric
from unjam.reports.assessment import write_assessment
from unjam.reports.results import read_results

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium found: apt-get install chromium")

ROAD = {"length": (120, 120), "vehicles": 8, "horizon": 150}
LAPTOP = (1280, 800)
PHONE = (390, 844)
WIDE_PICTURES = ".picture:not(.pictures *)"
SECONDS = 15.0
"""duration of the episodes"""


def mark_slow(size: tuple[int, int]) -> Any:
    return pytest.param(size, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def drive_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of `unjam drive`."""
    folder = tmp_path_factory.mktemp("drive") / "results"
    report = unjam.drive(driver=["human", "pi"], episodes=2, scenario_options=ROAD, workers=1, out=folder).report
    assert report is not None
    return report


@pytest.fixture(scope="module")
def merge_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of `unjam drive merge`: vehicles enter and leave."""
    road = {"horizon": 40, "penetration_rate": 0.3}
    folder = tmp_path_factory.mktemp("merge") / "results"
    report = unjam.drive("merge", ["human", "pi"], episodes=1, scenario_options=road, workers=1, out=folder).report
    assert report is not None
    return report


@pytest.fixture(scope="module")
def training_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of `unjam train`."""
    changes = {
        "scenario_options": ROAD,
        "steps": 600,
        "workers": 1,
        "policy.hidden": (8,),
        "trpo.steps_per_iteration": 300,
        "evaluation.validation_interval": 1,
        "evaluation.validation_episodes": 1,
        "evaluation.episodes": 2,
        "evaluation.baselines": ("human",),
    }
    return unjam.train(unjam.load_config(changes=changes), tmp_path_factory.mktemp("train") / "ring-001").report


@pytest.fixture(scope="module")
def assessment_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of `unjam assess`."""
    folder = assessment_folder(tmp_path_factory.mktemp("assess"), [HELPS, HARMS])
    return write_assessment(folder, folder / "assessment.html")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    switches = ["no-sandbox", "disable-gpu", "disable-background-networking", "disable-component-update"]
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(
            executable_path=CHROMIUM, args=[f"--{switch}" for switch in (*switches, "disable-sync")]
        )
        yield opened
        opened.close()


@dataclass
class Visit:
    """A page in the browser, and its errors."""

    page: Page
    requests: list[str] = field(default_factory=list)
    """everything that the page requested from elsewhere"""
    errors: list[str] = field(default_factory=list)

    def time(self) -> float:
        """Return the time of the replay [s]."""
        return float(self.page.locator(".clock").inner_text().removesuffix(" s"))

    def canvases(self) -> list[str]:
        return self.page.eval_on_selector_all("canvas", "all => all.map(canvas => canvas.toDataURL())")


@pytest.fixture
def open_page(browser: Browser) -> Iterator["Opener"]:
    opener = Opener(browser)
    yield opener
    for context in browser.contexts:
        context.close()
    assert [error for visit in opener.visits for error in visit.errors] == []
    assert [address for visit in opener.visits for address in visit.requests] == []


class Opener:
    """Opens report files offline; requests and errors of a page fail the test."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self.visits: list[Visit] = []

    def __call__(self, report: Path, size: tuple[int, int] = LAPTOP) -> Visit:
        context = self._browser.new_context(viewport={"width": size[0], "height": size[1]}, offline=True)
        visit = Visit(context.new_page())
        self.visits.append(visit)

        def refuse(route: Route) -> None:
            visit.requests.append(route.request.url)
            route.abort()

        def record_request(request: Request) -> None:
            if not request.url.startswith("data:") and request.url != report.as_uri():
                visit.requests.append(request.url)

        def record_message(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning"):
                visit.errors.append(message.text)

        context.route("**/*", lambda route: route.continue_() if route.request.url[:4] != "http" else refuse(route))
        visit.page.on("request", record_request)
        visit.page.on("console", record_message)
        visit.page.on("pageerror", lambda error: visit.errors.append(str(error)))
        visit.page.goto(report.as_uri())
        visit.page.wait_for_selector("#replay.ready, body:not(:has(#replay))", state="attached")
        return visit


@pytest.mark.slow
@pytest.mark.parametrize("size", [LAPTOP, PHONE], ids=["laptop", "phone"])
@pytest.mark.parametrize(
    ("report", "figures"),
    [
        pytest.param("drive_report", 3, marks=pytest.mark.slow),
        pytest.param("merge_report", 3, marks=pytest.mark.slow),
        ("training_report", 9),
        ("assessment_report", 2),
    ],
)
def test_page_has_every_figure(
    open_page: Opener, request: pytest.FixtureRequest, report: str, figures: int, size: tuple[int, int]
) -> None:
    page = open_page(request.getfixturevalue(report), size).page
    widths = page.eval_on_selector_all("img", "all => all.map(image => image.complete && image.naturalWidth)")
    assert len(widths) == figures
    assert all(width > 200 for width in widths)


@pytest.mark.long
@pytest.mark.parametrize(
    "size", [PHONE, *map(mark_slow, (LAPTOP, (320, 640), (820, 1180)))], ids=lambda size: str(size[0])
)
@pytest.mark.parametrize("report", ["drive_report", "merge_report", "training_report", "assessment_report"])
def test_page_is_not_wider_than_the_screen(
    open_page: Opener, request: pytest.FixtureRequest, report: str, size: tuple[int, int]
) -> None:
    page = open_page(request.getfixturevalue(report), size).page
    page.eval_on_selector_all("details", "all => all.forEach(each => each.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    too_wide = page.evaluate(
        """width => [...document.querySelectorAll("body *")].filter(found =>
             !found.parentElement.closest(".scroll, .picture, pre") &&
             found.getBoundingClientRect().right > width + 0.5
           ).map(found => found.outerHTML.slice(0, 80))""",
        size[0],
    )
    assert too_wide == []


def test_figures_fill_a_laptop_and_scroll_on_a_phone(open_page: Opener, drive_report: Path) -> None:
    sizes = """all => all.map(each => [each.clientWidth, each.scrollWidth, each.firstChild.clientWidth,
                 getComputedStyle(each, "::before").content.includes("swipe")])"""
    page = open_page(drive_report, LAPTOP).page
    for visible, total, image, has_hint in page.eval_on_selector_all(WIDE_PICTURES, sizes):
        assert visible == total == image > 1000
        assert not has_hint
    page = open_page(drive_report, PHONE).page
    for visible, total, image, has_hint in page.eval_on_selector_all(WIDE_PICTURES, sizes):
        assert visible < 390 < 700 < total == image
        assert has_hint
    page.eval_on_selector(WIDE_PICTURES, "element => element.scrollLeft = 1000")
    box = page.locator(f"{WIDE_PICTURES} img").first.bounding_box()
    assert box is not None
    assert box["x"] + box["width"] <= 390
    shape = "all => all.map(image => image.naturalHeight / image.naturalWidth - image.height / image.width)"
    assert all(abs(off) < 0.01 for off in page.eval_on_selector_all("img", shape)), "in the original proportions"


def test_pictures_of_drivers_are_side_by_side_on_a_laptop_and_stacked_on_a_phone(
    open_page: Opener, drive_report: Path
) -> None:
    boxes = "all => all.map(each => [each.x, each.y, each.x + each.width])"
    for size in (LAPTOP, PHONE):
        page = open_page(drive_report, size).page
        (left, top, end), (next_left, next_top, last) = page.eval_on_selector_all(".pictures img", boxes)
        assert (next_top == top, next_left > end) == ((True,) * 2 if size == LAPTOP else (False,) * 2)
        assert 0 <= left < max(end, last) <= size[0], "nothing is cut"


def test_a_table_that_is_opened_has_a_hint_to_swipe(open_page: Opener, drive_report: Path) -> None:
    page = open_page(drive_report, PHONE).page
    page.locator("summary", has_text="All metrics").click()
    page.wait_for_selector("details .scroll.wide")


def test_replay_shows_the_vehicles_of_every_driver(open_page: Opener, drive_report: Path) -> None:
    visit = open_page(drive_report)
    captions = visit.page.locator("figcaption").all_inner_texts()
    assert [caption.split("\n")[0] for caption in captions] == ["human", "pi"]
    assert all("mean" in caption for caption in captions)
    found = visit.page.eval_on_selector_all(
        "canvas",
        """all => all.map(canvas => {
             const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
             const off = (at, ...rgba) => rgba.reduce((sum, one, k) => sum + Math.abs(data[at + k] - one), 0);
             let drawn = 0, red = 0;
             for (let at = 0; at < data.length; at += 4) {
               drawn += data[at + 3] > 0;
               red += off(at, 0xd7, 0x26, 0x3d, 255) < 30;
             }
             return [canvas.width, drawn, red];
           })""",
    )
    assert len(found) == 2
    for width, drawn, _ in found:
        assert width >= 200
        assert drawn > width * 10, "a road and vehicles"
    human, driven = (red for _, _, red in found)
    assert human == 0 < 20 < driven, "a CAV has a red outline, and a human driver in its place has none"


def test_replay_opens_when_speeds_differ(open_page: Opener, drive_report: Path) -> None:
    human = read_results(drive_report.parent).plot_episodes["human"]
    spread = np.interp(open_page(drive_report).time(), human.times, human.speeds.std(1))
    assert spread > 0.8 * human.speeds.std(1).max()


@pytest.mark.long
def test_play_starts_and_pause_stops_the_replay(open_page: Opener, drive_report: Path) -> None:
    visit = open_page(drive_report)
    page, button = visit.page, visit.page.locator(".play")
    page.locator(".time").fill("0")
    before = visit.canvases()
    assert (visit.time(), button.inner_text()) == (0.0, "Play")
    page.locator(".pace").select_option("1")
    button.click()
    assert button.inner_text() == "Pause"
    page.wait_for_function("parseFloat(document.querySelector('.clock').textContent) >= 1")
    button.click()
    assert button.inner_text() == "Play"
    time, pictures = visit.time(), visit.canvases()
    assert 1 <= time < SECONDS
    assert all(old != new for old, new in zip(before, pictures, strict=True))
    page.wait_for_timeout(150)
    assert (visit.time(), visit.canvases()) == (time, pictures)


def test_replay_stops_at_its_end_and_restarts_from_the_beginning(open_page: Opener, drive_report: Path) -> None:
    visit = open_page(drive_report)
    page, button = visit.page, visit.page.locator(".play")
    page.locator(".pace").select_option("30")
    button.click()
    page.wait_for_function("document.querySelector('.play').textContent === 'Play'")
    assert visit.time() == SECONDS
    assert page.locator(".time").input_value() == page.locator(".time").get_attribute("max") == str(int(SECONDS))
    page.locator(".pace").select_option("1")
    button.click()
    page.wait_for_function(f"parseFloat(document.querySelector('.clock').textContent) < {SECONDS}")
    assert visit.time() < SECONDS / 2


@pytest.mark.long
def test_replay_of_an_open_road_plays_the_whole_episode(open_page: Opener, merge_report: Path) -> None:
    visit = open_page(merge_report)
    means = visit.page.locator("figcaption small")
    pictures, texts = [], []
    for moment in ("0", "10", "25.5", "40"):
        visit.page.locator(".time").fill(moment)
        pictures.append(visit.canvases())
        texts.append([float(text.split()[2]) for text in means.all_inner_texts()])
    for panel in range(2):
        assert len({picture[panel] for picture in pictures}) == 4
    assert all(0.5 < speed < 30 for text in texts for speed in text)  # every sixth vehicle enters at 10 m/s
    visit.page.locator(".time").fill("0")
    visit.page.locator(".pace").select_option("30")
    visit.page.locator(".play").click()
    visit.page.wait_for_function("document.querySelector('.play').textContent === 'Play'")
    assert visit.time() == 40.0
    assert visit.canvases() == pictures[-1]
    sizes = visit.page.eval_on_selector_all("canvas", "all => all.map(each => each.width / each.height)")
    assert all(size > 3 for size in sizes), "a long road has a wide picture"


def test_pace_is_the_speed_relative_to_real_time(open_page: Opener, drive_report: Path) -> None:
    visit = open_page(drive_report)
    visit.page.locator(".time").fill("0")
    visit.page.locator(".pace").select_option("5")
    ratio = visit.page.evaluate(
        """() => new Promise(done => {
             const slider = document.querySelector(".time"), started = performance.now();
             document.querySelector(".play").click();
             const check = () => {
               const time = Number(slider.value);
               if (time < 5) requestAnimationFrame(check);
               else done((performance.now() - started) / 1000 / time);
             };
             check();
           })"""
    )
    assert ratio == pytest.approx(1 / 5, rel=0.2)


def test_slider_selects_the_time(open_page: Opener, drive_report: Path) -> None:
    visit = open_page(drive_report)
    pictures = []
    for moment in ("4", "9.5", "15", "4"):
        visit.page.locator(".time").fill(moment)
        assert visit.time() == pytest.approx(float(moment), abs=0.51)
        pictures.append(visit.canvases())
    assert pictures[0] == pictures[3]
    assert len({picture[0] for picture in pictures}) == 3


def test_replay_shows_the_current_mean_speed(open_page: Opener, drive_report: Path) -> None:
    visit = open_page(drive_report)
    means = visit.page.locator("figcaption small")
    visit.page.locator(".time").fill("0")
    assert means.all_inner_texts() == ["mean now 0.0 m/s"] * 2
    visit.page.locator(".time").fill("12")
    assert all(float(text.split()[2]) > 1 for text in means.all_inner_texts())


@pytest.mark.parametrize("key", ["Enter", " "])
def test_keyboard_plays_and_pauses(open_page: Opener, drive_report: Path, key: str) -> None:
    visit = open_page(drive_report)
    visit.page.locator(".pace").select_option("1")
    visit.page.locator(".play").focus()
    visit.page.keyboard.press(key)
    visit.page.wait_for_function("parseFloat(document.querySelector('.clock').textContent) >= 1")
    visit.page.keyboard.press(key)
    assert visit.page.locator(".play").get_attribute("aria-label") == "Play"


def test_keyboard_moves_the_slider(open_page: Opener, drive_report: Path) -> None:
    visit = open_page(drive_report)
    slider = visit.page.locator(".time")
    slider.focus()
    moments = []
    for key in ("End", "Home", "ArrowRight", "ArrowRight", "ArrowLeft"):
        visit.page.keyboard.press(key)
        moments.append(float(slider.input_value()))
    end, home, once, twice, back = moments
    assert (end, home) == (SECONDS, 0.0)
    assert 0.1 <= once < twice <= SECONDS / 5, "a key moves by a small step"
    assert back == pytest.approx(once)


def test_all_controls_are_reachable_by_tab_and_have_names(open_page: Opener, drive_report: Path) -> None:
    page = open_page(drive_report).page
    page.locator(".play").focus()
    reached = []
    for _ in range(3):
        reached.append(page.evaluate("document.activeElement.className"))
        page.keyboard.press("Tab")
    assert reached == ["play", "time", "pace"]
    for name, role in (("Play", "button"), ("Time", "slider"), ("Pace", "combobox"), ("Zoom", "combobox")):
        assert page.get_by_role(role, name=name).count() == 1  # pyright: ignore[reportArgumentType]


OPEN_ALL = "document.querySelectorAll('details').forEach(each => each.open = true)"


def metrics_in(report: Path) -> list[Metric]:
    """Return the metrics that are defined on the road of a report."""
    rows = json.loads((report.parent / "evaluation.json").read_text())["rows"]
    return [metric for name, metric in METRICS.items() if any(row[name] is not None for row in rows)]


@pytest.mark.long
def test_table_has_all_metrics_of_all_drivers(open_page: Opener, training_report: Path) -> None:
    page = open_page(training_report).page
    page.evaluate(OPEN_ALL)
    table = page.locator("section:has(h2:text-is('Metrics')) details table")
    assert table.locator("thead th").all_inner_texts() == [
        *("metric", "human", "pi", "trained", "pi − human", "trained − human")
    ]
    rows, metrics = table.locator("tbody tr"), metrics_in(training_report)
    assert rows.count() == len(metrics) + 2  # and feasibility and probability of improvement
    assert rows.first.locator("th").inner_text() == "feasible"
    for row, metric in zip(rows.all()[2:], metrics, strict=True):
        assert row.locator("th").inner_text().replace("\n", " ") == f"{metric.label} {metric.unit}".strip()
        assert row.locator("td").count() == 5
        assert all(row.locator("td b").all_inner_texts())


def test_metrics_have_their_definition_as_a_tooltip(open_page: Opener, drive_report: Path) -> None:
    page = open_page(drive_report).page
    heads = page.locator("section:has(h2:text-is('Metrics')) details tbody th")
    for head, metric in zip(heads.all()[2:], metrics_in(drive_report), strict=True):
        assert head.get_attribute("title") == " ".join((metric.function.__doc__ or "").split())


def test_metric_names_stay_visible_when_a_phone_scrolls_the_table(open_page: Opener, training_report: Path) -> None:
    page = open_page(training_report, PHONE).page
    page.eval_on_selector(".scroll", "element => element.scrollLeft = 1000")
    assert page.eval_on_selector(".scroll", "element => element.scrollLeft") > 0
    box = page.locator("tbody th").first.bounding_box()
    assert box is not None
    assert 0 <= box["x"] < 40


def test_report_of_a_run_has_finding_and_configuration(open_page: Opener, training_report: Path) -> None:
    page = open_page(training_report).page
    assert page.title() == page.locator("h1").inner_text() == "ring: a trained residual on pi"
    assert page.locator(".lead").inner_text().startswith("Return difference to its expert, pi (return ")
    drivers = page.locator(".verdict strong").all_inner_texts()
    assert drivers == [label for label in read_results(training_report.parent).rows if label != "human"]
    for verdict in page.locator(".verdict").all_inner_texts():
        assert "feasible" in verdict
        assert "2 paired seeds" in verdict
        assert "mean speed" in verdict
    code = page.locator("details code")
    assert not code.is_visible()
    page.locator("summary", has_text="Configuration").click()
    assert "steps = 600" in code.inner_text()


def test_replay_adapts_to_the_size_of_the_window(open_page: Opener, drive_report: Path) -> None:
    page = open_page(drive_report).page
    for width in (1280, 500):
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_function(
            """[...document.querySelectorAll("canvas")].every(
                 canvas => Math.abs(canvas.width - canvas.clientWidth) <= 1)"""
        )
    assert all(len(picture) > 2000 for picture in open_page.visits[0].canvases())


@pytest.mark.parametrize("report", ["drive_report", "assessment_report"])
def test_every_figure_and_table_can_be_downloaded(
    open_page: Opener, request: pytest.FixtureRequest, report: str, tmp_path: Path
) -> None:
    page = open_page(request.getfixturevalue(report)).page
    page.evaluate(OPEN_ALL)
    assert page.locator(".picture + a.download").count() == page.locator(".picture").count() > 0
    assert page.locator(".scroll + a.download").count() == page.locator(".scroll").count() > 0
    for link in page.locator("a.download").all():
        with page.expect_download() as download:
            link.click()
        path = tmp_path / download.value.suggested_filename
        download.value.save_as(path)
        text = path.read_text()
        if path.suffix == ".svg":
            assert ElementTree.fromstring(text).tag.endswith("svg")
        else:
            header, *rows = csv.reader(text.splitlines())
            assert rows
            assert {len(row) for row in rows} == {len(header)}


def test_zoom_centers_the_slowest_vehicle_and_dragging_moves_the_view(open_page: Opener, merge_report: Path) -> None:
    visit = open_page(merge_report)
    visit.page.locator(".time").fill("20")
    overview = visit.canvases()
    visit.page.locator(".zoom").select_option("16")
    zoomed = visit.canvases()
    visit.page.locator("canvas").first.scroll_into_view_if_needed()
    box = visit.page.locator("canvas").first.bounding_box()
    assert box is not None
    visit.page.mouse.move(box["x"] + 200, box["y"] + 20)
    visit.page.mouse.down()
    visit.page.mouse.move(box["x"] + 40, box["y"] + 20, steps=4)
    visit.page.mouse.up()
    moved = visit.canvases()
    visit.page.locator(".zoom").select_option("1")
    for panel in range(2):
        assert len({overview[panel], zoomed[panel], moved[panel]}) == 3, "both roads move together"
    assert visit.canvases() == overview


@pytest.mark.long
def test_a_wide_table_has_a_hint_to_swipe(open_page: Opener, training_report: Path) -> None:
    scroll = "document.querySelector('.scroll')"
    for size in (PHONE, LAPTOP):
        page = open_page(training_report, size).page
        wide = page.evaluate(f"{scroll}.scrollWidth > {scroll}.clientWidth + 1")
        assert page.evaluate(f"getComputedStyle({scroll}, '::before').content.includes('swipe')") is wide
        assert wide is (size == PHONE)


def test_dark_mode_has_light_text_on_dark_background(open_page: Opener, drive_report: Path) -> None:
    page = open_page(drive_report).page
    style = "getComputedStyle(document.querySelector('section'))"
    colors = f"['background', 'color'].map(name => {style}[name].match(/\\d+/g)[0])"
    day = [int(part) for part in page.evaluate(colors)]
    page.emulate_media(color_scheme="dark")
    night = [int(part) for part in page.evaluate(colors)]
    assert day[0] > 200 > 80 > day[1]
    assert night[0] < 80 < 200 < night[1]


@pytest.mark.parametrize("size", [LAPTOP, PHONE], ids=["laptop", "phone"])
def test_page_can_be_captured_as_a_screenshot(
    open_page: Opener, drive_report: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    path = tmp_path / "page.png"
    open_page(drive_report, size).page.screenshot(path=path, full_page=True)
    assert path.stat().st_size > 20_000
