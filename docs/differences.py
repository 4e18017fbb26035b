"""The table of differences from the paper: settings come from the code, measured effects from results/."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from math import sqrt
from typing import Any

import numpy as np
import pandas as pd
from people import figure_6_rows
from tables import metric_mean, results_part

from unjam.measures.statistics import estimate
from unjam.parameters import flatten_keys
from unjam.training.config import load_config
from unjam_paper.study import UNFILTERED_ROADS, DriverComparison, interval_text, trainings_text
from unjam_paper.variants import VARIANTS

PRESETS = {"default": "", "`paper`": "paper", "`paper-exact`": "paper-exact"}
"""presets by their heading; the studies of tables and figures use `paper`"""
NOT_MEASURED = "not measured"
RING_STUDIES = {"table-1-ring-unfiltered": UNFILTERED_ROADS["ring"], "table-1-ring": "ring"}
"""roads of the ring by study, without the filter and with it"""
RING_SOURCES = ", ".join(f"`results/{study}.json`" for study in RING_STUDIES)


@dataclass(frozen=True)
class Difference:
    """A difference from the paper, or a choice that the paper leaves open."""

    what: str
    paper: str
    """text of the paper, with its section, table or equation"""
    settings: tuple[str, ...] = ()
    """names of the settings that differ, of the scenario as `scenario.NAME`; the table has their values"""
    note: str = ""
    """meaning of the values, or behavior of unjam with all presets where there is no setting"""
    effect: Callable[[], str] = lambda: NOT_MEASURED
    """returns the measured effect with its source"""
    road: str = "ring"


def filter_effect() -> str:
    """Return the returns of TRPO and the paper's method on the ring without and with the safety filter."""
    texts = []
    for name in ("TRPO", "proposed"):
        values = []
        for study, road in RING_STUDIES.items():
            rows = {row["name"]: row for row in results_part(f"{study}/table") if row["road"] == road}
            best = rows[rows[name]["gain_reference"]["expert"]]["return"]["mean"]
            values.append(best + float(np.mean(rows[name]["gains"])))
        texts.append(f"{name} {values[0]:,.0f} without and {values[1]:,.0f} with it")
    return f"return on test seeds, ring: {', '.join(texts)} ({RING_SOURCES})"


def noise_effect() -> str:
    """Return the differences of human traffic and of the speed with the PI of the paper by scaling of the noise."""
    texts = []
    for scaling, study in (("unscaled", "table-2-unscaled-noise"), ("scaled", "table-2")):
        rows = {row["name"]: row for row in results_part(f"{study}/table")}
        speeds = [rows[name]["mean_speed"]["mean"] for name in ("PI (paper)", "human")]
        std = rows["human"]["speed_std_fleet"]["mean"]
        texts.append(f"{scaling} {std:.2f} m/s, {speeds[0] - speeds[1]:+.2f} m/s")
    what = "standard deviation across vehicles of human traffic, mean speed with PI beyond it"
    return f"{what}: {'; '.join(texts)} (`results/table-2-unscaled-noise.json`, `results/table-2.json`)"


def expert_effect() -> str:
    """Return the difference of the return of the PI of the paper to the default PI, in ideal and usual cars."""
    parts = {
        **{"on `ring`": "feasible-ring-ideal/ring", "on `ring-jammed`": "feasible-ring-ideal/ring-jammed"},
        "on `ring` in a usual car, where it oscillates": "feasible-ring/ring-usual-car",
    }
    texts = []
    for road, part in parts.items():
        comparison = DriverComparison([*results_part(part).values()])
        paper, default = (comparison.values([label], "return") for label in ("PI (paper)", "PI"))
        by_length, by_seed = ((paper - default).mean(axes) for axes in ((1, 2), (0, 1)))
        lengths = f"({by_length.min():+,.0f} to {by_length.max():+,.0f} by length)"
        texts.append(f"{interval_text(asdict(estimate(by_seed.tolist())), 0, '+,')} {lengths} {road}")
    source = "ten seeds of six lengths, `results/feasible-ring-ideal.json`, `results/feasible-ring.json`"
    return f"return of the paper's PI, difference to the default one: {', '.join(texts)} ({source})"


def selection_effect() -> str:
    """Return the differences in return of the last checkpoints to the best ones, by learner."""
    versions = []
    for study, road in RING_STUDIES.items():
        curves, texts = results_part(f"{study}/curves")[road], []
        for name, label in (("trpo", "TRPO"), ("ppo", "PPO"), ("sac", "SAC"), ("proposed", "proposed")):
            values = np.array(curves[name]["return_validation"])
            texts.append(f"{label} {trainings_text(values[:, -1] - values.max(1), 0, '+,')}")
        versions.append(", ".join(texts))
    what = "return of the last checkpoint, difference to the best of its curve, on the seeds that select it (at most 0)"
    return f"{what}: {versions[0]}; with the filter {versions[1]} ({RING_SOURCES})"


