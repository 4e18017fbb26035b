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
from unjam.cli.output import console, err_console, new_table, print_json
from unjam.errors import MissingPartError, UnjamError
from unjam.files import make_folder
from unjam.processes import has_display, kernel_protections

REFERENCE_SUMO_VERSION = "1.28.0"
"""version of SUMO that all results of the documentation were made with"""
SUPPORTED_SUMO_VERSION = REFERENCE_SUMO_VERSION.rpartition(".")[0]
"""minor version of SUMO that is supported"""
TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""index of builds of torch that are a tenth of the size of those for graphics cards"""


def doctor_command(json: JsonOption = False) -> None:
    """Check SUMO, its version, a display, the cache, and one real episode; say what to do where one fails.

    Exit code 3 if a needed part is missing.

    Example:

      unjam doctor
    """
    checks = check_health()
    missing = [check for check in checks if not check.is_ok and check.is_required]
    if json:
        print_json({"ok": not missing, "checks": [asdict(check) for check in checks]})
    else:
        for check in checks:
            wanting = "[red]missing[/red]" if check.is_required else "[yellow]no[/yellow]     "
            mark = "[green]ok[/green]     " if check.is_ok else wanting
            console.print(f"{mark} {check.name}: {escape(check.detail)}", markup=True)
            if not check.is_ok:
                console.print(f"        {check.remedy}")
    if missing:
        raise typer.Exit(MissingPartError.exit_code)


@dataclass(frozen=True)
class HealthCheck:
    """One thing that should be there."""

    name: str
    is_ok: bool
    detail: str
    remedy: str = ""
    is_required: bool = True


def check_health() -> list[HealthCheck]:
    """Return all checks, the costliest last: an episode in a worker process."""
    from unjam.worlds.sumo.networks import sumo_program

    python, sumo = platform.python_version(), f"pip install eclipse-sumo=={REFERENCE_SUMO_VERSION}"
    display = has_display()
    no_display = "for unjam watch without a display: --video FILE, or xvfb-run unjam watch ..."
    return [
        HealthCheck("Python", sys.version_info >= (3, 11), python, "install Python 3.11 or newer"),
        _sumo_check("libsumo"),
        _sumo_check("eclipse-sumo"),
        _sumo_check("traci", is_required=False),
        _reference_sumo_check(),
        _try_check("netconvert", lambda: sumo_program("netconvert"), sumo),
        *map(_training_package_check, ("torch", "stable-baselines3", "sb3-contrib")),
        _cache_check(),
        _sandbox_check(),
        HealthCheck("display", display, "there" if display else "none", no_display, is_required=False),
        _video_check(),
        _try_check(
            "an episode in a worker", _run_test_episode, "see the message; unjam drive ring --driver pi tells more"
        ),
    ]


def _package_check(name: str) -> HealthCheck:
    try:
        return HealthCheck(name, True, version(name))
    except PackageNotFoundError:
        return HealthCheck(name, False, "not installed", f"pip install {name}")


def _training_package_check(name: str) -> HealthCheck:
    check = _package_check(name)
    remedy = "only what learns needs it: pip install 'unjam[train]' --extra-index-url " + TORCH_CPU_INDEX
    return HealthCheck(name, check.is_ok, check.detail, remedy, is_required=False)


def _sumo_check(name: str, is_required: bool = True) -> HealthCheck:
    check = _package_check(name)
    remedy = f"pip install {name}=={SUPPORTED_SUMO_VERSION}.0: results change with SUMO's version"
    return HealthCheck(name, check.detail.startswith(SUPPORTED_SUMO_VERSION), check.detail, remedy, is_required)


def _reference_sumo_check() -> HealthCheck:
    found = _package_check("libsumo").detail
    remedy = (
        f"the results of the documentation were made with SUMO {REFERENCE_SUMO_VERSION}, and numbers change with it: "
        f"pip install libsumo=={REFERENCE_SUMO_VERSION} eclipse-sumo=={REFERENCE_SUMO_VERSION}"
    )
    return HealthCheck("SUMO of the results", found == REFERENCE_SUMO_VERSION, found, remedy, is_required=False)


def _try_check(name: str, run: Callable[[], str], remedy: str) -> HealthCheck:
    try:
        return HealthCheck(name, True, run())
    except (UnjamError, OSError) as error:
        return HealthCheck(name, False, str(error), remedy)


def _cache_check() -> HealthCheck:
    from unjam.worlds.sumo.networks import cache_folder

    folder = cache_folder()
    try:
        make_folder(folder)
        free = shutil.disk_usage(folder).free / 2**30
    except (UnjamError, OSError) as error:
        return HealthCheck("cache folder", False, str(error), "set UNJAM_CACHE to a folder of yours")
    found, ok = f"{folder}, {free:.0f} GiB free", os.access(folder, os.W_OK) and free > 0.1
    return HealthCheck("cache folder", ok, found, "free some space, or set UNJAM_CACHE")


def _sandbox_check() -> HealthCheck:
    found = kernel_protections()
    remedy = "Linux 5.13 or newer keeps them from writing and from the network, where no container forbids it"
    words = ", ".join(["limits on memory and time" if os.name == "posix" else "no limits", *found])
    return HealthCheck("reading files of others", len(found) == 2, words, remedy, is_required=False)


def _video_check() -> HealthCheck:
    check = _package_check("imageio-ffmpeg")
    found = f"imageio-ffmpeg {check.detail}" if check.is_ok else check.detail
    remedy = "" if check.is_ok else "pip install imageio-ffmpeg; .gif and .webp work without"
    return HealthCheck("mp4 video", check.is_ok, found, remedy, is_required=False)


def _run_test_episode() -> str:
    from unjam.drivers.pi_saturation import PISaturation
    from unjam.scenarios.ring import Ring
    from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

    ring = Ring(length=(230, 230), horizon=100)
    with WorkerPool(1) as workers:
        episode = workers.run([EpisodeTask(ring, PISaturation(), (0,))])[0]
    if not episode.has_run:
        raise UnjamError(episode.reason)
    return f"{episode.control_steps} steps of the ring"


def bench_command(
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
    from unjam.training.benchmark import benchmark_episodes

    found = benchmark_episodes(rounds, err_console.print)
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
    words, times = (f"a batch of {batch['rings']:,} rings, the first of these", f"{batch['over_bare']:.0f} of bare")
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
    from unjam.training.batch_benchmark import benchmark_batches

    found = benchmark_batches(device, err_console.print)
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
