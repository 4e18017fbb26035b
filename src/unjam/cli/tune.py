"""How far an expert gets by its parameters alone: `unjam tune`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    JsonOption,
    OutOption,
    RewardOption,
    ScenarioArgument,
    ScenarioSettingsOption,
    SeedOption,
    WorkersOption,
    merge_settings,
    new_folder,
    parse_settings,
    scenario_changes,
    with_options,
)
from unjam.cli.output import console, err_console, print_json, print_next_command, setting_options
from unjam.errors import InputError, invalid_value

SEED_LIMIT = 2**32
"""what proposes settings takes no larger ones"""


@with_options(road=scenario_changes)
def tune_command(
    *,
    scenario: ScenarioArgument,
    expert: Annotated[str, typer.Option("--expert", help="Name of the expert, as in unjam drivers.")] = "pi",
    steps: Annotated[int, typer.Option(min=1, help="Steps in all: as many as a training.")] = 2_000_000,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="What is varied, as in search; without it, all parameters, four times each way."),
    ] = None,
    road: dict[str, Any],
    settings: ScenarioSettingsOption = None,
    reward: RewardOption = "",
    seed: SeedOption = 0,
    screen: Annotated[
        bool | None,
        typer.Option(
            help="Try settings on batches of imagined roads, equal to SUMO's or alike, and only finalists in "
            "SUMO itself; without it, where there are such roads."
        ),
    ] = None,
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Tune an expert's parameters: what needs no learning, with the steps that learning has.

    Settings are judged on seeds of their own, under the road's limits and filter; those that no car could
    drive do not count. The tuned expert is a controller that every verb takes. After a stop the same command
    with the same --out goes on.

    Examples:

      unjam tune ring --expert pi

      unjam tune figure-eight --expert pacer --vary gathering_speed=1..3 --steps 300000

      unjam tune rings --expert pi         (also shared-rings, figure-eights, motorways, or everywhere)
    """
    from unjam.scenarios import make_scenario
    from unjam.training.road_family import FAMILY, ROAD_GROUPS, family_scenarios
    from unjam.training.run_folder import lock_new_folder
    from unjam.training.search_space import default_search_space, expert_search_space
    from unjam.training.trial_log import REQUEST_FILE
    from unjam.training.tune import tune as run
    from unjam.worlds.reward import make_reward
    from unjam.worlds.worker_pool import WorkerPool

    if seed >= SEED_LIMIT:
        raise invalid_value("seed", seed, f"less than {SEED_LIMIT}")
    changes = merge_settings(road, parse_settings(settings))
    if scenario in ROAD_GROUPS:
        if changes or reward:
            raise InputError(f"scenario: with {scenario} neither changes nor a reward are allowed")
        roads = family_scenarios(scenario, "seen")
    else:
        roads = {scenario: make_scenario(scenario, changes)}
    made = next(iter(roads.values()))
    make_reward(reward or made.reward)
    around = default_search_space(expert, made.control_step)
    space = expert_search_space(vary, around) if vary else around
    folder = new_folder(out, f"tune-{Path(scenario).stem}")
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), WorkerPool(workers) as pool:
        found = run(
            *(roads, expert, space, steps, folder, pool, reward, seed),
            (lambda line: None) if json else err_console.print,
            screen,
        )
    best, default = found.best, found.default
    steps_of = {"environment_steps": found.environment_steps, "batch_steps": found.batch_steps}
    if json:
        print_json({"file": str(found.file), "best": asdict(best), "default": asdict(default), **steps_of})
        return
    console.print(f"{found.environment_steps:,} actual steps, {found.batch_steps:,} imagined")
    before = default.verdict if default.score is None else f"{default.score:.4g}"
    console.print(f"{best.driver}: {best.score:.4g} on tuning seeds; {default.driver}: {before}", soft_wrap=True)
    on = FAMILY[next(iter(roads))].scenario if scenario in ROAD_GROUPS else scenario
    options = setting_options(changes, reward=reward)
    print_next_command("drive with it", "drive", on, "--driver", found.file, "--held-out", *options)
