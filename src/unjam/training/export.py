"""Controller files in run folders, and the export of controllers."""

import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from unjam.adapters.stable_baselines3_file import read_policy
from unjam.controller import SUFFIX, controller_bytes, controller_path, make_driver
from unjam.controller.file import (
    GRAPH_PART,
    MAX_SAMPLE_STEPS,
    PACKAGED_PREFIX,
    SAMPLE_PART,
    Controller,
    read_controller,
    sample_bytes,
)
from unjam.controller.manifest import PROVENANCE_ENTRIES
from unjam.controller.verify import verify_controller_file
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.drivers.registry import driver_recipe, user_code_recipes
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError, import_optional, invalid_value, raise_failure
from unjam.files import atomic_write, check_parent_folder, make_folder
from unjam.measures.metrics import measure
from unjam.measures.statistics import summarize
from unjam.onnx_models import EXPORT_NOTE, parse_model
from unjam.processes import PrivateFolder
from unjam.reports.results import CONTROLLER_FILE, EVALUATION_FILE, is_outdated, read_evaluation
from unjam.scenarios import example_scenario, make_scenario, scenario_from_recipe, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_scenario import CODE_ENTRY, class_reference
from unjam.seeds import held_out_seeds
from unjam.training.evaluate import TRAINED_LABEL
from unjam.training.run_folder import (
    CONTROLLER_KINDS,
    check_controller,
    check_run_files,
    controller_origin,
    read_config,
)
from unjam.trust import check_trusted, forget_expected_code
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

if TYPE_CHECKING:
    from unjam.learners.algorithm import Tensors

_LOG = logging.getLogger(__name__)

ControllerKind = Literal["best", "latest"]


