"""Tuning of an expert's parameters: `unjam tune`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli import options as opt
from unjam.cli.output import console, err_console, print_json, print_next_command, setting_options
from unjam.errors import InputError


@opt.with_options(changes=opt.scenario_changes)
def tune_command(
    *,
    scenario: opt.ScenarioArgument,
    expert: Annotated[str, typer.Option("--expert", help="Name of the expert, as in unjam drivers.")] = "pi",
    steps: Annotated[int, typer.Option(min=1, help="Budget of steps, as that of a training.")] = 2_000_000,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Parameters to vary, as in search.", show_default="all, a quarter to four times each"),
    ] = None,
    changes: dict[str, Any],
    settings: opt.ScenarioSettingsOption = None,
    reward: opt.RewardOption = "",
    seed: opt.OptunaSeedOption = 0,
    screen: Annotated[
        bool | None,
        typer.Option(
            help="Evaluate trials in the batch simulator, exact or statistical, and only finalists in SUMO.",
            show_default="where the batch simulator supports the road",
        ),
    ] = None,
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Tune the parameters of an expert with the step budget of a training.

    Trials are evaluated on tuning seeds, with the limits and the safety filter of the road; infeasible ones are
    rejected. The tuned expert is a controller that every command accepts. The same command with the same --out
    continues a stopped tuning.

    Examples:

      unjam tune ring --expert pi

      unjam tune figure-eight --expert pacer --vary gathering_speed=1..3 --steps 300000

      unjam tune rings --expert pi         (also shared-rings, figure-eights, motorways, or all-roads)
    """
    from unjam.scenarios import make_scenario
    from unjam.training.road_family import FAMILY, ROAD_GROUPS, family_scenarios
    from unjam.training.run_folder import lock_new_folder
    from unjam.training.search_space import default_search_space, expert_search_space
    from unjam.training.trial_log import REQUEST_FILE
    from unjam.training.tune import tune
    from unjam.worlds.reward import make_reward
    from unjam.worlds.worker_pool import WorkerPool

    changes = opt.merge_settings(changes, opt.parse_settings(settings))
    if scenario in ROAD_GROUPS:
        if changes or reward:
            raise InputError(f"scenario: with {scenario} neither changes nor a reward are allowed")
        roads = family_scenarios(scenario, "training")
    else:
        roads = {scenario: make_scenario(scenario, changes)}
    first = next(iter(roads.values()))
    make_reward(reward or first.reward)
    space = default_search_space(expert, first.control_step)
    space = expert_search_space(vary, space) if vary else space
    folder = opt.new_folder(out, f"tune-{Path(scenario).stem}")
    on_message = (lambda line: None) if json else err_console.print
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), WorkerPool(workers) as pool:
        result = tune(roads, expert, space, steps, folder, pool, reward, seed, on_message, screen)
    best, default = result.best, result.default
    if json:
        counts = {"environment_steps": result.environment_steps, "batch_steps": result.batch_steps}
        print_json({"file": str(result.file), "best": asdict(best), "default": asdict(default), **counts})
        return
    console.print(f"{result.environment_steps:,} environment steps, {result.batch_steps:,} batch steps")
    default_score = default.verdict if default.score is None else f"{default.score:.4g}"
    scores = f"{best.driver}: {best.score:.4g} on tuning seeds; {default.driver}: {default_score}"
    console.print(scores, soft_wrap=True)
    road = FAMILY[next(iter(roads))].scenario if scenario in ROAD_GROUPS else scenario
    options = setting_options(changes, reward=reward)
    print_next_command("drive with it", "drive", road, "--driver", result.file, "--test-seeds", *options)
