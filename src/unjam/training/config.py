"""Everything that decides what a training run does: one validated configuration, as TOML and flags."""

import os
from collections.abc import Sequence
from dataclasses import asdict, field, fields, replace
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import AfterValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.car_following import Constant
from unjam.drivers.driver import Driver
from unjam.drivers.observation import observation_inputs
from unjam.drivers.user_driver import is_file_reference
from unjam.drivers.wrappers import HistoryDriver
from unjam.errors import InputError, invalid_value
from unjam.learners.settings import AgentSettings, PolicySettings
from unjam.models.settings import ModelSettings
from unjam.parameters import (
    STRICT,
    NonNegativeInt,
    Positive,
    PositiveInt,
    build_dataclass,
    flatten_keys,
    merge_changes,
    nest_keys,
    parse_toml,
)
from unjam.scenarios import SCENARIOS, make_scenario
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.scenario import Scenario
from unjam.training.presets import preset_values
from unjam.training.seeds import TRAINING_SEED_LIMIT
from unjam.training.task_sampling import TaskSampling, count_episodes, weight_shares
from unjam.trust import check_trusted_values
from unjam.worlds.batch.support import statistically_unsupported_reason, unsupported_reason
from unjam.worlds.episode import Task

CONFIG_FILE = "config.toml"
"""the configuration in a folder of a run, or of a search"""


def _without_tuples(options: dict[str, Any]) -> dict[str, Any]:
    """Return changes as a TOML file gives them back, so that a run knows its own road again."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in options.items()}


ScenarioOptions = Annotated[dict[str, Any], AfterValidator(_without_tuples)]


@dataclass(frozen=True, config=STRICT)
class EvaluationSettings:
    """How a run is judged, always with the deterministic policy; its steps are counted apart."""

    validation_interval: NonNegativeInt = 5
    """iterations between two validations; 0: none, and the last policy becomes the controller"""
    patience: NonNegativeInt = 0
    """validations in a row without a new best after which training ends; 0: it goes on to `steps`"""
    convergence_window: NonNegativeInt = 0
    """training ends where the mean return of so many iterations, exploration included, is no better than that
    of as many before them, looked at whenever as many have been made: the paper's rule; 0: it goes on to
    `steps`"""
    validation_episodes: PositiveInt = 4
    """episodes of a validation, the same seeds each time: they choose the controller"""
    episodes: PositiveInt = 20
    """episodes of the final evaluation, on held-out seeds that chose nothing"""
    baselines: tuple[str, ...] = ("human", "pi", "follower-stopper")
    """drivers that are evaluated beside the expert and the trained controller"""


@dataclass(frozen=True, config=STRICT)
class TaskConfig:
    """One of several roads of a training; what is left out, or empty, is the run's own."""

    scenario: str = ""
    scenario_options: ScenarioOptions = field(default_factory=dict)
    """changes to the scenario's parameters, beside the run's"""
    expert: str = ""
    reward: str = ""
    weight: Positive = 1.0
    """share of the actual steps, beside the weights of the other tasks"""
    name: Annotated[str, Field(pattern=r"^[\w-]*$")] = ""
    """of its folder; empty: the scenario's"""


