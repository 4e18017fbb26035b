"""What there is to see of a run's virtual environment: where it agrees with the actual one, and where not.

All of it is measured on episodes that no network learned from, and kept in the run folder as `model.json`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from unjam.errors import InputError, go_on_with
from unjam.files import to_json, write_whole
from unjam.learners.algorithm_1 import kind_of_imagination
from unjam.learners.imagination import RowImagination, WholeRoads
from unjam.learners.learner import under
from unjam.reports.results import MODEL_FILE, read_model, read_progress
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig
from unjam.training.folder import load_checkpoint
from unjam.virtual.comparison import one_step_errors, open_loop, recorded, replay
from unjam.virtual.fitting import OneStepErrors, root_mean_square
from unjam.virtual.model import NUMBERS, TARGETS, EnvironmentModel
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode, Floats
from unjam.worlds.workers import EpisodeTask

LONGEST = 500
"""decisions that virtual and actual are compared over, where the stays are long enough"""
ROWS = 20_000
"""at most so many decisions tell the errors one step ahead"""
STARTS = 200
"""from which recorded accelerations are replayed"""
EXAMPLES = 3
"""of them, shown one by one"""
MOMENTS = 100
"""at most so many moments of a replay are kept"""
BINS = 10
"""of equally many decisions, by gap and by speed"""
BINNED = ("leader_gap", "speed")
LENGTHS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""of rollouts, for which the bound is computed [decisions]"""
SHOWN = ("leader_gap", "leader_speed")
"""numbers of the examples"""


def newest_model_facts(folder: Path, config: RunConfig) -> dict[str, Any]:
    """Return the facts about a run's virtual environment, measured anew if they are missing or old.

    Raises:
        InputError: of the run's virtual environment, if it has one, nothing is measured, or it has no
            checkpoint yet.
    """
    if why := why_no_facts(config):
        raise InputError(f"run: {str(folder)!r} {why}")
    kept, progress = read_model(folder), read_progress(folder)
    if kept is None or not progress or kept.get("iteration") != progress[-1]["iteration"]:
        write_model_facts(folder, config)
        kept = read_model(folder)
    assert kept is not None
    return kept


def why_no_facts(config: RunConfig) -> str:
    """Return why there is nothing to say of a run's virtual environment; empty where there is."""
    if config.tasks:
        return "is of several roads; allowed: a run of one"
    if config.virtual.virtual_ratio == 0:
        return "has no virtual environment: its virtual.virtual_ratio is 0; allowed: > 0"
    return ""


def write_model_facts(folder: Path, config: RunConfig) -> None:
    """Write what `measure_model` finds into the run's `model.json`."""
    write_whole(folder / MODEL_FILE, to_json(measure_model(folder, config)))


def measure_model(folder: Path, config: RunConfig) -> dict[str, Any]:
    """Return the facts about the virtual environment in a run's newest checkpoint, to four digits.

    Raises:
        InputError: the run has no checkpoint yet.
    """
    checkpoint = load_checkpoint(folder / "checkpoint")
    progress = read_progress(folder)
    if checkpoint is None or not progress:
        raise InputError(f"run: {str(folder)!r} has no checkpoint yet{go_on_with(folder)}")
    torch.set_num_threads(1)  # for small networks more are slower
    state, tensors = checkpoint
    settings = replace(config.virtual, device="cpu")
    (task,) = config.make_tasks()
    imagination = kind_of_imagination(settings, task)(settings, task, config.policy, config.seed)
    imagination.restore(state[imagination.name], under(f"{imagination.name}/", tensors))
    about = {"iteration": state["iteration"], "base": settings.base, "members": settings.members}
    if settings.model == "road":
        return _rounded(about | _waves(cast(WholeRoads[Any], imagination), config.world))
    return _rounded(about | _of_rows(cast(RowImagination, imagination), config, progress[-1]))


def _waves(roads: WholeRoads[Any], world: str) -> dict[str, Any]:
    """Return what a road was like and what is imagined of it; actual episodes run in a world."""
    step, length, lane_names, seen = roads.waves(_in_batch if world == "batch" else _in_sumo)
    drawn = {label: each._asdict() for label, each in seen.items()}
    return {"step": step, "loop_length": length, "lane_names": lane_names, "waves": drawn}


def _in_batch(task: EpisodeTask) -> Episode:
    return run_batch([task], statistical=True)[0]


def _in_sumo(task: EpisodeTask) -> Episode:
    return run_episode(task.scenario, task.driver, task.seed)


