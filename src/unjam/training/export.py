"""Controllers as files: those that a run keeps in its folders, and what `unjam export` ships."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from unjam.controller import SUFFIX, controller_bytes, controller_path, make_driver
from unjam.controller.file import GRAPH_PART, MAX_SAMPLE_STEPS, SAMPLE_PART, read_controller, sample_bytes
from unjam.controller.manifest import PROVENANCE_ENTRIES
from unjam.controller.verify import verify_controller_file
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.drivers.registry import driver_recipe, user_code_recipes
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError, invalid_value
from unjam.files import atomic_write, check_parent_folder, make_folder
from unjam.measures.metrics import measure
from unjam.measures.statistics import summarize
from unjam.processes import PrivateFolder
from unjam.reports.results import EVALUATION_FILE, read_evaluation
from unjam.scenarios import example_scenario, scenario_from_recipe
from unjam.scenarios.scenario import Scenario
from unjam.training.evaluate import TRAINED_LABEL, raise_failure
from unjam.training.run_folder import controller_origin, read_config
from unjam.training.seeds import make_test_seeds
from unjam.trust import expecting_code
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

if TYPE_CHECKING:
    from unjam.learners.learner import Tensors

ControllerKind = Literal["best", "latest"]


class ControllerStore:
    """The content of the controllers that are in a run's folders.

    `best` are those of validations that a longer run makes too; `remaining_rows` also those of its last iteration.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        """Prepare for one controller in each of the folders."""
        self._folders = folders
        self._contents: dict[ControllerKind, list[bytes]] = {}

    def save(self, contents: list[bytes], is_best: bool) -> None:
        """Write a controller into each folder."""
        self._contents |= {"latest": contents, **({"best": contents} if is_best else {})}
        self._write("latest")

    def tensors(self) -> "Tensors":
        """Return all of them for a checkpoint."""
        import torch  # whoever exports a driver does without

        return {
            f"{kind}/{index}": torch.frombuffer(bytearray(content), dtype=torch.uint8)
            for kind, contents in self._contents.items()
            for index, content in enumerate(contents)
        }

    def restore(self, tensors: "Tensors", is_finished: bool) -> None:
        """Take those of a checkpoint out of `tensors`, and write them: `remaining_rows` where the training has ended.

        What was in the folders may be of a later iteration, or somebody else's.
        """
        for kind in ("best", "latest") if "best/0" in tensors else ():
            found = [tensors.pop(f"{kind}/{index}") for index in range(len(self._folders))]
            self._contents[kind] = [each.numpy().tobytes() for each in found]
        if not is_finished and "best" in self._contents:
            self._contents["latest"] = self._contents["best"]
        self._write("latest")

    def _write(self, kind: ControllerKind) -> None:
        for folder, content in zip(self._folders, self._contents.get(kind, ()), strict=False):
            make_folder(folder)
            atomic_write(folder / "controller.unjam", content)


@dataclass(frozen=True)
class ExportResult:
    """A controller that was exported."""

    file: Path
    graph: Path | None
    """the ONNX graph beside it; it is also in the file"""
    driver: str
    sample_steps: int
    """of the recorded sample"""


