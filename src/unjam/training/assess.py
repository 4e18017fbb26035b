"""What would CAVs do on a road of the user's own? Several shares and drivers, beside people alone.

Who drives is chosen on some seeds and judged on others; the page says what a rule makes of the numbers.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from unjam.controller import BEST, make_driver
from unjam.drivers.driver import Driver
from unjam.errors import InputError, NoCavError, wrong
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.effect import Judged, headline, recommended, shown_beside
from unjam.measures.notes import check_baseline, notes_of_rows
from unjam.measures.statistics import estimate_of
from unjam.reports.assessment import ASSESSMENT_FILE, ASSESSMENT_PAGE, write_assessment
from unjam.scenarios import NAMED_BEFORE, make_scenario, scenario_recipe
from unjam.scenarios.own_network import WITH_OWN_ACC
from unjam.scenarios.scenario import Scenario
from unjam.training.choice import (
    PEOPLE,
    Budget,
    Choice,
    OnLine,
    Option,
    Rows,
    Seed,
    choose,
    judge,
    least_episodes,
)
from unjam.training.evaluate import Evaluation, evaluate_each, save_evaluation
from unjam.training.folder import make_new_folder
from unjam.training.seeds import choosing_seeds, held_out_seeds
from unjam.worlds.episode import can_drive
from unjam.worlds.workers import Workers

DRIVERS_OF_OPEN_ROADS = (BEST, "cruise", "follower-stopper", "pi")
"""who is tried where nobody is named: drivers that fit roads with ends"""
ENOUGH_BASELINE = 20
"""episodes of the baseline for which early ends are counted before the last one: two of them are too many"""
FOR_PICTURES = 2
"""episodes of the budget that are kept for pictures"""
NOBODY = 1e-12
"""share of CAVs where people are alone: a network without any is not allowed"""
CHOOSING = "choosing"
"""folder within the results: the rows of the seeds that chose"""
WHO_IS_A_CAV = "cav_share", "cav_types", "cavs"
"""settings of a road that the shares stand for"""
METRICS_OF_PEOPLE = (
    "travel_time",
    "throughput_veh_per_h",
    "fuel_ml_per_km",
    "people_beyond_4_5",
    "collisions",
)


@dataclass(frozen=True)
class Question:
    """What is asked of a road; everything in it has been checked."""

    file: str
    road: Scenario
    """with people alone"""
    drivers: dict[str, Driver]
    shares: tuple[float, ...]
    episodes: int
    """at most, in all"""
    minutes: float | None
    """at most, looked at between batches"""
    precision: float
    """half-width of the interval of travel time that is narrow enough, as a share of people's"""

    @property
    def options(self) -> list[Option]:
        """All shares with all drivers."""
        return [Option(share, driver) for share in self.shares for driver in self.drivers]

    def setup(self, option: Option) -> tuple[Scenario, Driver]:
        """Return the road with so many CAVs, and who drives them."""
        if option == PEOPLE:
            return self.road, make_driver(PEOPLE.driver, self.road.decision_step)
        return replace(self.road, cav_share=option.share), self.drivers[option.driver]  # pyright: ignore[reportCallIssue]


def question(
    file: str,
    shares: Sequence[float],
    episodes: int,
    precision: float,
    minutes: float | None = None,
    drivers: Sequence[str] = DRIVERS_OF_OPEN_ROADS,
    changes: dict[str, Any] | None = None,
) -> Question:
    """Return a question whose parts have been checked; a share of 0 is always asked for.

    Raises:
        InputError: one of them is wrong.
    """
    if not file.endswith(".sumocfg"):
        raise wrong("scenario", file, "your own .sumocfg file")
    for name in [name for name in changes or {} if NAMED_BEFORE.get(name, name) in WHO_IS_A_CAV]:
        raise InputError(f"{name}: it is not allowed here: --shares says how many vehicles are CAVs")
    for share in shares:
        if not 0 <= share <= 1:
            raise wrong("shares", share, ">= 0, <= 1")
    asked = tuple(sorted(set(shares) - {0.0}))
    if not asked:
        raise wrong("shares", ",".join(f"{share:g}" for share in shares), "one above 0 at least")
    if minutes is not None and not minutes > 0:
        raise wrong("minutes", minutes, "> 0")
    if not 0 < precision < 1:
        raise wrong("precision", precision, "> 0, < 1")
    road = make_scenario(file, {**WITH_OWN_ACC, **(changes or {}), "cav_share": NOBODY})
    made = {name: make_driver(name, road.decision_step) for name in drivers}
    for name, driver in made.items():
        if driver.native or not can_drive(driver, road):
            why = "people alone are driven anyway" if driver.native else "one that needs no closed road"
            raise wrong("driver", name, why)
    least = least_episodes(len(asked), len(made)) + FOR_PICTURES
    if episodes < least:
        raise wrong("episodes", episodes, f">= {least} for {len(asked)} shares and {len(made)} drivers")
    return Question(file, road, made, asked, episodes, minutes, precision)


