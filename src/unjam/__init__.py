"""Train, compare and ship controllers for automated vehicles that dissolve stop-and-go waves.

    import unjam
    result = unjam.drive("ring-jammed", driver="pi", episodes=5, out="runs/first")
    print(result.mean["time_to_dissolve"], result.report)

The import registers the environments `unjam/Ring-v0`, `unjam/FigureEight-v0`, `unjam/Merge-v0`, `unjam/OnRamp-v0`,
`unjam/Recorded-v0` and `unjam/UserNetwork-v0` (your own SUMO network) with Gymnasium. `parallel_env` is for PettingZoo.

`drive` compares drivers, and `train` learns a residual on an expert. `export_controller` writes a controller into a
file, `verify_controller` checks it, and `load_controller` loads it. `run_episode` and `measure` are for one episode.
The command line also tunes experts, and calibrates and assesses your own network: `unjam --help`.
"""

import sys

# `python -m unjam` imports from the working folder first, which can be a downloaded one; `unjam` does not.
if sys.argv[:1] == ["-m"] and sys.orig_argv[-len(sys.argv)].endswith("unjam") and not sys.flags.safe_path:
    del sys.path[0]

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unjam.interruptions import exit_on_signals
from unjam.kernels import pin_kernels

if Path(*sys.argv[:1]).stem in ("unjam", "-m") and sys.orig_argv[-len(sys.argv)].endswith("unjam"):
    exit_on_signals()  # this process is the command line, and its imports take a second
pin_kernels()  # before anything imports NumPy

from unjam.environments import register_environments  # noqa: E402
from unjam.errors import missing_package_error  # noqa: E402

__version__ = "0.1.0"

if TYPE_CHECKING:
    from unjam.benchmarks.run import benchmark
    from unjam.controller import load_controller, make_driver
    from unjam.drivers import Driver, LocalState, check_driver
    from unjam.environments.pettingzoo_env import parallel_env
    from unjam.measures.metrics import measure
    from unjam.models.differentiable_rings import DifferentiableRings
    from unjam.resource_limits import verify_controller, write_report
    from unjam.scenarios import make_scenario
    from unjam.seeds import held_out_seeds
    from unjam.training.config import load_config
    from unjam.training.drive import drive
    from unjam.training.export import export_controller
    from unjam.training.learned_model import load_world_model
    from unjam.training.runs import list_runs
    from unjam.training.train import train
    from unjam.trust import trusting_code
    from unjam.worlds.episode import run_episode

# These are imported at their first use: workers must not import torch, and the command line must start quickly.
_LAZY_IMPORTS = {
    **{"Driver": "unjam.drivers", "LocalState": "unjam.drivers", "check_driver": "unjam.drivers"},
    **{"make_scenario": "unjam.scenarios", "load_controller": "unjam.controller"},
    **{"make_driver": "unjam.controller", "parallel_env": "unjam.environments.pettingzoo_env"},
    **{"measure": "unjam.measures.metrics", "DifferentiableRings": "unjam.models.differentiable_rings"},
    **{"benchmark": "unjam.benchmarks.run", "verify_controller": "unjam.resource_limits"},
    **{"write_report": "unjam.resource_limits", "held_out_seeds": "unjam.seeds"},
    **{"load_config": "unjam.training.config", "drive": "unjam.training.drive"},
    **{"export_controller": "unjam.training.export", "load_world_model": "unjam.training.learned_model"},
    **{"list_runs": "unjam.training.runs", "train": "unjam.training.train", "trusting_code": "unjam.trust"},
    **{"run_episode": "unjam.worlds.episode"},
}

register_environments()

__all__ = ["DifferentiableRings", "Driver", "LocalState", "benchmark", "check_driver", "drive", "export_controller"]
__all__ += ["held_out_seeds", "list_runs", "load_config", "load_controller", "load_world_model", "make_driver"]
__all__ += ["make_scenario", "measure", "parallel_env", "run_episode", "train", "trusting_code", "verify_controller"]
__all__ += ["write_report"]


def __getattr__(name: str) -> Any:
    if name not in _LAZY_IMPORTS:
        raise AttributeError(f"module 'unjam' has no attribute {name!r}")
    try:
        return getattr(import_module(_LAZY_IMPORTS[name]), name)
    except ImportError as error:
        raise missing_package_error(error) from None


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
