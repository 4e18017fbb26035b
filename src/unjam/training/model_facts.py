"""What there is to see of a run's virtual environment: where it agrees with the actual one, and where not.

All of it is measured on episodes that no network learned from, and kept in the run folder as `model.json`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from unjam.errors import InputError, resume_hint
from unjam.files import atomic_write, to_json
from unjam.learners.algorithm_1 import model_rollouts_class
from unjam.learners.learner import tensors_with_prefix
from unjam.learners.model_rollouts import RowRollouts, WholeRoadRollouts
from unjam.models.comparison import one_step_errors, open_loop_errors, recorded_states, replay_accelerations
from unjam.models.fitting import OneStepErrors, root_mean_square
from unjam.models.row_model import STATE_FIELDS, TARGET_NAMES, RowModel
from unjam.reports.results import MODEL_FILE, read_model_facts, read_progress
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig
from unjam.training.run_folder import load_checkpoint
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode, Floats
from unjam.worlds.worker_pool import EpisodeTask

MAX_REPLAY_STEPS = 500
"""decisions that virtual and actual are compared over, where the stays are long enough"""
MAX_ERROR_ROWS = 20_000
"""at most so many decisions tell the errors one step ahead"""
MAX_REPLAYS = 200
"""from which recorded accelerations are replayed"""
EXAMPLE_COUNT = 3
"""of them, shown one by one"""
MAX_REPLAY_TIMES = 100
"""at most so many moments of a replay are kept"""
BINS_PER_FIELD = 10
"""of equally many decisions, by gap and by speed"""
BINNED_FIELDS = ("leader_gap", "speed")
ROLLOUT_LENGTHS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""of rollouts, for which the bound is computed [decisions]"""
EXAMPLE_FIELDS = ("leader_gap", "leader_speed")
"""numbers of the examples"""


def update_model_facts(folder: Path, config: RunConfig) -> dict[str, Any]:
    """Return the facts about a run's virtual environment, measured anew if they are missing or old.

    Raises:
        InputError: of the run's virtual environment, if it has one, nothing is measured, or it has no
            checkpoint yet.
    """
    if why := no_facts_reason(config):
        raise InputError(f"run: {str(folder)!r} {why}")
    kept, progress = read_model_facts(folder), read_progress(folder)
    if kept is None or not progress or kept.get("iteration") != progress[-1]["iteration"]:
        write_model_facts(folder, config)
        kept = read_model_facts(folder)
    assert kept is not None
    return kept


def no_facts_reason(config: RunConfig) -> str:
    """Return why there is nothing to say of a run's virtual environment; empty where there is."""
    if config.tasks:
        return "is of several roads; allowed: a run of one"
    if config.model.model_ratio == 0:
        return "has no virtual environment: its model.model_ratio is 0; allowed: > 0"
    return ""


def write_model_facts(folder: Path, config: RunConfig) -> None:
    """Write what `measure_model` finds into the run's `model.json`."""
    atomic_write(folder / MODEL_FILE, to_json(measure_model(folder, config)))


def measure_model(folder: Path, config: RunConfig) -> dict[str, Any]:
    """Return the facts about the virtual environment in a run's newest checkpoint, to four digits.

    Raises:
        InputError: the run has no checkpoint yet.
    """
    checkpoint = load_checkpoint(folder / "checkpoint")
    progress = read_progress(folder)
    if checkpoint is None or not progress:
        raise InputError(f"run: {str(folder)!r} has no checkpoint yet{resume_hint(folder)}")
    torch.set_num_threads(1)  # for small networks more are slower
    state, tensors = checkpoint
    settings = replace(config.model, device="cpu")
    (task,) = config.make_tasks()
    imagination = model_rollouts_class(settings, task)(settings, task, config.policy, config.seed)
    imagination.restore(state[imagination.name], tensors_with_prefix(f"{imagination.name}/", tensors))
    about = {"iteration": state["iteration"], "base": settings.base, "members": settings.members}
    if settings.kind == "road":
        return _round_values(about | _wave_facts(cast(WholeRoadRollouts[Any], imagination), config.simulator))
    return _round_values(about | _row_facts(cast(RowRollouts, imagination), config, progress[-1]))


def _wave_facts(rollouts: WholeRoadRollouts[Any], simulator: str) -> dict[str, Any]:
    """Return what a road was like and what is imagined of it; actual episodes run in a world."""
    step, length, lane_names, seen = rollouts.waves(_run_in_batch if simulator == "batch" else _run_in_sumo)
    drawn = {label: each._asdict() for label, each in seen.items()}
    return {"control_step": step, "loop_length": length, "lane_names": lane_names, "waves": drawn}


def _run_in_batch(task: EpisodeTask) -> Episode:
    return run_batch([task], allow_statistical=True)[0]


def _run_in_sumo(task: EpisodeTask) -> Episode:
    return run_episode(task.scenario, task.driver, task.seed)


