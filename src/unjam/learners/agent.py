"""Construction of agents, which are learners of the package or classes of the user, and checks of their results."""

import inspect
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.drivers.user_driver import FileReference, is_file_reference, last_line
from unjam.errors import InputError, UnjamError
from unjam.learners.settings import LearnerSettings, PolicySettings, UserAgentSettings
from unjam.models.settings import ModelSettings
from unjam.worlds.episode import Task
from unjam.worlds.record import Floats


@dataclass(frozen=True)
class AgentSpec:
    """Specification of an agent: its tasks, the inputs of its networks, and the bounds of the residual."""

    tasks: Sequence[Task]
    policy: PolicySettings
    model: ModelSettings
    gamma: float
    """discount from one action of the network to the next"""
    seed: int
    """seed of the whole run"""
    string_gain: Callable[[Network], float] | None = None
    """function that returns the largest string gain of the full policy with a network on all tasks; None: no limit"""

    @property
    def inputs(self) -> int:
        """Number of inputs of the policy."""
        return observation_size(self.policy.inputs, self.tasks[0].expert)

    @property
    def critic_inputs(self) -> int:
        """Number of additional inputs of the critic."""
        drawn_values = np.zeros((1, len(self.tasks[0].scenario.drawn_ranges)))
        return self.privileged_inputs(0, drawn_values).shape[1] + self.policy.reward_after_exit

    @property
    def action_limit(self) -> float:
        """Largest acceleration of a CAV on all roads [m/s2]."""
        return min(task.scenario.action_limit for task in self.tasks)

    @property
    def authority(self) -> float:
        """Largest residual [m/s2]."""
        return self.policy.authority * self.action_limit

    @property
    def exploration_std(self) -> float:
        """Initial standard deviation of the exploration noise [m/s2]."""
        return self.policy.exploration_std * self.action_limit

    def privileged_inputs(self, task_index: int, drawn_values: Floats) -> Floats:
        """Return the additional inputs of the critic in rows of a task with `drawn_values`, shape (rows, m).

        With several tasks, these are the drawn values of each task, zeros for other tasks, and a one-hot task index.
        """
        if not self.policy.privileged_critic:
            return drawn_values[:, :0]
        if len(self.tasks) == 1:
            return drawn_values
        columns = [np.zeros((len(drawn_values), len(task.scenario.drawn_ranges))) for task in self.tasks]
        columns[task_index] = drawn_values
        return np.hstack([*columns, np.tile(np.eye(len(self.tasks))[task_index], (len(drawn_values), 1))])


def make_agent(name: str, settings: LearnerSettings, spec: AgentSpec) -> Any:
    """Return a new agent: a `Learner` of the package, or an object of the user's class."""
    if isinstance(settings, UserAgentSettings):
        user_class = _load_user_class(name)
        try:
            inspect.signature(user_class).bind(spec, **settings.options)
        except TypeError as error:
            raise InputError(f"user.options: {FileReference.parse(name)}: {error}") from None
        return user_class(spec, **settings.options)
    return learner_class(settings)(spec, settings)


def learner_class(settings: LearnerSettings) -> type[Any]:
    """Return the class of the package's learner with these settings; `ImportError` if a package is missing."""
    module, _, class_name = settings.learner_class.partition(":")
    return getattr(import_module(module), class_name)


def is_algorithm(agent: Any) -> bool:
    """Return whether an agent, or its class, is an `Algorithm` instead of a `Learner`."""
    return callable(getattr(agent, "iterate", None))


def check_agent(name: str) -> None:
    """Run the file of `path.py:Class`, and raise `InputError` if this is not a class of learners or algorithms."""
    from unjam.learners.algorithm import Algorithm  # these modules import this one
    from unjam.learners.learner import Learner

    user_class = _load_user_class(name)
    protocol: Any = Algorithm if is_algorithm(user_class) else Learner
    required = ("network", "state", "restore", "iterate" if protocol is Algorithm else "learn")
    unusable = [None, *(getattr(protocol, method) for method in required)]  # the methods of a protocol are empty
    if missing := [f"{method}()" for method in required if getattr(user_class, method, None) in unusable]:
        allowed = "a class with network(), state(), restore() and iterate(), an algorithm, or learn(), a learner"
        raise InputError(f"agent: {FileReference.parse(name)} has no {', '.join(missing)}; allowed: {allowed}")
    if protocol is Learner and Learner not in user_class.__mro__:
        allowed = "allowed: a class that inherits from unjam.learners.learner.Learner"
        raise InputError(f"agent: {FileReference.parse(name)} has no exploring_network() and others; {allowed}")


def check_network(name: str, network: Any, spec: AgentSpec) -> Network:
    """Return the network of an agent; raise `InputError` if workers cannot drive with it."""
    if not isinstance(network, Network):
        allowed = "allowed: an unjam.drivers.network.Network"
        raise InputError(f"agent: network() of {name} returns {type(network).__name__}; {allowed}")
    if network.input_size != spec.inputs:
        allowed = f"allowed: {spec.inputs}, those of policy.inputs"
        raise InputError(f"agent: the network of {name} has {network.input_size} inputs; {allowed}")
    if network.authority > spec.authority:
        allowed = f"allowed: at most {spec.authority} m/s2, AgentSpec.authority"
        raise InputError(f"agent: the network of {name} has an authority of {network.authority} m/s2; {allowed}")
    return network


def check_state(name: str, state: Any) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return copies of the values and tensors of an agent; raise `InputError` if a checkpoint cannot store them."""
    try:
        values, tensors = state
        copies = {key: torch.as_tensor(array).detach().clone().contiguous() for key, array in tensors.items()}
        return json.loads(json.dumps(values)), copies
    except (TypeError, ValueError, RuntimeError, AttributeError) as error:
        allowed = "allowed: (values for JSON, tensors or arrays by name)"
        raise InputError(f"agent: state() of {name} cannot be stored: {error}; {allowed}") from None


@contextmanager
def convert_user_errors(name: str) -> Iterator[None]:
    """Raise errors of the user's agent in the block as an `InputError` with the last executed line."""
    try:
        yield
    except UnjamError:
        raise
    except (Exception, SystemExit) as error:
        reference = FileReference.parse(name) if is_file_reference(name) else None
        if not (line := last_line(error, str(reference.path)) if reference else ""):
            raise
        raise InputError(f"agent: {reference}: {type(error).__name__}: {error}{line}") from error


def _load_user_class(name: str) -> type[Any]:
    reference = FileReference.parse(name)
    user_class = reference.load_object()
    if not inspect.isclass(user_class):
        raise InputError(f"agent: {reference} is not a class; allowed: a class of learners or algorithms")
    return user_class
