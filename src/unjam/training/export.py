"""Controller files: those in run folders, and the export of controllers."""

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
    """The contents of the controllers in a run's folders: the `best` of scheduled validations, and the `latest`."""

    def __init__(self, folders: Sequence[Path]) -> None:
        """Prepare one controller for each folder."""
        self._folders = folders
        self._contents: dict[ControllerKind, list[bytes]] = {}

    def save(self, contents: list[bytes], is_best: bool) -> None:
        """Write a controller into each folder."""
        self._contents |= {"latest": contents, **({"best": contents} if is_best else {})}
        self._write("latest")

    def tensors(self) -> "Tensors":
        """Return all contents for a checkpoint."""
        import torch  # not needed to export a driver

        return {
            f"{kind}/{index}": torch.frombuffer(bytearray(content), dtype=torch.uint8)
            for kind, contents in self._contents.items()
            for index, content in enumerate(contents)
        }

    def restore(self, tensors: "Tensors", is_finished: bool) -> None:
        """Take the contents from a checkpoint's `tensors` and write them: `latest` if the training has ended."""
        for kind in CONTROLLER_KINDS if "best/0" in tensors else ():
            stored = [tensors.pop(f"{kind}/{index}") for index in range(len(self._folders))]
            self._contents[kind] = [each.numpy().tobytes() for each in stored]
        if not is_finished and "best" in self._contents:
            self._contents["latest"] = self._contents["best"]
        self._write("latest")

    def _write(self, kind: ControllerKind) -> None:
        for folder, content in zip(self._folders, self._contents.get(kind, ()), strict=False):
            make_folder(folder)
            atomic_write(folder / CONTROLLER_FILE, content)


@dataclass(frozen=True)
class ExportResult:
    """An exported controller."""

    file: Path
    graph: Path | None
    """the ONNX graph with its description as metadata; without it, the graph is also in the controller's file"""
    model: Path | None
    driver: str
    sample_steps: int
    """length of the recorded sample"""
    car: str
    """the actuator that its safety filter knows; empty without a filter"""


@forget_expected_code()
def export_controller(
    source: str | Path,
    out: str | Path,
    onnx: bool = False,
    scenario: str = "",
    stable_baselines3: bool = False,
    settings: dict[str, Any] | None = None,
) -> ExportResult:
    """Write a controller into a self-contained file `.unjam`, and optionally an ONNX graph and a model of others.

    One test episode is run for its recorded sample. The controller includes the road's safety filter, if there is one.

    Args:
        source: a run folder, or any driver as in `unjam.drive`.
        out: the file, ending in `.unjam`; the graph has the same name with `.onnx`.
        onnx: whether to write the graph of the whole controller.
        scenario: the scenario for time step and bounds of a driver; a run and a controller's file have their own.
        stable_baselines3: whether to write the residual as a model of Stable-Baselines3, with the same name and `.zip`.
        settings: changes to the scenario, such as `{"actuator.delay": 0.5}`; a controller with a safety filter gets
            that of the changed scenario, or of the one named, in its place.

    Raises:
        InputError: there is no such controller, or it is Python code; with `onnx` it has no graph; with
            `stable_baselines3` it is no residual.
        MissingPartError: a package for graphs, or Stable-Baselines3, is needed and not installed.
    """
    source, out = Path(source), Path(out)
    if out.suffix != SUFFIX:
        raise invalid_value("out", str(out), f"a file that ends in {SUFFIX}")
    check_parent_folder(out)
    if _is_signed(out):
        raise InputError(f"out: {str(out)!r} is a signed controller; allowed: another file")
    siblings = [
        out.with_suffix(suffix) for suffix, is_asked in ((".onnx", onnx), (".zip", stable_baselines3)) if is_asked
    ]
    is_new = not out.exists()
    if others := [str(file) for file in siblings if os.path.lexists(file) and (is_new or not _is_exported(file))]:
        raise InputError(f"out: {', '.join(others)} exists and belongs to no {out.name}; allowed: another name")
    read_origin = _read_run_origin if source.is_dir() else _read_driver_origin
    road, driver, metadata = read_origin(str(source), scenario, settings or {})
    code = user_code_recipes(driver_recipe(driver)[0])
    if driver.is_native or code:
        reason = f"{Path(code[0]['path']).name} is Python code" if code else "human is the simulator itself"
        raise InputError(f"export: {driver.describe()} is not allowed: {reason}; allowed: drivers without Python code")
    model = _residual_model(driver, metadata) if stable_baselines3 else None
    if road.safety.active:
        driver = driver_with_filter(driver, road)
    low, high = driver.limits or road.acceleration_limits
    limit = max(-low, high)
    backend = read_config(source).episode_backend if source.is_dir() else "sumo"
    states, graph = _sample_states(road, driver, backend), dict[str, bytes]()
    if onnx:
        import_optional("torch")
        from unjam.controller.onnx_graph import onnx_graph  # imported late: torch.onnx is slow to import

        missing = [name for name in driver.requirements().input_fields if getattr(states, name) is None]
        if missing:  # the graph has all inputs of the driver
            reason = f"{road.title} does not provide {', '.join(missing)}; allowed: --scenario of a road that does"
            raise InputError(f"onnx: {driver.describe()} is not allowed: {reason}")
        graph = {GRAPH_PART: onnx_graph(driver, limit)}
    content = controller_bytes(driver, metadata, {SAMPLE_PART: sample_bytes(driver, states, limit), **graph})
    with PrivateFolder() as private:
        unverified = Path(private, out.name)
        atomic_write(unverified, content)
        verify_controller_file(unverified)
    atomic_write(out, content)  # an earlier file stays until then
    graph_file = out.with_suffix(".onnx") if graph else None
    if graph_file is not None:
        from unjam.controller.onnx_graph import describe_graph

        atomic_write(graph_file, describe_graph(graph[GRAPH_PART], driver, limit, road.control_step))
    model_file = None if model is None else out.with_suffix(".zip")
    if model is not None and model_file is not None:
        atomic_write(model_file, model)
    car = driver.actuator.describe() if isinstance(driver, FilteredDriver) else ""
    return ExportResult(out, graph_file, model_file, driver.describe(), len(states.speed), car)


