"""Agents of a user's own, `path.py:Class`, are trained, resumed, evaluated and exported as those of the package."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.training.test_run import (
    STEPS,
    Stop,
    collected_episodes,
    learn_with,
    outcome,
    progress,
    small_config,
    stop_after,
)
from unjam.controller import load_controller
from unjam.errors import InputError, UnjamError
from unjam.training.config import RunConfig
from unjam.training.evaluate import evaluate_run
from unjam.training.export import export_controller
from unjam.training.run_folder import check_config, read_config
from unjam.worlds.worker_pool import WorkerPool

FILE = Path(__file__).with_name("user_agents.py")
MBPO = Path(__file__).parents[2] / "examples/mbpo.py"


def config_of(name: str, file: Path = FILE, **changes: Any) -> RunConfig:
    return small_config(agent=f"{file}:{name}", user__steps_per_iteration=STEPS, **changes)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("Reinforce", {"user__options": {"learning_rate": 0.1}, "model__members": 2, "model__epochs": 2}),
        ("EvolutionStrategy", {"steps": 8 * STEPS}),
        (
            "MBPO",
            {"file": MBPO, "user__options": {"rounds": 2, "rollout_steps": 20, "gradient_steps": 5, "batch_size": 32}},
        ),
    ],
)
def test_user_agent_learns_and_a_resumed_run_repeats_bit_for_bit(
    name: str, changes: dict[str, Any], tmp_path: Path
) -> None:
    config = config_of(name, **changes)
    with WorkerPool(1) as workers:
        run = learn_with(workers, tmp_path / "whole", config)
        assert np.abs(run.network().layers[0][0]).max() > 0.0
        with pytest.raises(Stop):
            learn_with(workers, tmp_path / "stopped", config, stop_after(1))
        assert read_config(tmp_path / "stopped") == config
        learn_with(workers, tmp_path / "stopped", config, resume=True)
        assert outcome(tmp_path / "stopped") == outcome(tmp_path / "whole")
        # Its controller is a network as any other.
        evaluation = evaluate_run(tmp_path / "whole", config, workers)
    assert list(evaluation.rows) == ["human", "pi", "trained"]
    exported = export_controller(tmp_path / "whole", tmp_path / "mine.unjam")
    assert load_controller(exported.file).describe().startswith("pi + residual")
    rows = progress(tmp_path / "whole")
    assert len(rows) == 2
    assert (rows[-1]["model_steps"] > 0) == (name != "EvolutionStrategy")


def test_further_collections_of_an_iteration_have_the_same_seeds_and_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = collected_episodes(monkeypatch)
    with WorkerPool(1) as workers:
        run = learn_with(workers, tmp_path / "run", config_of("EvolutionStrategy", user__options={"pairs": 1}))
    seeds = [episode.seed for episode in episodes]
    assert seeds[:3] == seeds[3:6]
    assert run.collector.environment_steps == 2 * STEPS
    (row,) = progress(tmp_path / "run")
    assert (row["environment_steps"], row["episodes"], row["model"]) == (2 * STEPS, 6, {})
    returns = [episode.reward.sum() for episode in episodes]
    assert row["learner"] == {"best_return": max(np.mean(returns[:3]), np.mean(returns[3:]))}


AGENT = """
from unjam.drivers.network import Network
from unjam.learners.algorithm import IterationLog
from unjam.learners.learner import Learner
import numpy as np
class Idle:
    def __init__(self, spec): self.spec = spec
    def network(self): return Network(((np.zeros((self.spec.inputs, 1)), np.zeros(1)),), 1.0)
    def iterate(self, collect): return IterationLog()
    def state(self): return {}, {}
    def restore(self, values, tensors): pass
class Silent(Idle):
    def iterate(self, collect): collect(self.network())
class Failing(Idle):
    def iterate(self, collect):
        return collect(self.network())[7]
class Blind(Idle):
    def network(self): return Network(((np.zeros((1, 1)), np.zeros(1)),), 1.0)
class Strong(Idle):
    def network(self): return Network(((np.zeros((self.spec.inputs, 1)), np.zeros(1)),), 100.0)
class Torch(Idle):
    def network(self): return "a module"
class Forgetful(Idle):
    def iterate(self, collect):
        collect(self.network())
        return IterationLog({"one": 1})
    def state(self): return {"spec": self.spec}, {}
class Wordy(Idle):
    def iterate(self, collect):
        collect(self.network())
        return IterationLog({"loss": "small"})
class Stub(Learner):
    def __init__(self, spec): self.spec = spec
    def network(self): return None
class Stray:
    def __init__(self, spec): pass
    def network(self): return None
    def learn(self, update): pass
    def state(self): return {}, {}
    def restore(self, values, tensors): pass
class Stateless(Stub):
    def network(self): return Idle(self.spec).network()
    def learn(self, update): pass
    def state(self): return None
    def restore(self, values, tensors): pass
class Half:
    def __init__(self, spec): pass
    def network(self): return None
def function(spec): return None
"""


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Idle", "algorithm: iteration 1 runs no episodes; allowed: at least one collect()"),
        ("Silent", "algorithm: iterate() returns NoneType; allowed: an IterationLog"),
        ("Failing", "agent: mine.py:Failing: IndexError: list index out of range (line 16)"),
        ("Blind", "mine.py:Blind has 1 inputs; allowed: 8, those of policy.inputs"),
        ("Strong", "mine.py:Strong has an authority of 100.0 m/s2; allowed: at most 1.0 m/s2, AgentSpec.authority"),
        ("Torch", "mine.py:Torch returns str; allowed: an unjam.drivers.network.Network"),
        ("Wordy", "algorithm: loss of the log is 'small'; allowed: a number"),
        ("Stateless", "state() of Stateless cannot be stored: cannot unpack non-iterable NoneType object"),
        ("Forgetful", "mine.py:Forgetful cannot be stored: Object of type AgentSpec is not JSON serializable"),
    ],
)
def test_invalid_agent_gets_one_line(name: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(AGENT)
    config = config_of(name, tmp_path / "mine.py", evaluation__validation_interval=0)
    check_config(config)
    with WorkerPool(1) as workers, pytest.raises(UnjamError) as caught:
        learn_with(workers, tmp_path / "run", config)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Half", "agent: mine.py:Half has no state(), restore(), learn(); allowed: a class with network()"),
        ("Stub", "agent: mine.py:Stub has no state(), restore(), learn(); allowed: a class with network()"),
        ("Stray", "mine.py:Stray has no exploring_network() and others; allowed: a class that inherits from"),
        ("function", "agent: mine.py:function is not a class"),
        ("Nothing", "mine.py: has no 'Nothing'"),
    ],
)
def test_class_that_is_no_agent_is_refused_before_anything_is_written(name: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(AGENT)
    with pytest.raises(InputError) as caught:
        check_config(config_of(name, tmp_path / "mine.py"))
    assert words in str(caught.value)


def test_unknown_option_is_named(tmp_path: Path) -> None:
    with WorkerPool(1) as workers, pytest.raises(InputError) as caught:
        learn_with(workers, tmp_path / "run", config_of("EvolutionStrategy", user__options={"pears": 1}))
    assert "user.options: user_agents.py:EvolutionStrategy: got an unexpected keyword argument 'pears'" in str(
        caught.value
    )
