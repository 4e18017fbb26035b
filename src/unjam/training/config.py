"""The validated configuration of a training run, from TOML, command-line options and Python."""

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, field, fields, replace
from math import ceil, nan
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic import AfterValidator, Field, model_validator
from pydantic_core import ArgsKwargs

from unjam.drivers.car_following import Constant
from unjam.drivers.driver import Driver
from unjam.drivers.observation import observation_inputs
from unjam.drivers.user_driver import is_file_reference, object_label, object_reference
from unjam.drivers.wrappers import HistoryDriver
from unjam.errors import InputError, invalid_value
from unjam.file_names import absolute_names
from unjam.files import parse_json
from unjam.learners.settings import AgentSettings, PolicySettings, unused_tables
from unjam.models.settings import ModelSettings
from unjam.parameters import (
    STRICT,
    NonNegativeInt,
    Options,
    Positive,
    PositiveInt,
    build_dataclass,
    flatten_keys,
    merge_changes,
    nest_keys,
    parameter_dataclass,
    read_toml,
)
from unjam.scenarios import default_scenario, inline_toml_file, make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.seeds import TRAINING_SEED_LIMIT
from unjam.training.presets import preset_values
from unjam.training.task_sampling import TaskSampling, count_episodes, weight_shares
from unjam.trust import check_trusted_values
from unjam.worlds.backend import check_backend_name
from unjam.worlds.batch.support import statistically_unsupported_reason, unsupported_reason
from unjam.worlds.episode import Task

CONFIG_FILE = "config.toml"
"""file with the configuration of a run, or of a search for hyperparameters, in its folder"""
MANIFEST_FILE = "manifest.json"
"""file with the origin of a run in its folder: versions, machine, start folder"""


@parameter_dataclass(frozen=True, config=STRICT)
class EvaluationSettings:
    """Validation and evaluation of a run, with the deterministic policy; their steps do not count as training."""

    validation_interval: NonNegativeInt = 5
    """iterations between validations; 0: no validations, and the last policy becomes the controller"""
    patience: NonNegativeInt = 0
    """training ends after this number of validations without a new best return; 0: it continues to `steps`"""
    convergence_window: NonNegativeInt = 0
    """training ends if the mean return of this number of iterations, with exploration, is not better than that of as
    many iterations before them; this rule of the paper is checked once per window. 0: it continues to `steps`"""
    validation_episodes: PositiveInt = 4
    """episodes of a validation, with the same seeds in each validation; the controller is selected by their return"""
    episodes: PositiveInt = 20
    """episodes of the final evaluation, on test seeds"""
    baselines: tuple[str, ...] = ("human", "pi", "follower-stopper")
    """drivers that are evaluated in addition to the expert and the trained controller"""

    def should_stop_early(self, progress: Sequence[dict[str, Any]]) -> bool:
        """Return whether a training with these rows of progress ends before it has made all steps."""
        return self.is_out_of_patience(progress) or self.has_converged(progress)

    def has_converged(self, progress: Sequence[dict[str, Any]]) -> bool:
        """Return whether the last `convergence_window` iterations were not better than as many iterations before."""
        window = self.convergence_window
        if not window or len(progress) % window or len(progress) < 2 * window:
            return False
        returns = [nan if (value := row.get("return_mean")) is None else value for row in progress[-2 * window :]]
        return sum(returns[window:]) <= sum(returns[:window])

    def is_out_of_patience(self, progress: Sequence[dict[str, Any]]) -> bool:
        """Return whether the last `patience` scheduled validations had no new best return; the expert's counts too."""
        interval = self.validation_interval
        scheduled = [row for row in progress if interval and row["iteration"] % interval == 0]
        returns = [value for row in scheduled if (value := row.get("return_validation")) is not None]
        if not self.patience or not returns:
            return False
        best = max(range(len(returns)), key=returns.__getitem__)
        count = len(returns) - 1 - best if returns[best] > progress[0]["return_expert"] else len(returns)
        return count >= self.patience


