"""`unjam bench`: speed on this machine, beside the limit."""

from typing import Annotated

import typer

from unjam.cli.options import JsonOption


def bench(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds in which all parts are measured in turn.")] = 7,
    json: JsonOption = False,
) -> None:
    """Measure how fast episodes run here, beside bare SUMO, the same over TraCI, and virtual ones.

    One core. Look at the ratios: steps per second change with the machine, and with the minute.

    Example:

      unjam bench
    """
    from rich.table import Table

    from unjam.cli.output import aside, console, print_json
    from unjam.training.speed import measure_speed

    found = measure_speed(rounds, lambda line: aside.print(line))
    if json:
        print_json(found)
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("ring, 22 vehicles, one core")
    table.add_column("steps/s", justify="right")
    table.add_column("ratio", justify="right")
    table.add_row("bare SUMO", f"{found['bare_steps_per_s']:,.0f}", "1")
    table.add_row(
        "run_episode, residual that looks once a second",
        f"{found['episode_steps_per_s']:,.0f}",
        f"{found['over_bare']:.2f} of bare",
    )
    table.add_row(
        "run_episode, residual that looks in every step",
        f"{found['every_step_steps_per_s']:,.0f}",
        f"{found['over_bare_every_step']:.2f} of bare",
    )
    table.add_row(
        "the first of these over TraCI",
        f"{found['traci_steps_per_s']:,.0f}",
        f"{found['over_traci']:.1f} times slower",
    )
    for rollouts in found["virtual"].values():
        table.add_row(
            f"virtual environment, {rollouts['rows']:,} rollouts of {rollouts['decisions']} decisions",
            f"{rollouts['steps_per_s']:,.0f}",
            f"{rollouts['over_actual']:.0f} times run_episode",
        )
    for name, road in found["roads"].items():
        table.add_row(f"{name}: bare SUMO", f"{road['bare_steps_per_s']:,.0f}", "1")
        speed, ratio = road["episode_steps_per_s"], road["over_bare"]
        table.add_row(f"{name}: run_episode", f"{speed:,.0f}", f"{ratio:.2f} of bare")
    console.print(table)
    for entry in found["scaling"]:
        console.print(
            f"{entry['vehicles']:>5} vehicles: {entry['us_per_vehicle_step']:.2f} us a vehicle-step"
        )
