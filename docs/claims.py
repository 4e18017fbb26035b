"""Claims of the paper, compared with the results of the studies, from files under results/."""

from typing import Any

import numpy as np
import pandas as pd
from studies import beyond_own_expert, rows_of
from tables import results_part

from unjam.measures.statistics import estimate_over_trainings
from unjam_paper.study import interval_text
from unjam_paper.variants import VARIANTS

Claim = tuple[str, str, str]
"""what the paper says, whether it held, by which numbers"""
ROADS = ("ring", "figure-eight", "merge")
OTHERS = {"TRPO": "trpo", "PPO": "ppo", "SAC": "sac"}
TENTHS = 10
"""parts of a training"""


def claims() -> pd.DataFrame:
    """Return all claims but those on car-following data, which `people.py` has."""
    rows = [claim(road) for claim in (best_on, fastest_on, first_rounds_on) for road in ROADS]
    rows += [
        ppo_ends_lower(),
        *(ppo_slows_down(road) for road in ("ring", "figure-eight")),
        sac_swings(),
        collisions(),
        initial_policy(),
        model_alone(),
        unstable(),
        trpo_slowest(),
        ppo_and_sac(),
        volumes(),
        training_time(),
        model_error(),
        percent_over_ppo(),
        beyond_the_expert(),
    ]
    return pd.DataFrame(rows, columns=["the paper", "here", "number"])


def table(study: str, road: str) -> dict[str, dict[str, Any]]:
    """Return the rows of a study by name."""
    return {row["name"]: row for row in rows_of(study, road)}


def of(rows: dict[str, dict[str, Any]], name: str, metric: str = "return") -> float:
    """Return the mean of a metric."""
    return rows[name][metric]["mean"]


def verdict(held: bool) -> str:
    """Return it in words, where the sign of means is all that is asked."""
    return "held, by the sign alone" if held else "not held, by the sign alone"


def together(verdicts: list[str]) -> str:
    """Return the verdict on all parts of a claim: it holds where each holds, and fails where one fails."""
    worst = (found for word in ("not held", "undecided") for found in verdicts if found.startswith(word))
    return next(worst, verdicts[0])


def earns_more(rows: dict[str, dict[str, Any]], name: str, *others: str) -> str:
    """Say whether one has a larger return than all others, trainings of the same seed paired, 95 % interval."""
    gain = {one: np.array(rows[one]["gains"]) for one in (name, *others)}
    found = [estimate_over_trainings(gain[name] - gain[other]) for other in others]
    trainings = f"({len(gain[name])} trainings)"
    if all(difference.low > 0 for difference in found):
        return f"held {trainings}"
    lost = any(difference.high < 0 for difference in found)
    return f"not held {trainings}" if lost else f"undecided {trainings}"


def largest(values: dict[str, float]) -> str:
    """Return the name of the largest value."""
    return max(values, key=values.__getitem__)


def best_on(road: str) -> Claim:
    """Is the paper's method better than TRPO, PPO and SAC, with its settings?"""
    words, rows = f"best of all learners on {road}", table(f"table-1-{road}", road)
    numbers = ", ".join(f"{name} {of(rows, name):.0f}" for name in ("proposed", *OTHERS))
    return words, earns_more(rows, "proposed", *OTHERS), f"return, held-out: {numbers}"


def fastest_on(road: str) -> Claim:
    """Has the paper's method the highest `average speed`, in its convention?"""
    words, rows = f"fastest of all learners on {road}", table(f"table-1-{road}", road)
    speeds = {name: rows[name]["paper_convention"]["speed"]["mean"] for name in ("proposed", *OTHERS)}
    numbers = ", ".join(f"{name} {speed:.2f}" for name, speed in speeds.items())
    return words, verdict(largest(speeds) == "proposed"), f"CAV in training, m/s: {numbers}"


def tenths(study: str, road: str, variant: str, name: str) -> np.ndarray:
    """Return a learning curve as means over tenths of the training and over the trainings, shape (10,)."""
    curves = results_part(f"{study}/curves")
    return np.mean(curves[road][variant][name], axis=0).reshape(TENTHS, -1).mean(axis=1)


