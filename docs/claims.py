"""Write CLAIMS.md: tables of the claims of the paper, compared with the results of the studies.

    python docs/claims.py

Verdicts are about studies without the safety filter, as in the paper, where these have results.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from differences import differences_table
from people import people_claims
from studies import difference_to_expert, study_rows
from tables import markdown_table, results_part
from verdicts import (
    HELD,
    INCONSISTENT,
    NOT_HELD,
    UNDECIDED,
    Finding,
    Values,
    combine_findings,
    compare_values,
    judge_differences,
    list_values,
)

from unjam.files import atomic_write
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.statistics import Estimate, estimate_over_trainings, linearized_ratio
from unjam_paper.comparison import PAPER_RESULTS
from unjam_paper.study import NO_VALUE_TEXT, UNFILTERED_ROADS, interval_text
from unjam_paper.variants import VARIANTS

PAGE = Path(__file__).parent.parent / "CLAIMS.md"
INTRODUCTION = """# Claims of the paper

*Knowledge-informed model-based residual reinforcement learning*
([arXiv:2408.17380](https://arxiv.org/abs/2408.17380)): its empirical claims compared with trainings of this package.
They have the values of its Tables B2 to B5 and, except for the reward, B6 (`--preset paper`), and 300,000 environment
steps each; rows with `paper-exact` have the 4,000,000 of its authors' code (1,000,000 on the merge) and its settings
[to the letter](docs/to-the-letter.md). [All that differs](#what-differs-from-the-paper) is in the last table.

- *On test seeds*: the deterministic controller that was best in validation (`paper-exact`: the last checkpoint), on 20
  seeds that played no part in training or selection. The captions of the paper's tables say "last checkpoint".
- *In training*: with exploration, which is as large as the action limit at first, and decreases. The paper does not
  state its size.
- *In validation*: the same trainings without exploration, on the seeds that select the checkpoint.

Verdicts are about the three to ten trainings that they name, with these settings, and not about methods; they are not
corrected for their number, and many share trainings: Tables 1 and 2 and Figures 9 and 10 have the same ones of TRPO and
of the method, and the rows with ten trainings contain them. Numbers are means over trainings, in Figure 5, rows on
collisions and speeds of the last table interquartile means, as in [tables and figures](docs/results.md).

The paper's method without the safety filter, in short (95 % intervals over trainings). The verdict on the difference to
TRPO is another one on the figure eight with the last checkpoint, and on all three roads with `paper-exact`, which has
more steps and other settings:

SHORT_ANSWER

**The paper has no safety filter; unjam has one by default** (a time gap of 1 s, no contact behind leaders that brake
with at most 6 m/s²). Verdicts are about trainings without it, except those on training time. Merges have no filter in
either column.

- *Held* and *not held*: the 95 % interval of the difference lies on one side of zero. It is over trainings, those of
  the same seed paired, on one set of traffic seeds: other seeds would widen it. A claim about several others holds if
  each interval is on its side, and does not hold if one is on the other side; the difference that decides is shown.
- *Undecided*: the interval includes zero, or there is none. Brackets have an interval, parentheses the range where
  there is none: of two values, of differences in two groups, and of differences with both signs where what is compared
  forms two groups: n values with a gap of more than 1/3 + 2/n of their range, and two or more on each side.
- *By the expert*: PI, its expert, which the paper does not evaluate alone, has at least 90 % of the difference without
  learning, with the paper's time constant or with 3 s (in A1 on the test seeds), or the method is not shown to be
  better than both; in validation, not better than at first, where its residual is nearly zero, or no training becomes
  better than PI.
- *In training alone*: a return rises while exploration decreases, which is not shown in validation. That it rises
  faster than with other learners is not tested.
- Values are *similar* where the interval of the difference lies within 10 % of the value. Percentages of training time
  and of Figure 9 hold if the cost is at most, or the gain at least, as large. Of other percentages the sign is judged.
- *Learning curves* have 100 points; in validation, which is about every 30,000 steps, with lines between validations.
- *Convergence*: environment steps to 0.9 of TRPO's final return, in blocks of five points of the learning curve, 15,000
  steps, in validation at multiples of 30,000; by this resolution intervals are widened at both ends; all steps if
  never. *Stable*: mean change of the return between points of the learning curve, in its second half.
- Rules without an interval: collisions are *rare* with fewer than 0.05 vehicles in an episode with each learner, *by
  construction* if the same holds for each other driver of the table, since SUMO brakes; A2 holds if all trainings are
  within 5 % of the best training with the paper's settings, *by the expert* if PI with either time constant is, too; a
  bound that is a hundred times what it bounds *says nothing*; a percentage is *inconsistent* if it needs a larger
  return than any in the paper's Table 1. *Similar* is not held where the interval lies beyond 10 %.

Numbers of verdicts:

"""
DIFFERENCES = """<!-- differences -->

## What differs from the paper

Tables, figures and claims are measured with the preset `paper`; [the paper to the letter](docs/to-the-letter.md) has
`paper-exact`. "Not stated" means that the text of the paper leaves it open. Numbers in brackets are its sections,
tables and equations. "Not measured": there is no training in which this alone differs."""
END = """<!-- end -->

`python docs/claims.py` writes this page from the settings of the package and the files in `results/`;
[the documentation](docs/results.md) has the tables and figures."""
EXPERT, SMOOTH_EXPERT, SMOOTH_LABEL = "PI (paper)", "PI", "PI with a time constant of 3 s"
"""labels of the expert of the paper, and of the same expert with the default time constant of unjam"""
NOT_MEASURED = "not yet measured"
BY_EXPERT, BY_CONSTRUCTION, SAYS_NOTHING = ", by the expert", ", by construction", ", but says nothing"
BY_EXPLORATION = ", in training alone"
CAUSES = BY_EXPERT, BY_CONSTRUCTION, SAYS_NOTHING, BY_EXPLORATION
KINDS = (HELD, *(f"{HELD}{cause}" for cause in CAUSES), NOT_HELD, UNDECIDED, INCONSISTENT, NOT_MEASURED)
"""kinds of verdicts in the summary"""
A1_EXPERT = "expert alone"
"""row of the expert without a network in the study of A1"""
ERROR_ESTIMATORS = "unexplained_variance", "transitions"
"""estimators of the model error; the second one is the paper's quantity"""
SLOWER_STEP = 0.5
"""additional time that a slower simulator would need for 1,000 steps [s]"""
LARGE_BOUND = 100.0
"""ratio of a bound to the bounded quantity from which on the bound says nothing"""
RARE = 0.05
"""mean number of vehicles that collide in an episode below which collisions are rare"""
PAPER_ROADS = ("ring", "figure-eight", "merge")
LEARNERS = ("trpo", "ppo", "sac")
"""variants of the learners in Table 1 besides the paper's method"""
TABLE_1, TABLE_2 = ("proposed", *LEARNERS), ("proposed", "trpo", "mb-trpo", "no-initial-policy")
VOLUMES = {"5": "ring-5", "11": "ring-11", "22": "ring"}
"""roads of Figure 10 by the number of vehicles"""
PAPER_QUANTITIES = {"cav_mean_speed": "speed", "speed_std_cav": "std"}
"""quantities of learning curves that other drivers also have, with their names in the convention of the paper"""
SIMILAR_SHARE = 0.1
"""largest difference between similar returns, as a share of a return"""
EXPERT_SHARE = 0.9
"""share of a difference from which on the difference is due to the expert"""
TRAINED, VALIDATED = "return_mean", "return_validation"
RETURNS = {TRAINED: "in training", VALIDATED: "in validation"}
"""returns of learning curves: with exploration, and of the deterministic controller"""
FIRST, LAST, THIRD_QUARTER, LAST_QUARTER = slice(0, 10), slice(90, 100), slice(50, 75), slice(75, 100)
"""parts of a learning curve of 100 points"""
VALIDATION_STEPS = 30_000
"""environment steps between two validations: five iterations of 6,000"""
BLOCK = 5
"""points of a learning curve that are averaged before they are compared with a return"""


class MissingResultsError(Exception):
    """There are no results for a claim."""


@dataclass(frozen=True)
class Version:
    """Results of the studies of the paper with the safety filter, or without it."""

    has_filter: bool

    def study(self, name: str, road: str) -> tuple[str, str]:
        """Return the names of a study and a road in this version; merges have no filter in either."""
        is_exact = name.startswith("to-the-letter")
        if self.has_filter or road not in UNFILTERED_ROADS:
            return (f"{name}-filtered" if is_exact and road in UNFILTERED_ROADS else name), road
        return (name if is_exact else f"{name}-unfiltered"), UNFILTERED_ROADS[road]

    def exact_variants(self, road: str) -> tuple[str, str]:
        """Return the variants of the paper's method and of TRPO to the letter."""
        suffix = "-filtered" if self.has_filter and road in UNFILTERED_ROADS else "-million" if road == "merge" else ""
        return f"proposed-exact{suffix}", f"trpo-exact{suffix}"

    def part(self, name: str, road: str, part: str) -> Any:
        """Return a part of the results of a study; raise `MissingResultsError` if there is none."""
        try:
            return results_part(f"{self.study(name, road)[0]}/{part}")
        except (FileNotFoundError, KeyError):
            raise MissingResultsError from None

    def rows(self, name: str, road: str) -> dict[str, dict[str, Any]]:
        """Return the rows of a study by variant, those of drivers that do not learn by label."""
        self.part(name, road, "table")
        return {row.get("variant", row["name"]): row for row in study_rows(*self.study(name, road))}

    def returns(self, name: str, road: str, variants: Sequence[str]) -> Values:
        """Return the return of each training on test seeds."""
        rows = self.rows(name, road)
        best = rows[rows[variants[0]]["gain_reference"]["expert"]]["return"]["mean"]
        return {variant_label(name): best + np.array(rows[name]["gains"]) for name in variants}

    def curves(self, name: str, road: str, variants: Sequence[str], quantity: str = "return_mean") -> Values:
        """Return learning curves, shape (trainings, 100)."""
        curves = self.part(name, road, "curves")[self.study(name, road)[1]]
        return {variant_label(name): np.array(curves[name][quantity]) for name in variants}

    def curve_means(self, name: str, road: str, variants: Sequence[str], quantity: str, part: slice) -> Values:
        """Return means over a part of the learning curves."""
        return {label: curve[:, part].mean(1) for label, curve in self.curves(name, road, variants, quantity).items()}

    def validation_cause(self, verdict: str, name: str, road: str, variant: str, quantity: str) -> str:
        """Return `BY_EXPERT` for a claim that holds in validation if the method is not shown to learn anything there.

        Its residual is nearly zero in the first validation, except with SAC: a training that never becomes better than
        its expert keeps the expert.
        """
        if not (verdict.startswith(HELD) and quantity == VALIDATED and variant.startswith("proposed")):
            return ""
        row = self.rows(name, road)[variant]
        if row["untrained_count"] == row["trainings"]:
            return BY_EXPERT
        (curve,) = self.curves(name, road, (variant,), quantity).values()
        gain = estimate_over_trainings((curve[:, LAST].mean(1) - curve[:, 0]).tolist())
        return "" if judge_differences([gain]) == HELD else BY_EXPERT


Assessment = Callable[[Version], Finding]
"""function that returns the finding on a claim from the results of a version"""


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, and the function that assesses it."""

    text: str
    study: str
    road: str
    assess: Assessment
    depends_on_filter: bool = True

    def row(self) -> dict[str, str]:
        """Return the row of the claim in the table."""
        with_filter, without = (self._finding(Version(has_filter)) for has_filter in (True, False))
        has_one_version = self.road not in UNFILTERED_ROADS or not self.depends_on_filter
        verdict, numbers = with_filter if has_one_version else without
        version = Version(has_one_version)
        has_two = not has_one_version and with_filter[0] != NOT_MEASURED
        return {
            "the paper says": self.text,
            "we get, without the filter": numbers,
            "verdict": verdict,
            "with the filter": f"**{with_filter[0]}**: {with_filter[1]}" if has_two else NO_VALUE_TEXT,
            "command": f"`unjam reproduce {version.study(self.study, self.road)[0]}`",
        }

    def _finding(self, version: Version) -> Finding:
        try:
            return self.assess(version)
        except MissingResultsError:
            return NOT_MEASURED, NO_VALUE_TEXT


def variant_label(variant: str) -> str:
    """Return the label of a variant."""
    return VARIANTS[variant].label


def paper_values(road: str, column: int, digits: int, variants: Sequence[str] = TABLE_1) -> str:
    """Return the values of the paper's table by variant."""
    return list_values({variant_label(name): PAPER_RESULTS[road, name][column] for name in variants}, digits)


def larger_return(study: str, road: str, variant: str, *others: str) -> Assessment:
    """Return the assessment of a larger return of a variant on test seeds; for residuals, it considers the expert."""

    def judge_returns(version: Version) -> Finding:
        rows, returns = version.rows(study, road), version.returns(study, road, (variant, *others))
        verdict, numbers = compare_values(returns, variant_label(variant))
        if not variant.startswith("proposed"):
            return verdict, f"return on test seeds: {numbers}"
        gain = difference_to_expert(rows, variant, EXPERT)
        numbers = f"{numbers}; {list_values({EXPERT: rows[EXPERT]['return']['mean']})}"
        gains = [gain, smooth_gain := difference_to_expert(rows, variant, SMOOTH_EXPERT)]
        if kept := rows[variant]["untrained_count"]:
            numbers += f", which {kept} of {rows[variant]['trainings']} trainings kept"
        numbers += f"; difference to it {interval_text(gain, 0, '+,')}"
        smooth = list_values({SMOOTH_LABEL: rows[SMOOTH_EXPERT]["return"]["mean"]})
        numbers += f"; {smooth}, difference {interval_text(smooth_gain, 0, '+,')}"
        if best := best_feasible(rows):
            numbers += f"; best feasible driver of the table without learning: {list_values(best)}"
        if verdict.startswith(HELD):
            means = {label: float(values.mean()) for label, values in returns.items()}
            own, best = means.pop(variant_label(variant)), max(means.values())
            share = (rows[EXPERT]["return"]["mean"] - best) / (own - best)
            numbers += f"; PI has {100 * share:.0f} % of the difference to the others" if share > 0 else ""
            verdict += expert_cause(own, best, expert_returns(rows), [Estimate(**gain_entry) for gain_entry in gains])
        return verdict, f"return on test seeds: {numbers}{feasible_trainings(rows, (variant, *others))}"

    return judge_returns


def expert_returns(rows: dict[str, dict[str, Any]]) -> list[float]:
    """Return the returns of PI without learning, with the time constant of the paper and with 3 s."""
    return [rows[label]["return"]["mean"] for label in (EXPERT, SMOOTH_EXPERT)]


def expert_cause(own: float, other: float, experts: Sequence[float], gains: Sequence[Estimate] = ()) -> str:
    """Return `BY_EXPERT` if an expert has most of a difference, or a gain over one of the experts is not shown."""
    share = (max(experts) - other) / (own - other)
    return BY_EXPERT if share >= EXPERT_SHARE or (gains and judge_differences(gains) != HELD) else ""


def best_feasible(rows: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Return label and return of the best feasible driver of a table that does not learn; empty if there is none."""
    candidates = {
        label: row["return"]["mean"]
        for label, row in rows.items()
        if not row["is_learned"] and row.get("feasibility") == FEASIBLE
    }
    best = max(candidates, key=candidates.__getitem__, default="")
    return {SMOOTH_LABEL if best == SMOOTH_EXPERT else best: candidates[best]} if best else {}


def feasible_trainings(rows: dict[str, dict[str, Any]], variants: Sequence[str]) -> str:
    """Return the numbers of feasible trainings of each variant as text; empty if they were not measured."""
    verdicts = {variant_label(name): rows[name].get("feasibility", ()) for name in variants}
    if not all(verdicts.values()):
        return ""
    counts = {label: feasibility.count(FEASIBLE) for label, feasibility in verdicts.items()}
    return f"; feasible trainings: {list_values(counts)}"


def curve_extreme(
    study: str,
    road: str,
    quantity: str,
    what: str,
    part: slice = LAST,
    variants: Sequence[str] = TABLE_1,
    larger: bool = True,
    digits: int = 2,
) -> Assessment:
    """Return the assessment of the largest (smallest) value of the first variant in a part of the training."""

    def judge_means(version: Version) -> Finding:
        values = version.curve_means(study, road, variants, quantity, part)
        verdict, numbers = compare_values(values, variant_label(variants[0]), larger=larger, digits=digits)
        verdict += version.validation_cause(verdict, study, road, variants[0], quantity)
        key = PAPER_QUANTITIES.get(quantity)
        if key is None or not verdict.startswith(HELD):
            return verdict, f"{what}: {numbers}"
        rows = version.rows(study, road)
        experts = {
            label: rows[name]["paper_convention"][key]["mean"]
            for label, name in ((EXPERT, EXPERT), (SMOOTH_LABEL, SMOOTH_EXPERT))
        }
        own = values[variant_label(variants[0])]
        gains = [estimate_over_trainings((own - expert_value).tolist()) for expert_value in experts.values()]
        alone = "" if judge_differences(gains, larger) == HELD else BY_EXPERT
        return f"{verdict}{alone}", f"{what}: {numbers}; {list_values(experts, digits)}"

    return judge_means


def first_return(study: str, road: str, quantity: str) -> Assessment:
    """Return the assessment of the largest return of the method in the first rounds, or at the first validation."""
    at_validation = f"return at the first validation, after about {VALIDATION_STEPS:,} steps", slice(1)
    what, part = at_validation if quantity == VALIDATED else ("return in the first tenth", FIRST)
    return curve_extreme(study, road, quantity, what, part, digits=0)


def late_change(
    study: str, road: str, variant: str, quantity: str, what: str, larger: bool, digits: int = 2
) -> Assessment:
    """Return the assessment of a rise (fall) of a quantity from the third to the last quarter of the training."""

    def change(version: Version, quantity: str) -> Finding:
        parts = {"third quarter": THIRD_QUARTER, "last": LAST_QUARTER}
        values = {
            name: version.curve_means(study, road, (variant,), quantity, part)[variant_label(variant)]
            for name, part in parts.items()
        }
        return compare_values(values, "last", larger=larger, digits=digits)

    def judge_change(version: Version) -> Finding:
        verdict, numbers = change(version, quantity)
        if quantity == TRAINED and verdict.startswith(HELD) and not change(version, VALIDATED)[0].startswith(HELD):
            verdict += BY_EXPLORATION
        return verdict, f"{what}: {numbers}"

    return judge_change


def first_arrival(
    study: str, road: str, variant: str, *others: str, quantity: str = TRAINED, is_last: bool = False
) -> Assessment:
    """Return the assessment of the first (last) arrival of a variant at 0.9 of the final return of TRPO."""

    def judge_steps(version: Version) -> Finding:
        curves = version.curves(study, road, (variant, *others), quantity)
        final = float(version.curve_means(study, road, ("trpo",), quantity, LAST)[variant_label("trpo")].mean())
        goal, values, resolution = final - 0.1 * abs(final), dict[str, np.ndarray](), 0.0
        for name, curve in zip((variant, *others), curves.values(), strict=True):
            steps = np.array(version.part(study, road, "curves")[version.study(study, road)[1]][name]["steps"])
            if quantity == VALIDATED:  # its curve is linear between validations
                ends = np.arange(VALIDATION_STEPS, steps[-1] + 1, VALIDATION_STEPS)
                reaches = np.array([np.interp(ends, steps, row) for row in curve]) >= goal
            else:
                ends, reaches = steps[BLOCK - 1 :: BLOCK], curve.reshape(len(curve), -1, BLOCK).mean(2) >= goal
            resolution = float(ends[1] - ends[0])
            values[variant_label(name)] = np.where(reaches.any(1), ends[reaches.argmax(1)], steps[-1])
        verdict, numbers = compare_values(values, variant_label(variant), larger=is_last, resolution=resolution)
        return verdict + version.validation_cause(verdict, study, road, variant, quantity), f"steps: {numbers}"

    return judge_steps


def fluctuation(
    study: str, road: str, variant: str, *others: str, quantity: str = TRAINED, larger: bool = False
) -> Assessment:
    """Return the assessment of smaller (larger) changes of a variant between points of the second half of its curve."""

    def judge_changes(version: Version) -> Finding:
        curves = version.curves(study, road, (variant, *others), quantity)
        values = {label: np.abs(np.diff(curve[:, 50:])).mean(1) for label, curve in curves.items()}
        verdict, numbers = compare_values(values, variant_label(variant), larger=larger)
        return verdict + version.validation_cause(verdict, study, road, variant, quantity), f"mean change: {numbers}"

    return judge_changes


def compared_with_idm(road: str, metric: str, what: str, larger: bool) -> Assessment:
    """Return the assessment of a larger (smaller) metric of all vehicles with the method than with IDM in the CAV."""

    def judge_metric(version: Version) -> Finding:
        rows = version.rows(f"table-1-{road}", road)
        own = Estimate(**rows["proposed"][metric])
        others = {name: rows[name][metric]["mean"] for name in ("IDM", EXPERT, SMOOTH_EXPERT)}
        idm, *experts = (
            replace(own, mean=own.mean - mean, low=own.low - mean, high=own.high - mean) for mean in others.values()
        )
        verdict = judge_differences([idm], larger)
        alone = BY_EXPERT if verdict == HELD and judge_differences(experts, larger) != HELD else ""
        others[SMOOTH_LABEL] = others.pop(SMOOTH_EXPERT)
        means = list_values({"proposed": own.mean, **others}, 3)
        numbers = f"{what}: {means}; difference to IDM {interval_text(asdict(idm), 3, '+')}"
        numbers += feasible_trainings(rows, ("proposed",))
        return f"{verdict} ({own.count} trainings){alone}", numbers

    return judge_metric


def rare_collisions(road: str) -> Assessment:
    """Return the assessment of rare collisions."""

    def judge_collisions(version: Version) -> Finding:
        rows = [version.rows(f"table-1-{road}", road)[variant] for variant in TABLE_1]
        most = max(row["collisions"]["largest"] for row in rows)
        episodes = sum(row["trainings"] * row["episodes"] for row in rows)
        gap = min(row["min_time_gap"]["mean"] for row in rows)
        numbers = f"at most {most:.2f} vehicles in an episode, of {episodes} episodes"
        numbers += f"; mean of the smallest time gaps {gap:.2f} s with the worst learner"
        braking = [row["cav_max_braking"]["largest"] or 0.0 for row in rows if "cav_max_braking" in row]
        if braking:  # older results do not have it
            numbers += f", of the hardest braking {max(braking):.1f} m/s² in the worst training"
        others = max(row["collisions"]["mean"] for row in version.rows(f"table-1-{road}", road).values())
        if others >= RARE:
            return HELD if most < RARE else NOT_HELD, f"{numbers}; {others:.1f} with another driver"
        causes = "SUMO's brakes and the filter" if version.has_filter and road in UNFILTERED_ROADS else "SUMO's brakes"
        return f"{HELD}{BY_CONSTRUCTION} of {causes}" if most < RARE else NOT_HELD, numbers

    return judge_collisions


def similar_return(version: Version) -> Finding:
    """Assess whether the returns of the other variants of Table 2 are within 10 % of the return of TRPO."""
    returns = version.returns("table-2", "ring", TABLE_2)
    trpo, verdicts, texts = returns[variant_label("trpo")], list[str](), list[str]()
    margin = SIMILAR_SHARE * abs(float(trpo.mean()))
    for label, values in returns.items():
        if label != variant_label("trpo"):
            gain = estimate_over_trainings((values - trpo).tolist())
            is_similar, differs = -margin < gain.low <= gain.high < margin, gain.low > margin or gain.high < -margin
            verdicts.append(HELD if is_similar else NOT_HELD if differs else UNDECIDED)
            texts.append(f"{label} {interval_text(asdict(gain), 0, '+,')}")
    verdict, _ = combine_findings([(part_verdict, "") for part_verdict in verdicts])
    return f"{verdict} ({len(trpo)} trainings)", f"difference of the return on test seeds to TRPO's: {', '.join(texts)}"


def gains_within_framework(version: Version) -> Finding:
    """Assess whether PPO and SAC have larger returns within the framework."""
    pairs = (("proposed-ppo", "ppo"), ("proposed-sac", "sac"))
    return combine_findings([larger_return("figure-9", "ring", *pair)(version) for pair in pairs])


def higher_throughout(quantity: str) -> Assessment:
    """Return the assessment of a higher return within the framework over the whole training."""

    def judge_means(version: Version) -> Finding:
        findings = []
        for pair in (("proposed-ppo", "ppo"), ("proposed-sac", "sac")):
            values = version.curve_means("figure-9", "ring", pair, quantity, slice(None))
            verdict, numbers = compare_values(values, variant_label(pair[0]))
            findings.append(
                (verdict + version.validation_cause(verdict, "figure-9", "ring", pair[0], quantity), numbers)
            )
        verdict, numbers = combine_findings(findings)
        return verdict, f"mean return over the training: {numbers}"

    return judge_means


def stated_gain(learner: str, percent: float) -> Assessment:
    """Return the assessment of a return within the framework that is larger by a percentage."""
    stated, largest = (PAPER_RESULTS["ring", variant][0] for variant in (learner, "proposed"))
    goal = stated * (1 + percent / 100)

    def judge_gain(version: Version) -> Finding:
        without, within = version.returns("figure-9", "ring", (learner, f"proposed-{learner}")).values()
        gain = estimate_over_trainings((100 * linearized_ratio(within - without, without)).tolist())
        excess = replace(gain, mean=gain.mean - percent, low=gain.low - percent, high=gain.high - percent)
        expert = version.rows("figure-9", "ring")[EXPERT]["return"]["mean"] / without.mean() - 1
        numbers = f"on test seeds {interval_text(asdict(gain), 0, '+')} %, with PI alone {100 * expert:+.0f} %"
        if is_unknown := judge_differences([estimate_over_trainings(without.tolist())]) != HELD:
            alone = f"{without.mean():,.0f}, is not shown to be above 0"
            numbers = f"on test seeds no percentage: the return alone, {alone}"
        text = f"{stated:,.1f} × {1 + percent / 100:.2f} = {goal:,.0f}"
        if goal > largest:
            return INCONSISTENT, f"{text}, which its Table 1 does not have; {numbers}"
        verdict = UNDECIDED if is_unknown else judge_differences([excess])
        return f"{verdict} ({gain.count} trainings)", f"{text}; {numbers}"

    return judge_gain


def lower_return(study: str, road: str, variant: str, other: str) -> Assessment:
    """Return the assessment of a smaller return of a variant than of another one on test seeds."""

    def judge_returns(version: Version) -> Finding:
        returns = version.returns(study, road, (variant, other))
        verdict, numbers = compare_values(returns, variant_label(variant), larger=False)
        own, reference = (float(values.mean()) for values in returns.values())
        experts = expert_returns(version.rows(study, road))
        if other.startswith("proposed") and verdict.startswith(HELD):
            verdict += expert_cause(reference, own, experts)
        share = 100 * (own / reference - 1)
        return verdict, f"return on test seeds: {numbers} ({share:+.0f} %); {list_values({EXPERT: experts[0]})}"

    return judge_returns


def larger_return_to_the_letter(road: str) -> Assessment:
    """Return the assessment of a larger return of the method than of TRPO, with the exact settings of the paper."""
    return lambda version: larger_return(f"to-the-letter-{road}", road, *version.exact_variants(road))(version)


def larger_last_return(study: str, road: str) -> Assessment:
    """Return the assessment of a larger return of the last checkpoint of the method than of that of TRPO."""

    def judge_last(version: Version) -> Finding:
        values = version.curve_means(study, road, ("proposed", "trpo"), VALIDATED, slice(-1, None))
        verdict, numbers = compare_values(values, variant_label("proposed"))
        return verdict + version.validation_cause(verdict, study, road, "proposed", VALIDATED), f"return: {numbers}"

    return judge_last


def best_with_each_volume(version: Version) -> Finding:
    """Assess whether the method is best with 5, 11 and 22 vehicles."""
    findings = list[Finding]()
    for count, road in VOLUMES.items():
        verdict, numbers = larger_return("figure-10", road, *TABLE_1)(version)
        findings.append((verdict, f"{count} vehicles: {numbers}"))
    return combine_findings(findings)


def volume_speed(quantity: str) -> Assessment:
    """Return the assessment of an earlier arrival of the method at the return of TRPO with each number of vehicles."""

    def judge_volumes(version: Version) -> Finding:
        findings = list[Finding]()
        for count, road in VOLUMES.items():
            verdict, numbers = first_arrival("figure-10", road, *TABLE_1, quantity=quantity)(version)
            findings.append((verdict, f"{count} vehicles: {numbers}"))
        return combine_findings(findings)

    return judge_volumes


def training_time(other: str, stated: float) -> Assessment:
    """Return the assessment of a training time of the method of at most a multiple of that of another learner."""

    def judge_time(version: Version) -> Finding:
        rounds = version.part("figure-8", "merge", "time")["rounds"]
        own, reference = (np.array([sum(seconds.values()) for seconds in rounds[name]]) for name in ("proposed", other))
        ratio = estimate_over_trainings((own / reference).tolist())
        slower = estimate_over_trainings(((own + SLOWER_STEP) / (reference + SLOWER_STEP)).tolist())
        more = replace(ratio, mean=ratio.mean - stated, low=ratio.low - stated, high=ratio.high - stated)
        processor = version.part("figure-8", "merge", "manifest")["kernels"]["processor"]
        numbers = (
            f"{interval_text(asdict(ratio), 2)} times, this implementation with the filter on one core ({processor})"
        )
        numbers += f"; {interval_text(asdict(slower), 2)} if the simulator took {SLOWER_STEP:g} s more for 1,000 steps"
        return f"{judge_differences([more], larger=False)} ({ratio.count} rounds)", numbers

    return judge_time


def model_history(version: Version, variant: str, estimator: str, part: slice) -> np.ndarray:
    """Return the model error of each training, mean over a part of its iterations."""
    trainings = version.part("theory", "ring", "theory")["model"][variant]
    return np.array(
        [np.mean([row["eps_m_by_estimator"][estimator] for row in training[part]]) for training in trainings]
    )


def exact_model_error_falls(road: str) -> Assessment:
    """Return the assessment of a fall of eps_m on transitions in trainings with the exact settings of the paper."""

    def judge_errors(version: Version) -> Finding:
        trainings = version.part(f"to-the-letter-{road}", road, "paper-exact")[version.exact_variants(road)[0]]
        first, last = np.array([training["eps_m"] for training in trainings]).T
        values = {"first tenth": first, "last": last}
        verdict, numbers = compare_values(values, "last", larger=False, digits=2)
        limit = " (at its upper limit)" if first.min() == last.min() == 1.0 else ""
        return verdict, f"transitions: {numbers}{limit}"

    return judge_errors


def model_error_falls(version: Version) -> Finding:
    """Assess whether eps_m falls during training."""
    findings = []
    for estimator in ERROR_ESTIMATORS:
        parts = {"first iteration": slice(1), "last": slice(-1, None)}
        values = {name: model_history(version, "proposed", estimator, part) for name, part in parts.items()}
        verdict, numbers = compare_values(values, "last", larger=False, digits=2)
        findings.append((verdict, f"{estimator.replace('_', ' ')}: {numbers}"))
    return combine_findings(findings)


def knowledge_in_model(part: slice, what: str) -> Assessment:
    """Return the assessment of a smaller model error with IDM in the model, without an expert."""

    def judge_errors(version: Version) -> Finding:
        variants = {"with IDM": "no-initial-policy", "networks alone": "mb-trpo"}
        findings = []
        for estimator in ERROR_ESTIMATORS:
            values = {name: model_history(version, variant, estimator, part) for name, variant in variants.items()}
            verdict, numbers = compare_values(values, "with IDM", larger=False, digits=2)
            findings.append((verdict, f"{estimator.replace('_', ' ')}, {what}: {numbers}"))
        return combine_findings(findings)

    return judge_errors


def better_start(road: str) -> Assessment:
    """Return the assessment of larger returns of untrained residuals on the expert than of untrained policies alone."""

    def judge_untrained(version: Version) -> Finding:
        rows = version.part("theory", road, "theory")["untrained"]
        road_name = version.study("theory", road)[1]
        values = {
            row["policy"]: np.array(row["returns"]) for row in rows if row["road"] == road_name and "returns" in row
        }
        verdict, numbers = compare_values(values, "expert + random", unit="random networks")
        better = values["expert + random"] > values["random"]
        expert = next(row["mean"] for row in rows if row["road"] == road_name and row["policy"] == A1_EXPERT)
        smooth = expert_returns(version.rows(f"table-1-{road}", road))[1]
        own, other = (float(returns.mean()) for returns in (values["expert + random"], values["random"]))
        gains = [
            estimate_over_trainings((values["expert + random"] - expert_return).tolist())
            for expert_return in (expert, smooth)
        ]
        if verdict.startswith(HELD):
            verdict += expert_cause(own, other, (expert, smooth), gains)
        numbers = f"{numbers}, larger in {better.sum()} of {len(better)}; {list_values({EXPERT: expert})}"
        return verdict, f"return before training: {numbers}; {list_values({SMOOTH_LABEL: smooth})} on test seeds"

    return judge_untrained


def near_best(version: Version, quantity: str = "") -> Finding:
    """Assess whether all trainings of the method end within 5 % of the best training, in curves or on test seeds.

    The best training is one with the settings of the paper; the numbers also refer to the best residual of unjam.
    """
    place, variants = ("table-1-ring", "ring"), (*TABLE_1, "without-model", "ours")
    ends = version.curve_means(*place, variants, quantity, LAST) if quantity else version.returns(*place, variants)
    own, best_of_others = ends[variant_label("proposed")], float(ends.pop(variant_label("ours")).max())
    best, count = max(float(values.max()) for values in ends.values()), len(own)

    def count_near(values: np.ndarray, reference: float) -> int:
        return int((values >= reference - 0.05 * abs(reference)).sum())

    rows, reached = version.rows(*place), count_near(own, best)
    verdict = f"{HELD if reached == count else f'{NOT_HELD} within these steps'} ({count} trainings)"
    if reached == count and not quantity and count_near(np.array(expert_returns(rows)), best):
        verdict += BY_EXPERT
    what = "in the last tenth" if quantity else "on test seeds"
    numbers = f"{reached} of {count} trainings are within 5 % of the best training, {what} {best:,.0f}"
    others = f"{count_near(own, best_of_others)} of {count} of the best one of unjam's residual, {best_of_others:,.0f}"
    experts = dict(zip((EXPERT, SMOOTH_LABEL), expert_returns(rows), strict=True))
    feasible = f"best feasible driver of the table without learning {list_values(best_feasible(rows))}"
    return verdict, f"{numbers}; {others}; on test seeds: {list_values(experts)}, {feasible}"


def bound_on_returns(version: Version) -> Finding:
    """Assess whether the bound on the difference between returns in model and environment holds, and is tight."""
    trainings = version.part("theory", "ring", "theory")["model"]["proposed"]
    rows = [row for training in trainings for row in training if row["gap"] is not None]
    broken = sum(row["gap"] > row["bound"] for row in rows)
    times = np.median([row["bound"] / row["gap"] for row in rows])
    numbers = f"broken in {broken} of {len(rows)} iterations; median {times:,.0f} times the measured difference"
    verdict = NOT_HELD if broken else f"{HELD}{SAYS_NOTHING if times >= LARGE_BOUND else ''}"
    return f"{verdict} ({len(trainings)} trainings)", numbers


def gain_over_expert(version: Version) -> Finding:
    """Assess whether the residual has a larger return than its expert."""
    rows = version.rows("table-2", "ring")
    gain = difference_to_expert(rows, "proposed", EXPERT)
    share = 100 * gain["mean"] / rows[EXPERT]["return"]["mean"]
    verdict = judge_differences([Estimate(**gain)])
    return (
        f"{verdict} ({gain['count']} trainings)",
        f"{interval_text(gain, 0, '+')} ({share:+.1f} %) compared with PI alone",
    )


def table_1_claims(
    text: str,
    make_assessment: Callable[[str, str], Assessment],
    column: int = 0,
    digits: int = 0,
    roads: Sequence[str] = PAPER_ROADS,
    study: str = "table-1-{road}",
) -> list[Claim]:
    """Return a claim for each road, on Table 1 or another study.

    The text can contain `{road}`, `{values}` (a column of the table of the paper), and `{lowest}` (the learner with the
    smallest value in this column).
    """
    claims = []
    for road in roads:
        lowest = variant_label(min(TABLE_1, key=lambda variant: PAPER_RESULTS[road, variant][column]))
        words = text.format(road=road, values=paper_values(road, column, digits), lowest=lowest)
        name = study.format(road=road)
        claims.append(Claim(words, name, road, make_assessment(name, road)))
    return claims


def claims_on_both_returns(
    text: str, make_assessment: Callable[..., Assessment], roads: Sequence[str] = PAPER_ROADS
) -> list[Claim]:
    """Return a claim on Table 1 for each road and each return of learning curves, the argument `quantity`."""
    return [
        claim
        for road in roads
        for quantity, where in RETURNS.items()
        for claim in table_1_claims(f"{text}, {where}", partial(make_assessment, quantity=quantity), roads=(road,))
    ]


def both_assessments(text: str, make_assessment: Callable[..., Assessment]) -> list[tuple[str, Assessment]]:
    """Return text and assessment of a claim for each return of learning curves, the argument `quantity`."""
    return [(f"{text}, {where}", make_assessment(quantity=quantity)) for quantity, where in RETURNS.items()]


def ring_claims(study: str, *claims: tuple[str, Assessment]) -> list[Claim]:
    """Return claims on one study of the ring, from their texts and assessments."""
    return [Claim(text, study, "ring", assess) for text, assess in claims]


TRAINING = "in the last tenth of training"
PPO_LOSSES = {
    road: 100 * (1 - PAPER_RESULTS[road, "ppo"][0] / PAPER_RESULTS[road, "proposed"][0]) for road in PAPER_ROADS
}
"""difference of the return of PPO to that of the method in the table of the paper, by road [%]"""
LEARNED_ROADS = ("ring", "figure-eight")
"""roads with ten trainings of TRPO and the paper's method"""
PEOPLE_HEADING = "Figure 6: the model of human drivers"
A2 = "A2: it converges to a policy as close to the optimal one as wanted (here: the best of the paper's trainings)"
CLAIMS: dict[str, Sequence[Claim]] = {
    "Table 1 and Figure 4: the proposed method, TRPO, PPO and SAC": (
        *table_1_claims("largest return, {road}: {values}", lambda study, road: larger_return(study, road, *TABLE_1)),
        *table_1_claims(
            "larger return than TRPO, {road}, ten trainings",
            lambda study, road: larger_return(study, road, "proposed", "trpo"),
            **{"roads": LEARNED_ROADS, "study": "proposed-{road}"},
        ),
        *table_1_claims(
            "larger return than TRPO, {road}, ten trainings, last checkpoint, in validation",
            larger_last_return,
            **{"roads": LEARNED_ROADS, "study": "proposed-{road}"},
        ),
        *table_1_claims(
            "larger return than TRPO, {road}, last checkpoint, in validation", larger_last_return, roads=("merge",)
        ),
        *table_1_claims(
            "larger return than TRPO, {road}, `paper-exact`",
            lambda _, road: larger_return_to_the_letter(road),
            study="to-the-letter-{road}",
        ),
        *table_1_claims(
            "highest average speed, {road} [m/s]: {values}",
            partial(curve_extreme, quantity="cav_mean_speed", what=f"speed of the CAV {TRAINING}"),
            *(1, 2),
        ),
        *table_1_claims(
            "lower standard deviation of the speed, {road} [m/s]: {values}; in its own table the lowest is {lowest}",
            partial(curve_extreme, quantity="speed_std_cav", what=f"of the CAV {TRAINING}", larger=False),
            *(2, 2),
        ),
        *claims_on_both_returns("larger return in the first rounds, {road}", first_return),
        *claims_on_both_returns(
            "faster convergence, higher sample efficiency, {road}",
            lambda study, road, quantity: first_arrival(study, road, *TABLE_1, quantity=quantity),
        ),
        *claims_on_both_returns(
            "the return rises throughout the training (here: in its second half), {road}",
            partial(late_change, variant="proposed", what="return", larger=True, digits=0),
        ),
        *claims_on_both_returns(
            "more stable learning, {road}",
            lambda study, road, quantity: fluctuation(study, road, *TABLE_1, quantity=quantity),
        ),
        *(
            claim
            for road, loss in PPO_LOSSES.items()
            for claim in table_1_claims(
                f"PPO's final return is lower (42 % on a road not named; in its own table {loss:.0f} %), {{road}}",
                lambda study, road: lower_return(study, road, "ppo", "proposed"),
                roads=(road,),
            )
        ),
        *table_1_claims(
            "the speed of PPO's CAV falls late, {road}",
            partial(
                late_change, variant="ppo", quantity="cav_mean_speed", what="speed in training [m/s]", larger=False
            ),
            roads=LEARNED_ROADS,
        ),
        *table_1_claims(
            "the standard deviation of the speed of SAC's CAV rises, {road}",
            partial(late_change, variant="sac", quantity="speed_std_cav", what="in training [m/s]", larger=True),
            roads=("figure-eight",),
        ),
        *table_1_claims("collisions are rare with all learners, {road}", lambda _, road: rare_collisions(road)),
    ),
    "Figure 5: traffic with the proposed method instead of IDM in the CAV": (
        *table_1_claims(
            "smoother traffic, {road}",
            lambda _, road: compared_with_idm(
                road, "speed_std_fleet", "standard deviation across vehicles [m/s]", False
            ),
        ),
        *table_1_claims(
            "much faster traffic, {road}",
            lambda _, road: compared_with_idm(road, "mean_speed", "mean speed of all vehicles [m/s]", True),
            roads=("merge",),
        ),
    ),
    PEOPLE_HEADING: (),
    "Table 2 and Figure 7: parts of the method, on the ring": (
        *ring_claims(
            "table-2",
            (
                f"largest return of all variants: {paper_values('ring', 0, 0, TABLE_2)}",
                larger_return("table-2", "ring", *TABLE_2),
            ),
            *both_assessments(
                "fastest convergence of all variants", partial(first_arrival, "table-2", "ring", *TABLE_2)
            ),
            *both_assessments(
                "TRPO alone learns most slowly",
                partial(first_arrival, "table-2", "ring", *TABLE_2[1:], "proposed", is_last=True),
            ),
            ("TRPO's final return is similar to the others'", similar_return),
            *both_assessments(
                "MB-TRPO is more sample-efficient than TRPO",
                partial(first_arrival, "table-2", "ring", "mb-trpo", "trpo"),
            ),
            *both_assessments(
                "MB-TRPO's return fluctuates", partial(fluctuation, "table-2", "ring", "mb-trpo", "trpo", larger=True)
            ),
            (
                "the initial policy improves the result",
                larger_return("table-2", "ring", "proposed", "no-initial-policy"),
            ),
            (
                "knowledge in the model improves the result (in its own table it does not: 1,633 with, 1,717 without)",
                larger_return("table-2", "ring", "no-initial-policy", "mb-trpo"),
            ),
            ("the residual improves its expert (the paper has no expert alone)", gain_over_expert),
        ),
        *table_1_claims(
            "the model improves the result, {road} (the paper has no residual without a model)",
            lambda study, road: larger_return(study, road, "proposed", "without-model"),
        ),
        *ring_claims(
            "theory",
            ("knowledge makes the model more accurate", knowledge_in_model(slice(None), "mean over the training")),
        ),
    ),
    "Figure 8: training time": (
        *(
            Claim(text, "figure-8", "ring", training_time(other, stated), depends_on_filter=False)
            for text, other, stated in (
                ("37 % more training time than TRPO", "trpo", 1.37),
                ("4.6 % less training time than PPO", "ppo", 0.954),
                ("4.6 % less training time than SAC", "sac", 0.954),
            )
        ),
    ),
    "Figure 9: PPO and SAC within the framework": ring_claims(
        "figure-9",
        ("the framework improves PPO and SAC as well", gains_within_framework),
        *both_assessments("their return is higher throughout the training", higher_throughout),
        *both_assessments(
            "SAC's return is more stable", partial(fluctuation, "figure-9", "ring", "proposed-sac", "sac")
        ),
        ("by 483 % for PPO", stated_gain("ppo", 483)),
        ("by 34 % for SAC", stated_gain("sac", 34)),
    ),
    "Figure 10: 5, 11 and 22 vehicles": ring_claims(
        "figure-10",
        ("largest return with each number", best_with_each_volume),
        *both_assessments("faster convergence with each number", volume_speed),
    ),
    "Appendix A: theorems": (
        *(
            Claim(f"A1: the initial policy starts closer to the optimum, {road}", "theory", road, better_start(road))
            for road in PAPER_ROADS
        ),
        *ring_claims(
            "theory",
            (f"{A2}, in training", partial(near_best, quantity=TRAINED)),
            (f"{A2}, on test seeds", near_best),
            ("A3: the model error falls during training, ring, preset `paper`", model_error_falls),
            (
                "A3: with IDM the model starts with a smaller error (here SUMO's human drivers follow that IDM)",
                knowledge_in_model(slice(1), "first iteration, after a fit"),
            ),
            ("A3: the bound on returns in the model warrants improvement in the environment", bound_on_returns),
        ),
        *table_1_claims(
            "A3: the model error falls during training, {road}, `paper-exact`",
            lambda _, road: exact_model_error_falls(road),
            study="to-the-letter-{road}",
        ),
    ),
}
"""claims by part of the paper; `people_claims` returns the claims on Figure 6"""


def people_rows() -> list[dict[str, str]]:
    """Return the rows of the claims on the model of human drivers, which do not depend on the filter."""
    return [
        {
            "the paper says": row["the paper"],
            "we get, without the filter": row["number"],
            "verdict": row["here"],
            "with the filter": NO_VALUE_TEXT,
            "command": "`unjam reproduce figure-6`",
        }
        for row in people_claims().to_dict("records")
    ]


def claims_tables() -> dict[str, pd.DataFrame]:
    """Return tables of claims by part of the paper: claim, measured numbers, verdicts and command."""
    return {
        heading: pd.DataFrame(people_rows() if heading == PEOPLE_HEADING else [claim.row() for claim in claims])
        for heading, claims in CLAIMS.items()
    }


def verdict_kind(verdict: str) -> str:
    """Return the kind of a verdict: its first words, and the cause of a claim that holds, if not the method."""
    first_words = next(
        kind for kind in (HELD, NOT_HELD, UNDECIDED, INCONSISTENT, NOT_MEASURED) if verdict.startswith(kind)
    )
    return first_words + next((cause for cause in CAUSES if cause in verdict), "")


def verdict_counts(tables: Sequence[pd.DataFrame]) -> str:
    """Return the numbers of verdicts of each kind, without and with the filter, as text."""
    rows = [row for table in tables for row in table.to_dict("records")]
    with_filter = [row["with the filter"] for row in rows if row["with the filter"] != NO_VALUE_TEXT]
    texts = {
        "without the filter": [row["verdict"] for row in rows],
        "with the filter": [text.removeprefix("**") for text in with_filter],
    }
    sentences = []
    for version, verdicts in texts.items():
        counts = Counter(map(verdict_kind, verdicts))
        listed = "; ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])
        sentences.append(f"- {len(verdicts)} {version}: {listed}")
    return "\n".join(sentences)


def short_answer() -> str:
    """Return the results of the method without the filter: a line for each road, human traffic and the model."""
    version, lines, parts = Version(has_filter=False), list[str](), list[str]()
    for road in PAPER_ROADS:
        study = f"proposed-{road}" if road in LEARNED_ROADS else f"table-1-{road}"
        proposed, trpo = version.returns(study, road, ("proposed", "trpo")).values()
        last = version.curve_means(study, road, ("proposed", "trpo"), VALIDATED, slice(-1, None)).values()
        exact = version.exact_variants(road)
        exact_returns = version.returns(f"to-the-letter-{road}", road, exact).values()
        steps, count = VARIANTS[exact[0]].steps, len(next(iter(exact_returns)))
        rows = version.rows(study, road)
        gain, smooth_gain = (
            interval_text(difference_to_expert(rows, "proposed", expert), 0, "+,") for expert in (EXPERT, SMOOTH_EXPERT)
        )
        best = best_feasible(rows)
        feasible = f"; best feasible driver of the table without learning: {list_values(best)}" if best else ""
        lines.append(
            f"- {road}: return {proposed.mean():,.0f}; difference to TRPO {_difference_text(proposed, trpo)}, with the "
            f"last checkpoint (validation) {_difference_text(*last)}, with `paper-exact` ({steps:,} steps, {count} "
            f"trainings) {_difference_text(*exact_returns)}; difference to PI, its expert without learning, {gain}, "
            f"to {SMOOTH_LABEL} {smooth_gain} ({len(proposed)} trainings){feasible}"
        )
        proposed, without = version.returns(f"table-1-{road}", road, ("proposed", "without-model")).values()
        parts.append(f"{road} {_difference_text(proposed, without)} ({len(proposed)} trainings)")
    rows = version.rows("table-1-merge", "merge")
    human = f"return {rows[HUMAN_LABEL]['return']['mean']:,.0f}"
    lines.append(f"- human traffic alone on the merge: {human}, on the same seeds; no driver there is feasible")
    lines.append(f"- the virtual environment: difference to a residual without it {', '.join(parts)}")
    return "\n".join(lines)


def _difference_text(values: np.ndarray, others: np.ndarray) -> str:
    return interval_text(asdict(estimate_over_trainings((values - others).tolist())), 0, "+,")


def page_text() -> str:
    """Return the content of CLAIMS.md."""
    tables = claims_tables()
    parts = [f"## {heading}\n\n{markdown_table(table)}" for heading, table in tables.items()]
    introduction = INTRODUCTION.replace("SHORT_ANSWER", short_answer()) + verdict_counts([*tables.values()])
    blocks = (introduction, *parts, DIFFERENCES, markdown_table(differences_table()), END)
    return "\n\n".join(blocks) + "\n"


if __name__ == "__main__":
    atomic_write(PAGE, page_text())