@dataclass(frozen=True, config=STRICT)
class RunConfig(AgentSettings):
    """One training run. Every key can be set in a TOML file, by `--set key=value`, and in Python."""

    scenario: str = "ring"
    scenario_options: ScenarioOptions = field(default_factory=dict)
    """changes to the scenario's parameters"""
    expert: str = "pi"
    """driver that the residual is added to: a name, `path.py:name`, a run folder, a .unjam file; `none`:
    the network drives alone"""
    reward: str = ""
    """a name or `path.py:name`; empty: the scenario's own"""
    steps: PositiveInt = 960_000
    """actual steps of training"""
    seed: Annotated[int, Field(ge=0, lt=TRAINING_SEED_LIMIT)] = 0
    """of the whole run; numbers from a million on are those of the episodes that judge"""
    workers: PositiveInt = 2
    simulator: Literal["sumo", "batch"] = "sumo"
    """where episodes of training and validation are driven: in SUMO, or, on rings, all of an iteration at
    once in what equals it but for rounding; it pays where iterations are large. A figure eight alone is
    driven so too, where episodes are SUMO's in distribution. Other roads of a mixture are driven in SUMO,
    which judges in any case"""
    stratified: bool = True
    """whether the episodes of an iteration, and of a validation, cover the range of what they draw (the
    ring's lengths) evenly"""
    policy: PolicySettings = field(default_factory=PolicySettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    """the virtual environment, in which the agent learns between actual episodes"""
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    tasks: tuple[TaskConfig, ...] = ()
    """roads that are trained on together; empty: the one above"""
    task_sampling: TaskSampling = "weights"
    """how many episodes each of several roads has: as its `weight` says; `regret`: from each validation to
    the next, half of all steps go where the policy earns less than was seen there before"""
    preset: str = ""
    """which preset this started from, for the record"""

    @model_validator(mode="after")
    def _check_combinations(self) -> "RunConfig":
        why_none = unsupported_reason if self.tasks else statistically_unsupported_reason
        scenarios = [road.make_scenario() for road in self.task_configs().values()]
        whys = [why_none(scenario) for scenario in scenarios]
        if self.simulator == "batch" and all(whys):
            raise ValueError(f"simulator: batch is not allowed; allowed: sumo, for {whys[0]}")
        imagines = self.model.kind if self.model.model_ratio > 0 else ""
        if self.policy.reward_after_exit and imagines == "row":
            raise ValueError("policy.reward_after_exit: true is not allowed; allowed: false where rows are imagined")
        own = any(is_file_reference(name) for name in self.policy.inputs)
        if self.policy.history_features and "expert_memory" not in self.policy.inputs and not own:
            raise ValueError(
                "policy.history_features: true is not allowed; allowed: false, where expert_memory is not observed"
            )
        if self.evaluation.patience and not self.evaluation.validation_interval:
            raise ValueError(
                "evaluation.patience: it is not allowed without validations (evaluation.validation_interval 0)"
            )
        if imagines == "road" and self.model.device != "cpu":
            raise ValueError(f"model.device: {self.model.device} is not allowed; allowed: cpu, for whole roads")
        if self.policy.episode_noise and self.agent not in ("trpo", "ppo"):
            kind = self.policy.exploration
            raise ValueError(f"policy.exploration: {kind} is not allowed; allowed: per_step, for {self.agent}")
        on_ramps = imagines == "road" and all(isinstance(road, OnRamp) for road in scenarios)
        if self.policy.exploration == "antithetic" and imagines and not on_ramps:
            allowed = "per_step, per_episode, for these model rollouts have no antithetic pairs"
            raise ValueError(f"policy.exploration: antithetic is not allowed; allowed: {allowed}")
        if self.task_sampling == "regret" and (len(self.tasks) < 2 or self.evaluation.validation_interval == 0):
            raise ValueError("task_sampling: regret is not allowed; allowed: weights, but for several validated tasks")
        return self

    def task_configs(self) -> dict[str, "RunConfig"]:
        """Return the configuration of each road alone, by its folder's name; one road has none."""
        if not self.tasks:
            return {"": self}
        found: dict[str, RunConfig] = {}
        for task in self.tasks:
            scenario = task.scenario or self.scenario
            name = base = task.name or Path(scenario).stem
            number = 1
            while name in found:
                number += 1
                name = f"{base}-{number}"
            road = replace(
                self,
                scenario=scenario,
                scenario_options=merge_changes(self.scenario_options, task.scenario_options),
                expert=task.expert or self.expert,
                reward=task.reward or self.reward,
                tasks=(),
                task_sampling="weights",
                simulator="sumo",
            )
            batched = self.simulator == "batch" and not unsupported_reason(road.make_scenario())
            found[name] = replace(road, simulator="batch") if batched else road
        return found

    def make_tasks(self) -> list[Task]:
        """Return what is trained on: a task per road.

        Raises:
            InputError: the network would see something else on one of them.
        """
        weights = [task.weight for task in self.tasks] or [1.0]
        tasks = [
            Task(road.make_scenario(), road.make_expert(), road.reward, weight, name)
            for (name, road), weight in zip(self.task_configs().items(), weights, strict=True)
        ]
        first = tasks[0]
        for task in tasks[1:]:
            if observation_inputs(self.policy.inputs, task.expert) != observation_inputs(
                self.policy.inputs, first.expert
            ):
                raise InputError(f"tasks: on {task.name} the network would see something else than on {first.name}")
        return tasks

    def make_scenario(self) -> Scenario:
        """Return the scenario with its changes."""
        try:
            return make_scenario(self.scenario, self.scenario_options)
        except InputError as error:
            raise ValueError(str(error)) from None

    def make_expert(self) -> Driver:
        """Return the driver that the residual is added to."""
        from unjam.controller import make_expert

        step = self.make_scenario().control_step
        expert = Constant() if self.expert == "none" else make_expert(self.expert, step)
        return HistoryDriver(expert, step) if self.policy.history_features else expert


def planned_steps(config: RunConfig) -> int:
    """Return how many actual steps a new training will make: whole iterations, unless episodes end early."""
    tasks = config.make_tasks()
    counts = count_episodes(tasks, config.learner.steps_per_iteration, weight_shares(tasks))
    each = sum(count * task.scenario.horizon for count, task in zip(counts, tasks, strict=True))
    return ceil(config.steps / each) * each


def load_config(file: Path | None = None, preset: str = "", changes: dict[str, Any] | None = None) -> RunConfig:
    """Return a configuration: the defaults, changed by a preset, by a TOML file, by `changes`, in this order.

    Keys of `changes` may have dots: `trpo.gamma`.

    Raises:
        InputError: an unknown key or preset, a value out of range, an unreadable file; or a file in a run
            folder names Python code that is not trusted.
    """
    read = read_toml(file) if file is not None else {}
    if file is not None and _is_in_run_folder(file):  # by itself it is the user's own
        check_trusted_values(f"config file {file}", read)
    given = merge_changes(read, nest_keys(changes or {}))
    values: dict[str, Any] = {}
    road = SCENARIOS.get(str(given.get("scenario", RunConfig.scenario)), Scenario)
    for name in given.keys() - {each.name for each in fields(RunConfig)}:
        if hasattr(road, name):
            raise InputError(f"{name}: unknown name; did you mean 'scenario_options.{name}'?")
    if preset:
        started = preset_values(preset, str(given.get("scenario", RunConfig.scenario)))
        if "tasks" in started and "tasks" not in given:
            _check_preset_conflicts(preset, started["tasks"], given)
        values = {**started, "preset": preset}
    wanted = merge_changes(values, given)
    virtual = wanted.get("model", {})
    if road.actuation == "cruise" and isinstance(virtual, dict) and virtual.get("kind", "row") == "row":
        # Virtual rows know no ACC of a CAV's own: without a model, unless one is asked for.
        wanted = merge_changes({"model": {"model_ratio": 0.0}}, wanted)
    return build_dataclass(RunConfig, wanted, "")


def _is_in_run_folder(file: Path) -> bool:
    """Return whether a file lies in or below a folder of results; the search ends at the working folder."""
    for folder in file.absolute().parents:
        if (folder / CONFIG_FILE).is_file():
            return True
        if folder == Path.cwd():
            break
    return False


def _check_preset_conflicts(preset: str, tasks: Sequence[dict[str, Any]], user_values: dict[str, Any]) -> None:
    """Raise `InputError` where the user says what every task of a preset says otherwise."""
    said = {name: value for name, value in user_values.items() if name in ("scenario", "reward")}
    changes = user_values.get("scenario_options", {})
    said |= {f"scenario_options.{name}": value for name, value in changes.items()} if isinstance(changes, dict) else {}
    for name, value in said.items():
        if all(flatten_keys(task).get(name, "") not in ("", value) for task in tasks):
            raise invalid_value(name, value, f"none with the preset {preset}, whose roads have their own")


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; raise `InputError` where it is missing or not TOML."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"config file {path}: not a file: a directory, a pipe or a device")
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"config file {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # also a number too long, NUL in the path
        raise InputError(f"config file {path}: not TOML: {error}") from None


def to_toml(config: RunConfig) -> str:
    """Return a configuration as TOML, every key written out."""
    return tomli_w.dumps(asdict(config))