@expecting_code()
def export_controller(source: str | Path, out: str | Path, onnx: bool = False, scenario: str = "") -> ExportResult:
    """Write a controller into a file that needs nothing else: `.unjam`, and on demand an ONNX graph.

    One held-out episode is driven for its recorded sample. What is written has the road's safety filter with
    it, where the road has one.

    Args:
        source: a run folder, or any driver as `unjam.drive` takes it.
        to: the file, ending in `.unjam`; the graph goes beside it, with `.onnx`.
        onnx: whether to draw the graph of the whole controller.
        scenario: whose time step and bounds a driver gets; a run and a controller's file have their own.

    Raises:
        InputError: there is no such controller, or it is Python code, or, with `onnx`, cannot be drawn.
        MissingPartError: with `onnx`, a package that draws or runs graphs is not installed.
    """
    source, out = Path(source), Path(out)
    if out.suffix != SUFFIX:
        raise invalid_value("out", str(out), f"a file that ends in {SUFFIX}")
    check_parent_folder(out)
    if _is_signed(out):
        raise InputError(f"out: {str(out)!r} is a signed controller; allowed: another file")
    road, driver, about = (
        _read_run_origin(source, scenario) if source.is_dir() else _read_driver_origin(str(source), scenario)
    )
    code = user_code_recipes(driver_recipe(driver)[0])
    if driver.is_native or code:
        why = f"{Path(code[0]['path']).name} is Python code" if code else "human is the simulator itself"
        raise InputError(f"export: {driver.describe()} is not allowed: {why}; allowed: drivers that are data")
    if road.safety.active and not road.actuator.is_instant:
        late = f"actuator.delay {road.actuator.delay:g}, actuator.lag {road.actuator.lag:g}"
        raise InputError(f"export: {late} is not allowed: the filter of a file does not know it; allowed: 0 and 0")
    if road.safety.active and not isinstance(driver, FilteredDriver):
        asked = (driver.limits or road.acceleration_limits).highest
        driver = FilteredDriver(driver, asked, road.safety, road.control_step)
    low, high = driver.limits or road.acceleration_limits
    limit = max(-low, high)
    states, graph = _sample_states(road, driver), dict[str, bytes]()
    if onnx:
        from unjam.controller.onnx_graph import onnx_graph  # torch.onnx takes its time, and not all want it

        missed = [name for name in driver.input_fields if getattr(states, name) is None]
        if missed:  # the graph takes all that a driver may look at
            why = f"{road.title} does not tell {', '.join(missed)}; allowed: --scenario of a road that does"
            raise InputError(f"onnx: {driver.describe()} is not allowed: {why}")
        graph = {GRAPH_PART: onnx_graph(driver, limit)}
    made = controller_bytes(driver, about, {SAMPLE_PART: sample_bytes(driver, states, limit), **graph})
    with PrivateFolder() as private:
        unverified = Path(private, out.name)
        atomic_write(unverified, made)
        verify_controller_file(unverified)
    atomic_write(out, made)  # what was there before is good until then
    beside = out.with_suffix(".onnx") if graph else None
    if beside is not None:
        atomic_write(beside, graph[GRAPH_PART])
    return ExportResult(out, beside, driver.describe(), len(states.speed))


def _is_signed(file: Path) -> bool:
    """Return whether a file is a controller that somebody has signed."""
    with suppress(InputError):
        return file.is_file() and read_controller(file).signed_by is not None
    return False


def _read_run_origin(folder: Path, scenario: str) -> tuple[Scenario, Driver, dict[str, Any]]:
    """Return the road, controller and origin of a run."""
    if scenario:
        raise invalid_value("scenario", scenario, "none beside a run, which has its own")
    config = read_config(folder)
    road, found = config.make_scenario(), read_controller(folder)
    counted = {key: found.manifest.get(key) for key in ("iteration", "environment_steps")}
    about = {
        **controller_origin(road, config.make_expert()),
        "run": {"scenario": config.scenario, "agent": config.agent, "seed": config.seed},
        **counted,
        "metrics": _test_metrics(folder),
    }
    return road, found.driver, about


def _read_driver_origin(driver_name: str, scenario: str) -> tuple[Scenario, Driver, dict[str, Any]]:
    """Return the road, driver and origin of a driver by itself; those of a controller's file are kept."""
    file = None if scenario else controller_path(driver_name)
    if file is not None:
        found = read_controller(file)
        about = {name: found.manifest[name] for name in PROVENANCE_ENTRIES if name in found.manifest}
        road = scenario_from_recipe(about["scenario"]) if "scenario" in about else example_scenario("ring")
        return road, found.driver, about
    road = example_scenario(scenario or "ring")
    driver = make_driver(driver_name, road.control_step)
    expert = driver.expert if isinstance(driver, ResidualDriver) else driver
    return road, driver, controller_origin(road, expert)


def _test_metrics(folder: Path) -> dict[str, Any] | None:
    """Return what the run's evaluation measured of the controller and of its expert; None before its end."""
    if not (folder / EVALUATION_FILE).is_file():
        return None
    found, rows_of = read_evaluation(folder)
    measured: dict[str, Any] = {"reward": found["reward"]}
    for label in (TRAINED_LABEL, found["expert"]):
        if rows := rows_of.get(label):
            estimates = {name: each.__dict__ for name, each in summarize(rows).items() if each.count}
            measured[label] = {"episodes": len(rows), **estimates}
    return measured


def _sample_states(scenario: Scenario, driver: Driver) -> LocalState:
    """Return what the CAV that stays longest perceives in a held-out episode, arrays of shape (T,)."""
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(scenario, driver, make_test_seeds(1)[0])])
    raise_failure([measure(episode)] if not episode.has_run else [])
    longest = max(episode.trajectories, key=lambda trajectory: len(trajectory.applied_acceleration))
    decisions = min(len(longest.applied_acceleration), MAX_SAMPLE_STEPS)
    seen = longest.states.select(slice(decisions))
    return LocalState(**{name: values for name, values in seen._asdict().items() if name in driver.input_fields})