@parameter_dataclass(frozen=True, config=STRICT)
class TaskConfig:
    """One task of a training run on several scenarios; missing and empty entries have the values of the run."""

    scenario: str = ""
    """name of the scenario, or a file"""
    scenario_options: Options = field(default_factory=dict)
    """changes to the scenario's parameters, in addition to those of the run"""
    expert: str = ""
    """driver to which the residual is added"""
    reward: str = ""
    """a name or `path.py:name`"""
    weight: Positive = 1.0
    """share of the environment steps, relative to the weights of the other tasks"""
    name: Annotated[str, Field(pattern=r"^[\w-]*$")] = ""
    """name of the folder of the task; empty: the name of the scenario"""


@parameter_dataclass("", frozen=True, config=STRICT)
class RunConfig(AgentSettings):
    """One training run. Every key can be set in a TOML file, by `--set key=value`, and in Python."""

    scenario: str = "ring"
    scenario_options: Options = field(default_factory=dict)
    """changes to the scenario's parameters"""
    expert: str = "pi"
    """driver to which the residual is added: a name, `path.py:name`, a run folder, a .unjam file; `none`: the network
    drives without an expert"""
    reward: str = ""
    """a name or `path.py:name`; empty: the reward of the scenario"""
    steps: PositiveInt = 960_000
    """environment steps of training"""
    seed: Annotated[int, Field(ge=0, lt=TRAINING_SEED_LIMIT)] = 0
    """seed of the whole run; numbers from `TRAINING_SEED_LIMIT` are reserved for validation, tuning and test seeds"""
    workers: PositiveInt = 2
    """processes that run episodes; the result does not depend on their number"""
    backend: Annotated[str, AfterValidator(check_backend_name)] = "sumo"
    """the simulator: `sumo`, `batch`, or your own, `path.py:name`. `batch` runs all episodes of an iteration, or of a
    validation, at once, which is faster for large iterations. On rings and recorded roads it equals SUMO except for
    rounding, on figure eights and motorways in distribution. In runs with several tasks only rings and recorded roads
    run in the batch. The final evaluation always runs in SUMO"""
    stratified: bool = True
    """whether the episodes of an iteration or validation cover the range of drawn values (the ring's length) evenly"""
    policy: PolicySettings = field(default_factory=PolicySettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    """the learned model (the paper: virtual environment), in which the agent learns between environment episodes"""
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    tasks: tuple[TaskConfig, ...] = ()
    """tasks of a training run on several scenarios; empty: only `scenario`"""
    task_sampling: TaskSampling = "weights"
    """distribution of the steps among several tasks, by their `weight`; with `regret`, from each validation to the next
    only half of the steps, and the other half goes to tasks with a return below their best value so far"""
    preset: str = ""
    """name of the preset from which the configuration was made"""

    @model_validator(mode="before")
    @classmethod
    def _check_no_objects(cls, values: Any) -> Any:
        _check_no_objects_in(values.kwargs if isinstance(values, ArgsKwargs) else values, "")
        return values

    @model_validator(mode="after")
    def _check_combinations(self) -> "RunConfig":
        policy, evaluation = self.policy, self.evaluation
        scenarios = [task_config.make_scenario() for task_config in self.task_configs().values()]
        batch_reasons = list(map(unsupported_reason if self.tasks else statistically_unsupported_reason, scenarios))
        model_kind = self.model.kind if self.model.model_ratio > 0 else ""
        has_memory_input = "expert_memory" in policy.inputs or any(map(is_file_reference, policy.inputs))
        is_open_road_model = model_kind == "road" and not any(scenario.is_closed for scenario in scenarios)
        allows_antithetic_pairs = not model_kind or is_open_road_model
        has_validated_tasks = len(self.tasks) > 1 and evaluation.validation_interval > 0
        device, patience, exploration = self.model.device, evaluation.patience, policy.exploration
        lacks_exit_reward = policy.reward_after_exit and model_kind == "row"
        lacks_memory = policy.history_features and not has_memory_input
        lacks_validation = patience and not evaluation.validation_interval
        lacks_episode_noise = policy.episode_noise and self.agent in ("sac", "td3")
        allowed_exploration = "per_step, per_episode, because these model rollouts have no antithetic pairs"
        allowed_sampling = "weights; regret needs several tasks and validations"
        checks = (
            (self.backend == "batch" and all(batch_reasons), "backend: batch", f"sumo ({batch_reasons[0]})"),
            (lacks_exit_reward, "policy.reward_after_exit: true", "false with model.kind: row"),
            (self.unused_setting, self.unused_setting, f"none for the agent {self.agent}"),
            (lacks_memory, "policy.history_features: true", "false, or true with expert_memory among the inputs"),
            (lacks_validation, f"evaluation.patience: {patience}", "0 without validations"),
            (model_kind == "road" and device != "cpu", f"model.device: {device}", "cpu, for road models"),
            (lacks_episode_noise, f"policy.exploration: {exploration}", f"per_step, for {self.agent}"),
            (
                exploration == "antithetic" and not allows_antithetic_pairs,
                "policy.exploration: antithetic",
                allowed_exploration,
            ),
            (self.task_sampling == "regret" and not has_validated_tasks, "task_sampling: regret", allowed_sampling),
        )
        for is_wrong, value, allowed in checks:
            if is_wrong:
                raise ValueError(f"{value} is not allowed; allowed: {allowed}")
        return self

    @property
    def episode_backend(self) -> str:
        """The backend of single episodes, as in the final evaluation: SUMO instead of the batch."""
        return "sumo" if self.backend == "batch" else self.backend

    def task_configs(self) -> dict[str, "RunConfig"]:
        """Return the configuration of each task by the name of its folder; without tasks, the name is empty."""
        if not self.tasks:
            return {"": self}
        configs: dict[str, RunConfig] = {}
        for task in self.tasks:
            scenario = task.scenario or self.scenario
            name = base = task.name or Path(scenario).stem.strip(".") or "road"
            number = 1
            while name in configs:
                number += 1
                name = f"{base}-{number}"
            task_config = replace(
                self,
                scenario=scenario,
                scenario_options=merge_changes(self.scenario_options, task.scenario_options),
                expert=task.expert or self.expert,
                reward=task.reward or self.reward,
                tasks=(),
                task_sampling="weights",
                backend="sumo",
            )
            needs_sumo = self.backend == "batch" and unsupported_reason(task_config.make_scenario()) != ""
            configs[name] = task_config if needs_sumo else replace(task_config, backend=self.backend)
        return configs

    def make_tasks(self) -> list[Task]:
        """Return the tasks of the training; raise `InputError` if the network would need different inputs."""
        weights = [task.weight for task in self.tasks] or [1.0]
        tasks = [
            Task(task_config.make_scenario(), task_config.make_expert(), task_config.reward, weight, name)
            for (name, task_config), weight in zip(self.task_configs().items(), weights, strict=True)
        ]
        inputs = [observation_inputs(self.policy.inputs, task.expert) for task in tasks]
        for task, task_inputs in zip(tasks, inputs, strict=True):
            if task_inputs != inputs[0]:
                reason = f"{task.name} gives the network other inputs than {tasks[0].name}"
                raise InputError(f"tasks: {reason}; allowed: tasks with equal inputs")
        return tasks

    def make_scenario(self) -> Scenario:
        """Return the scenario with the configured options."""
        return make_scenario(self.scenario, self.scenario_options)

    def make_expert(self) -> Driver:
        """Return the driver to which the residual is added."""
        from unjam.controller import make_expert

        control_step = self.make_scenario().control_step
        expert = Constant() if self.expert == "none" else make_expert(self.expert, control_step)
        return HistoryDriver(expert, control_step) if self.policy.history_features else expert


def planned_steps(config: RunConfig) -> int:
    """Return the environment steps of a new training in whole iterations if no episode ends early."""
    tasks = config.make_tasks()
    counts = count_episodes(tasks, config.learner.steps_per_iteration, weight_shares(tasks))
    iteration_steps = sum(count * task.scenario.max_episode_steps for count, task in zip(counts, tasks, strict=True))
    return ceil(config.steps / iteration_steps) * iteration_steps


def load_config(file: Path | str | None = None, preset: str = "", changes: dict[str, Any] | None = None) -> RunConfig:
    """Return a configuration: the defaults, changed by a preset, a TOML file and `changes`, in this order.

    Keys of `changes` may have dots: `trpo.gamma`. Values are no Python objects, because a training imports functions,
    classes and drivers in other processes: `path.py:name`. Raise `InputError` for an unknown key or preset, a value
    that is not allowed, an unreadable file, and untrusted Python code in a file in a run folder.
    """
    file = None if file is None else Path(file)
    file_values = read_config_values(file) if file is not None else {}
    if file is not None and _is_in_run_folder(file):  # the code in other files is the user's own
        check_trusted_values(f"config file {file}", file_values)
    user_values = inline_toml_file(merge_changes(file_values, nest_keys(changes or {})))
    if isinstance(tasks := user_values.get("tasks"), list):
        user_values["tasks"] = [_expand_toml_file_of_task(task) for task in tasks]
    scenario_name = str(user_values.get("scenario", RunConfig.scenario))
    scenario = default_scenario(scenario_name)
    for name in user_values.keys() - {setting.name for setting in fields(RunConfig)}:
        if hasattr(scenario, name):
            raise InputError(f"{name}: unknown name; did you mean 'scenario_options.{name}'?")
    values: dict[str, Any] = {}
    if preset:
        values = {**preset_values(preset, scenario_name), "preset": preset}
        if "tasks" in values and "tasks" not in user_values:
            _check_preset_conflicts(preset, values["tasks"], user_values)
    unused = unused_tables({"agent": RunConfig.agent, **values, **user_values}["agent"])
    values = merge_changes({key: value for key, value in values.items() if key not in unused}, user_values)
    model = values.get("model", {})
    if scenario.actuation == "cruise" and isinstance(model, dict) and model.get("kind", "row") == "row":
        # The row model cannot represent the ACC of a CAV: by default, there is no model.
        values = merge_changes({"model": {"model_ratio": 0.0}}, values)
    return build_dataclass(RunConfig, values, "")


def read_config_values(file: Path) -> dict[str, Any]:
    """Return the values of a configuration file, with absolute file names if its run was started in another folder."""
    values, start_folder = read_toml(file), _start_folder(file.absolute().parent)
    return values if start_folder == Path.cwd() else absolute_names(values, start_folder)


def _start_folder(run: Path) -> Path:
    """Return the folder in which the run of a run folder or task folder was started, or else the working folder."""
    for folder in (run, run.parent):
        with suppress(OSError, ValueError, LookupError, TypeError):
            if (folder / MANIFEST_FILE).is_file():
                start_folder = parse_json((folder / MANIFEST_FILE).read_bytes())["start_folder"]
                return Path(os.path.realpath(folder / start_folder))
    return Path.cwd()


def _expand_toml_file_of_task(values: Any) -> Any:
    """Return the values of a task; the content of a TOML file of a scenario replaces its name, which names the task."""
    if not isinstance(values, dict) or (expanded := inline_toml_file(values)) is values:
        return values
    return {"name": re.sub(r"[^\w-]", "-", Path(values["scenario"]).stem), **expanded}


def _check_no_objects_in(value: Any, name: str) -> None:
    """Raise `InputError` if a value contains a function, a class or a driver."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _check_no_objects_in(inner, f"{name}.{key}".strip("."))
    elif isinstance(value, list | tuple):
        for inner in value:
            _check_no_objects_in(inner, name)
    elif callable(value) or callable(getattr(value, "act", None)):
        reference = object_reference(value)
        hint = f"; did you mean {reference!r}?" if reference else ""
        reason = f"the Python object {object_label(value)} is not allowed, because other processes must import it"
        raise InputError(f"{name}: {reason}; allowed: path.py:name{hint}")


def _is_in_run_folder(file: Path) -> bool:
    """Return whether a file lies in or below a run folder; the search ends at the working folder."""
    for folder in file.absolute().parents:
        if (folder / CONFIG_FILE).is_file():
            return True
        if folder == Path.cwd():
            break
    return False


def _check_preset_conflicts(preset: str, tasks: Sequence[dict[str, Any]], user_values: dict[str, Any]) -> None:
    """Raise `InputError` if every task of a preset has another value for a setting of the user."""
    names = ("scenario", "reward", "scenario_options")
    for name, value in flatten_keys({key: value for key, value in user_values.items() if key in names}).items():
        if all(flatten_keys(task).get(name, "") not in ("", value) for task in tasks):
            raise invalid_value(name, value, f"no value with the preset {preset}: its tasks set it")


def to_toml(config: RunConfig) -> str:
    """Return a configuration as TOML with all keys."""
    return tomli_w.dumps(asdict(config))