class ControllerStore:
    """The controllers of a run, one for each task.

    The file in the folder of a task is the `latest` controller. Checkpoints also contain the `best` controller of the
    scheduled validations.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        """Start without contents for the folders of the tasks."""
        self._folders = folders
        self._contents: dict[ControllerKind, list[bytes]] = {}

    def save(self, contents: list[bytes], is_scheduled: bool) -> None:
        """Write better controllers into the files; those of a scheduled validation are the `best` for checkpoints."""
        self._contents |= {"latest": contents, **({"best": contents} if is_scheduled else {})}
        self._write_latest()

    def tensors(self) -> "Tensors":
        """Return the contents of all controllers for a checkpoint."""
        import torch  # not needed to export a driver

        return {
            f"{kind}/{index}": torch.frombuffer(bytearray(content), dtype=torch.uint8)
            for kind, contents in self._contents.items()
            for index, content in enumerate(contents)
        }

    def restore(self, tensors: "Tensors", is_finished: bool) -> None:
        """Take the controllers out of the `tensors` of a checkpoint, and write their files.

        An unfinished run continues with `best`, so that its result does not depend on a validation at an interruption.
        """
        for kind in CONTROLLER_KINDS if "best/0" in tensors else ():
            stored = [tensors.pop(f"{kind}/{index}") for index in range(len(self._folders))]
            self._contents[kind] = [tensor.numpy().tobytes() for tensor in stored]
        if not is_finished and "best" in self._contents:
            self._contents["latest"] = self._contents["best"]
        self._write_latest()

    def _write_latest(self) -> None:
        for folder, content in zip(self._folders, self._contents.get("latest", ()), strict=False):
            make_folder(folder)
            atomic_write(folder / CONTROLLER_FILE, content)


@dataclass(frozen=True)
class ExportResult:
    """An exported controller."""

    file: Path
    graph: Path | None
    """the ONNX graph, with a description in its metadata; the `.unjam` file has the same graph without description"""
    model: Path | None
    """file of the Stable-Baselines3 model"""
    driver: str
    """description of the driver"""
    sample_steps: int
    """length of the recorded sample [control steps]"""
    actuator: str
    """actuator that the safety filter expects; empty without a filter"""


@forget_expected_code()
def export_controller(
    source: str | Path,
    out: str | Path,
    onnx: bool = False,
    scenario: str = "",
    stable_baselines3: bool = False,
    settings: dict[str, Any] | None = None,
) -> ExportResult:
    """Write a controller into a self-contained `.unjam` file, and optionally into an ONNX graph and an SB3 model.

    A test episode is run to record a sample of local states and accelerations, with which readers verify the file. The
    controller includes the safety filter of the scenario, if there is one.

    Args:
        source: a run folder, or any driver as in `unjam.drive`.
        out: the file, which ends in `.unjam`.
        onnx: whether to write the graph of the whole controller into a file with the same name and `.onnx`.
        scenario: scenario that gives time step and limits; by default that of a controller file, or `ring`. Runs have
            their own scenario: another one is refused.
        stable_baselines3: whether to write the residual as a model of Stable-Baselines3, with the same name and `.zip`.
        settings: changes to the scenario, such as `{"actuator.delay": 0.5}`. With `settings` or `scenario`, the safety
            filter of a controller is replaced by that of the scenario.

    Raises:
        InputError: there is no such controller, it is Python code, it has no graph (`onnx`), it is not a residual
            (`stable_baselines3`), or `out` is a signed controller or would replace another file.
        MissingPartError: a package for graphs, or Stable-Baselines3, is needed and not installed.
    """
    source, out = Path(source), Path(out)
    if out.suffix != SUFFIX:
        raise invalid_value("out", str(out), f"a file that ends in {SUFFIX}")
    check_parent_folder(out)
    if _is_signed(out):
        raise InputError(f"out: {str(out)!r} is a signed controller; allowed: another file")
    suffixes = [*([".onnx"] if onnx else []), *([".zip"] if stable_baselines3 else [])]
    is_new = not out.exists()
    foreign_files = [
        str(file)
        for file in map(out.with_suffix, suffixes)
        if os.path.lexists(file) and (is_new or not _is_exported(file))
    ]
    if foreign_files:
        raise InputError(
            f"out: {', '.join(foreign_files)} exists and is no export of {out.name}; allowed: another name"
        )
    read_source = _read_run if source.is_dir() else _read_driver
    exported_scenario, driver, metadata = read_source(str(source), scenario, settings or {})
    code = user_code_recipes(driver_recipe(driver)[0])
    if driver.is_driven_by_simulator or code:
        reason = f"{Path(code[0]['path']).name} is Python code" if code else "the simulator drives this vehicle"
        raise InputError(f"export: {driver.describe()} is not allowed: {reason}; allowed: drivers without Python code")
    model = _residual_model(driver, metadata) if stable_baselines3 else None
    if exported_scenario.safety.active:
        driver = driver_with_filter(driver, exported_scenario)
    low, high = driver.limits or exported_scenario.acceleration_limits
    limit = max(-low, high)
    backend = read_config(source).episode_backend if source.is_dir() else "sumo"
    states, graph = _sample_states(exported_scenario, driver, backend), dict[str, bytes]()
    if onnx:
        import_optional("torch")
        from unjam.controller.onnx_graph import onnx_graph  # imported late: torch.onnx is slow to import

        missing = [name for name in driver.requirements().input_fields if getattr(states, name) is None]
        if missing:  # the graph needs samples of all inputs of the driver
            reason = f"{exported_scenario.title} does not provide {', '.join(missing)}; allowed: a scenario that does"
            raise InputError(f"onnx: {driver.describe()} is not allowed: {reason}")
        graph = {GRAPH_PART: onnx_graph(driver, limit)}
    content = controller_bytes(driver, metadata, {SAMPLE_PART: sample_bytes(driver, states, limit), **graph})
    with PrivateFolder() as private:
        unverified = Path(private, out.name)
        atomic_write(unverified, content)
        verify_controller_file(unverified)
    atomic_write(out, content)  # only now, so that an unverified controller replaces no file
    graph_file = out.with_suffix(".onnx") if graph else None
    if graph_file is not None:
        from unjam.controller.onnx_graph import describe_graph

        atomic_write(graph_file, describe_graph(graph[GRAPH_PART], driver, limit, exported_scenario.control_step))
    model_file = None if model is None else out.with_suffix(".zip")
    if model is not None and model_file is not None:
        atomic_write(model_file, model)
    actuator = driver.actuator.describe() if isinstance(driver, FilteredDriver) else ""
    return ExportResult(out, graph_file, model_file, driver.describe(), len(states.speed), actuator)


def _is_exported(file: Path) -> bool:
    """Return whether a file is a graph or a model of Stable-Baselines3 that an export has written."""
    with suppress(InputError, OSError):
        if file.suffix == ".zip":
            return bool(read_policy(file).unjam)
        return file.is_file() and EXPORT_NOTE in parse_model(file.read_bytes()).doc_string
    return False


def read_exported_controller(source: str, settings: dict[str, Any], scenario: str = "") -> Controller:
    """Return the controller that `export_controller` would write, with sample and safety filter; no file remains."""
    with PrivateFolder() as private:
        file = Path(private, f"in-car{SUFFIX}")
        return read_controller(export_controller(source, file, scenario=scenario, settings=settings).file)


def has_default_actuator(scenario: Scenario) -> bool:
    """Return whether CAVs have the default actuator of the scenario's class; true for open roads, without a check."""
    return not scenario.is_closed or scenario.actuator == type(scenario)().actuator


def measure_test_episode(controller: Controller) -> dict[str, Any]:
    """Return the metrics of a controller in the first test episode on the road of its manifest."""
    scenario = scenario_from_recipe(controller.manifest["scenario"])
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(scenario, controller.driver, held_out_seeds(1)[0], record_details=True)])
    return measure(episode)


def driver_with_filter(driver: Driver, scenario: Scenario) -> FilteredDriver:
    """Return a driver with the limits, the safety filter and the actuator of a scenario, unless it has a filter."""
    if isinstance(driver, FilteredDriver):
        return driver
    max_acceleration = (driver.limits or scenario.acceleration_limits).highest
    return FilteredDriver(driver, max_acceleration, scenario.safety, scenario.control_step, scenario.actuator)


