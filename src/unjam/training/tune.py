"""Tuning: how far an expert gets by its parameters alone, with as many actual steps as a training has.

What a training gains is judged beside this: `unjam tune`, with Optuna, on seeds of its own, under the same
limits and filter. Settings that no car could drive do not count.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller.file import SUFFIX, controller_bytes
from unjam.drivers.driver import labelled
from unjam.drivers.registry import named_driver
from unjam.errors import InputError, UnjamError, wrong_name
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.drivable import DRIVABLE, drivable_in_all
from unjam.measures.gain import MEAN_GAIN, Rows, ceiling, gain
from unjam.measures.metrics import measure
from unjam.scenarios import scenario_recipe
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.scenario import Scenario
from unjam.training.belonging import hashes_of_files
from unjam.training.evaluate import raise_failure
from unjam.training.folder import origin
from unjam.training.search import quiet_optuna
from unjam.training.seeds import tuning_seeds
from unjam.training.space import Space
from unjam.training.tried import Setting, Tried, Verdict
from unjam.worlds.batch.possible import statistical_why_not, why_not
from unjam.worlds.batch.run import run_batch, run_batches
from unjam.worlds.workers import EpisodeTask, Workers

TUNED = "tuned.json"
EPISODES = 8
"""of each setting that is tried"""
OF_EACH = 2
"""of these on each road, where there are several"""
FINALISTS = 5
"""settings that are driven again, on twice as many other seeds: else the luckiest would win"""
SCREENED = 8
"""settings that are screened at once, each on rings of its own"""

Run = Callable[[list[list[EpisodeTask]]], list[Rows]]
"""runs the tasks of each driver on one road, in SUMO or in a batch, and measures their episodes"""


@dataclass(frozen=True)
class Tuned:
    """What a tuning found."""

    best: Setting
    default: Setting
    """the expert as it is, on the seeds that chose among the finalists"""
    settings: list[Setting]
    """all that were tried, in order"""
    actual_steps: int
    """driven in SUMO"""
    imagined_steps: int
    """driven in batches, where settings were screened there"""
    file: Path
    """the tuned expert as a controller"""


def tune(
    roads: Mapping[str, Scenario],
    expert: str,
    space: Space,
    steps: int,
    folder: Path,
    workers: Workers,
    reward: str = "",
    seed: int = 0,
    on_line: Callable[[str], None] = lambda line: None,
    screen: bool | None = False,
) -> Tuned:
    """Search an expert's parameters, and write `tuned.json` and the expert as `EXPERT.unjam` into a folder.

    What was tried is kept there: a tuning that was stopped goes on where it was, and finds the same.

    On one road the return is maximised. On several it is the mean over the roads of the share that is gained
    of what people alone leave to be gained; who could not be driven on a road gains nothing there.

    Args:
        roads: by name; limits and filter are theirs.
        expert: its name.
        space: what is varied, of `space_around` or `search.space_of`.
        steps: that may be driven in all.
        folder: new, empty, or that of this tuning.
        workers: drive; the result does not depend on how many.
        reward: what is maximised on one road; empty: the scenario's own.
        seed: of the proposals.
        on_line: gets a line for each setting.
        screen: whether settings are tried in batches where a road can be stepped so (of several: exactly),
            and there only the finalists, and the expert as it is, in SUMO; None: if there is one.

    Raises:
        InputError: the steps are too few, a parameter is wrong, no road can be stepped in a batch, or the
            folder holds something else.
        UnjamError: no car could drive any of the settings.
        MissingPartError: Optuna is not installed.
    """
    known = named_driver(expert, 1.0).recipe()["parameters"]
    for key in space:
        if key not in known:
            raise wrong_name("vary", key, known)
    episodes = EPISODES if len(roads) == 1 else OF_EACH
    each = episodes * sum(scenario.horizon for scenario in roads.values())
    # People, who are the measure on several roads, drive as often as a setting and a finalist.
    final = (FINALISTS + 1) * 2 * each + (3 * each if len(roads) > 1 else 0)
    trials = (steps - final) // each
    if trials < 2:
        raise InputError(f"steps: {steps} is not allowed; allowed: >= {final + 2 * each} for two settings")
    why_none = statistical_why_not if len(roads) == 1 else why_not
    reasons = {road: why_none(scenario) for road, scenario in roads.items()}
    if screen and all(reasons.values()):
        raise InputError(f"screen: {next(iter(reasons.values()))}")
    screened = [road for road, why in reasons.items() if screen is not False and not why]
    recipes = {road: scenario_recipe(scenario) for road, scenario in roads.items()}
    wanted = {"roads": recipes, "expert": expert, "space": repr(space), "steps": steps, "reward": reward}
    files = hashes_of_files([reward], *roads.values())
    wanted |= {"files": files} if files else {}
    tried = Tried(folder, wanted | {"seed": seed, "screen": bool(screened)})
    in_sumo = dict.fromkeys(roads, partial(_in_sumo, workers))
    trying = in_sumo | dict.fromkeys(screened, _in_batch)

    @cache
    def alone(first: int, count: int) -> dict[str, Rows]:
        return _driven(roads, ["human"], first, count, reward, in_sumo)[0] if len(roads) > 1 else {}

    def judged(
        all_values: list[dict[str, Any]], first: int, count: int, run: Mapping[str, Run]
    ) -> list[Setting]:
        texts = [labelled(expert, values) for values in all_values]
        scores: dict[str, Verdict] = {text: (None, why) for text in texts if (why := _not_made(text))}
        unknown = [text for text in texts if text not in scores and (first, text) not in tried.known]
        new = list(dict.fromkeys(unknown))
        for text, rows in zip(new, _driven(roads, new, first, count, reward, run), strict=True):
            tried.keep(first, text, _score(rows, alone(first, count)))
        scores |= {text: tried.known[first, text] for text in texts if text not in scores}
        return [Setting(text, values, *scores[text]) for text, values in zip(texts, all_values, strict=True)]

    optuna, settings = quiet_optuna("tune"), list[Setting]()
    sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    motorways = any(isinstance(roads[road], OnRamp) for road in screened)  # many take as long as few
    at_once = SCREENED if screen or motorways else 1
    for first in range(0, trials, at_once):
        asked = [study.ask() for _ in range(first, min(first + at_once, trials))]
        for trial in asked:
            for key, values in space.items():
                values.suggest(trial, key)
        proposed = [{key: _rounded(value) for key, value in trial.params.items()} for trial in asked]
        found = judged(proposed, 0, episodes, trying)
        for trial, setting in zip(asked, found, strict=True):
            failed = None if setting.score is not None else optuna.trial.TrialState.FAIL
            study.tell(trial, setting.score, state=failed)
            settings.append(setting)
            said = setting.verdict if setting.score is None else f"{setting.score:.4g}"
            on_line(f"{len(settings)} of {trials}: {setting.driver}: {said}")
    able = [(one.score, one) for one in settings if one.score is not None]
    ranked = [one for _, one in sorted(able, key=lambda pair: pair[0], reverse=True)]
    different = {one.driver: one.values for one in ranked}
    best_values = list(different.values())[:FINALISTS]
    *again, default = judged([*best_values, {}], episodes, 2 * episodes, in_sumo)
    finalists = [one for one in (*again, default) if one.score is not None]
    if not finalists:
        raise UnjamError(f"no car could drive any of {trials} settings of {expert}: {default.verdict}")
    best = max(finalists, key=lambda one: -inf if one.score is None else one.score)
    file = folder / f"{expert}{SUFFIX}"
    made = {setting.driver for setting in settings if not _not_made(setting.driver)}
    imagined = len(made) * episodes * sum(roads[road].horizon for road in screened)
    unused = (FINALISTS - len(best_values)) * 2 * each
    tuned = Tuned(best, default, settings, len(made) * each + final - unused - imagined, imagined, file)
    _write(roads, expert, tuned, folder, reward, seed, tried.starts)
    return tuned


def _not_made(driver: str) -> str:
    """Return why there is no such driver, as of parameters that do not go together; empty where there is."""
    try:
        named_driver(driver, 1.0)
    except InputError as error:
        return str(error)
    return ""


def _driven(
    roads: Mapping[str, Scenario],
    drivers: Sequence[str],
    first: int,
    count: int,
    reward: str,
    run: Mapping[str, Run],
) -> list[dict[str, Rows]]:
    """Return the rows of each driver, by road, each by its own of `run`, on tuning seeds from `first` on."""
    found: list[dict[str, Rows]] = [{} for _ in drivers]
    seeds = tuning_seeds(count, first)
    for road, scenario in roads.items() if drivers else ():
        tasks = [
            [
                EpisodeTask(scenario.part(part, count), made, number, reward)
                for part, number in enumerate(seeds)
            ]
            for made in (named_driver(driver, scenario.decision_step) for driver in drivers)
        ]
        for rows, measured in zip(found, run[road](tasks), strict=True):
            rows[road] = measured
            raise_failure(measured)
    return found


def _in_sumo(workers: Workers, tasks: list[list[EpisodeTask]]) -> list[Rows]:
    # Measured as they end: a motorway's whole episode takes 80 MB.
    rows = iter(workers.run_each([*chain(*tasks)], lambda index, episode: measure(episode)))
    return [[next(rows) for _ in each] for each in tasks]


def _in_batch(tasks: list[list[EpisodeTask]]) -> list[Rows]:
    import torch

    every = [*chain(*tasks)]
    if isinstance(every[0].scenario, OnRamp):
        driven = iter(run_batches(every, statistical=True))
    else:
        numbers = torch.as_tensor if all(task.driver.tensors for task in every) else np.asarray
        driven = iter(run_batch(every, numbers, statistical=True))
    return [[measure(next(driven)) for _ in each] for each in tasks]


def _score(found: Mapping[str, Rows], people: Mapping[str, Rows]) -> tuple[float | None, str]:
    """Return the score of what was driven, road by road, and the verdict."""
    if people:
        gains = {
            road: gain(rows, people[road], [ceiling(row) for row in people[road]])
            for road, rows in found.items()
        }
        worst = min(gains, key=lambda road: gains[road].mean)
        mean = float(np.mean([each.mean for each in gains.values()]))
        return mean, f"worst on {worst}: {gains[worst].mean:+.2f}"
    (rows,) = found.values()
    verdict = drivable_in_all([{**row, "people_beyond_4_5": 0.0} for row in rows])
    return float(np.mean([row["return"] for row in rows])) if verdict == DRIVABLE else None, verdict


def _rounded(value: Any) -> Any:
    """Return a number with as many digits as anybody wants to read; words as they are."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _write(
    roads: Mapping[str, Scenario],
    expert: str,
    found: Tuned,
    folder: Path,
    reward: str,
    seed: int,
    starts: list[dict[str, Any]],
) -> None:
    recipes = {road: scenario_recipe(scenario) for road, scenario in roads.items()}
    scenario = next(iter(roads.values()))
    about = {
        "scenario": recipes if len(roads) > 1 else scenario_recipe(scenario),
        "expert": expert,
        "reward": reward or (scenario.reward if len(roads) == 1 else MEAN_GAIN),
        "seed": seed,
        "actual_steps": found.actual_steps,
        "imagined_steps": found.imagined_steps,
        "best": asdict(found.best),
        "default": asdict(found.default),
    }
    driver = named_driver(found.best.driver, scenario.decision_step)
    tuned = {key: value for key, value in about.items() if key not in ("scenario", "expert")}
    content = controller_bytes(driver, {**origin(scenario, driver), "tuned": tuned})
    write_whole(found.file, content)
    rows = [asdict(one) for one in found.settings]
    write_whole(
        folder / TUNED,
        to_json({**about, "manifest": {**manifest(), "starts": starts}, "settings": rows}, indent=1),
    )
