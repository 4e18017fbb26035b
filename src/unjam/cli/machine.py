"""This machine: `unjam doctor` says whether everything is there, `unjam bench` how fast episodes run."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Literal

import typer
from rich.markup import escape

from unjam.cli.options import JsonOption
from unjam.cli.output import aside, console, new_table, print_json
from unjam.errors import MissingPartError, UnjamError
from unjam.files import make_folder
from unjam.processes import has_display, protections

RESULTS_SUMO = "1.28.0"
"""version of SUMO that all results of the documentation were made with"""
TESTED_SUMO = RESULTS_SUMO.rpartition(".")[0]
"""minor version of SUMO that is supported"""
TORCH_CPU = "https://download.pytorch.org/whl/cpu"
"""index of builds of torch that are a tenth of the size of those for graphics cards"""


def doctor(json: JsonOption = False) -> None:
    """Check SUMO, its version, a display, the cache, and one real episode; say what to do where one fails.

    Exit code 3 if a needed part is missing.

    Example:

      unjam doctor
    """
    checks = check_health()
    missing = [check for check in checks if not check.ok and check.needed]
    if json:
        print_json({"ok": not missing, "checks": [asdict(check) for check in checks]})
    else:
        for check in checks:
            wanting = "[red]missing[/red]" if check.needed else "[yellow]no[/yellow]     "
            mark = "[green]ok[/green]     " if check.ok else wanting
            console.print(f"{mark} {check.name}: {escape(check.found)}", markup=True)
            if not check.ok:
                console.print(f"        {check.remedy}")
    if missing:
        raise typer.Exit(MissingPartError.exit_code)


@dataclass(frozen=True)
class Check:
    """One thing that should be there."""

    name: str
    ok: bool
    found: str
    remedy: str = ""
    needed: bool = True


def check_health() -> list[Check]:
    """Return all checks, the costliest last: an episode in a worker process."""
    from unjam.worlds.sumo.networks import sumo_program

    python, sumo = platform.python_version(), f"pip install eclipse-sumo=={RESULTS_SUMO}"
    display = has_display()
    no_display = "for unjam watch without a display: --video FILE, or xvfb-run unjam watch ..."
    return [
        Check("Python", sys.version_info >= (3, 11), python, "install Python 3.11 or newer"),
        _sumo_package("libsumo"),
        _sumo_package("eclipse-sumo"),
        _sumo_package("traci", needed=False),
        _sumo_of_results(),
        _try("netconvert", lambda: sumo_program("netconvert"), sumo),
        *map(_learning, ("torch", "stable-baselines3", "sb3-contrib")),
        _cache(),
        _files_of_others(),
        Check("display", display, "there" if display else "none", no_display, needed=False),
        _video(),
        _try("an episode in a worker", _episode, "see the message; unjam drive ring --driver pi tells more"),
    ]


def _package(name: str) -> Check:
    try:
        return Check(name, True, version(name))
    except PackageNotFoundError:
        return Check(name, False, "not installed", f"pip install {name}")


def _learning(name: str) -> Check:
    check = _package(name)
    remedy = "only what learns needs it: pip install 'unjam[train]' --extra-index-url " + TORCH_CPU
    return Check(name, check.ok, check.found, remedy, needed=False)


def _sumo_package(name: str, needed: bool = True) -> Check:
    check = _package(name)
    remedy = f"pip install {name}=={TESTED_SUMO}.0: results change with SUMO's version"
    return Check(name, check.found.startswith(TESTED_SUMO), check.found, remedy, needed)


def _sumo_of_results() -> Check:
    found = _package("libsumo").found
    remedy = (
        f"the results of the documentation were made with SUMO {RESULTS_SUMO}, and numbers change with it: "
        f"pip install libsumo=={RESULTS_SUMO} eclipse-sumo=={RESULTS_SUMO}"
    )
    return Check("SUMO of the results", found == RESULTS_SUMO, found, remedy, needed=False)


def _try(name: str, run: Callable[[], str], remedy: str) -> Check:
    try:
        return Check(name, True, run())
    except (UnjamError, OSError) as error:
        return Check(name, False, str(error), remedy)


def _cache() -> Check:
    from unjam.worlds.sumo.networks import cache_folder

    folder = cache_folder()
    try:
        make_folder(folder)
        free = shutil.disk_usage(folder).free / 2**30
    except (UnjamError, OSError) as error:
        return Check("cache folder", False, str(error), "set UNJAM_CACHE to a folder of yours")
    found, ok = f"{folder}, {free:.0f} GiB free", os.access(folder, os.W_OK) and free > 0.1
    return Check("cache folder", ok, found, "free some space, or set UNJAM_CACHE")


def _files_of_others() -> Check:
    found = protections()
    remedy = "Linux 5.13 or newer keeps them from writing and from the network, where no container forbids it"
    words = ", ".join(["limits on memory and time" if os.name == "posix" else "no limits", *found])
    return Check("reading files of others", len(found) == 2, words, remedy, needed=False)


def _video() -> Check:
    check = _package("imageio-ffmpeg")
    found = f"imageio-ffmpeg {check.found}" if check.ok else check.found
    remedy = "" if check.ok else "pip install imageio-ffmpeg; .gif and .webp work without"
    return Check("mp4 video", check.ok, found, remedy, needed=False)


def _episode() -> str:
    from unjam.drivers.pi_saturation import PISaturation
    from unjam.scenarios.ring import Ring
    from unjam.worlds.workers import EpisodeTask, Workers

    ring = Ring(length=(230, 230), horizon=100)
    with Workers(1) as workers:
        episode = workers.run([EpisodeTask(ring, PISaturation(), (0,))])[0]
    if not episode.ok:
        raise UnjamError(episode.reason)
    return f"{episode.steps} steps of the ring"


def bench(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds in which all parts are measured in turn.")] = 7,
    device: Annotated[
        Literal["cpu", "cuda"] | None,
        typer.Option(help="Step batches of rings there instead, and say how fast by their size."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure how fast episodes run here, beside bare SUMO, over TraCI, in a batch, and virtual ones.

    One core. Look at the ratios: steps per second change with the machine, and with the minute.

    Examples:

      unjam bench

      unjam bench --device cuda
    """
    if device:
        _bench_batches(device, json)
        return
    from unjam.training.speed import measure_speed

    found = measure_speed(rounds, aside.print)
    if json:
        print_json(found)
        return
    residual, bare = "run_episode, residual that looks", "{:.2f} of bare"
    every_step, slower = bare.format(found["over_bare_every_step"]), f"{found['over_traci']:.1f} times slower"
    rows = [
        ("bare SUMO", found["bare_steps_per_s"], "1"),
        (f"{residual} once a second", found["episode_steps_per_s"], bare.format(found["over_bare"])),
        (f"{residual} in every step", found["every_step_steps_per_s"], every_step),
        ("the first of these over TraCI", found["traci_steps_per_s"], slower),
    ]
    batch = found["batch"]
    words, times = (
        f"a batch of {batch['rings']:,} rings, the first of these",
        f"{batch['over_bare']:.0f} of bare",
    )
    rows.append((words, batch["steps_per_s"], times))
    for rollouts in found["virtual"].values():
        words = f"{rollouts['rows']:,} rollouts of {rollouts['decisions']} decisions"
        times = f"{rollouts['over_actual']:.0f} times run_episode"
        rows.append((f"virtual environment, {words}", rollouts["steps_per_s"], times))
    for name, road in found["roads"].items():
        rows.append((f"{name}: bare SUMO", road["bare_steps_per_s"], "1"))
        rows.append((f"{name}: run_episode", road["episode_steps_per_s"], bare.format(road["over_bare"])))
    table = new_table(("ring, 22 vehicles, one core",), ("steps/s", "ratio"))
    for what, speed, ratio in rows:
        table.add_row(what, f"{speed:,.0f}", ratio)
    console.print(table)
    filtered = f"safety filter: an episode runs at {found['over_unfiltered']:.2f} of its speed without"
    console.print(f"{filtered}; its audit takes {100 * found['audit_share']:.1f} % of the time")
    for entry in found["scaling"]:
        cost = f"{entry['us_per_vehicle_step']:.2f} us a vehicle-step"
        console.print(f"{entry['vehicles']:>5} vehicles: {cost}")
    for entry in batch["scaling"]:
        cost = f"{1e3 * entry['us_per_vehicle_step']:.1f} ns a vehicle-step in a batch"
        console.print(f"{entry['vehicles']:>5} vehicles: {cost}")


def _bench_batches(device: Literal["cpu", "cuda"], json: bool) -> None:
    """Measure batches of growing size on a device, and print it."""
    from unjam.training.batch_speed import measure_batches

    found = measure_batches(device, aside.print)
    if json:
        print_json(found)
        return
    for name, rates in found["batches"].items():
        heading = f"rings of {found['vehicles']} vehicles on {found['device']}, {name}"
        table = new_table((heading,), ("steps/s", "vehicle-steps/s"))
        for entry in rates:
            speeds = (f"{entry[key]:,.0f}" for key in ("steps_per_s", "vehicle_steps_per_s"))
            table.add_row(f"{entry['rings']:,} at once", *speeds)
        console.print(table)
