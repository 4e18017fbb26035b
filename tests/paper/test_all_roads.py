"""Tables and resumption of the study `all-roads`."""

from math import nan
from pathlib import Path

import pytest

from unjam.measures.gain import MAX_GAIN, MIN_GAIN
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.road_family import FAMILY
from unjam_paper.all_roads import (
    FAMILY_DRIVERS,
    SINGLE_CONTROLLERS,
    TWO_FORMULAS_LABEL,
    UNSEEN_PARTS,
    all_drivers_table,
    all_roads_figure,
    all_roads_table,
    best_feasible_driver,
    road_gains,
)
from unjam_paper.results_file import read_part

RESULTS = Path(__file__).parents[2] / "results/all-roads.json"


def test_each_road_has_a_row_followed_by_mean_and_worst() -> None:
    roads = road_gains(RESULTS)
    assert set(roads) <= set(FAMILY)
    for parts in (("training",), UNSEEN_PARTS):
        table = all_roads_table(parts, RESULTS)
        names = [name for name, road in roads.items() if road["part"] in parts]
        assert list(table["road"]) == [*names, "mean", "mean, roads with a potential gain", "worst"]
        worst = min(roads[name]["gains"]["unjam:best"].mean for name in names)
        assert table["unjam:best"].iloc[-1] == f"{worst:+.2f}"


@pytest.mark.long
def test_each_driver_has_mean_gains_and_the_difference_to_the_first() -> None:
    table = all_drivers_table(RESULTS).set_index("")
    first, *others = FAMILY_DRIVERS
    assert list(table.index) == [first, TWO_FORMULAS_LABEL, *others]
    for heading, parts in {"training": ("training",), "unseen": UNSEEN_PARTS}.items():
        by_road = all_roads_table(parts, RESULTS).set_index("road")
        for label in SINGLE_CONTROLLERS:
            assert table.loc[label, heading] == by_road.loc["mean", label]
            assert table.loc[label, f"worst, {heading}"] == by_road.loc["worst", label]
        mean = table[heading].str.split().str[0].astype(float)
        differences = table[f"unjam:best, difference to it, {heading}"].iloc[1:].str.split().str[0].astype(float)
        assert list(mean.iloc[0] - mean.iloc[1:]) == pytest.approx(list(differences), abs=0.011)
    assert table.iloc[0]["unjam:best, difference to it, training"] == ""


def test_the_combination_of_two_controllers_has_the_gain_of_each_on_its_road_type() -> None:
    table, roads = all_drivers_table(RESULTS).set_index(""), road_gains(RESULTS)
    gains = {name: road["by_seed"] for name, road in roads.items() if road["part"] == "training"}
    mean = sum(
        seeds["jam-ahead, tuned on all roads" if name.startswith("on-ramp") else "PI, tuned on all roads"].mean()
        for name, seeds in gains.items()
    ) / len(gains)
    assert float(table.loc[TWO_FORMULAS_LABEL, "training"].split()[0]) == pytest.approx(mean, abs=0.005)


def test_the_gain_of_the_best_expert_is_one() -> None:
    for road in road_gains(RESULTS).values():
        assert all(MIN_GAIN <= gain.mean <= MAX_GAIN for gain in road["gains"].values())
        best_gain = road["gains"].get(road["best"])
        assert best_gain is None or best_gain.mean in (0.0, pytest.approx(1.0)), "no potential gain, or the reference"


def test_the_best_driver_is_feasible_in_every_episode() -> None:
    rows = read_part(RESULTS, "00")["rows"]
    measured = {label: [{**row, "travel_time": nan} for row in rows[label]] for label in (HUMAN_LABEL, "unjam:best")}
    careful = measured["unjam:best"]
    reckless = [{**row, "mean_speed_second_half": 9.0} for row in careful]
    reckless[1] |= {"status": "collision", "collisions": 1.0}
    assert best_feasible_driver({**measured, "reckless": reckless}) == "unjam:best"
    assert best_feasible_driver({HUMAN_LABEL: measured[HUMAN_LABEL], "reckless": reckless}) == HUMAN_LABEL


def test_the_figure_has_a_cell_for_each_driver_on_each_road() -> None:
    axes = all_roads_figure(RESULTS).axes[0]
    assert len(axes.texts) == len(road_gains(RESULTS)) * len(FAMILY_DRIVERS)