@dataclass(frozen=True)
class Assessment:
    """The answer."""

    judged: list[Judged]
    """the driver that was chosen for each share; none of a share where all were set aside"""
    document: dict[str, Any]
    """all of it but the rows, as `assessment.json` has it"""
    page: Path


def assess(
    asked: Question,
    folder: Path,
    workers: Workers,
    progress: Callable[[Any, int], None] | None = None,
    on_line: OnLine = lambda line: None,
) -> Assessment:
    """Answer a question, and write rows, `assessment.json` and the page into a new folder.

    Nothing is written before all is known. The result does not depend on how many workers drive, where no
    minutes are asked for. `progress` is told now and then how many decisions an episode has made, `on_line`
    gets a line for each batch of episodes.

    Raises:
        InputError: the folder holds something, or no driver can drive this road.
    """
    make_new_folder(folder)
    budget, baseline = Budget(asked.episodes - FOR_PICTURES, asked.minutes), Rows()

    def driven(options: Sequence[Option], seeds: Sequence[Seed], pictured: bool = False) -> Evaluation:
        setups = {option.label: asked.setup(option) for option in options}
        batch = budget.spent

        def note(episode: tuple[str, int], steps: int) -> None:
            if progress is not None:
                progress((batch, *episode), steps)

        found = evaluate_each(setups, seeds, workers, progress=note, pictured=pictured)
        budget.spend(len(options) * len(seeds))
        return found

    def drive(options: Sequence[Option], seeds: Sequence[Seed]) -> dict[Option, Rows]:
        rows = driven(options, seeds).rows
        people = rows.get(PEOPLE.label, [])
        baseline.extend(people)
        check_baseline(baseline, ENOUGH_BASELINE)
        # Of a small share no vehicle is a CAV on some seeds: then it is people alone who drive.
        return {
            option: [
                alone if row["error"] == NoCavError.__name__ else row
                for row, alone in zip(rows[option.label], people, strict=True)
            ]
            for option in options
        }

    choice = choose(asked.options, drive, budget, asked.precision, on_line)
    rows, judged, chose = {PEOPLE: choice.rows[PEOPLE]}, list[Judged](), budget.spent
    if choice.finalists:
        rows, judged = judge(choice.finalists, drive, budget, asked.precision, on_line)
    check_baseline(baseline)
    beside = shown_beside(judged)
    on_line("pictures of people alone" + ("" if beside is None else " and with CAVs, same seed"))
    pictured = [PEOPLE] if beside is None else [PEOPLE, Option(beside.share, beside.driver)]
    seeds = held_out_seeds(1) if judged else choosing_seeds(1)
    shown = driven(pictured, seeds, pictured=True).shown

    about = {"scenario": Path(asked.file).name, "reward": asked.road.reward, "manifest": manifest()}
    tried = {option.label: found for option, found in choice.rows.items()}
    fresh = rows if judged else {}
    notes = notes_of_rows({each.label: [*found, *fresh.get(each, ())] for each, found in choice.rows.items()})
    document = {**about, **_document(asked, choice, rows, judged, chose, budget), "notes": notes}
    save_evaluation(folder / CHOOSING, Evaluation(tried, {}), about)
    save_evaluation(folder, Evaluation({each.label: found for each, found in rows.items()}, shown), about)
    write_whole(folder / ASSESSMENT_FILE, to_json(document, indent=1))
    page = write_assessment(folder, folder / ASSESSMENT_PAGE)
    return Assessment(judged, json.loads(to_json(document)), page)


def _document(
    asked: Question,
    choice: Choice,
    rows: dict[Option, Rows],
    judged: Sequence[Judged],
    chose: int,
    budget: Budget,
) -> dict[str, Any]:
    """Return what is known in the end, but for the rows."""
    best = recommended(judged)
    tried = [
        {
            **option._asdict(),
            "set_aside": choice.set_aside.get(option, ""),
            "chosen": option in choice.finalists,
            "effect": asdict(choice.effect(option)),
        }
        for option in asked.options
    ]
    found = [{**asdict(each), "reasons": each.reasons, "words": each.words} for each in judged]
    return {
        "headline": headline(judged),
        "recommended": best and {"share": best.share, "driver": best.driver},
        "judged": found,
        "tried": tried,
        "people": {name: asdict(estimate_of(rows[PEOPLE], name)) for name in METRICS_OF_PEOPLE},
        "road": {**scenario_recipe(asked.road), "file": asked.file},
        "people_drive": asked.road.people_in_words,
        "drivers": {name: driver.recipe().get("parameters", {}) for name, driver in asked.drivers.items()},
        "shares": asked.shares,
        "precision": asked.precision,
        "budget": {"episodes": asked.episodes, "minutes": asked.minutes},
        "episodes": {"choosing": chose, "all": budget.spent},
        "seeds": {"choosing": len(choice.rows[PEOPLE]), "judging": len(rows[PEOPLE]) if judged else 0},
    }