def remove_filter(driver: Driver) -> Driver:
    """Return the driver in a `FilteredDriver`, and other drivers unchanged."""
    return driver.driver if isinstance(driver, FilteredDriver) else driver


def _residual_model(driver: Driver, metadata: dict[str, Any]) -> bytes:
    """Return the residual of a controller as a model of the algorithm that trained it, by default SAC."""
    from unjam.adapters.stable_baselines3_export import ALGORITHMS, stable_baselines3_bytes

    driver = remove_filter(driver)
    if not isinstance(driver, ResidualDriver):
        raise invalid_value("stable_baselines3", driver.describe(), "a residual, such as a training run")
    agent = metadata.get("run", {}).get("agent")
    return stable_baselines3_bytes(driver, agent if agent in ALGORITHMS else "sac")


def _is_signed(file: Path) -> bool:
    with suppress(InputError):
        return file.is_file() and read_controller(file).signed_by is not None
    return False


def _read_run(run: str, scenario_name: str, settings: dict[str, Any]) -> tuple[Scenario, Driver, dict[str, Any]]:
    if scenario_name:
        raise invalid_value("scenario", scenario_name, "none for a run, which has its own")
    folder = Path(run)
    config = read_config(folder)
    check_run_files(folder, config, "export")
    check_controller(folder, "export")
    scenario, controller = make_scenario(config.make_scenario(), settings), read_controller(folder)
    metadata = {
        **controller_origin(scenario, config.make_expert()),
        "run": {"scenario": config.scenario, "agent": config.agent, "seed": config.seed},
        **{key: controller.manifest.get(key) for key in ("iteration", "environment_steps")},
        "metrics": _test_metrics(folder),
    }
    return scenario, controller.driver, metadata


def _read_driver(
    driver_name: str, scenario_name: str, settings: dict[str, Any]
) -> tuple[Scenario, Driver, dict[str, Any]]:
    """Return scenario, driver and manifest entries; without a scenario's name, those of a controller's file.

    With settings, or with a scenario's name, the driver has no safety filter.
    """
    file = None if scenario_name else controller_path(driver_name)
    if file is not None:
        controller = read_controller(file)
        metadata = {name: controller.manifest[name] for name in PROVENANCE_ENTRIES if name in controller.manifest}
        scenario, driver = _read_manifest_scenario(file, metadata.get("scenario")), controller.driver
        if driver_name.startswith(PACKAGED_PREFIX) and not has_default_actuator(scenario):
            # Packaged controllers for ideal actuators are exported for real cars.
            settings = {"actuator": asdict(type(scenario)().actuator), **settings}
        if not settings:
            return scenario, driver, metadata
        scenario = make_scenario(scenario, settings)
        metadata["scenario"] = scenario_recipe(scenario)
        return scenario, remove_filter(driver), metadata
    scenario = make_scenario(example_scenario(scenario_name or "ring"), settings)
    driver = remove_filter(make_driver(driver_name, scenario.control_step))
    expert = driver.expert if isinstance(driver, ResidualDriver) else driver
    return scenario, driver, controller_origin(scenario, expert)


def _read_manifest_scenario(file: Path, recipe: dict[str, Any] | None) -> Scenario:
    """Return the scenario in the manifest of a controller's file, by default the ring; user code must be trusted."""
    if recipe is None:
        return example_scenario("ring")
    if code := recipe.get(CODE_ENTRY):
        check_trusted(f"controller {file.name}", class_reference(code).read_code())
    return scenario_from_recipe(recipe)


def _test_metrics(folder: Path) -> dict[str, Any] | None:
    """Return the test metrics of the controller and the expert of a run; None before its evaluation."""
    if not (folder / EVALUATION_FILE).is_file():
        return None
    evaluation, rows_by_driver = read_evaluation(folder)
    if is_outdated(folder, evaluation):
        _LOG.warning(
            "export: the metrics in %s belong to an earlier controller and are left out; measure with unjam evaluate",
            folder,
        )
        return None
    metrics: dict[str, Any] = {"reward": evaluation["reward"]}
    for label in (TRAINED_LABEL, evaluation["expert"]):
        if rows := rows_by_driver.get(label):
            estimates = {name: estimate.__dict__ for name, estimate in summarize(rows).items() if estimate.count}
            metrics[label] = {"episodes": len(rows), **estimates}
    return metrics


def _sample_states(scenario: Scenario, driver: Driver, backend: str) -> LocalState:
    """Return the local states of the CAV with the longest trip in a test episode, with arrays of shape (T,)."""
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(scenario, driver, held_out_seeds(1)[0], backend=backend)])
    raise_failure([measure(episode)] if not episode.has_run else [])
    longest = max(episode.trajectories, key=lambda trajectory: len(trajectory.applied_acceleration))
    states = longest.states.select(slice(min(len(longest.applied_acceleration), MAX_SAMPLE_STEPS)))
    fields = driver.requirements().input_fields
    return LocalState(**{name: values for name, values in states._asdict().items() if name in fields})
