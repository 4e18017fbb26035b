"""Errors and the bound of the learned model of a run, measured on holdout episodes, for the run's `model.json`."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from unjam.errors import InputError, resume_hint
from unjam.files import atomic_write, to_json
from unjam.learners.agent import AgentSpec
from unjam.learners.algorithm import tensors_with_prefix
from unjam.learners.model_rollouts import ModelRollouts
from unjam.models.comparison import one_step_errors, open_loop_errors, recorded_states, replay_accelerations
from unjam.models.ensemble import root_mean_square
from unjam.models.row_model import STATE_FIELDS, TARGET_NAMES, OneStepErrors, RowModel
from unjam.models.whole_road_models import WholeRoadModel
from unjam.models.world_model import WorldModel
from unjam.reports.results import MODEL_FILE, read_model_facts, read_progress
from unjam.training.config import RunConfig
from unjam.training.run_folder import load_checkpoint
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode, Floats
from unjam.worlds.worker_pool import EpisodeTask

MAX_REPLAY_STEPS = 500
"""maximum length of a replay [control steps]"""
MAX_ERROR_ROWS = 20_000
"""maximum number of rows for the one-step errors"""
MAX_REPLAYS = 200
EXAMPLE_COUNT = 3
"""number of replays that are plotted individually"""
MAX_REPLAY_TIMES = 100
"""maximum number of times at which errors of replays are stored"""
BINS_PER_FIELD = 10
"""number of bins with equally many control steps, for each of `BINNED_FIELDS`"""
BINNED_FIELDS = ("leader_gap", "speed")
ROLLOUT_LENGTHS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""lengths for which the bound is computed [control steps]"""
EXAMPLE_FIELDS = ("leader_gap", "leader_speed")


def update_model_facts(folder: Path, config: RunConfig) -> dict[str, Any]:
    """Return facts about the model of a run, measured again if out of date; raise `InputError` without a model."""
    _check_has_facts(folder, config)
    facts, progress = read_model_facts(folder), read_progress(folder)
    if facts is None or not progress or facts.get("iteration") != progress[-1]["iteration"]:
        write_model_facts(folder, config)
        facts = read_model_facts(folder)
    assert facts is not None
    return facts


def _check_has_facts(folder: Path, config: RunConfig) -> None:
    if reason := no_facts_reason(folder, config):
        raise InputError(f"run: {str(folder)!r} {reason}")


def no_facts_reason(folder: Path, config: RunConfig) -> str:
    """Return the reason why there are no facts about the model of a run, or an empty text."""
    if config.tasks:
        return "has several tasks; allowed: a run of one road"
    if config.model.model_ratio == 0:
        return "has no model: its model.model_ratio is 0; allowed: > 0"
    if (progress := read_progress(folder)) and not progress[-1]["model"]:
        return f"has no model: {config.agent} learns none; allowed: an agent that does"
    return ""


def write_model_facts(folder: Path, config: RunConfig) -> None:
    """Write the facts of `measure_model` into the run's `model.json`."""
    atomic_write(folder / MODEL_FILE, to_json(measure_model(folder, config)))


def measure_model(folder: Path, config: RunConfig) -> dict[str, Any]:
    """Return the facts about the model in a run's newest checkpoint, to four digits; raise `InputError` without it."""
    return trained_model_facts(read_trained_model(folder, config))


class TrainedModel(NamedTuple):
    """The model in the newest checkpoint of a run, with the newest row of the run's progress."""

    rollouts: ModelRollouts
    config: RunConfig
    progress_row: dict[str, Any]


def read_trained_model(folder: Path, config: RunConfig) -> TrainedModel:
    """Return the model of a run on the CPU; raise `InputError` without a model or a valid checkpoint."""
    _check_has_facts(folder, config)
    checkpoint, progress = load_checkpoint(folder / "checkpoint"), read_progress(folder)
    if checkpoint is None or not progress:
        raise InputError(f"run: {str(folder)!r} has no checkpoint yet{resume_hint(folder)}")
    state, tensors = checkpoint
    settings = replace(config.model, device="cpu")
    spec = AgentSpec(config.make_tasks(), config.policy, settings, config.learner.gamma, config.seed)
    rollouts = ModelRollouts(spec)
    rollouts.restore(state["algorithm"][rollouts.name], tensors_with_prefix(f"algorithm/{rollouts.name}/", tensors))
    return TrainedModel(rollouts, config, {**progress[-1], "iteration": state["iteration"]})


def trained_model_facts(trained: TrainedModel) -> dict[str, Any]:
    """Return the facts about a model, to four digits."""
    rollouts, config, progress_row = trained
    torch.set_num_threads(1)  # small networks are slower with more threads
    settings = rollouts.spec.model
    facts = {"iteration": progress_row["iteration"], "base": settings.base, "members": settings.members}
    if settings.kind == "road":
        run = partial(_run_episode, config.backend)
        return _round_values(facts | cast(WholeRoadModel[Any], rollouts.world_model).compare_waves(run))
    return _round_values(facts | _row_model_facts(rollouts, config, progress_row))


def _run_episode(backend: str, task: EpisodeTask) -> Episode:
    return run_episode(task.scenario, task.driver, task.seed, backend=backend)