def _is_exported(file: Path) -> bool:
    """Return whether an export wrote a graph or a model of Stable-Baselines3."""
    with suppress(InputError, OSError):
        if file.suffix == ".zip":
            return bool(read_policy(file).unjam)
        return file.is_file() and EXPORT_NOTE in parse_model(file.read_bytes()).doc_string
    return False


def read_in_car(source: str, settings: dict[str, Any], scenario: str = "") -> Controller:
    """Return a controller as `export_controller` writes it, with the filter for a car and a sample; no file stays."""
    with PrivateFolder() as private:
        return read_controller(
            export_controller(source, Path(private, f"in-car{SUFFIX}"), False, scenario, False, settings).file
        )


def has_usual_car(road: Scenario) -> bool:
    """Return whether CAVs of a road have the actuator that such roads have by default; true on open roads."""
    return not road.is_closed or road.actuator == type(road)().actuator


def measure_test_episode(controller: Controller) -> dict[str, Any]:
    """Return the metrics of a controller in the first test episode of its own road and car."""
    road = scenario_from_recipe(controller.manifest["scenario"])
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(road, controller.driver, held_out_seeds(1)[0], record_details=True)])
    return measure(episode)


def driver_with_filter(driver: Driver, road: Scenario) -> FilteredDriver:
    """Return a driver with the limits, the safety filter and the actuator of a road, unless it has a filter."""
    if isinstance(driver, FilteredDriver):
        return driver
    max_acceleration = (driver.limits or road.acceleration_limits).highest
    return FilteredDriver(driver, max_acceleration, road.safety, road.control_step, road.actuator)


def without_filter(driver: Driver) -> Driver:
    """Return a driver without the safety filter of its own file, if it has one."""
    return driver.driver if isinstance(driver, FilteredDriver) else driver


def _residual_model(driver: Driver, metadata: dict[str, Any]) -> bytes:
    """Return the residual of a controller as a model of the algorithm that trained it; SAC if that is unknown."""
    from unjam.adapters.stable_baselines3_export import ALGORITHMS, stable_baselines3_bytes

    driver = without_filter(driver)
    if not isinstance(driver, ResidualDriver):
        raise invalid_value("stable_baselines3", driver.describe(), "a residual, such as a training run")
    agent = metadata.get("run", {}).get("agent")
    return stable_baselines3_bytes(driver, agent if agent in ALGORITHMS else "sac")


