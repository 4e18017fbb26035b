"""Claims of the paper, compared with the results of the studies: the tables of CLAIMS.md, which this file writes.

    python docs/claims.py

Verdicts are about the studies without the safety filter, which the paper does not have, once these are measured.
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
from verdicts import HELD, INCONSISTENT, NOT_HELD, UNDECIDED, Finding, Values, compare, judge, list_values, worst

from unjam.files import atomic_write
from unjam.measures.statistics import Estimate, estimate_over_trainings
from unjam_paper.comparison import PAPER_RESULTS
from unjam_paper.study import NO_VALUE_TEXT, UNFILTERED_ROADS, interval_text
from unjam_paper.variants import VARIANTS

PAGE = Path(__file__).parent.parent / "CLAIMS.md"
INTRODUCTION = """# Claims of the paper

*Knowledge-informed model-based residual reinforcement learning*
([arXiv:2408.17380](https://arxiv.org/abs/2408.17380)): its empirical claims compared with trainings of this package.
They have the values of its Tables B2 to B6 (`--preset paper`) and 300,000 environment steps each, instead of the
4,000,000 of its authors' code; [all that differs](#what-differs-from-the-paper) is in the last table. Returns "on
test seeds" are of the deterministic controller that validation chose, on 20 seeds that played no part in training or
selection; other numbers of trainings are of training episodes, exploration included. Verdicts are about the three to
ten trainings that they name, with these settings, and not about methods; they are not corrected for their
number. Numbers are means over trainings; [tables and figures](docs/results.md) have interquartile means.

The paper's method without the safety filter, on test seeds, in short (95 % intervals over trainings):

SHORT_ANSWER

**The paper has no safety filter; unjam has one by default** (a time gap of 1 s, no contact behind leaders that brake
with at most 6 m/s²). Verdicts are about trainings without it; where these are not yet measured, only the numbers
and the verdict with the filter stand here. Merges have no filter in either column.

- *Held* and *not held*: the 95 % interval of the difference lies on one side of zero. It is over trainings, those of
  the same seed paired, on one set of traffic seeds: other seeds would widen it. A claim about several others holds if
  each interval is on its side, and does not hold if one is on the other side; the difference that decides is shown.
- *Undecided*: the interval includes zero. Brackets have an interval, parentheses the range where trainings form two
  groups, which have no interval.
- *By the expert alone*: the method is not shown to be better than PI, its expert, without any learning. The paper has
  no results of its expert alone.
- Returns are *similar* where the interval of the difference lies within 10 % of the return.

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
EXPERT = "PI (paper)"
"""the expert of the paper, without a residual"""
NOT_MEASURED = "not yet measured"
BY_EXPERT, BY_CONSTRUCTION, SAYS_NOTHING = ", by the expert alone", ", by construction", ", but says nothing"
CAUSES = BY_EXPERT, BY_CONSTRUCTION, SAYS_NOTHING
KINDS = (HELD, *(f"{HELD}{cause}" for cause in CAUSES), NOT_HELD, UNDECIDED, INCONSISTENT, NOT_MEASURED)
"""kinds of verdicts in the summary"""
RARE = 0.05
"""vehicles that collide in an episode, below which collisions are rare"""
PAPER_ROADS = ("ring", "figure-eight", "merge")
LEARNERS = ("trpo", "ppo", "sac")
"""variants of the learners in Table 1 besides the paper's method"""
TABLE_1, TABLE_2 = ("proposed", *LEARNERS), ("proposed", "trpo", "mb-trpo", "no-initial-policy")
VOLUMES = {"5": "ring-5", "11": "ring-11", "22": "ring"}
"""roads of Figure 10 by the number of vehicles"""
PAPER_QUANTITIES = {"cav_mean_speed": "speed", "speed_std_cav": "std"}
"""quantities of learning curves that drivers without learning have, too, in the convention of the paper"""
SIMILAR_SHARE = 0.1
"""share of a return within which another one is similar"""
FIRST, LAST, THIRD_QUARTER, LAST_QUARTER = slice(0, 10), slice(90, 100), slice(50, 75), slice(75, 100)
"""parts of a learning curve of 100 points"""
BLOCK = 5
"""points of a learning curve that are averaged before it counts as having reached a return"""


class MissingResultsError(Exception):
    """There are no results for a claim."""


@dataclass(frozen=True)
class Version:
    """Results of the paper's studies with the safety filter or without it."""

    has_filter: bool

    def study(self, name: str, road: str) -> tuple[str, str]:
        """Return the names of a study and a road in this version; merges have no filter in either."""
        if self.has_filter or road not in UNFILTERED_ROADS:
            return name, road
        suffix = "-unfiltered"
        return (name if name.endswith(suffix) else f"{name}{suffix}"), UNFILTERED_ROADS[road]

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
        return {label_of(each): best + np.array(rows[each]["gains"]) for each in variants}

    def curves(self, name: str, road: str, variants: Sequence[str], quantity: str = "return_mean") -> Values:
        """Return learning curves, shape (trainings, 100)."""
        curves = self.part(name, road, "curves")[self.study(name, road)[1]]
        return {label_of(each): np.array(curves[each][quantity]) for each in variants}

    def curve_means(self, name: str, road: str, variants: Sequence[str], quantity: str, part: slice) -> Values:
        """Return means over a part of the learning curves."""
        return {label: each[:, part].mean(1) for label, each in self.curves(name, road, variants, quantity).items()}


Assessment = Callable[[Version], Finding]
"""what the results of a version say of a claim"""


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, and how results of a version assess it."""

    text: str
    study: str
    road: str
    assess: Assessment
    depends_on_filter: bool = True
    has_unfiltered_study: bool = True
    """whether a study measures it without the filter"""

    def row(self) -> dict[str, str]:
        """Return the row of the table."""
        with_filter, without = (self._finding(Version(has_filter)) for has_filter in (True, False))
        is_one = self.road not in UNFILTERED_ROADS or not self.depends_on_filter
        verdict, numbers = with_filter if is_one else without
        version = Version(is_one or not self.has_unfiltered_study)
        has_two = not is_one and with_filter[0] != NOT_MEASURED
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


def label_of(variant: str) -> str:
    """Return the label of a variant."""
    return VARIANTS[variant].label


def paper_values(road: str, column: int, digits: int, variants: Sequence[str] = TABLE_1) -> str:
    """Return the values of the paper's table by variant."""
    return list_values({label_of(each): PAPER_RESULTS[road, each][column] for each in variants}, digits)


def larger_return(study: str, road: str, variant: str, *others: str) -> Assessment:
    """Return how to judge that a variant has a larger return on test seeds than others, and whether its expert has it.

    The expert counts for variants that add a residual to it.
    """

    def judge_returns(version: Version) -> Finding:
        rows, returns = version.rows(study, road), version.returns(study, road, (variant, *others))
        verdict, numbers = compare(returns, label_of(variant))
        if not variant.startswith("proposed"):
            return verdict, f"return on test seeds: {numbers}"
        gain = difference_to_expert(rows, variant, EXPERT)
        is_beyond = judge([Estimate(**gain)]) == HELD
        alone = BY_EXPERT if verdict.startswith(HELD) and not is_beyond else ""
        numbers = f"{numbers}; {list_values({EXPERT: rows[EXPERT]['return']['mean']})}"
        if kept := rows[variant]["untrained_count"]:
            numbers += f", which {kept} of {rows[variant]['trainings']} trainings kept"
        numbers += f"; difference to it {interval_text(gain, 0, '+,')}"
        if verdict.startswith(HELD):
            means = {label: float(each.mean()) for label, each in returns.items()}
            own, best = means.pop(label_of(variant)), max(means.values())
            share = (rows[EXPERT]["return"]["mean"] - best) / (own - best)
            numbers += f"; PI has {100 * share:.0f} % of the difference to the others"
        return f"{verdict}{alone}", f"return on test seeds: {numbers}"

    return judge_returns


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
    """Return how to judge that the first variant has the largest (smallest) value in a part of the training."""

    def judge_means(version: Version) -> Finding:
        values = version.curve_means(study, road, variants, quantity, part)
        verdict, numbers = compare(values, label_of(variants[0]), larger=larger, digits=digits)
        key = PAPER_QUANTITIES.get(quantity)
        if key is None or not verdict.startswith(HELD):
            return verdict, f"{what}: {numbers}"
        expert = version.rows(study, road)[EXPERT]["paper_convention"][key]["mean"]
        gain = estimate_over_trainings((values[label_of(variants[0])] - expert).tolist())
        alone = "" if judge([gain], larger) == HELD else BY_EXPERT
        return f"{verdict}{alone}", f"{what}: {numbers}; {list_values({EXPERT: expert}, digits)}"

    return judge_means


def late_change(
    study: str, road: str, variant: str, quantity: str, what: str, larger: bool, digits: int = 2
) -> Assessment:
    """Return how to judge that a quantity rises (falls) from the third to the last quarter of the training."""

    def judge_change(version: Version) -> Finding:
        parts = {"third quarter": THIRD_QUARTER, "last": LAST_QUARTER}
        values = {
            name: version.curve_means(study, road, (variant,), quantity, part)[label_of(variant)]
            for name, part in parts.items()
        }
        verdict, numbers = compare(values, "last", larger=larger, digits=digits)
        return verdict, f"{what} in training: {numbers}"

    return judge_change


def first_arrival(study: str, road: str, variant: str, *others: str, is_last: bool = False) -> Assessment:
    """Return how to judge that a variant reaches 0.9 of TRPO's final return first, or last."""

    def judge_steps(version: Version) -> Finding:
        curves = version.curves(study, road, (variant, *others))
        final = float(version.curve_means(study, road, ("trpo",), "return_mean", LAST)[label_of("trpo")].mean())
        goal, values, resolution = final - 0.1 * abs(final), dict[str, np.ndarray](), 0.0
        for each, curve in zip((variant, *others), curves.values(), strict=True):
            steps = np.array(version.part(study, road, "curves")[version.study(study, road)[1]][each]["steps"])
            blocks = curve.reshape(len(curve), -1, BLOCK).mean(2) >= goal
            ends = steps[BLOCK - 1 :: BLOCK]
            resolution = float(ends[1] - ends[0])
            values[label_of(each)] = np.where(blocks.any(1), ends[blocks.argmax(1)], steps[-1])
        verdict, numbers = compare(values, label_of(variant), larger=is_last, resolution=resolution)
        what = f"steps to 0.9 of TRPO's final return, to the next {resolution:,.0f} steps, all steps if never"
        return verdict, f"{what}: {numbers}"

    return judge_steps


def fluctuation(study: str, road: str, variant: str, *others: str, larger: bool = False) -> Assessment:
    """Return how to judge that the curve of a variant changes less (more) between points, in its second half."""

    def judge_changes(version: Version) -> Finding:
        curves = version.curves(study, road, (variant, *others))
        values = {label: np.abs(np.diff(each[:, 50:])).mean(1) for label, each in curves.items()}
        verdict, numbers = compare(values, label_of(variant), larger=larger)
        return verdict, f"mean change of the return between points of the curve, second half: {numbers}"

    return judge_changes


def compared_with_idm(road: str, metric: str, what: str, larger: bool) -> Assessment:
    """Return how to judge that all vehicles have a larger (smaller) value with the method than with IDM in the CAV."""

    def judge_metric(version: Version) -> Finding:
        rows = version.rows(f"table-1-{road}", road)
        own = Estimate(**rows["proposed"][metric])
        others = {each: rows[each][metric]["mean"] for each in ("IDM", EXPERT)}
        idm, expert = (
            replace(own, mean=own.mean - each, low=own.low - each, high=own.high - each) for each in others.values()
        )
        verdict = judge([idm], larger)
        alone = BY_EXPERT if verdict == HELD and judge([expert], larger) != HELD else ""
        means = list_values({"proposed": own.mean, **others}, 3)
        numbers = f"{what}: {means}; difference to IDM {interval_text(asdict(idm), 3, '+')}"
        return f"{verdict} ({own.count} trainings){alone}", numbers

    return judge_metric


def collisions(road: str) -> Assessment:
    """Return how to judge that collisions are rare."""

    def judge_collisions(version: Version) -> Finding:
        rows = [version.rows(f"table-1-{road}", road)[each] for each in TABLE_1]
        most = max(row["collisions"]["largest"] for row in rows)
        episodes = sum(row["trainings"] * row["episodes"] for row in rows)
        gap = min(row["min_time_gap"]["mean"] for row in rows)
        numbers = f"at most {most:.2f} vehicles in an episode, of {episodes} episodes"
        numbers += f"; mean of the smallest time gaps {gap:.2f} s with the worst learner"
        braking = [row["cav_max_braking"]["largest"] or 0.0 for row in rows if "cav_max_braking" in row]
        if braking:  # older results do not have it
            numbers += f", of the hardest braking {max(braking):.1f} m/s² in the worst training"
        causes = "SUMO's brakes and the filter" if version.has_filter and road in UNFILTERED_ROADS else "SUMO's brakes"
        return f"{HELD}{BY_CONSTRUCTION} of {causes}" if most < RARE else NOT_HELD, numbers

    return judge_collisions


def similar_return(version: Version) -> Finding:
    """Are the returns of the other variants of Table 2 within 10 % of TRPO's?"""
    returns = version.returns("table-2", "ring", TABLE_2)
    trpo, verdicts, texts = returns[label_of("trpo")], list[str](), list[str]()
    margin = SIMILAR_SHARE * abs(float(trpo.mean()))
    for label, values in returns.items():
        if label != label_of("trpo"):
            gain = estimate_over_trainings((values - trpo).tolist())
            is_similar, differs = -margin < gain.low <= gain.high < margin, gain.low > margin or gain.high < -margin
            verdicts.append(HELD if is_similar else NOT_HELD if differs else UNDECIDED)
            texts.append(f"{label} {interval_text(asdict(gain), 0, '+,')}")
    verdict, _ = worst([(each, "") for each in verdicts])
    return f"{verdict} ({len(trpo)} trainings)", f"difference of the return on test seeds to TRPO's: {', '.join(texts)}"


def framework(version: Version) -> Finding:
    """Do PPO and SAC gain within the framework?"""
    pairs = (("proposed-ppo", "ppo"), ("proposed-sac", "sac"))
    return worst([larger_return("figure-9", "ring", *pair)(version) for pair in pairs])


def higher_throughout(version: Version) -> Finding:
    """Is the return within the framework higher over the whole training?"""
    findings = []
    for pair in (("proposed-ppo", "ppo"), ("proposed-sac", "sac")):
        values = version.curve_means("figure-9", "ring", pair, "return_mean", slice(None))
        findings.append(compare(values, label_of(pair[0])))
    verdict, numbers = worst(findings)
    return verdict, f"mean return over the training: {numbers}"


def percentages(version: Version) -> Finding:
    """Is the return within the framework 483 % above that of PPO?"""
    variants = ("ppo", "proposed-ppo", "sac", "proposed-sac")
    returns = version.returns("figure-9", "ring", variants)
    numbers = list_values({label: float(each.mean()) for label, each in returns.items()})
    ppo = PAPER_RESULTS["ring", "ppo"][0]
    return (
        INCONSISTENT,
        f"{ppo:,.0f} × 5.83 = {ppo * 5.83:,.0f}, which its Table 1 does not have; test seeds: {numbers}",
    )


def volumes(version: Version) -> Finding:
    """Is the paper's method best with 5, 11 and 22 vehicles?"""
    found = [(count, larger_return("figure-10", road, *TABLE_1)(version)) for count, road in VOLUMES.items()]
    return worst([(verdict, f"{count} vehicles: {numbers}") for count, (verdict, numbers) in found])


def volume_speed(version: Version) -> Finding:
    """Does the paper's method reach TRPO's return sooner with each number of vehicles?"""
    found = [(count, first_arrival("figure-10", road, *TABLE_1)(version)) for count, road in VOLUMES.items()]
    return worst([(verdict, f"{count} vehicles: {numbers}") for count, (verdict, numbers) in found])


def transfer(version: Version) -> Finding:
    """Are all vehicles faster than human-only traffic, with controllers of the ring and other numbers of vehicles?"""
    findings = []
    rows = version.part("figure-10", "ring", "transfer")
    for road in dict.fromkeys(row["road"] for row in rows):
        speeds = {row["driver"]: row["mean_speed"]["mean"] for row in rows if row["road"] == road}
        own = np.array([speed for driver, speed in speeds.items() if driver.startswith("proposed")])
        values = {"proposed": own, "human": np.full(len(own), speeds["human"])}
        verdict, numbers = compare(values, "proposed", digits=2)
        findings.append((verdict, f"{road}: {numbers}"))
    verdict, numbers = worst(findings)
    return verdict, f"trained with 22 vehicles, mean speed of all [m/s]: {numbers}"


def training_time(version: Version) -> Finding:
    """Does the paper's method take 37 % longer than TRPO, and less than PPO and SAC?"""
    rounds = version.part("figure-8", "merge", "time")["rounds"]
    variants = ("proposed", "ppo", "sac")
    totals = {name: np.array([sum(each.values()) for each in rounds[name]]) for name in ("trpo", *variants)}
    relative = {name: estimate_over_trainings((totals[name] / totals["trpo"]).tolist()) for name in variants}
    shorter = judge([estimate_over_trainings((totals[each] - totals["proposed"]).tolist()) for each in ("ppo", "sac")])
    own = relative["proposed"]
    verdict = NOT_HELD if not own.low <= 1.37 <= own.high else shorter
    numbers = ", ".join(f"{label_of(name)} {interval_text(asdict(each), 2)}" for name, each in relative.items())
    return f"{verdict} ({own.count} rounds)", f"times that of TRPO, on one core without a GPU: {numbers}"


def model_history(version: Version, variant: str, estimator: str, part: slice) -> np.ndarray:
    """Return the model error of each training, mean over a part of its iterations."""
    trainings = version.part("theory", "ring", "theory")["model"][variant]
    return np.array([np.mean([row["eps_m_by_estimator"][estimator] for row in each[part]]) for each in trainings])


def model_error_falls(version: Version) -> Finding:
    """Does eps_m fall during training?"""
    findings = []
    for estimator in ("unexplained_variance", "transitions"):
        parts = {"first iteration": slice(1), "last": slice(-1, None)}
        values = {name: model_history(version, "proposed", estimator, part) for name, part in parts.items()}
        verdict, numbers = compare(values, "last", larger=False, digits=2)
        findings.append((verdict, f"{estimator.replace('_', ' ')}: {numbers}"))
    return worst(findings)


def knowledge_in_model(part: slice, what: str) -> Assessment:
    """Return how to judge that the model error is smaller with IDM in the model, without an expert."""

    def judge_errors(version: Version) -> Finding:
        variants = {"with IDM": "no-initial-policy", "networks alone": "mb-trpo"}
        values = {name: model_history(version, each, "unexplained_variance", part) for name, each in variants.items()}
        verdict, numbers = compare(values, "with IDM", larger=False, digits=2)
        return verdict, f"unexplained variance, {what}: {numbers}"

    return judge_errors


def better_start(road: str) -> Assessment:
    """Return how to judge that untrained residuals on the expert have larger returns than untrained policies alone."""

    def judge_untrained(version: Version) -> Finding:
        rows = version.part("theory", road, "theory")["untrained"]
        road_name = version.study("theory", road)[1]
        values = {
            row["policy"]: np.array(row["returns"]) for row in rows if row["road"] == road_name and "returns" in row
        }
        verdict, numbers = compare(values, "expert + random", unit="random networks")
        return verdict, f"return before training: {numbers}"

    return judge_untrained


def convergence(version: Version) -> Finding:
    """Does the paper's method come within 5 % of the best return of all trainings?"""
    rows = version.part("theory", "ring", "theory")["convergence"]
    row = next(each for each in rows if each["variant"] == "proposed")
    reached, count = row["converged_at_end"], row["trainings"]
    numbers = (
        f"{reached} of {count} trainings end within 5 % of the best return of any training, {row['best_known']:,.0f}"
    )
    return f"{HELD if reached == count else f'{NOT_HELD} within these steps'} ({count} trainings)", numbers


def bound(version: Version) -> Finding:
    """Does the bound of the difference between returns in model and environment hold, and how tight is it?"""
    trainings = version.part("theory", "ring", "theory")["model"]["proposed"]
    rows = [row for each in trainings for row in each if row["gap"] is not None]
    broken = sum(row["gap"] > row["bound"] for row in rows)
    times = np.median([row["bound"] / row["gap"] for row in rows])
    numbers = f"broken in {broken} of {len(rows)} iterations; median {times:,.0f} times the measured difference"
    return f"{NOT_HELD if broken else f'{HELD}{SAYS_NOTHING}'} ({len(trainings)} trainings)", numbers


def gain_over_expert(version: Version) -> Finding:
    """Is the residual worth anything beyond the expert?"""
    rows = version.rows("table-2", "ring")
    gain = difference_to_expert(rows, "proposed", EXPERT)
    share = 100 * gain["mean"] / rows[EXPERT]["return"]["mean"]
    verdict = judge([Estimate(**gain)])
    return (
        f"{verdict} ({gain['count']} trainings)",
        f"{interval_text(gain, 0, '+')} ({share:+.1f} %) compared with PI alone",
    )


def of_table_1(
    text: str,
    make_assessment: Callable[[str, str], Assessment],
    column: int = 0,
    digits: int = 0,
    roads: Sequence[str] = PAPER_ROADS,
) -> list[Claim]:
    """Return a claim on Table 1 for each road.

    In the text `{road}` is the road, `{values}` a column of the paper's table, and `{lowest}` the learner with its
    smallest value.
    """
    claims = []
    for road in roads:
        lowest = label_of(min(TABLE_1, key=lambda each: PAPER_RESULTS[road, each][column]))
        words = text.format(road=road, values=paper_values(road, column, digits), lowest=lowest)
        claims.append(Claim(words, f"table-1-{road}", road, make_assessment(f"table-1-{road}", road)))
    return claims


def with_ten_trainings(road: str) -> Claim:
    """Return the claim that the paper's method has a larger return than TRPO, from a study of more trainings."""
    study = f"proposed-{road}"
    text = f"larger return than TRPO, {road}, ten trainings: {paper_values(road, 0, 0, ('proposed', 'trpo'))}"
    return Claim(text, study, road, larger_return(study, road, "proposed", "trpo"))


def of_ring(study: str, *claims: tuple[str, Assessment]) -> list[Claim]:
    """Return claims on one study of the ring, from their texts and assessments."""
    return [Claim(text, study, "ring", each) for text, each in claims]


TRAINING = "in the last tenth of training"
PPO_LOSS = 100 * (1 - PAPER_RESULTS["ring", "ppo"][0] / PAPER_RESULTS["ring", "proposed"][0])
PEOPLE_HEADING = "Figure 6: the model of human drivers"
CLAIMS: dict[str, Sequence[Claim]] = {
    "Table 1 and Figure 4: the proposed method, TRPO, PPO and SAC": (
        *of_table_1("largest return, {road}: {values}", lambda study, road: larger_return(study, road, *TABLE_1)),
        *map(with_ten_trainings, ("ring", "figure-eight")),
        *of_table_1(
            "highest average speed, {road} [m/s]: {values}",
            partial(curve_extreme, quantity="cav_mean_speed", what=f"speed of the CAV {TRAINING}"),
            *(1, 2),
        ),
        *of_table_1(
            "lower standard deviation of the speed, {road} [m/s]: {values}; in its own table the lowest is {lowest}",
            partial(curve_extreme, quantity="speed_std_cav", what=f"of the CAV {TRAINING}", larger=False),
            *(2, 2),
        ),
        *of_table_1(
            "larger return in the first rounds, {road}",
            partial(curve_extreme, quantity="return_mean", what="return in the first tenth", part=FIRST, digits=0),
        ),
        *of_table_1(
            "faster convergence, higher sample efficiency, {road}",
            lambda study, road: first_arrival(study, road, *TABLE_1),
        ),
        *of_table_1(
            "the return rises throughout the training, {road}",
            partial(
                late_change,
                variant="proposed",
                quantity="return_mean",
                what="return (exploration decreases, too)",
                larger=True,
                digits=0,
            ),
        ),
        *of_table_1("more stable learning, {road}", lambda study, road: fluctuation(study, road, *TABLE_1)),
        *of_ring(
            "table-1-ring",
            (
                f"PPO's final return is lower (by 42 %; in its own table {PPO_LOSS:.0f} %), ring",
                curve_extreme(
                    *("table-1-ring", "ring"),
                    **{"variants": ("ppo", "proposed"), "quantity": "return_mean", "larger": False},
                    **{"what": f"return {TRAINING}", "digits": 0},
                ),
            ),
        ),
        *of_table_1(
            "the speed of PPO's CAV falls late, {road}",
            partial(late_change, variant="ppo", quantity="cav_mean_speed", what="speed [m/s]", larger=False),
            roads=("ring", "figure-eight"),
        ),
        *of_table_1(
            "the standard deviation of the speed of SAC's CAV rises, {road}",
            partial(late_change, variant="sac", quantity="speed_std_cav", what="of the CAV [m/s]", larger=True),
            roads=("figure-eight",),
        ),
        *of_table_1("collisions are rare with all learners, {road}", lambda _, road: collisions(road)),
    ),
    "Figure 5: traffic with the proposed method instead of IDM in the CAV": (
        *of_table_1(
            "smoother traffic, {road}",
            lambda _, road: compared_with_idm(
                road, "speed_std_fleet", "standard deviation across vehicles [m/s]", False
            ),
        ),
        *of_table_1(
            "much faster traffic, {road}",
            lambda _, road: compared_with_idm(road, "mean_speed", "mean speed of all vehicles [m/s]", True),
            roads=("merge",),
        ),
    ),
    PEOPLE_HEADING: (),
    "Table 2 and Figure 7: parts of the method, on the ring": (
        *of_ring(
            "table-2",
            (
                f"largest return of all variants: {paper_values('ring', 0, 0, TABLE_2)}",
                larger_return("table-2", "ring", *TABLE_2),
            ),
            ("fastest convergence of all variants", first_arrival("table-2", "ring", *TABLE_2)),
            ("TRPO alone learns most slowly", first_arrival("table-2", "ring", *TABLE_2[1:], "proposed", is_last=True)),
            ("TRPO's final return is similar to the others'", similar_return),
            ("MB-TRPO is more sample-efficient than TRPO", first_arrival("table-2", "ring", "mb-trpo", "trpo")),
            ("MB-TRPO's return fluctuates", fluctuation("table-2", "ring", "mb-trpo", "trpo", larger=True)),
            (
                "the initial policy improves the result",
                larger_return("table-2", "ring", "proposed", "no-initial-policy"),
            ),
            (
                "knowledge in the model improves the result (in its own table it does not: 1,633 with, 1,717 without)",
                larger_return("table-2", "ring", "no-initial-policy", "mb-trpo"),
            ),
            (
                "the model improves the result (the paper has no residual without a model)",
                larger_return("table-2", "ring", "proposed", "without-model"),
            ),
            ("the residual improves its expert (the paper has no expert alone)", gain_over_expert),
        ),
        *of_ring(
            "theory",
            ("knowledge makes the model more accurate", knowledge_in_model(slice(None), "mean over the training")),
        ),
    ),
    "Figure 8: training time": (
        Claim(
            "37 % more training time than TRPO, 4.6 % less than PPO and SAC",
            *("figure-8", "ring", training_time),
            depends_on_filter=False,
        ),
    ),
    "Figure 9: PPO and SAC within the framework": of_ring(
        "figure-9",
        ("the framework improves PPO and SAC as well", framework),
        ("their return is higher throughout the training", higher_throughout),
        ("SAC's return is more stable", fluctuation("figure-9", "ring", "proposed-sac", "sac")),
        ("by 483 % for PPO and 34 % for SAC", percentages),
    ),
    "Figure 10: 5, 11 and 22 vehicles": (
        *of_ring(
            "figure-10",
            ("largest return with each number", volumes),
            ("faster convergence with each number", volume_speed),
        ),
        Claim(
            "it transfers to other traffic (the paper trains for each number)",
            *("figure-10", "ring", transfer),
            has_unfiltered_study=False,
        ),
    ),
    "Appendix A: theorems": (
        *(
            Claim(f"A1: the initial policy starts closer to the optimum, {road}", "theory", road, better_start(road))
            for road in PAPER_ROADS
        ),
        *of_ring(
            "theory",
            ("A2: it converges to a policy as close to the optimal one as wanted", convergence),
            ("A3: the model error falls during training", model_error_falls),
            (
                "A3: with IDM the model starts with a smaller error",
                knowledge_in_model(slice(1), "first iteration, after a fit"),
            ),
            ("A3: the bound on returns in the model warrants improvement in the environment", bound),
        ),
    ),
}
"""claims by the part of the paper; those of Figure 6 are `people_claims`"""


def people_rows() -> list[dict[str, str]]:
    """Return the rows of the claims on the model of human drivers, which have no filter."""
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
    """Return all claims by part of the paper: what it says, what the studies measured, the verdict and the command."""
    return {
        heading: pd.DataFrame(people_rows() if heading == PEOPLE_HEADING else [claim.row() for claim in claims])
        for heading, claims in CLAIMS.items()
    }


def kind_of(verdict: str) -> str:
    """Return the kind of a verdict: its first words, and what makes a claim hold if that is not the method."""
    first = next(kind for kind in (HELD, NOT_HELD, UNDECIDED, INCONSISTENT, NOT_MEASURED) if verdict.startswith(kind))
    return first + next((cause for cause in CAUSES if cause in verdict), "")


def summary(tables: Sequence[pd.DataFrame]) -> str:
    """Return how many verdicts there are of each kind, without the filter and with it."""
    rows = [row for table in tables for row in table.to_dict("records")]
    with_filter = [row["with the filter"] for row in rows if row["with the filter"] != NO_VALUE_TEXT]
    texts = {
        "without the filter": [row["verdict"] for row in rows],
        "with the filter": [each.removeprefix("**") for each in with_filter],
    }
    sentences = []
    for version, verdicts in texts.items():
        counts = Counter(map(kind_of, verdicts))
        listed = "; ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])
        sentences.append(f"- {len(verdicts)} claims {version}: {listed}")
    return "\n".join(sentences)


def short_answer() -> str:
    """Return what was found of the paper's method without the filter, a line for each road and one for the model."""
    version, lines = Version(has_filter=False), list[str]()
    for road, study in (
        ("ring", "proposed-ring"),
        ("figure-eight", "proposed-figure-eight"),
        ("merge", "table-1-merge"),
    ):
        proposed, trpo = version.returns(study, road, ("proposed", "trpo")).values()
        gain = interval_text(difference_to_expert(version.rows(study, road), "proposed", EXPERT), 0, "+,")
        lines.append(
            f"- {road}: return {proposed.mean():,.0f}; difference to TRPO {_difference_text(proposed, trpo)}, to PI, "
            f"its expert without learning, {gain} ({len(proposed)} trainings)"
        )
    proposed, without = version.returns("table-2", "ring", ("proposed", "without-model")).values()
    lines.append(
        f"- the virtual environment, ring: difference to a residual without it {_difference_text(proposed, without)}"
    )
    return "\n".join(lines)


def _difference_text(values: np.ndarray, others: np.ndarray) -> str:
    return interval_text(asdict(estimate_over_trainings((values - others).tolist())), 0, "+,")


def page_text() -> str:
    """Return the content of CLAIMS.md."""
    tables = claims_tables()
    parts = [f"## {heading}\n\n{markdown_table(table)}" for heading, table in tables.items()]
    introduction = INTRODUCTION.replace("SHORT_ANSWER", short_answer()) + summary([*tables.values()])
    blocks = (introduction, *parts, DIFFERENCES, markdown_table(differences_table()), END)
    return "\n\n".join(blocks) + "\n"


if __name__ == "__main__":
    atomic_write(PAGE, page_text())
