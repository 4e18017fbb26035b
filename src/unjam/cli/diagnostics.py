"""`unjam doctor` checks the installation, and `unjam bench` measures the speed of episodes."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Literal

import typer
from rich.markup import escape
from typer import Option

from unjam.cli.options import JsonOption
from unjam.cli.output import console, err_console, new_table, print_json
from unjam.drivers.pi_saturation import PISaturation
from unjam.errors import EXTRAS, MissingPartError, UnjamError
from unjam.files import make_folder
from unjam.processes import has_display, kernel_protections
from unjam.scenarios.ring import Ring
from unjam.worlds.sumo.networks import cache_folder, sumo_program
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

REFERENCE_SUMO_VERSION = "1.28.0"
"""version of SUMO with which all results of the documentation were measured; its minor version is supported"""
TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"  # builds without GPU support, a tenth of the size


def doctor_command(json: JsonOption = False) -> None:
    """Check SUMO, its version, the display, the cache and one real episode; print a remedy for each failure.

    The exit code is 3 if a required part is missing.

    Example:

    - unjam doctor
    """
    checks = check_health()
    missing = [check for check in checks if not check.is_ok and check.is_required]
    if json:
        print_json({"ok": not missing, "checks": [asdict(check) for check in checks]})
    else:
        for check in checks:
            failure = "[red]missing[/red]" if check.is_required else "[yellow]no[/yellow]     "
            mark = "[green]ok[/green]     " if check.is_ok else failure
            console.print(f"{mark} {check.name}: {escape(check.detail)}", markup=True)
            if not check.is_ok:
                console.print(f"        {check.remedy}")
    if missing:
        raise typer.Exit(MissingPartError.exit_code)


@dataclass(frozen=True)
class HealthCheck:
    """Result of the check of one part of the installation."""

    name: str
    is_ok: bool
    detail: str  # such as the installed version
    remedy: str = ""
    is_required: bool = True  # unjam cannot run without this part


def check_health() -> list[HealthCheck]:
    """Run all checks and return their results."""
    python, sumo = platform.python_version(), f"pip install eclipse-sumo=={REFERENCE_SUMO_VERSION}"
    display, episode_remedy = has_display(), "see the message; unjam drive ring --driver pi shows more"
    display_remedy = "for unjam watch without a display: --video FILE, or xvfb-run unjam watch ..."
    index = f" --extra-index-url {TORCH_CPU_INDEX}"
    return [
        HealthCheck("Python", sys.version_info >= (3, 11), python, "install Python 3.11 or newer"),
        _sumo_check("libsumo"),
        _sumo_check("eclipse-sumo"),
        _sumo_check("traci", is_required=False),
        _reference_sumo_check(),
        _call_check("netconvert", lambda: sumo_program("netconvert"), sumo),
        *(_extra_check(name, "train and search", index) for name in ("torch", "stable-baselines3", "sb3-contrib")),
        _extra_check("optuna", "tune, search and calibrate"),
        _extra_check("cryptography", "keys, sign and signed controllers"),
        _cache_check(),
        _sandbox_check(),
        HealthCheck("display", display, "available" if display else "none", display_remedy, is_required=False),
        replace(_extra_check("imageio-ffmpeg", ".mp4"), name="mp4 video (imageio-ffmpeg)"),
        _call_check("an episode in a worker", _run_test_episode, episode_remedy),
    ]


def _package_check(name: str, remedy: str, is_required: bool = True, prefix: str = "") -> HealthCheck:
    """Check that a package is installed, in a version that starts with `prefix`."""
    try:
        installed = version(name)
    except PackageNotFoundError:
        return HealthCheck(name, False, "not installed", remedy, is_required)
    return HealthCheck(name, installed.startswith(prefix), installed, remedy, is_required)


def _extra_check(name: str, commands: str, pip_options: str = "") -> HealthCheck:
    """Check that a package of an extra is installed, which only some commands need."""
    extra = EXTRAS[name.replace("-", "_")]
    remedy = f"only needed for {commands}: pip install 'unjam[{extra}]'{pip_options}"
    return _package_check(name, remedy, is_required=False)


def _sumo_check(name: str, is_required: bool = True) -> HealthCheck:
    remedy = f"pip install {name}=={REFERENCE_SUMO_VERSION}: results depend on the version of SUMO"
    return _package_check(name, remedy, is_required, REFERENCE_SUMO_VERSION.rpartition(".")[0])


def _reference_sumo_check() -> HealthCheck:
    install = f"pip install libsumo=={REFERENCE_SUMO_VERSION} eclipse-sumo=={REFERENCE_SUMO_VERSION}"
    reason = f"the results of the documentation were measured with SUMO {REFERENCE_SUMO_VERSION}"
    check = _package_check("libsumo", f"{reason}; numbers depend on it: {install}", is_required=False)
    return replace(check, name="SUMO of the results", is_ok=check.detail == REFERENCE_SUMO_VERSION)


def _call_check(name: str, function: Callable[[], str], remedy: str) -> HealthCheck:
    """Check that a function returns its detail without an error."""
    try:
        return HealthCheck(name, True, function())
    except (UnjamError, OSError) as error:
        return HealthCheck(name, False, str(error), remedy)


def _cache_check() -> HealthCheck:
    folder = cache_folder()
    try:
        make_folder(folder)
        free = shutil.disk_usage(folder).free / 2**30
    except (UnjamError, OSError) as error:
        return HealthCheck("cache folder", False, str(error), "set UNJAM_CACHE to a writable folder")
    is_ok = os.access(folder, os.W_OK) and free > 0.1
    return HealthCheck("cache folder", is_ok, f"{folder}, {free:.0f} GiB free", "free some space, or set UNJAM_CACHE")


def _sandbox_check() -> HealthCheck:
    protections = kernel_protections()
    remedy = "Linux 5.13 or newer blocks writing and network access, unless a container forbids it"
    detail = ", ".join(["limits on memory and time" if os.name == "posix" else "no limits", *protections])
    return HealthCheck("reading untrusted files", len(protections) == 2, detail, remedy, is_required=False)


def _run_test_episode() -> str:
    with WorkerPool(1) as pool:
        episode = pool.run([EpisodeTask(Ring(length=(230, 230), horizon=100), PISaturation(), (0,))])[0]
    if not episode.has_run:
        raise UnjamError(episode.reason)
    return f"{episode.control_steps} steps of the ring"


def bench_command(
    rounds: Annotated[int, Option(min=1, help="Number of rounds; each measures all parts once.")] = 7,
    device: Annotated[
        Literal["cpu", "cuda"] | None,
        Option(help="Measure batches of rings of increasing size on this device instead."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure the speed of episodes in SUMO, over TraCI and in batches, and of model rollouts.

    The benchmark uses one core. Compare ratios: steps per second depend on the machine and its load.

    Examples:

    - unjam bench
    - unjam bench --device cuda
    """
    from unjam.training.speed import benchmark_batches, benchmark_episodes

    rates = benchmark_batches(device, err_console.print) if device else benchmark_episodes(rounds, err_console.print)
    if json:
        print_json(rates)
        return
    if not device:
        table = new_table(("part, one core",), ("steps/s", "us per vehicle-step", "ratio"))
        for part in rates["parts"]:
            cost = f"{1e6 / part['steps_per_s'] / part['vehicles']:.3g}" if part["vehicles"] else ""
            ratio = f"{part['ratio']:,.2f} of {part['reference']}" if part["reference"] else ""
            table.add_row(part["name"], f"{part['steps_per_s']:,.0f}", cost, ratio)
        console.print(table)
    for name, entries in rates.get("batches", {}).items():
        heading = f"rings of {rates['vehicles']} vehicles on {rates['device']}, {name}"
        table = new_table((heading,), ("steps/s", "vehicle-steps/s"))
        for entry in entries:
            speeds = (f"{entry[key]:,.0f}" for key in ("steps_per_s", "vehicle_steps_per_s"))
            table.add_row(f"{entry['rings']:,} rings", *speeds)
        console.print(table)