def _is_signed(file: Path) -> bool:
    with suppress(InputError):
        return file.is_file() and read_controller(file).signed_by is not None
    return False


def _read_run_origin(run: str, scenario: str, settings: dict[str, Any]) -> tuple[Scenario, Driver, dict[str, Any]]:
    if scenario:
        raise invalid_value("scenario", scenario, "none for a run, which has its own")
    folder = Path(run)
    config = read_config(folder)
    check_run_files(folder, config, "export")
    check_controller(folder, "export")
    road, controller = make_scenario(config.make_scenario(), settings), read_controller(folder)
    metadata = {
        **controller_origin(road, config.make_expert()),
        "run": {"scenario": config.scenario, "agent": config.agent, "seed": config.seed},
        **{key: controller.manifest.get(key) for key in ("iteration", "environment_steps")},
        "metrics": _test_metrics(folder),
    }
    return road, controller.driver, metadata


def _read_driver_origin(
    driver_name: str, scenario: str, settings: dict[str, Any]
) -> tuple[Scenario, Driver, dict[str, Any]]:
    """Return the road, driver and origin of a driver; a controller's file keeps its own, with changed settings."""
    file = None if scenario else controller_path(driver_name)
    if file is not None:
        controller = read_controller(file)
        metadata = {name: controller.manifest[name] for name in PROVENANCE_ENTRIES if name in controller.manifest}
        road, driver = _read_scenario(file, metadata.get("scenario")), controller.driver
        if driver_name.startswith(PACKAGED_PREFIX) and not has_usual_car(road):
            settings = {"actuator": asdict(type(road)().actuator), **settings}
        if not settings:
            return road, driver, metadata
        road = make_scenario(road, settings)
        metadata["scenario"] = scenario_recipe(road)
        return road, without_filter(driver), metadata
    road = make_scenario(example_scenario(scenario or "ring"), settings)
    driver = without_filter(make_driver(driver_name, road.control_step))
    expert = driver.expert if isinstance(driver, ResidualDriver) else driver
    return road, driver, controller_origin(road, expert)


def _read_scenario(file: Path, recipe: dict[str, Any] | None) -> Scenario:
    """Return the scenario that a controller's file names; its Python file runs only if its code is trusted."""
    if recipe is None:
        return example_scenario("ring")
    if code := recipe.get(CODE_ENTRY):
        check_trusted(f"controller {file.name}", class_reference(code).read_code())
    return scenario_from_recipe(recipe)


def _test_metrics(folder: Path) -> dict[str, Any] | None:
    """Return the test metrics of a run's controller and expert; None before the evaluation of this controller."""
    if not (folder / EVALUATION_FILE).is_file():
        return None
    evaluation, rows_by_driver = read_evaluation(folder)
    if is_outdated(folder, evaluation):
        _LOG.warning(
            "export: the metrics in %s are of an earlier controller: left out; unjam evaluate measures", folder
        )
        return None
    metrics: dict[str, Any] = {"reward": evaluation["reward"]}
    for label in (TRAINED_LABEL, evaluation["expert"]):
        if rows := rows_by_driver.get(label):
            estimates = {name: each.__dict__ for name, each in summarize(rows).items() if each.count}
            metrics[label] = {"episodes": len(rows), **estimates}
    return metrics


def _sample_states(scenario: Scenario, driver: Driver, backend: str) -> LocalState:
    """Return the local states of the CAV with the longest trip in a test episode, arrays of shape (T,)."""
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(scenario, driver, held_out_seeds(1)[0], backend=backend)])
    raise_failure([measure(episode)] if not episode.has_run else [])
    longest = max(episode.trajectories, key=lambda trajectory: len(trajectory.applied_acceleration))
    states = longest.states.select(slice(min(len(longest.applied_acceleration), MAX_SAMPLE_STEPS)))
    fields = driver.requirements().input_fields
    return LocalState(**{name: values for name, values in states._asdict().items() if name in fields})