def exact_effect() -> str:
    """Return the returns on test seeds of trainings with all of `paper-exact`."""
    trainings = results_part("to-the-letter-ring/paper-exact")
    texts = []
    for name, rows in trainings.items():
        returns = sorted(round(row["test_return"]) for row in rows)
        texts.append(f"{VARIANTS[name].label} {', '.join(f'{value:,}' for value in returns)}")
    source = "`results/to-the-letter-ring.json`"
    return f"not alone; all of `paper-exact`, returns of the trainings: {'; '.join(texts)} ({source})"


def stop_effect() -> str:
    """Return how many trainings the convergence rule of the paper would have ended, and when."""
    trainings = results_part("to-the-letter-ring/paper-exact").values()
    ends = [row["converged"] for rows in trainings for row in rows]
    steps = [end["steps"] for end in ends if end]
    return (
        f"it would end {len(steps)} of {len(ends)} trainings, after {min(steps):,} to {max(steps):,} steps "
        "(`results/to-the-letter-ring.json`)"
    )


def reward_effect() -> str:
    """Return the mean speed of trainings with Eq. 16 as printed and as meant."""
    rows = {row["name"]: row["mean_speed"]["mean"] for row in results_part("eq16/table")}
    speeds = [rows[f"proposed, Eq. 16 as {version}"] for version in ("printed", "meant")]
    texts = f"{speeds[0]:.2f} m/s as printed, {speeds[1]:.2f} as meant; human drivers {rows['human']:.2f}"
    return f"mean speed of the method, with the filter, 5 trainings: {texts} (`results/eq16.json`)"


def merge_effect() -> str:
    """Return the return of human traffic on the merge with other minimum gaps and initial states."""
    rows = results_part("research-notes/merge-level")["rows"]
    human = {
        (row["gap"], row["standing_vehicles"]): row["return"]["mean"]
        for row in rows
        if row["driver"] == "human baseline"
    }
    values = human[2.5, 5], human[2.5, 0], human[0.0, 5]
    return (
        "return of human traffic {:.0f}; {:.0f} from an empty road; {:.0f} without SUMO's gap "
        "(`results/research-notes.json`)".format(*values)
    )


def impatience_effect() -> str:
    """Return the speed of human traffic on the figure eight with other values of impatience."""
    parts = {"": "figure-eight-32", " with impatience 0": "figure-eight-32-impatience=0"}
    parts[" with 1"] = "figure-eight-32-impatience=1"
    texts = (
        f"{metric_mean(f'experts/{part}', 'human', 'mean_speed'):.2f} m/s{suffix}" for suffix, part in parts.items()
    )
    return f"human traffic, radius 32 m: {', '.join(texts)} (`results/experts.json`)"


def data_effect() -> str:
    """Return the errors of the networks of Figure 6 with few data, of another driver and of the IDM in the model."""
    texts = []
    for driver, data in (("other", "with another driver"), ("same", "with the same IDM")):
        rows = figure_6_rows(driver=driver, split="trajectories", is_long=False, size=0.01)
        errors = {network: fits["driver_error"].mean() for network, fits in rows.groupby("network")}
        texts.append(f"{errors['knowledge']:.3f} with IDM and {errors['vanilla']:.3f} without {data}")
    return f"error with 1 % of the data [m/s²]: {'; '.join(texts)} (`results/figure-6.json`)"


def speed_effect() -> str:
    """Return the mean speed of a variant in the convention of the paper, and on test seeds."""
    texts = []
    for study in RING_STUDIES:
        row = next(row for row in results_part(f"{study}/table") if row["name"] == "TRPO")
        cav_speed, fleet_speed = row["paper_convention"]["speed"]["mean"], row["mean_speed"]["mean"]
        texts.append(f"{cav_speed:.2f} m/s in the paper's convention, {fleet_speed:.2f} on test seeds")
    return f"TRPO, ring: {texts[0]}; with the filter {texts[1]} ({RING_SOURCES})"


