"""Tuning: how far an expert gets by its parameters alone, with as many actual steps as a training has.

What a training gains is judged beside this: `unjam tune`, with Optuna, on seeds of its own, under the same
limits and filter. Settings that no car could drive do not count.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from math import inf
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from unjam.controller.file import SUFFIX, controller_bytes
from unjam.drivers.driver import Driver, labelled
from unjam.drivers.registry import DRIVERS, named_driver
from unjam.drivers.wrappers import Mixed
from unjam.errors import InputError, UnjamError, wrong_name
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.drivable import DRIVABLE, drivable_in_all
from unjam.measures.metrics import measure
from unjam.scenarios import scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.training.evaluate import raise_failure
from unjam.training.folder import origin
from unjam.training.search import Choice, Range, Space, quiet_optuna
from unjam.training.seeds import tuning_seeds
from unjam.worlds.batch.run import run_batch
from unjam.worlds.batch.world import why_not
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

TUNED = "tuned.json"
EPISODES = 8
"""of each setting that is tried"""
FINALISTS = 5
"""settings that are driven again, on twice as many other seeds: else the luckiest would win"""
SCREENED = 8
"""settings that are screened at once, each on rings of its own"""
WIDTH = 4.0
"""a parameter is varied from its default over this to its default times this"""
TO_ONE = 1.0
"""upper end for a parameter that is zero by default"""


@dataclass(frozen=True)
class Setting:
    """Parameters of an expert that were tried."""

    driver: str
    """as `--driver` takes it"""
    values: dict[str, Any]
    score: float | None
    """mean return; None where no car could drive so"""
    verdict: str


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
    """driven in batches of rings, where settings were screened"""
    file: Path
    """the tuned expert as a controller"""


def space_around(expert: str, time_step: float) -> Space:
    """Return the ranges around an expert's parameters: four times less and more, all words, both truths.

    Raises:
        InputError: there is no such expert, or nothing of it can be varied.
    """
    default = named_driver(expert, time_step)
    if expert not in DRIVERS or default.native:
        known = [name for name, kind in DRIVERS.items() if not kind.native]
        raise wrong_name("expert", expert, known)
    space: Space = {}
    hints = get_type_hints(type(default))
    for field in fields(default):  # pyright: ignore[reportArgumentType]
        around = _around(getattr(default, field.name), hints[field.name])
        if around is not None and field.name != "time_step":
            space[field.name] = around
    if not space:
        raise InputError(f"expert: {expert!r} has nothing to tune")
    return space


def _around(value: Any, hint: Any) -> Range | Choice | None:
    """Return what is tried of a parameter; None where nothing is near, as for a list."""
    if isinstance(value, bool):
        return Choice((False, True))
    if get_origin(hint) is Literal:
        return Choice(get_args(hint))
    if not isinstance(value, int | float):
        return None
    if value == 0:
        return Range(0.0, TO_ONE)
    if isinstance(value, int):
        return Range(max(1, round(value / WIDTH)), round(value * WIDTH), log=True)
    ends = sorted((float(value) / WIDTH, float(value) * WIDTH))
    return Range(*ends, log=value > 0)


def tune(
    scenario: Scenario,
    expert: str,
    space: Space,
    steps: int,
    folder: Path,
    workers: Workers,
    reward: str = "",
    seed: int = 0,
    on_line: Callable[[str], None] = lambda line: None,
    screen: bool = False,
) -> Tuned:
    """Search an expert's parameters, and write `tuned.json` and the expert as `EXPERT.unjam` into a folder.

    Args:
        scenario: road, limits and filter.
        expert: its name.
        space: what is varied, of `space_around` or `search.space_of`.
        steps: that may be driven in all.
        folder: exists and is empty.
        workers: drive; the result does not depend on how many.
        reward: what is maximised; empty: the scenario's own.
        seed: of the proposals.
        on_line: gets a line for each setting.
        screen: whether settings are tried in batches of rings, which are SUMO's but for rounding, and only
            the finalists, and the expert as it is, in SUMO.

    Raises:
        InputError: the steps are too few, a parameter is wrong, or the road cannot be stepped in a batch.
        UnjamError: no car could drive any of the settings.
        MissingPartError: Optuna is not installed.
    """
    each = EPISODES * scenario.horizon
    final = (FINALISTS + 1) * 2 * each
    trials = (steps - final) // each
    if trials < 2:
        raise InputError(f"steps: {steps} is not allowed; allowed: >= {final + 2 * each} for two settings")

    if screen and (why := why_not(scenario)):
        raise InputError(f"screen: {why}")

    def made(values: dict[str, Any]) -> Driver | Setting:
        try:
            return named_driver(labelled(expert, values), scenario.decision_step)
        except InputError as error:  # parameters that do not go together
            return Setting(labelled(expert, values), values, None, str(error))

    def driven(values: dict[str, Any], first: int, episodes: int) -> Setting:
        driver = made(values)
        if isinstance(driver, Setting):
            return driver
        tasks = [
            EpisodeTask(scenario.part(part, episodes), driver, number, reward)
            for part, number in enumerate(tuning_seeds(episodes, first))
        ]
        return _judged(labelled(expert, values), values, workers.run(tasks))

    def tried(all_values: list[dict[str, Any]]) -> list[Setting]:
        if not screen:
            return [driven(values, 0, EPISODES) for values in all_values]
        drivers = [made(values) for values in all_values]
        episodes = iter(_screened(scenario, [one for one in drivers if isinstance(one, Driver)], reward))
        return [
            one if isinstance(one, Setting) else _judged(labelled(expert, values), values, next(episodes))
            for values, one in zip(all_values, drivers, strict=True)
        ]

    optuna, settings = quiet_optuna("tune"), list[Setting]()
    sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    at_once = SCREENED if screen else 1
    for first in range(0, trials, at_once):
        asked = [study.ask() for _ in range(first, min(first + at_once, trials))]
        for trial in asked:
            for key, values in space.items():
                values.suggest(trial, key)
        found = tried([{key: _rounded(value) for key, value in trial.params.items()} for trial in asked])
        for trial, setting in zip(asked, found, strict=True):
            failed = None if setting.score is not None else optuna.trial.TrialState.FAIL
            study.tell(trial, setting.score, state=failed)
            settings.append(setting)
            said = setting.verdict if setting.score is None else f"{setting.score:.0f}"
            on_line(f"{len(settings)} of {trials}: {setting.driver}: {said}")
    ranked = sorted(settings, key=lambda one: -inf if one.score is None else one.score, reverse=True)
    again = [driven(one.values, EPISODES, 2 * EPISODES) for one in ranked[:FINALISTS]]
    default = driven({}, EPISODES, 2 * EPISODES)
    finalists = [one for one in (*again, default) if one.score is not None]
    if not finalists:
        raise UnjamError(f"no car could drive any of {trials} settings of {expert}: {default.verdict}")
    best = max(finalists, key=lambda one: one.score or 0.0)
    file = folder / f"{expert}{SUFFIX}"
    actual, imagined = (final, trials * each) if screen else (trials * each + final, 0)
    tuned = Tuned(best, default, settings, actual, imagined, file)
    _write(scenario, expert, tuned, folder, reward, seed)
    return tuned


def _judged(driver: str, values: dict[str, Any], episodes: Sequence[Episode]) -> Setting:
    """Return a setting with its score and its verdict."""
    rows = [measure(episode) for episode in episodes]
    raise_failure(rows)
    verdict = drivable_in_all([{**row, "people_beyond_4_5": 0.0} for row in rows])
    score = float(np.mean([row["return"] for row in rows])) if verdict == DRIVABLE else None
    return Setting(driver, values, score, verdict)


def _screened(scenario: Scenario, drivers: list[Driver], reward: str) -> list[list[Episode]]:
    """Return the episodes of each driver, all driven in one batch."""
    if not drivers:
        return []
    import torch

    # Rings go round the drivers as CAVs do in a mixture: a ring's CAVs all have the same one.
    together = drivers[0] if len(drivers) == 1 else Mixed(tuple(drivers))
    tasks = [
        EpisodeTask(scenario.part(part, EPISODES), together, number, reward)
        for part, number in enumerate(tuning_seeds(EPISODES))
        for _ in drivers
    ]
    episodes = run_batch(tasks, torch.as_tensor if together.tensors else np.asarray)
    return [episodes[number :: len(drivers)] for number in range(len(drivers))]


def _rounded(value: Any) -> Any:
    """Return a number with as many digits as anybody wants to read; words as they are."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _write(scenario: Scenario, expert: str, found: Tuned, folder: Path, reward: str, seed: int) -> None:
    about = {
        "scenario": scenario_recipe(scenario),
        "expert": expert,
        "reward": reward or scenario.reward,
        "seed": seed,
        "actual_steps": found.actual_steps,
        "imagined_steps": found.imagined_steps,
        "best": asdict(found.best),
        "default": asdict(found.default),
    }
    driver = named_driver(found.best.driver, scenario.decision_step)
    tuned = {
        key: about[key] for key in ("reward", "seed", "actual_steps", "imagined_steps", "best", "default")
    }
    content = controller_bytes(driver, {**origin(scenario, driver), "tuned": tuned})
    write_whole(found.file, content)
    rows = [asdict(one) for one in found.settings]
    write_whole(folder / TUNED, to_json({**about, "manifest": manifest(), "settings": rows}, indent=1))
