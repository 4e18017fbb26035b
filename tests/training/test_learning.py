"""Each learner exceeds the return of random driving with environment and model rows."""

from pathlib import Path
from typing import Any

import pytest

from tests.training.test_run import learn_with
from unjam.training.config import load_config
from unjam.worlds.worker_pool import WorkerPool

LITTLE_RING: dict[str, Any] = {
    "scenario": "ring",
    "scenario_options.length": [110, 130],
    "scenario_options.vehicles": 10,
    "scenario_options.horizon": 600,
    "expert": "none",
    "policy.exploration_std": 0.3,
    "model.model_ratio": 2.0,
    "evaluation.validation_interval": 4,
    "workers": 1,
}
QUICK: dict[str, dict[str, Any]] = {
    "trpo": {"trpo.steps_per_iteration": 3000, "steps": 48_000},
    "ppo": {"ppo.steps_per_iteration": 3000, "ppo.epochs": 40, "steps": 36_000},
    "sac": {
        **{"sac.steps_per_iteration": 3000, "sac.learning_starts": 3000, "sac.gradient_steps_per_step": 0.3},
        **{"sac.temperature": 0.2, "steps": 24_000},
    },
    "td3": {
        **{"td3.steps_per_iteration": 3000, "td3.learning_starts": 3000, "td3.gradient_steps_per_step": 0.3},
        **{"td3.tau": 0.03, "steps": 24_000},
    },
}
STANDING = 60.0
"""above the return of an untrained network, which never starts and stops the vehicles behind it"""
TARGET = 100.0
"""measured with other seeds: 166 (trpo), 195 (ppo), 173 (sac), 300 (td3)"""


@pytest.mark.slow
@pytest.mark.parametrize("agent", QUICK)
def test_network_without_expert_learns_on_a_small_ring(agent: str, tmp_path: Path) -> None:
    config = load_config(changes={**LITTLE_RING, "agent": agent, **QUICK[agent]})
    rows: list[dict[str, Any]] = []
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", config, rows.append)
    assert rows[0]["return_expert"] < STANDING
    assert max(row["return_validation"] or 0.0 for row in rows) > TARGET
    assert sum(row["model_steps"] for row in rows) > 0
