"""Does the study of all roads say what its files hold?"""

from functools import partial
from math import nan
from pathlib import Path
from typing import Any

import pytest

from unjam.measures.gain import MAX_GAIN, MIN_GAIN
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.scenarios import Ring
from unjam.training.road_family import FAMILY
from unjam_paper import all_roads
from unjam_paper.all_roads import (
    FAMILY_DRIVERS,
    SINGLE_CONTROLLERS,
    TWO_LAWS_LABEL,
    UNSEEN_PARTS,
    all_drivers_table,
    all_roads_figure,
    all_roads_table,
    best_feasible_driver,
    road_gains,
)
from unjam_paper.results_file import read_part

RESULTS = Path(__file__).parents[2] / "results/everywhere.json"


def test_each_road_has_a_row_and_the_mean_and_the_worst_follow() -> None:
    roads = road_gains(RESULTS)
    assert set(roads) <= set(FAMILY)
    for parts in (("seen",), UNSEEN_PARTS):
        shown = all_roads_table(parts, RESULTS)
        names = [name for name, road in roads.items() if road["part"] in parts]
        assert list(shown["road"]) == [*names, "mean", "mean, where there is something to gain", "worst"]
        worst = min(roads[name]["gains"]["unjam:best"].mean for name in names)
        assert shown["unjam:best"].iloc[-1] == f"{worst:+.2f}"


def test_each_driver_has_its_means_and_what_the_first_gains_more() -> None:
    shown = all_drivers_table(RESULTS).set_index("")
    first, *others = FAMILY_DRIVERS
    assert list(shown.index) == [first, TWO_LAWS_LABEL, *others]
    for heading, parts in {"seen": ("seen",), "held out": UNSEEN_PARTS}.items():
        laws = all_roads_table(parts, RESULTS).set_index("road")
        for label in SINGLE_CONTROLLERS:
            assert shown.loc[label, heading] == laws.loc["mean", label]
            assert shown.loc[label, f"worst, {heading}"] == laws.loc["worst", label]
        mean = shown[heading].str.split().str[0].astype(float)
        more = shown[f"unjam:best beyond it, {heading}"].iloc[1:].str.split().str[0].astype(float)
        assert list(mean.iloc[0] - mean.iloc[1:]) == pytest.approx(list(more), abs=0.011)
    assert shown.iloc[0]["unjam:best beyond it, seen"] == ""


def test_two_laws_have_what_each_has_on_its_kind_of_road() -> None:
    shown, laws = all_drivers_table(RESULTS).set_index(""), road_gains(RESULTS)
    seen = {name: road["by_seed"] for name, road in laws.items() if road["part"] == "seen"}
    mean = sum(
        of["jam-ahead, tuned on all" if name.startswith("on-ramp") else "PI, tuned on all"].mean()
        for name, of in seen.items()
    ) / len(seen)
    assert float(shown.loc[TWO_LAWS_LABEL, "seen"].split()[0]) == pytest.approx(mean, abs=0.005)


def test_the_best_of_a_road_gains_what_its_one_says() -> None:
    for road in road_gains(RESULTS).values():
        assert all(MIN_GAIN <= found.mean <= MAX_GAIN for found in road["gains"].values())
        one = road["gains"].get(road["best"])
        assert one is None or one.mean in (0.0, pytest.approx(1.0)), "nothing counts, or it is the one"


def test_the_best_of_a_road_could_have_driven_so_in_every_episode() -> None:
    rows = read_part(RESULTS, "00")["rows"]
    measured = {who: [{**row, "travel_time": nan} for row in rows[who]] for who in (HUMAN_LABEL, "unjam:best")}
    careful = measured["unjam:best"]
    reckless = [{**row, "mean_speed_second_half": 9.0} for row in careful]
    reckless[1] |= {"status": "collision", "collisions": 1.0}
    assert best_feasible_driver({**measured, "reckless": reckless}) == "unjam:best"
    assert best_feasible_driver({HUMAN_LABEL: measured[HUMAN_LABEL], "reckless": reckless}) == HUMAN_LABEL


def test_the_picture_has_a_field_for_each_driver_on_each_road() -> None:
    axes = all_roads_figure(RESULTS).axes[0]
    assert len(axes.texts) == len(road_gains(RESULTS)) * len(FAMILY_DRIVERS)


def test_only_what_is_not_known_is_driven_and_the_best_may_be_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row is known while the shipped file that drove it is the one that is there."""
    asked: list[list[str]] = []
    speeds = {HUMAN_LABEL: 3.0, "pi": 4.0, "unjam:ring-tuned": 4.5}

    def driven(scenario: object, drivers: dict[str, str], seeds: object, run: object) -> dict[str, Any]:
        asked.append([*drivers.values()])
        return {label: [{**row, "mean_speed_second_half": speeds[name]}] for label, name in drivers.items()}

    found = read_part(RESULTS, "00")
    row = {**found["rows"]["unjam:best"][0], "travel_time": nan}
    files = {"unjam:ring-tuned": "one"}
    monkeypatch.setattr(all_roads, "driven", driven)
    monkeypatch.setattr(all_roads, "JUDGED", {"PI": "pi"})
    monkeypatch.setattr(all_roads, "file_of", lambda driver: files.get(driver, ""))

    road: dict[str, Any] = {"best": HUMAN_LABEL, "tried": {}, "drove": {}, "rows": {}}
    go_on = partial(all_roads._drive_missing, Ring(), results=road, run_episodes=lambda tasks: [])
    go_on(("pi",))
    assert (asked, road["best"]) == ([[HUMAN_LABEL, "pi"], [HUMAN_LABEL, "pi", "pi"]], "pi")
    go_on(("pi",))
    assert len(asked) == 2, "all is known"
    go_on(("pi", "unjam:ring-tuned"))
    assert (asked[2:], road["best"]) == (
        [[HUMAN_LABEL, "pi", "unjam:ring-tuned"], ["unjam:ring-tuned"]],
        "unjam:ring-tuned",
    )
    files["unjam:ring-tuned"] = "another"
    go_on(("pi", "unjam:ring-tuned"))
    assert asked[4:] == [[HUMAN_LABEL, "pi", "unjam:ring-tuned"], ["unjam:ring-tuned"]], "the best may be another"
    del road["drove"][HUMAN_LABEL]  # as files of before have it
    go_on(("pi", "unjam:ring-tuned"))
    assert asked[6:] == [[HUMAN_LABEL]]
    monkeypatch.setattr(all_roads, "JUDGED", {"PI": "pi:window=9"})
    speeds["pi:window=9"] = 4.1
    go_on(("pi", "unjam:ring-tuned"))
    assert asked[7:] == [["pi:window=9"]], "other parameters are another law"


def test_a_shipped_controller_is_known_by_its_file_and_others_by_their_name() -> None:
    assert all_roads.controller_digest("pi:window=23") == ""
    names = ("unjam:best", "unjam:ring-tuned")
    assert len({all_roads.controller_digest(name) for name in names} - {""}) == 2
