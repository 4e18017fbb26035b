"""`unjam benchmark` measures a driver on a suite of roads with fixed test seeds, and compares files of results."""

import re
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from unjam.benchmarks.suites import DEFAULT_SUITE, SUITES
from unjam.cli import options as opt
from unjam.cli.output import console, err_console, new_table, print_json, print_next_command
from unjam.controller import DEFAULT_DRIVER
from unjam.errors import InputError, invalid_value
from unjam.files import atomic_write, make_folder
from unjam.text import format_count

LEADERBOARD_WIDTH = 80  # [characters]


def benchmark_command(
    names: Annotated[
        list[str] | None,
        Argument(
            help="Driver of the CAVs, as in drive --driver; with --compare, files of results.",
            show_default=DEFAULT_DRIVER,
        ),
    ] = None,
    suite: Annotated[str, Option(help=f"Set of roads: {', '.join(SUITES)}.")] = DEFAULT_SUITE,
    out: Annotated[
        Path | None,
        Option(
            help="File for the result; repeat the command to continue it. With --compare, an .svg or .png file.",
            show_default="under runs/",
        ),
    ] = None,
    compare: Annotated[bool, Option("--compare", help="Print and draw the leaderboard of result files.")] = False,
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    backend: Annotated[
        str, Option(help="Simulator: exact (batch on rings, else sumo), sumo, batch, or your own: path.py:name.")
    ] = "exact",
    training_steps: Annotated[
        int | None,
        Option(
            min=0,
            help="Environment steps of the training: calls of env.step in all environments together. "
            "A value in the file of the driver has priority.",
        ),
    ] = None,
    roads: Annotated[
        str, Option(help="Roads of the suite for a trial, joined by commas. Only a trial with --out can be continued.")
    ] = "",
    json: opt.JsonOption = False,
) -> None:
    """Measure the gain of a driver on the test seeds of a suite: 0 is the human baseline, 1 the best tuned expert.

    Examples:

    - unjam benchmark pi --suite closed-roads-v1
    - unjam benchmark my_driver.py:gentle --suite closed-roads-v1 --roads ring-22-dense,figure-eight-14
    - unjam benchmark my_driver.py:gentle --suite closed-roads-v1 --out gentle.json
    - unjam benchmark policy.onnx --training-steps 1000000
    - unjam benchmark --compare gentle.json results/benchmark/*.json
    """
    if compare:
        _print_leaderboard(names or [], out or Path("runs") / "leaderboard.svg", json)
        return
    if len(names or []) > 1:
        raise invalid_value("driver", " ".join(names or []), "one driver, or files with --compare")
    from unjam.benchmarks.run import benchmark

    driver = (names or [DEFAULT_DRIVER])[0]
    selected_roads = [name.strip() for name in roads.split(",")] if roads else []
    if out is None and not selected_roads:
        slug = re.sub(r"[^\w-]+", "-", Path(driver).stem)[:40].strip("-")
        out = Path("runs") / f"benchmark-{suite}-{slug}.json"
    on_message = (lambda text: None) if json else (lambda text: err_console.print(text, soft_wrap=True))
    result = benchmark(driver, suite, out, workers, backend, training_steps, on_message, selected_roads)
    trial = {"missing_roads": result.missing_roads, "gains": result.road_rows()} if result.missing_roads else {}
    if json:
        print_json(trial | result.document())
        return
    table = new_table(("road", "part"), ("gain", "95 % CI"))
    table.add_column("feasible")
    for row in result.road_rows():
        interval = f"[{row['low']:.2f}, {row['high']:.2f}]"
        table.add_row(row["road"], row["part"], f"{row['gain']:.2f}", interval, row["feasible"])
    console.print(table)
    if out is not None:
        err_console.print(f"result: {out}", soft_wrap=True)
    if trial:
        total = format_count(len(result.roads) + len(result.missing_roads), "road")
        progress = f"{len(result.roads)} of {total} of {suite}"
        err_console.print(f"trial: {progress}; the same command without --roads drives all", soft_wrap=True)
    else:
        print_next_command("compare it", "benchmark", "--compare", out, "OTHER.json")


def _print_leaderboard(names: list[str], out: Path, json: bool) -> None:
    """Print the leaderboard of result files, and draw it into a file."""
    if not names:
        raise InputError("compare: no files; allowed: results of `unjam benchmark`")
    if out.suffix not in (".svg", ".png"):
        raise invalid_value("out", str(out), "a file that ends in .svg or .png")
    from unjam.benchmarks import leaderboard
    from unjam.reports.figures import png_bytes, svg_bytes

    results = leaderboard.read_leaderboard([Path(name) for name in names])
    make_folder(out.parent)
    atomic_write(out, (svg_bytes if out.suffix == ".svg" else png_bytes)(leaderboard.leaderboard_figure(results)))
    if json:
        print_json({label: {"driver": result.driver, **result.summary()} for label, result in results.items()})
        return
    table = new_table(leaderboard.HEADINGS[:1], leaderboard.HEADINGS[1:])
    table.padding, table.columns[0].no_wrap = (0, 1, 0, 0), False  # a name may be long
    for row in leaderboard.leaderboard_rows(results):
        table.add_row(*row)
    console.print(table, width=LEADERBOARD_WIDTH)
    err_console.print(f"picture: {out}", soft_wrap=True)
