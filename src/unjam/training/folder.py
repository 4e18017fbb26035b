"""The folder of a run: begun, read, gone on with. Free of torch, so that what is wrong is told at once."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.registry import describe
from unjam.drivers.residual import observation_size
from unjam.errors import InputError
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest, package_versions
from unjam.scenarios.registry import scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig, load_config, to_toml
from unjam.worlds.reward import make_reward


def check_possible(config: RunConfig) -> None:
    """Raise `InputError` where an expert, what the network sees, a reward or a baseline is at fault."""
    for road in config.roads().values():
        _check_road(road)
    config.make_tasks()


def _check_road(config: RunConfig) -> None:
    scenario = config.make_scenario()
    of_a_loop = [part for part in config.policy.observe if part in ("loop_length", "place")]
    if of_a_loop and not scenario.closed:
        raise InputError(f"policy.observe: {of_a_loop[0]!r} is not allowed on a road with ends")
    if "route_position" in config.policy.observe and not scenario.has_coordinate:
        raise InputError("policy.observe: 'route_position' is not allowed on a network of one's own")
    observation_size(config.policy.observe, config.make_expert())
    make_reward(config.reward or scenario.reward)
    for name in config.evaluation.baselines:
        make_driver(name, scenario.decision_step)


def start_folder(folder: Path, config: RunConfig) -> None:
    """Make the folder of a new run and write what it is about.

    Raises:
        InputError: the folder holds something already.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"out: {str(folder)!r} is not empty; allowed: a new folder, or --resume {folder}")
    make_folder(folder)
    write_whole(folder / "config.toml", to_toml(config))
    write_whole(folder / "manifest.json", to_json(manifest(), indent=1))


def read_config(folder: Path) -> RunConfig:
    """Return the configuration of a run folder; raise `InputError` where it is none."""
    if not (folder / "config.toml").is_file():
        raise InputError(f"run: {str(folder)!r} is not a run folder: it has no config.toml")
    return load_config(folder / "config.toml")


def continue_folder(folder: Path, config: RunConfig) -> None:
    """Check that `config` may go on with the run in `folder`, and write down its new budget.

    Raises:
        InputError: something else than the budget or the number of workers differs, or the folder is that of
            one road of a run of several.
    """
    whole = folder.absolute().parent
    if (whole / "config.toml").is_file() and folder.name in read_config(whole).roads():
        raise InputError(f"resume: {str(folder)!r} is one road of a run of several; allowed: {whole}")
    before = read_config(folder)
    if replace(before, steps=config.steps, workers=config.workers) != config:
        raise InputError("resume: only steps and workers may change; all else is the run's")
    if config != before:
        write_whole(folder / "config.toml", to_toml(config))


def origin(scenario: Scenario, expert: Driver) -> dict[str, Any]:
    """Return where a controller comes from, for its own manifest: the same for the same run."""
    return {
        "scenario": scenario_recipe(scenario),
        "time_step": scenario.decision_step,
        "action_limit": scenario.action_limit,
        "expert": describe(expert),
        "versions": package_versions(),
    }
