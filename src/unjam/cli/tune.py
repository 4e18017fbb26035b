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
    assignments,
    new_folder,
    scenario_changes,
    together,
    with_options,
)
from unjam.cli.output import as_options, aside, console, print_json, say_next
from unjam.errors import InputError, wrong

SEEDS_BELOW = 2**32
"""what proposes settings takes no larger ones"""


@with_options(road=scenario_changes)
def tune(
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
    from unjam.training.family import FAMILY, GROUPS, roads_of
    from unjam.training.folder import new_and_owned
    from unjam.training.space import space_around, space_asked
    from unjam.training.tried import ASKED
    from unjam.training.tune import tune as run
    from unjam.worlds.reward import make_reward
    from unjam.worlds.workers import Workers

    if seed >= SEEDS_BELOW:
        raise wrong("seed", seed, f"less than {SEEDS_BELOW}")
    changes = together(road, assignments(settings))
    if scenario in GROUPS:
        if changes or reward:
            raise InputError(f"scenario: with {scenario} neither changes nor a reward are allowed")
        roads = roads_of(scenario, "seen")
    else:
        roads = {scenario: make_scenario(scenario, changes)}
    made = next(iter(roads.values()))
    make_reward(reward or made.reward)
    around = space_around(expert, made.decision_step)
    space = space_asked(vary, around) if vary else around
    folder = new_folder(out, f"tune-{Path(scenario).stem}")
    with new_and_owned(folder, or_with=ASKED), Workers(workers) as pool:
        found = run(
            *(roads, expert, space, steps, folder, pool, reward, seed),
            (lambda line: None) if json else aside.print,
            screen,
        )
    best, default = found.best, found.default
    steps_of = {"actual_steps": found.actual_steps, "imagined_steps": found.imagined_steps}
    if json:
        print_json({"file": str(found.file), "best": asdict(best), "default": asdict(default), **steps_of})
        return
    console.print(f"{found.actual_steps:,} actual steps, {found.imagined_steps:,} imagined")
    before = default.verdict if default.score is None else f"{default.score:.4g}"
    console.print(
        f"{best.driver}: {best.score:.4g} on tuning seeds; {default.driver}: {before}", soft_wrap=True
    )
    on = FAMILY[next(iter(roads))].scenario if scenario in GROUPS else scenario
    options = as_options(changes, reward=reward)
    say_next("drive with it", "drive", on, "--driver", found.file, "--held-out", *options)