def _row_model_facts(rollouts: ModelRollouts, config: RunConfig, progress_row: dict[str, Any]) -> dict[str, Any]:
    model, generator = rollouts.world_model, np.random.default_rng(config.seed)
    scenario, transitions = model.scenario, model.data.transitions(config.model.holdout)
    holdout = transitions.select(generator.permutation(np.flatnonzero(transitions.is_holdout))[:MAX_ERROR_ROWS])
    errors = one_step_errors(model.ensemble, holdout, scenario, config.reward)
    return {
        "control_step": scenario.control_step,
        "k_star": progress_row["k_star"],
        "validation_steps": int(transitions.is_holdout.sum()),
        "one_step": {name: rmse._asdict() for name, rmse in errors.rmse_by_target().items()},
        "by_state": {name: _errors_by_bin(getattr(holdout.states, name), errors) for name in BINNED_FIELDS},
        "replay": _replay_facts(model, generator),
        "bound": _bound_facts(rollouts, progress_row),
    }


def _errors_by_bin(values: Floats, errors: OneStepErrors) -> dict[str, Any]:
    """Return the one-step errors by `values`, shape (R,), in bins with equal numbers of rows."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS_PER_FIELD + 1)))
    bin_indices = np.searchsorted(edges[1:-1], values, side="right")
    bin_masks = [bin_indices == index for index in np.unique(bin_indices)]

    def rmse_by_target(row_errors: Floats) -> dict[str, list[float]]:
        """Return the RMSE in each bin by target; `row_errors` has the shape (..., R, targets)."""
        return {
            name: [root_mean_square(row_errors[..., mask, column]) for mask in bin_masks]
            for column, name in enumerate(TARGET_NAMES)
        }

    return {
        "values": [values[mask].mean() for mask in bin_masks],
        "control_steps": [int(mask.sum()) for mask in bin_masks],
        "base": rmse_by_target(errors.base),
        "model": rmse_by_target(errors.model),
    }


def replay_length(trip_lengths: Sequence[int]) -> int:
    """Return the length of replays: half of the median trip, so that at least half of the trips are long enough."""
    return min(MAX_REPLAY_STEPS, max(1, int(np.median(trip_lengths)) // 2))


def _replay_facts(world_model: WorldModel[RowModel, Any], generator: np.random.Generator) -> dict[str, Any]:
    """Return the errors of replays, in which the model without noise gets recorded accelerations, and examples."""
    data, model, scenario = world_model.data, world_model.ensemble, world_model.scenario
    masks = data.holdout_masks(world_model.settings.holdout)
    steps = replay_length([int(mask.sum()) for mask in masks if mask.any()])
    starts = data.start_indices(steps)
    starts = starts[[masks[recording][index] for recording, index in starts]]
    starts = starts[np.sort(generator.permutation(len(starts))[:MAX_REPLAYS])]
    base_settings = replace(world_model.settings, members=1, error_estimator="unexplained_variance")
    models = model, RowModel(base_settings, len(scenario.drawn_ranges), (0,))  # an unfitted model is the base
    times = np.unique(np.linspace(0, steps - 1, MAX_REPLAY_TIMES).round().astype(int))
    errors, base_errors = (open_loop_errors(replayed, data, starts, steps, scenario) for replayed in models)
    examples = starts[generator.permutation(len(starts))[:EXAMPLE_COUNT]]
    recorded = recorded_states(data, examples, steps)
    members, base = (replay_accelerations(replayed, data, examples, steps, scenario) for replayed in models)
    return {
        "times": (times + 1) * scenario.control_step,
        "starts": len(starts),
        "quantities": {
            name: {
                "model": errors.error[name][times],
                "spread": errors.spread[name][times],
                "base": base_errors.error[name][times],
                "change": errors.change[name][times],
            }
            for name in STATE_FIELDS
        },
        "examples": [
            {
                "start_time": index * scenario.control_step,
                "drawn_values": data.recordings[recording].drawn_values,
                "quantities": {
                    name: {
                        "recorded": recorded[name][example, 1:][times],
                        "members": members[name][:, example, times],
                        "base": base[name][0, example, times],
                    }
                    for name in EXAMPLE_FIELDS
                },
            }
            for example, (recording, index) in enumerate(examples)
        ],
    }


def _bound_facts(rollouts: ModelRollouts, progress_row: dict[str, Any]) -> dict[str, Any] | None:
    """Return the paper's bound C by rollout length for the newest row of progress; None without eps_m or eps_pi."""
    eps_m = progress_row["model"]["eps_m_by_estimator"].get("transitions")
    eps_pi = progress_row["learner"].get("eps_pi_max")
    if eps_m is None or eps_pi is None:
        return None
    max_reward = rollouts.world_model.max_reward
    return {
        "eps_pi": eps_pi,
        "eps_m": eps_m,
        "max_reward": max_reward,
        "largest_return": max_reward / (1.0 - rollouts.step_discount),
        "k": ROLLOUT_LENGTHS,
        "bound": [rollouts.bound(k, eps_pi, eps_m) for k in ROLLOUT_LENGTHS],
    }


def _round_values(value: Any) -> Any:
    """Return a JSON value with lists instead of arrays, and numbers with four digits."""
    if isinstance(value, dict):
        return {key: _round_values(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_round_values(entry) for entry in value]
    if isinstance(value, np.integer):
        return int(value)
    return float(f"{value:.4g}") if isinstance(value, (float, np.floating)) else value