NOISE_STEP = 0.2 * sqrt(0.1)
"""noise of human drivers in a step of 0.1 s [m/s2]"""
TRAFFIC = (
    Difference(
        "safety filter of the CAV",
        "none: only the box of ±1 m/s² (4.1.2)",
        ("scenario.safety.active", "scenario.safety.time_gap"),
        effect=filter_effect,
    ),
    Difference(
        "delay and lag of the CAV",
        "none: the command is the acceleration (4.1.2)",
        ("scenario.actuator.delay", "scenario.actuator.lag"),
        "those of a usual car by default; packaged controllers with both cars are on the page on string stability",
    ),
    Difference(
        "SUMO's own safety of the CAV",
        "not stated",
        ("scenario.actuation",),
        "SUMO brakes before contact, and the override is counted",
    ),
    Difference(
        "noise of human drivers",
        "standard deviation 0.2 (4.1.1), N(0, 0.2) (Table B1); it cites Flow, which scales it by the root of the step",
        ("scenario.noise", "scenario.noise_scaling"),
        f"{NOISE_STEP:.3f} m/s² in a step of 0.1 s",
        noise_effect,
    ),
    Difference(
        "human drivers",
        "IDM (4.1.1)",
        ("scenario.human_control",),
        "SUMO's IDM; on figure eight and merge IDM commands above SUMO's layer for safety and right of way",
    ),
    Difference(
        "length of an episode, warm-up",
        "not stated",
        ("scenario.horizon", "scenario.warmup"),
        "Flow drives 750 steps before; 1,500 on the figure eight as in the authors' code, 600 of 1 s on the merge",
    ),
    Difference(
        "sizes of the ring in one iteration",
        "varies between episodes (4.1.1)",
        ("stratified",),
        "`true`: the episodes of an iteration cover the range evenly",
    ),
    Difference(
        "right of way on the figure eight",
        "vehicles obey it (4.1.1)",
        ("scenario.right_of_way", "scenario.impatience"),
        effect=impatience_effect,
        road="figure-eight",
    ),
    Difference(
        "start of the merge, right of way, limits of brakes",
        "not stated",
        ("scenario.standing_vehicles", "scenario.right_of_way", "scenario.enforce_human_limits"),
        "as in Flow, as is the gap of 2.5 m that SUMO keeps for human drivers",
        merge_effect,
        road="merge",
    ),
    Difference(
        "control step of the merge",
        "not stated",
        ("scenario.simulation_step", "scenario.steps_per_control_step"),
        "as in Flow: one command for 1 s",
        road="merge",
    ),
    Difference(
        "reward",
        "Eq. 16: its first term falls with the speed",
        ("reward",),
        "that of the authors' code; on the merge `released-merge`; `eq16` and `eq16-as-printed` are options",
        reward_effect,
    ),
)
CONTROLLER = (
    Difference(
        "expert",
        "PI, command reached within one step (Eq. 9 to 11, Table B2)",
        ("expert",),
        "the default approaches the command in 3 s",
        expert_effect,
    ),
    Difference(
        "inputs of the policy", "own speed, relative speeds and gaps of leader and follower (4.1.2)", ("policy.inputs",)
    ),
    Difference("first residual", "random parameters (3.3.2)", ("policy.zero_init",), "`true`: zero", exact_effect),
    Difference("exploration, as a share of the action limit", "not stated", ("policy.exploration_std",)),
    Difference("time for which a residual is held [s]", "one step (3.3.2)", ("policy.action_duration",)),
    Difference(
        "value network",
        "state-value function of the state (3.3.2)",
        ("policy.privileged_critic", "policy.normalize_value"),
        "`true`: it knows the ring's length; it is scaled by the first returns",
    ),
    Difference(
        "critics of SAC",
        "those of Haarnoja et al. (2018), without normalization (4.2.1)",
        (),
        "layer normalization in both hidden layers (`NormalizedReLU` in `src/unjam/learners/sac_td3.py`)",
    ),
    Difference(
        "end of an episode at its horizon",
        "not stated; terminal in the authors' code for TRPO and PPO",
        (),
        "not terminal: the value of the last state is added",
    ),
)
LEARNING = (
    Difference("TRPO: discount, largest KL", "0.995, 0.01 (Table B5)", ("trpo.gamma", "trpo.target_kl")),
    Difference(
        "environment steps in an iteration",
        "not stated; 6,000 in the authors' code",
        ("trpo.steps_per_iteration", "ppo.steps_per_iteration"),
    ),
    Difference(
        "PPO: gradient steps of an epoch", "not stated", ("ppo.minibatches",), "1: one on all rows of an iteration"
    ),
    Difference(
        "SAC: temperature",
        "0.2 (Table B4)",
        ("sac.temperature", "sac.learn_temperature", "sac.reward_scale"),
        "learned in the authors' code; the last is a factor of the rewards",
    ),
    Difference(
        "SAC: first 10,000 steps",
        '"start steps" (Table B4)',
        ("sac.start_policy",),
        "`uniform`: random actions; `expert`: the expert with noise",
    ),
    Difference("SAC: gradient steps for each environment step", "not stated", ("sac.gradient_steps_per_step",)),
    Difference(
        "environment steps of a training",
        "not stated; 4,000,000 in the authors' code",
        ("steps",),
        "300,000 in the studies of tables and figures",
        exact_effect,
    ),
    Difference(
        "trainings of each learner",
        "3 (4.2.1)",
        (),
        "5, ten of TRPO and the method, 3 on the merge; with the filter 5 in Tables 1 and 2 on the ring, with Eq. "
        "16 and to the letter, else 3",
    ),
    Difference(
        "which checkpoint counts",
        "the last (captions of Tables 1 and 2)",
        ("evaluation.validation_interval",),
        "iterations between validations, the best of which counts; 0: the last checkpoint",
        selection_effect,
    ),
    Difference(
        "end of a training",
        "when the mean return has not risen over some iterations (3.3.2)",
        ("evaluation.convergence_window",),
        "0: all steps are made",
        stop_effect,
    ),
    Difference(
        "data of Figure 6",
        "262,630 rows in four regimes of Mo et al. (2021), 20 % for the test at random (4.2.2)",
        (),
        "as many rows made alike, with another driver than the IDM in the model; test trajectories are in no training",
        data_effect,
    ),
    Difference(
        "average speed",
        "of all vehicles (4.2.1); the values are those of the CAV in the authors' code",
        (),
        "both are shown",
        speed_effect,
    ),
)
MODEL = (
    Difference("networks of the model", "one (Eq. 4)", ("model.members",)),
    Difference(
        "where the base predicts better",
        "the network is added (Eq. 4)",
        ("model.fallback_to_base",),
        "`true`: the base alone",
        exact_effect,
    ),
    Difference("noise in the model", "none: the sum of base and network (Eq. 4)", ("model.add_noise",)),
    Difference("model error", "total variation to the environment (3.4, A3)", ("model.error_estimator",)),
    Difference("rollouts: sensitivity κ, longest", "2, 500 (Table B6)", ("model.kappa", "model.k_max")),
    Difference("model steps for each environment step", "not stated", ("model.model_ratio",)),
    Difference(
        "where rollouts start",
        "sampled from the buffer of all experience (3.1)",
        ("model.rollout_starts",),
        "at random steps of the newest episodes",
    ),
    Difference(
        "mean speed of all vehicles, in the model",
        "not stated: the state has three vehicles (4.1.2)",
        (),
        "approximated by that of the three, the network corrects it",
    ),
)
DIFFERENCES = {
    "Roads, traffic and reward": TRAFFIC,
    "Expert and policy": CONTROLLER,
    "Learning and evaluation": LEARNING,
    "Model": MODEL,
}
"""differences by topic"""


