"""Is everything there that unjam needs: what `unjam doctor` checks."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from unjam.drivers.pi_saturation import PISaturation
from unjam.errors import UnjamError
from unjam.scenarios.ring import Ring
from unjam.worlds.sumo.network_files import cache_folder, sumo_program
from unjam.worlds.workers import EpisodeTask, Workers

RESULTS_SUMO = "1.28.0"
"""version of SUMO that all results of the documentation were made with"""
TESTED_SUMO = RESULTS_SUMO.rpartition(".")[0]
"""minor version of SUMO that is supported"""


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
    return [
        Check(
            "Python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer"
        ),
        _sumo_package("libsumo"),
        _sumo_package("eclipse-sumo"),
        _sumo_package("traci", needed=False),
        _sumo_of_results(),
        _try("netconvert", lambda: sumo_program("netconvert"), "pip install eclipse-sumo==1.28.0"),
        _package("torch"),
        _package("stable-baselines3"),
        _package("sb3-contrib"),
        _cache(),
        _display(),
        _video(),
        _try("an episode in a worker", _episode, "see the message; unjam drive ring --driver pi tells more"),
    ]


def _package(name: str) -> Check:
    try:
        return Check(name, True, version(name))
    except PackageNotFoundError:
        return Check(name, False, "not installed", f"pip install {name}")


def _sumo_package(name: str, needed: bool = True) -> Check:
    check = _package(name)
    remedy = f"pip install {name}=={TESTED_SUMO}.0: results change with SUMO's version"
    return Check(name, check.ok and check.found.startswith(TESTED_SUMO), check.found, remedy, needed)


def _sumo_of_results() -> Check:
    check = _package("libsumo")
    remedy = (
        f"the results of the documentation were made with SUMO {RESULTS_SUMO}, and numbers change with it: "
        f"pip install libsumo=={RESULTS_SUMO} eclipse-sumo=={RESULTS_SUMO}"
    )
    return Check("SUMO of the results", check.found == RESULTS_SUMO, check.found, remedy, needed=False)


def _try(name: str, run: Callable[[], str], remedy: str) -> Check:
    try:
        return Check(name, True, run())
    except (UnjamError, OSError) as error:
        return Check(name, False, str(error), remedy)


def _cache() -> Check:
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free / 2**30
        writable = os.access(folder, os.W_OK)
    except OSError as error:
        return Check(
            "cache folder", False, f"{folder}: {error.strerror}", "set UNJAM_CACHE to a folder of yours"
        )
    found = f"{folder}, {free:.0f} GiB free"
    return Check("cache folder", writable and free > 0.1, found, "free some space, or set UNJAM_CACHE")


def _display() -> Check:
    there = bool(os.environ.get("DISPLAY")) or sys.platform in ("win32", "darwin")
    found = "there" if there else "none"
    remedy = "for unjam watch without a display: --video FILE, or xvfb-run unjam watch ..."
    return Check("display", there, found, remedy, needed=False)


def _video() -> Check:
    try:
        return Check("mp4 video", True, f"imageio-ffmpeg {version('imageio-ffmpeg')}", needed=False)
    except PackageNotFoundError:
        return Check(
            "mp4 video",
            False,
            "not installed",
            "pip install 'unjam[video]'; .gif and .webp work without",
            False,
        )


def _episode() -> str:
    ring = Ring(length=(230, 230), horizon=100)
    with Workers(1) as workers:
        episode = workers.run([EpisodeTask(ring, PISaturation(), (0,))])[0]
    if not episode.ok:
        raise UnjamError(episode.reason)
    return f"{episode.steps} steps of the ring"