def first_rounds_on(road: str) -> Claim:
    """Does it have a larger return in the first tenth of the training?"""
    words, study = f"more reward in the first rounds on {road}", f"table-1-{road}"
    variants = {"proposed": "proposed", **OTHERS}
    starts = {name: tenths(study, road, variant, "return_mean")[0] for name, variant in variants.items()}
    numbers = ", ".join(f"{name} {value:.0f}" for name, value in starts.items())
    return words, verdict(largest(starts) == "proposed"), f"return, first tenth of the training: {numbers}"


def ppo_ends_lower() -> Claim:
    """Is PPO's final reward lower?"""
    rows = table("table-1-ring", "ring")
    ends = [rows[name]["paper_convention"]["reward"]["mean"] for name in ("PPO", "proposed")]
    numbers = f"return, last tenth of the training: {ends[0]:.0f} against {ends[1]:.0f}"
    return "PPO's final reward is 42 % lower (ring)", verdict(ends[0] < ends[1]), numbers


def ppo_slows_down(road: str) -> Claim:
    """Does PPO's speed fall in the later stages?"""
    speeds = tenths(f"table-1-{road}", road, "ppo", "cav_mean_speed")
    numbers = f"CAV in training: {speeds.max():.2f} m/s in its fastest tenth, {speeds[-1]:.2f} in the last"
    return f"PPO's speed falls late on {road}", verdict(speeds[-1] < 0.95 * speeds.max()), numbers


def sac_swings() -> Claim:
    """Does the CAV of SAC swing more, the longer it learns?"""
    stds = tenths("table-1-figure-eight", "figure-eight", "sac", "speed_std_cav")
    # The first tenth is SAC's start, with actions drawn at random.
    numbers = f"CAV in training: {stds[1]:.2f} m/s in the second tenth, {stds[-1]:.2f} in the last"
    return "SAC's speed std rises on figure-eight", verdict(stds[-1] > stds[1]), numbers


def collisions() -> Claim:
    """Are collisions rare?"""
    studies = [(f"table-1-{road}", road) for road in ROADS]
    rows = [row for study, road in studies for row in table(study, road).values() if row["is_learned"]]
    most = max(row["collisions"]["mean"] for row in rows)
    numbers = f"at most {most:.2f} in an episode, held-out, over {sum(row['trainings'] for row in rows)} trainings"
    return "collisions are rare with all learners", verdict(most < 0.05), numbers


def trpo_slowest() -> Claim:
    """Do the other variants of Table 2 reach TRPO's own final return before it does?"""
    curves = results_part("table-2/curves")["ring"]
    goal = 0.9 * tenths("table-2", "ring", "trpo", "return_mean")[-1]
    arrivals = {}
    for variant in ("trpo", "mb-trpo", "no-initial-policy", "proposed"):
        there = np.mean(curves[variant]["return_mean"], axis=0) >= goal
        arrivals[VARIANTS[variant].label] = curves[variant]["steps"][there.argmax()] if there.any() else np.inf
    numbers = ", ".join(f"{name} {steps:,.0f}" for name, steps in arrivals.items())
    words = "vanilla TRPO is the slowest (ring)"
    return (words, verdict(largest(arrivals) == "TRPO"), f"actual steps to 0.9 of TRPO's final return: {numbers}")


def initial_policy() -> Claim:
    """Is the expert worth something at the start?"""
    rows = table("table-2", "ring")
    numbers = f"{of(rows, 'proposed'):.0f} with, {of(rows, 'no initial policy'):.0f} without"
    held = earns_more(rows, "proposed", "no initial policy")
    return "the initial policy improves the result (ring)", held, f"return, held-out: {numbers}"


def model_alone() -> Claim:
    """Is MB-TRPO better than TRPO?"""
    rows = table("table-2", "ring")
    numbers = f"{of(rows, 'MB-TRPO'):.0f} with, {of(rows, 'TRPO'):.0f} without"
    words = "a learned model alone improves TRPO (ring)"
    return words, earns_more(rows, "MB-TRPO", "TRPO"), f"return, held-out: {numbers}"