@cache
def preset_settings(preset: str, road: str) -> dict[str, Any]:
    """Return all settings of a training with a preset by name; settings of the scenario are `scenario.NAME`."""
    config = load_config(preset=preset, changes={"scenario": road})
    scenario = config.make_scenario()
    scenario_settings = {"scenario": asdict(scenario), "reward": config.reward or scenario.reward}
    return flatten_keys({**asdict(config), **scenario_settings})


def unlisted_settings() -> list[str]:
    """Return the names of settings in which presets differ, but which have no row."""
    listed = {name for rows in DIFFERENCES.values() for row in rows for name in row.settings}
    by_preset = [preset_settings(preset, "ring") for preset in PRESETS.values()]
    differing = {name for name in by_preset[0] if len({repr(settings[name]) for settings in by_preset}) > 1}
    return sorted(differing - listed - {"preset"})


def setting_text(value: Any) -> str:
    """Return the value of a setting as text."""
    if isinstance(value, (tuple, list)):
        return "`" + ", ".join(map(str, value)) + "`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value}`" if isinstance(value, str) else f"{value:,g}" if isinstance(value, float) else f"{value:,}"


def differences_table() -> pd.DataFrame:
    """Return a row for each difference: the paper, the settings in each preset, and the measured effect."""
    table = []
    for topic, rows in DIFFERENCES.items():
        for row in rows:
            names = ", ".join(f"`{name.removeprefix('scenario.')}`" for name in row.settings)
            cells = {"": topic, "what": f"{row.what} ({names})" if names else row.what, "the paper": row.paper}
            topic = ""
            for heading, preset in PRESETS.items():
                values = preset_settings(preset, row.road)
                cells[heading] = ", ".join(setting_text(values[name]) for name in row.settings)
            table.append({**cells, "note": row.note, "measured effect": row.effect()})
    return pd.DataFrame(table)