def _of_rows(imagination: RowImagination, config: RunConfig, newest: dict[str, Any]) -> dict[str, Any]:
    """Return how wrong imagined rows are, on episodes that no network learned from."""
    scenario, generator = imagination.scenario, np.random.default_rng(config.seed)
    actual = imagination.data.transitions(config.virtual.holdout)
    held_out = actual.chosen(generator.permutation(np.flatnonzero(actual.held_out))[:ROWS])
    errors = one_step_errors(imagination.model, held_out, scenario, config.reward)
    return {
        "decision_step": scenario.decision_step,
        "k_star": newest["k_star"],
        "held_out": int(actual.held_out.sum()),
        "one_step": {name: found._asdict() for name, found in errors.by_number().items()},
        "where": {name: _by_bins(getattr(held_out.states, name), errors) for name in BINNED},
        "replay": _replayed(imagination, scenario, generator),
        "bound": _bounds(imagination, newest, config.learner.gamma),
    }


def _by_bins(values: Floats, errors: OneStepErrors) -> dict[str, Any]:
    """Return the errors one step ahead by what `values`, shape (R,), were, in bins of equally many rows."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS + 1)))
    places = np.searchsorted(edges[1:-1], values, side="right")
    bins = [places == place for place in np.unique(places)]

    def errors_of(kind: Floats) -> dict[str, list[float]]:
        """By target, the error in each bin, of errors of shape (..., R, targets)."""
        return {
            name: [root_mean_square(kind[..., rows, column]) for rows in bins]
            for column, name in enumerate(TARGETS)
        }

    return {
        "at": [values[rows].mean() for rows in bins],
        "decisions": [int(rows.sum()) for rows in bins],
        "base": errors_of(errors.base),
        "model": errors_of(errors.model),
    }


def decisions_ahead(stays: Sequence[int]) -> int:
    """Return over how many decisions to replay stays on the road that were so long [decisions].

    Over half of a usual one, so that at least half of the stays have places to start from.
    """
    return min(LONGEST, max(1, int(np.median(stays)) // 2))


def _replayed(
    imagination: RowImagination, scenario: Scenario, generator: np.random.Generator
) -> dict[str, Any]:
    """Return how recorded accelerations end in the virtual environment, without noise, and some examples."""
    data, model = imagination.data, imagination.model
    held_out = data.held_out(imagination.settings.holdout)
    decisions = decisions_ahead([int(rows.sum()) for rows in held_out if rows.any()])
    starts = data.choices(decisions)
    starts = starts[[held_out[place][at] for place, at in starts]]
    starts = starts[np.sort(generator.permutation(len(starts))[:STARTS])]
    single = replace(imagination.settings, members=1, error="unexplained")
    alone = EnvironmentModel(single, len(scenario.drawn_ranges), (0,))
    moments = np.unique(np.linspace(0, decisions - 1, MOMENTS).round().astype(int))
    found, base = (open_loop(each, data, starts, decisions, scenario) for each in (model, alone))
    examples = starts[generator.permutation(len(starts))[:EXAMPLES]]
    actual = recorded(data, examples, decisions)
    members, lone = (replay(each, data, examples, decisions, scenario) for each in (model, alone))
    return {
        "seconds": (moments + 1) * scenario.decision_step,
        "starts": len(starts),
        "numbers": {
            name: {
                "model": found.error[name][moments],
                "spread": found.spread[name][moments],
                "base": base.error[name][moments],
                "change": found.change[name][moments],
            }
            for name in NUMBERS
        },
        "examples": [
            {
                "begins": at * scenario.decision_step,
                "drawn": data.recordings[place].drawn,
                "numbers": {
                    name: {
                        "actual": actual[name][example, 1:][moments],
                        "members": members[name][:, example, moments],
                        "base": lone[name][0, example, moments],
                    }
                    for name in SHOWN
                },
            }
            for example, (place, at) in enumerate(examples)
        ],
    }


def _bounds(imagination: RowImagination, newest: dict[str, Any], gamma: float) -> dict[str, Any] | None:
    """Return the bound C by the length of rollouts for the newest row of progress; None without an eps_m."""
    eps_m = newest["virtual"]["eps_m_by_estimator"].get("transitions")  # of runs of before there is none
    if eps_m is None:
        return None
    eps_pi = newest["learner"]["eps_pi_max"]
    discount = imagination.decision_discount(gamma)
    return {
        "eps_pi": eps_pi,
        "eps_m": eps_m,
        "largest_reward": imagination.largest_reward,
        "largest_return": imagination.largest_reward / (1.0 - discount),
        "k": LENGTHS,
        "C": [imagination.bound_at(k, eps_pi, eps_m, gamma) for k in LENGTHS],
    }


def _rounded(value: Any) -> Any:
    """Return plain lists and numbers, these to four digits."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_rounded(entry) for entry in value]
    if isinstance(value, np.integer):
        return int(value)
    return float(f"{value:.4g}") if isinstance(value, (float, np.floating)) else value
