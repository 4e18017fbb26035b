"""Does the study of all roads say what its files hold?"""

from functools import partial
from math import nan
from pathlib import Path
from typing import Any

import pytest

from unjam.measures.gain import MOST, WORST
from unjam.measures.table import PEOPLE
from unjam.scenarios import Ring
from unjam.studies import everywhere
from unjam.studies.everywhere import (
    HELD_OUT,
    JUDGED,
    LAWS,
    TWO_LAWS,
    best_of,
    drivers,
    gains_of,
    picture,
    table,
)
from unjam.studies.results_file import read_part
from unjam.training.family import FAMILY

RESULTS = Path(__file__).parents[2] / "results/everywhere.json"


def test_each_road_has_a_row_and_the_mean_and_the_worst_follow() -> None:
    roads = gains_of(RESULTS)
    assert set(roads) <= set(FAMILY)
    for parts in (("seen",), HELD_OUT):
        shown = table(parts, RESULTS)
        names = [name for name, road in roads.items() if road["part"] in parts]
        assert list(shown["road"]) == [*names, "mean", "mean, where there is something to gain", "worst"]
        worst = min(roads[name]["gains"]["unjam:best"].mean for name in names)
        assert shown["unjam:best"].iloc[-1] == f"{worst:+.2f}"


def test_each_driver_has_its_means_and_what_the_first_gains_more() -> None:
    shown = drivers(RESULTS).set_index("")
    first, *others = JUDGED
    assert list(shown.index) == [first, TWO_LAWS, *others]
    for heading, parts in {"seen": ("seen",), "held out": HELD_OUT}.items():
        laws = table(parts, RESULTS).set_index("road")
        for label in LAWS:
            assert shown.loc[label, heading] == laws.loc["mean", label]
            assert shown.loc[label, f"worst, {heading}"] == laws.loc["worst", label]
        mean = shown[heading].str.split().str[0].astype(float)
        more = shown[f"unjam:best beyond it, {heading}"].iloc[1:].str.split().str[0].astype(float)
        assert list(mean.iloc[0] - mean.iloc[1:]) == pytest.approx(list(more), abs=0.011)
    assert shown.iloc[0]["unjam:best beyond it, seen"] == ""


def test_two_laws_have_what_each_has_on_its_kind_of_road() -> None:
    shown, laws = drivers(RESULTS).set_index(""), gains_of(RESULTS)
    seen = {name: road["by_seed"] for name, road in laws.items() if road["part"] == "seen"}
    mean = sum(
        of["jam-ahead, tuned on all" if name.startswith("on-ramp") else "PI, tuned on all"].mean()
        for name, of in seen.items()
    ) / len(seen)
    assert float(shown.loc[TWO_LAWS, "seen"].split()[0]) == pytest.approx(mean, abs=0.005)


def test_the_best_of_a_road_gains_what_its_one_says() -> None:
    for road in gains_of(RESULTS).values():
        assert all(WORST <= found.mean <= MOST for found in road["gains"].values())
        one = road["gains"].get(road["best"])
        assert one is None or one.mean in (0.0, pytest.approx(1.0)), "nothing counts, or it is the one"


def test_the_best_of_a_road_could_have_driven_so_in_every_episode() -> None:
    rows = read_part(RESULTS, "00")["rows"]
    measured = {who: [{**row, "travel_time": nan} for row in rows[who]] for who in (PEOPLE, "unjam:best")}
    careful = measured["unjam:best"]
    reckless = [{**row, "mean_speed_second_half": 9.0} for row in careful]
    reckless[1] |= {"status": "collision", "collisions": 1.0}
    assert best_of({**measured, "reckless": reckless}) == "unjam:best"
    assert best_of({PEOPLE: measured[PEOPLE], "reckless": reckless}) == PEOPLE


def test_the_picture_has_a_field_for_each_driver_on_each_road() -> None:
    axes = picture(RESULTS).axes[0]
    assert len(axes.texts) == len(gains_of(RESULTS)) * len(JUDGED)


def test_only_what_is_not_known_is_driven_and_the_best_may_be_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row is known while the shipped file that drove it is the one that is there."""
    asked: list[list[str]] = []
    speeds = {PEOPLE: 3.0, "pi": 4.0, "unjam:ring-tuned": 4.5}

    def driven(scenario: object, drivers: dict[str, str], seeds: object, run: object) -> dict[str, Any]:
        asked.append([*drivers.values()])
        return {label: [{**row, "mean_speed_second_half": speeds[name]}] for label, name in drivers.items()}

    found = read_part(RESULTS, "00")
    row = {**found["rows"]["unjam:best"][0], "travel_time": nan}
    files = {"unjam:ring-tuned": "one"}
    monkeypatch.setattr(everywhere, "driven", driven)
    monkeypatch.setattr(everywhere, "JUDGED", {"PI": "pi"})
    monkeypatch.setattr(everywhere, "file_of", lambda driver: files.get(driver, ""))

    road: dict[str, Any] = {"best": PEOPLE, "tried": {}, "drove": {}, "rows": {}}
    go_on = partial(everywhere._go_on, Ring(), found=road, run=lambda tasks: [])
    go_on(("pi",))
    assert (asked, road["best"]) == ([[PEOPLE, "pi"], [PEOPLE, "pi", "pi"]], "pi")
    go_on(("pi",))
    assert len(asked) == 2, "all is known"
    go_on(("pi", "unjam:ring-tuned"))
    assert (asked[2:], road["best"]) == (
        [[PEOPLE, "pi", "unjam:ring-tuned"], ["unjam:ring-tuned"]],
        "unjam:ring-tuned",
    )
    files["unjam:ring-tuned"] = "another"
    go_on(("pi", "unjam:ring-tuned"))
    assert asked[4:] == [[PEOPLE, "pi", "unjam:ring-tuned"], ["unjam:ring-tuned"]], "the best may be another"
    del road["drove"][PEOPLE]  # as files of before have it
    go_on(("pi", "unjam:ring-tuned"))
    assert asked[6:] == [[PEOPLE]]
    monkeypatch.setattr(everywhere, "JUDGED", {"PI": "pi:window=9"})
    speeds["pi:window=9"] = 4.1
    go_on(("pi", "unjam:ring-tuned"))
    assert asked[7:] == [["pi:window=9"]], "other parameters are another law"


def test_a_shipped_controller_is_known_by_its_file_and_others_by_their_name() -> None:
    assert everywhere.file_of("pi:window=23") == ""
    names = ("unjam:best", "unjam:ring-tuned")
    assert len({everywhere.file_of(name) for name in names} - {""}) == 2