def _row_facts(rollouts: RowRollouts, config: RunConfig, progress_row: dict[str, Any]) -> dict[str, Any]:
    """Return how wrong imagined rows are, on episodes that no network learned from."""
    scenario, generator = rollouts.scenario, np.random.default_rng(config.seed)
    actual = rollouts.data.transitions(config.model.holdout)
    held_out = actual.select(generator.permutation(np.flatnonzero(actual.is_holdout))[:MAX_ERROR_ROWS])
    errors = one_step_errors(rollouts.model, held_out, scenario, config.reward)
    return {
        "control_step": scenario.control_step,
        "k_star": progress_row["k_star"],
        "validation_steps": int(actual.is_holdout.sum()),
        "one_step": {name: found._asdict() for name, found in errors.rmse_by_target().items()},
        "by_state": {name: _errors_by_bin(getattr(held_out.states, name), errors) for name in BINNED_FIELDS},
        "replay": _replay_facts(rollouts, scenario, generator),
        "bound": _bound_facts(rollouts, progress_row, config.learner.gamma),
    }


def _errors_by_bin(values: Floats, errors: OneStepErrors) -> dict[str, Any]:
    """Return the errors one step ahead by what `values`, shape (R,), were, in bins of equally many rows."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS_PER_FIELD + 1)))
    places = np.searchsorted(edges[1:-1], values, side="right")
    bins = [places == place for place in np.unique(places)]

    def errors_of(kind: Floats) -> dict[str, list[float]]:
        """By target, the error in each bin, of errors of shape (..., R, targets)."""
        return {
            name: [root_mean_square(kind[..., rows, column]) for rows in bins]
            for column, name in enumerate(TARGET_NAMES)
        }

    return {
        "values": [values[rows].mean() for rows in bins],
        "control_steps": [int(rows.sum()) for rows in bins],
        "base": errors_of(errors.base),
        "model": errors_of(errors.model),
    }


def replay_length(trip_lengths: Sequence[int]) -> int:
    """Return over how many decisions to replay stays on the road that were so long [decisions].

    Over half of a usual one, so that at least half of the stays have places to start from.
    """
    return min(MAX_REPLAY_STEPS, max(1, int(np.median(trip_lengths)) // 2))


def _replay_facts(rollouts: RowRollouts, scenario: Scenario, generator: np.random.Generator) -> dict[str, Any]:
    """Return how recorded accelerations end in the virtual environment, without noise, and some examples."""
    data, model = rollouts.data, rollouts.model
    held_out = data.holdout_masks(rollouts.settings.holdout)
    decisions = replay_length([int(rows.sum()) for rows in held_out if rows.any()])
    starts = data.start_indices(decisions)
    starts = starts[[held_out[place][at] for place, at in starts]]
    starts = starts[np.sort(generator.permutation(len(starts))[:MAX_REPLAYS])]
    single = replace(rollouts.settings, members=1, error_estimator="unexplained_variance")
    alone = RowModel(single, len(scenario.drawn_ranges), (0,))
    moments = np.unique(np.linspace(0, decisions - 1, MAX_REPLAY_TIMES).round().astype(int))
    found, base = (open_loop_errors(each, data, starts, decisions, scenario) for each in (model, alone))
    examples = starts[generator.permutation(len(starts))[:EXAMPLE_COUNT]]
    actual = recorded_states(data, examples, decisions)
    members, lone = (replay_accelerations(each, data, examples, decisions, scenario) for each in (model, alone))
    return {
        "times": (moments + 1) * scenario.control_step,
        "starts": len(starts),
        "quantities": {
            name: {
                "model": found.error[name][moments],
                "spread": found.spread[name][moments],
                "base": base.error[name][moments],
                "change": found.change[name][moments],
            }
            for name in STATE_FIELDS
        },
        "examples": [
            {
                "start_time": at * scenario.control_step,
                "drawn_values": data.recordings[place].drawn_values,
                "quantities": {
                    name: {
                        "recorded": actual[name][example, 1:][moments],
                        "members": members[name][:, example, moments],
                        "base": lone[name][0, example, moments],
                    }
                    for name in EXAMPLE_FIELDS
                },
            }
            for example, (place, at) in enumerate(examples)
        ],
    }


def _bound_facts(rollouts: RowRollouts, progress_row: dict[str, Any], gamma: float) -> dict[str, Any] | None:
    """Return the bound C by the length of rollouts for the newest row of progress; None without an eps_m."""
    eps_m = progress_row["model"]["eps_m_by_estimator"].get("transitions")  # of runs of before there is none
    if eps_m is None:
        return None
    eps_pi = progress_row["learner"]["eps_pi_max"]
    discount = rollouts.step_discount(gamma)
    return {
        "eps_pi": eps_pi,
        "eps_m": eps_m,
        "max_reward": rollouts.max_reward,
        "largest_return": rollouts.max_reward / (1.0 - discount),
        "k": ROLLOUT_LENGTHS,
        "bound": [rollouts.bound_at(k, eps_pi, eps_m, gamma) for k in ROLLOUT_LENGTHS],
    }


def _round_values(value: Any) -> Any:
    """Return plain lists and numbers, these to four digits."""
    if isinstance(value, dict):
        return {key: _round_values(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_round_values(entry) for entry in value]
    if isinstance(value, np.integer):
        return int(value)
    return float(f"{value:.4g}") if isinstance(value, (float, np.floating)) else value
