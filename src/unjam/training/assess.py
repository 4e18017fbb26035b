"""What would CAVs do on the user's own road? Controllers at several penetration rates, and two baselines.

The baselines are human drivers alone, and ACC vehicles without a controller. A controller is chosen for each
penetration rate on tuning seeds and tested on others; a rule says whether it is recommended.
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
from unjam.measures.effect import AccResult, Judged, headline, recommended, shown_beside
from unjam.measures.notes import check_baseline, notes_of_rows
from unjam.measures.statistics import estimate_of
from unjam.reports.assessment import ASSESSMENT_FILE, ASSESSMENT_PAGE, write_assessment
from unjam.scenarios import NAMED_BEFORE, make_scenario, scenario_recipe
from unjam.scenarios.own_network import WITH_OWN_ACC, OwnNetwork
from unjam.scenarios.scenario import Scenario
from unjam.training.choice import (
    ACC,
    HUMAN,
    UNCHANGED_ACC,
    Budget,
    Choice,
    Findings,
    OnLine,
    Option,
    Rows,
    Seed,
    choose,
    in_words,
    judge,
    least_episodes,
)
from unjam.training.evaluate import Evaluation, evaluate_each, raise_failure, save_evaluation
from unjam.training.folder import make_new_folder
from unjam.training.seeds import held_out_seeds
from unjam.worlds.episode import can_drive
from unjam.worlds.workers import Workers

DRIVERS_OF_OPEN_ROADS = (BEST, "follower-stopper", "pi")
"""controllers that are tried where none is named: they fit roads with ends"""
PROPERTIES = ("acceleration", "deceleration", "keep_right", "overtake")
"""settings of the CAVs' ACC that replace a property of the vehicle"""
ENOUGH_BASELINE = 20
"""episodes of the baseline for which early ends are counted before the last one: two of them are too many"""
FOR_PICTURES = 2
"""episodes of the budget that are kept for pictures"""
NOBODY = 1e-12
"""share of CAVs where people are alone: a network without any is not allowed"""
CHOOSING = "choosing"
"""folder within the results: the rows of the seeds that chose"""
WHO_IS_A_CAV = "cav_share", "cav_types", "cavs"
"""settings of a road that the penetration rates stand for"""
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
    road: OwnNetwork
    """with human drivers alone"""
    drivers: dict[str, Driver]
    """the controllers"""
    shares: tuple[float, ...]
    episodes: int
    """at most, in all"""
    minutes: float | None
    """at most, looked at between batches"""
    precision: float
    """half-width of the interval of travel time that is narrow enough, as a share of people's"""

    @property
    def options(self) -> list[Option]:
        """All penetration rates with all controllers."""
        return [Option(share, driver) for share in self.shares for driver in self.drivers]

    @property
    def sets_properties(self) -> bool:
        """Whether the user replaces a property of the vehicles by another one for CAVs."""
        return any(getattr(self.road.cruise, name) is not None for name in PROPERTIES)

    def setup(self, option: Option) -> tuple[Scenario, Driver]:
        """Return the road with so many CAVs, and their driver."""
        if option == HUMAN:
            return self.road, make_driver(HUMAN.driver, self.road.decision_step)
        road = replace(self.road, cav_share=option.share)
        if option.driver not in (ACC, UNCHANGED_ACC):
            return road, self.drivers[option.driver]
        cruise = road.cruise
        if option.driver == UNCHANGED_ACC:
            cruise = replace(cruise, **dict.fromkeys(PROPERTIES))
        safety = replace(road.safety, active=False)
        return replace(road, actuation="cruise", safety=safety, cruise=cruise), make_driver(
            ACC, road.decision_step
        )


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
    assert isinstance(road, OwnNetwork)
    made = {name: make_driver(name, road.decision_step) for name in drivers if name != ACC}
    for name, driver in made.items():
        if driver.native or not can_drive(driver, road):
            why = "the human baseline is driven anyway" if driver.native else "one that needs no closed road"
            raise wrong("driver", name, why)
    asked_for = Question(file, road, made, asked, episodes, minutes, precision)
    least = least_episodes(len(asked), len(made), asked_for.sets_properties) + FOR_PICTURES
    if episodes < least:
        controllers = f"{len(asked)} penetration rates and {len(made)} controllers"
        raise wrong("episodes", episodes, f">= {least} for {controllers}")
    return asked_for


