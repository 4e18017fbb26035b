"""`unjam search`: find settings that learn better."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    AgentOption,
    ConfigOption,
    ExecutorOption,
    ExpertOption,
    JsonOption,
    OutOption,
    OwnScenarioArgument,
    PresetOption,
    RewardOption,
    RunSeedOption,
    SettingsOption,
    StepsOption,
    assignments,
    executor_named,
    new_folder,
    run_changes,
)


def search(
    scenario: OwnScenarioArgument = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="What is varied: key=low..high, key=low..high:log, or key=a,b,c."),
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="Trainings in all.")] = 20,
    preset: PresetOption = "",
    config: ConfigOption = None,
    settings: SettingsOption = None,
    steps: StepsOption = None,
    seed: RunSeedOption = None,
    agent: AgentOption = None,
    expert: ExpertOption = None,
    reward: RewardOption = "",
    workers: Annotated[int, typer.Option(min=1, help="Trainings at once.")] = DEFAULT_WORKERS,
    executor: ExecutorOption = "local",
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Search for settings that learn better: many trainings, proposed by Optuna.

    Trials are judged by their validations, never by the held-out seeds. After a stop the same command goes
    on; the best settings are in best.toml, for `unjam train --config`.

    Examples:

      unjam search ring --steps 60000 --vary trpo.target_kl=0.003..0.1:log --vary policy.hold=0.1..2.0

      unjam search merge --agent ppo --vary expert=acc,bcm,lacc --trials 30 --workers 8 --out runs/search

      unjam search ring --vary policy.exploration_std=0.05..0.5 --executor ray --workers 64 --out /shared/it
    """
    from unjam.cli.output import aside, console, print_json
    from unjam.training.config import load_config
    from unjam.training.search import BEST
    from unjam.training.search import search as run
    from unjam.training.search_space import check_space, space_of

    changes = run_changes(scenario, steps, seed, agent, expert, reward)
    changes |= assignments(settings)
    base, space = load_config(config, preset, changes), space_of(vary or [])
    runner = executor_named(executor)
    base = replace(base, workers=1)
    check_space(base, space)
    folder = new_folder(out, f"search-{Path(base.scenario).stem}")
    found = run(base, space, trials, folder, workers, runner, (lambda line: None) if json else aside.print)
    best = folder / BEST
    if json:
        rows = [{"trial": one.number, "gain": one.gain, "values": one.values} for one in found]
        print_json({"folder": str(folder), "best": str(best), "trials": rows})
        return
    for one in found[:5]:
        values = ", ".join(f"{key}={value}" for key, value in one.values.items())
        gain = "failed" if one.gain is None else f"{one.gain:+.1f}"
        console.print(f"trial {one.number}: {gain} beyond the expert, validation seeds: {values}")
    console.print(f"train with the best: unjam train --config {best}", soft_wrap=True)