def unstable() -> Claim:
    """Do trainings of MB-TRPO differ more than those of TRPO?"""
    gains = {name: table("table-2", "ring")[name]["gains"] for name in ("MB-TRPO", "TRPO")}
    ranges = {name: max(found) - min(found) for name, found in gains.items()}
    numbers = ", ".join(f"{name} {value:.0f}" for name, value in ranges.items())
    held = ranges["MB-TRPO"] > ranges["TRPO"]
    return "MB-TRPO is unstable", verdict(held), f"from best to worst training, return: {numbers}"


def ppo_and_sac() -> Claim:
    """Do PPO and SAC gain within the framework?"""
    words, rows = "the framework improves PPO and SAC as well (ring)", table("figure-9", "ring")
    pairs = [(name, f"proposed with {name}") for name in ("PPO", "SAC")]
    numbers = ", ".join(f"{one} {of(rows, one):.0f}, within {of(rows, two):.0f}" for one, two in pairs)
    return words, together([earns_more(rows, two, one) for one, two in pairs]), numbers


def volumes() -> Claim:
    """Is the paper's method best with 5, 11 and 22 vehicles?"""
    words, numbers, held = "best with 5, 11 and 22 vehicles, trained for each", [], []
    for road, count in (("ring-5", 5), ("ring-11", 11), ("ring", 22)):
        rows = table("figure-10", road)
        held.append(earns_more(rows, "proposed", *OTHERS))
        best = max(of(rows, name) for name in OTHERS)
        numbers.append(f"{count}: {of(rows, 'proposed'):.0f}, best other {best:.0f}")
    return words, together(held), "return, held-out: " + "; ".join(numbers)


def training_time() -> Claim:
    """Does the paper's method take 37 % longer than TRPO, and less than PPO and SAC?"""
    words = "37 % more training time than TRPO, 4.6 % less than PPO and SAC"
    over = results_part("figure-8/time")["relative_to_trpo"]
    held = abs(over["proposed"] - 1.37) < 0.1 and over["proposed"] < min(over["ppo"], over["sac"])
    numbers = ", ".join(f"{name} {over[name]:.2f}" for name in ("proposed", "ppo", "sac"))
    return words, verdict(held), f"times TRPO's, side by side: {numbers}"


def model_error() -> Claim:
    """Does eps_m fall during training?"""
    words, runs = "the model error falls during training", results_part("theory/theory")["model"]["proposed"]
    fell = [run[-1]["eps_m"] < run[0]["eps_m"] for run in runs]
    ends = "; ".join(f"{run[0]['eps_m']:.2f} to {run[-1]['eps_m']:.2f}" for run in runs)
    return words, verdict(all(fell)), f"eps_m, first to last iteration: {ends}"


def percent_over_ppo() -> Claim:
    """Is it 483 % over PPO?"""
    rows = table("table-2", "ring")
    best = max(of(rows, name) for name in rows)
    numbers = "PPO's 1,057 times 5.83 is 6,162; no driver can have a larger return than 2,481; "
    numbers += f"the most of these rows, a tuned PI, {best:,.0f}"
    return "483 % more return than PPO, 34 % more than SAC", "impossible", numbers


def beyond_the_expert() -> Claim:
    """Is the residual worth anything beyond the expert?"""
    rows = table("table-2", "ring")
    papers, ours = (
        beyond_own_expert(rows, name, expert) for name, expert in (("proposed", "PI (paper)"), ("ours", "tuned PI"))
    )
    best = rows["ours"]["gain_over_best_expert"]
    numbers = (
        f"the paper's settings {interval_text(papers, 0, '+')}; ours, on a tuned PI, {interval_text(ours, 0, '+')}, "
    )
    numbers += f"which is {interval_text(best, 0, '+')} compared with the best tuned expert"
    gain = papers["mean"] / of(rows, "PI (paper)")
    words = "the residual improves on its expert (ring; the paper does not show the expert alone)"
    return words, f"by {100 * gain:.1f} %", numbers