@dataclass(frozen=True)
class Assessment:
    """The answer."""

    judged: list[Judged]
    """the controller that was chosen for each penetration rate; none where all were set aside"""
    acc: list[AccResult]
    """what ACC vehicles alone do at each penetration rate"""
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
    budget, baseline = Budget(asked.episodes - 1, asked.minutes, workers.count), Rows()

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
        humans = rows[HUMAN.label]
        baseline.extend(humans)
        check_baseline(baseline, ENOUGH_BASELINE)
        # On a seed with which a small share picks no vehicle, human drivers alone are driven.
        return {
            option: [
                alone if row["error"] == NoCavError.__name__ else row
                for row, alone in zip(rows[option.label], humans, strict=True)
            ]
            for option in options
        }

    first = driven([HUMAN], held_out_seeds(1), pictured=True)
    raise_failure(first.rows[HUMAN.label])
    took, whole = in_words(budget.elapsed), in_words(budget.seconds_for(budget.episodes))
    on_line(
        f"an episode of the human baseline took {took}; all {asked.episodes} episodes on {workers.count} "
        f"workers may take {whole}" + (f", but at most {asked.minutes:g} min" if asked.minutes else "")
    )
    choice = choose(asked.options, drive, budget, on_line)
    chose = budget.spent - 1
    tested = judge(
        choice.finalists, asked.shares, asked.sets_properties, drive, budget, asked.precision, on_line
    )
    best = shown_beside(tested.judged)
    option = Option(best.share, best.driver) if best else Option(asked.shares[-1], ACC)
    shown = first.shown | driven([option], held_out_seeds(1), pictured=True).shown

    about = {"scenario": Path(asked.file).name, "reward": asked.road.reward, "manifest": manifest()}
    tried = {option.label: found for option, found in choice.rows.items()}
    rows = {option.label: found for option, found in tested.rows.items()}
    check_baseline(baseline)
    notes = [
        *notes_of_rows({label: [*tried.get(label, ()), *found] for label, found in rows.items()}),
        *asked.road.notes,
    ]
    document = {**about, **_document(asked, choice, tested, chose, budget), "notes": notes}
    save_evaluation(folder / CHOOSING, Evaluation(tried, {}), about)
    save_evaluation(folder, Evaluation(rows, shown), about)
    write_whole(folder / ASSESSMENT_FILE, to_json(document, indent=1))
    page = write_assessment(folder, folder / ASSESSMENT_PAGE)
    return Assessment(tested.judged, tested.acc, json.loads(to_json(document)), page)


def _document(asked: Question, choice: Choice, found: Findings, chose: int, budget: Budget) -> dict[str, Any]:
    """Return what is known in the end, but for the rows."""
    best = recommended(found.judged)
    tried = [
        {
            **option._asdict(),
            "set_aside": choice.set_aside.get(option, ""),
            "chosen": option in choice.finalists,
            "effect": asdict(choice.effect(option)),
        }
        for option in asked.options
        if choice.rows[option]
    ]
    return {
        "headline": headline(found.judged, found.acc, found.rows[HUMAN]),
        "recommended": best and {"share": best.share, "driver": best.driver},
        "judged": [{**asdict(each), "reasons": each.reasons, "words": each.words} for each in found.judged],
        "acc": [{**asdict(each), "driver": ACC, "words": each.words} for each in found.acc],
        "tried": tried,
        "people": {name: asdict(estimate_of(found.rows[HUMAN], name)) for name in METRICS_OF_PEOPLE},
        "road": {**scenario_recipe(asked.road), "file": asked.file},
        "people_drive": asked.road.people_in_words,
        "drivers": {name: driver.recipe().get("parameters", {}) for name, driver in asked.drivers.items()},
        "shares": asked.shares,
        "precision": asked.precision,
        "budget": {"episodes": asked.episodes, "minutes": asked.minutes},
        "episodes": {"choosing": chose, "all": budget.spent},
        "seeds": {"choosing": len(choice.rows[HUMAN]), "judging": len(found.rows[HUMAN])},
    }
