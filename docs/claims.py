"""Claims of the paper, compared with the results of the studies: the table of CLAIMS.md, which this file writes.

    python docs/claims.py

Verdicts are about the studies without the safety filter, which the paper does not have, once these are measured.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from people import people_claims
from studies import beyond_own_expert, rows_of
from tables import RESULTS, results_part

from unjam.files import atomic_write
from unjam.measures.statistics import estimate_over_trainings
from unjam_paper.comparison import PAPER_RESULTS
from unjam_paper.study import NO_VALUE_TEXT, UNFILTERED_ROADS, interval_text
from unjam_paper.variants import VARIANTS

PAGE = Path(__file__).parent.parent / "CLAIMS.md"
INTRODUCTION = """# Claims of the paper

*Knowledge-informed model-based residual reinforcement learning*
([arXiv:2408.17380](https://arxiv.org/abs/2408.17380)), claim by claim, compared with trainings of this package with the
paper's settings where it states them (`--preset paper`): 300,000 environment steps each instead of the paper's
4,000,000, the deterministic controller on 20 test seeds, which played no part in training or selection. Returns are
means over trainings and seeds. There are five trainings on the ring, and three of figures 9 and 10 and on the other
roads. Human drivers have the noise of the authors' simulator, 0.2 m/s² times the square root of the step.

**The paper has no safety filter; unjam has one by default** (a time gap of 1 s, no contact behind leaders that brake
with at most 6 m/s²). Verdicts are about trainings without it; where these are not yet measured, only the numbers
with the filter stand here. *By the expert alone*: the residual is not shown to be better than PI, its expert, without
any learning, which the paper does not show. *Held* and *not held*: the 95 % interval of the paired
difference between trainings lies on one side of zero; *undecided*: it includes zero; *by the sign of means*: no
interval was calculated. Merges have no filter in either column.

`python docs/claims.py` writes this page from the files in [results](results);
[the documentation](docs/results.md) has the tables and figures.

"""
EXPERT = "PI (paper)"
"""the expert of the paper, without a residual"""
NOT_MEASURED = "not yet measured"
HELD, NOT_HELD, UNDECIDED, INCONSISTENT = "held", "not held", "undecided", "inconsistent with its Table 1"
PAPER_ROADS = ("ring", "figure-eight", "merge")
LEARNERS = {"TRPO": "trpo", "PPO": "ppo", "SAC": "sac"}
"""learners of the paper besides its own method: label and variant"""
TENTHS = 10
"""parts of a training"""


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

    def is_measured(self, name: str, road: str) -> bool:
        """Return whether there are results."""
        return (RESULTS / f"{self.study(name, road)[0]}.json").is_file()

    def rows(self, name: str, road: str) -> dict[str, dict[str, Any]]:
        """Return the rows of a study by label."""
        return {row["name"]: row for row in rows_of(*self.study(name, road))}

    def curve(self, name: str, road: str, variant: str, quantity: str) -> np.ndarray:
        """Return a learning curve, one row for each training."""
        study, road = self.study(name, road)
        return np.array(results_part(f"{study}/curves")[road][variant][quantity])

    def steps(self, name: str, road: str, variant: str) -> list[float]:
        """Return the environment steps of the points of a curve."""
        study, road = self.study(name, road)
        return results_part(f"{study}/curves")[road][variant]["steps"]

    def tenths(self, name: str, road: str, variant: str, quantity: str) -> np.ndarray:
        """Return a curve as means over tenths of the training and over the trainings, shape (10,)."""
        return self.curve(name, road, variant, quantity).mean(0).reshape(TENTHS, -1).mean(1)


Finding = tuple[str, str]
"""verdict and numbers"""


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, and how results judge it."""

    text: str
    study: str
    road: str
    judge: Callable[[Version], Finding]
    depends_on_filter: bool = True

    def row(self) -> dict[str, str]:
        """Return the row of the table."""
        with_filter, without = (
            self.judge(version) if version.is_measured(self.study, self.road) else (NOT_MEASURED, NOT_MEASURED)
            for version in (Version(has_filter=True), Version(has_filter=False))
        )
        is_one = self.road not in UNFILTERED_ROADS or not self.depends_on_filter
        without = with_filter if not self.depends_on_filter else without
        return {
            "the paper says": self.text,
            "we get, without the filter": without[1],
            "with the filter": NO_VALUE_TEXT if is_one else f"{with_filter[1]}: {with_filter[0]}",
            "verdict": without[0],
            "command": f"`unjam reproduce {Version(not self.depends_on_filter).study(self.study, self.road)[0]}`",
        }


def mean_return(rows: dict[str, dict[str, Any]], label: str) -> float:
    """Return the mean return of a row over trainings and test seeds."""
    row = rows[label]
    if "gains" not in row:
        return row["return"]["mean"]
    return rows[row["gain_reference"]["expert"]]["return"]["mean"] + float(np.mean(row["gains"]))


def verdict_of_signs(is_so: bool) -> str:
    """Return the verdict where means alone are compared."""
    return f"{HELD if is_so else NOT_HELD}, by the sign of means"


def worst_verdict(verdicts: Sequence[str]) -> str:
    """Return the verdict on all parts of a claim: it holds where each holds, and fails where one fails."""
    return next((each for word in (NOT_HELD, UNDECIDED) for each in verdicts if each.startswith(word)), verdicts[0])


def compare_returns(rows: dict[str, dict[str, Any]], label: str, *others: str) -> str:
    """Return whether a row has a larger return than all others, trainings of the same seed paired, 95 % interval."""
    count = min(len(rows[each]["gains"]) for each in (label, *others))
    gains = {each: np.array(rows[each]["gains"])[:count] for each in (label, *others)}
    differences = [estimate_over_trainings(gains[label] - gains[other]) for other in others]
    trainings = f"({count} trainings)"
    if all(each.low > 0 for each in differences):
        return f"{HELD} {trainings}"
    return f"{NOT_HELD if any(each.high < 0 for each in differences) else UNDECIDED} {trainings}"


def compare_with_expert(rows: dict[str, dict[str, Any]], label: str, verdict: str) -> str:
    """Return a verdict on a residual, with a note if it is not better than its expert alone, the PI of the paper."""
    gain = beyond_own_expert(rows, label, EXPERT)
    return verdict if gain["low"] > 0 or not verdict.startswith(HELD) else f"{verdict}, by the expert alone"


def list_values(values: dict[str, float], digits: int = 0) -> str:
    """Return labels and values as text."""
    return ", ".join(f"{label} {value:,.{digits}f}" for label, value in values.items())


def paper_values(road: str, column: int, digits: int) -> str:
    """Return the values of the paper's table for its method and the other learners."""
    variants = {"proposed": "proposed", **LEARNERS}
    return list_values({label: PAPER_RESULTS[road, name][column] for label, name in variants.items()}, digits)


def largest_return(road: str) -> Claim:
    """Is the paper's method better than TRPO, PPO and SAC?"""
    study = f"table-1-{road}"

    def judge(version: Version) -> Finding:
        rows = version.rows(study, road)
        numbers = list_values({label: mean_return(rows, label) for label in ("proposed", *LEARNERS, EXPERT)})
        verdict = compare_returns(rows, "proposed", *LEARNERS)
        return compare_with_expert(rows, "proposed", verdict), f"test seeds: {numbers}"

    return Claim(f"largest return of all learners, {road}: {paper_values(road, 0, 0)}", study, road, judge)


def largest_speed(road: str) -> Claim:
    """Has the paper's method the highest `average speed`, in its convention?"""
    study = f"table-1-{road}"

    def judge(version: Version) -> Finding:
        rows = version.rows(study, road)
        speeds = {label: rows[label]["paper_convention"]["speed"]["mean"] for label in ("proposed", *LEARNERS)}
        is_so = max(speeds, key=speeds.__getitem__) == "proposed"
        return verdict_of_signs(is_so), f"in training, exploration included: {list_values(speeds, 2)}"

    text = f"highest speed of the CAV, {road} [m/s]: {paper_values(road, 1, 2)}"
    return Claim(text, study, road, judge)


def best_start(road: str) -> Claim:
    """Has the paper's method a larger return in the first tenth of the training?"""
    study, variants = f"table-1-{road}", {"proposed": "proposed", **LEARNERS}

    def judge(version: Version) -> Finding:
        starts = {label: version.tenths(study, road, variant, "return_mean")[0] for label, variant in variants.items()}
        is_so = max(starts, key=starts.__getitem__) == "proposed"
        return verdict_of_signs(is_so), f"return in the first tenth, exploration included: {list_values(starts)}"

    return Claim(f"larger return in the first rounds, {road}", study, road, judge)


def ppo_final_return(version: Version) -> Finding:
    """Is the final return of PPO smaller?"""
    rows = version.rows("table-1-ring", "ring")
    ends = {label: rows[label]["paper_convention"]["reward"]["mean"] for label in ("PPO", "proposed")}
    return verdict_of_signs(ends["PPO"] < ends["proposed"]), f"return in the last tenth: {list_values(ends)}"


def ppo_slows_down(road: str) -> Claim:
    """Does the speed of PPO's CAV fall late in the training?"""
    study = f"table-1-{road}"

    def judge(version: Version) -> Finding:
        speeds = version.tenths(study, road, "ppo", "cav_mean_speed")
        numbers = f"{speeds.max():.2f} m/s in the fastest tenth, {speeds[-1]:.2f} in the last"
        return verdict_of_signs(speeds[-1] < 0.95 * speeds.max()), numbers

    return Claim(f"the speed of PPO's CAV falls late, {road}", study, road, judge)


def collisions(road: str) -> Claim:
    """Are collisions rare?"""
    study = f"table-1-{road}"

    def judge(version: Version) -> Finding:
        rows = [row for row in version.rows(study, road).values() if row["is_learned"]]
        most = max(row["collisions"]["mean"] for row in rows)
        gaps = [row["min_time_gap"]["mean"] for row in rows]
        numbers = f"at most {most:.2f} vehicles in an episode; mean of the smallest time gaps {min(gaps):.2f} s"
        if version.has_filter and road in UNFILTERED_ROADS:
            return "by construction of the filter", numbers
        return verdict_of_signs(most < 0.05), numbers

    return Claim(f"collisions are rare with all learners, {road}", study, road, judge)


def trpo_is_slowest(version: Version) -> Finding:
    """Do the other variants of Table 2 reach TRPO's own final return before it does?"""
    goal, arrivals = 0.9 * version.tenths("table-2", "ring", "trpo", "return_mean")[-1], dict[str, float]()
    for variant in ("trpo", "mb-trpo", "no-initial-policy", "proposed"):
        reached = version.curve("table-2", "ring", variant, "return_mean").mean(0) >= goal
        steps = version.steps("table-2", "ring", variant)
        arrivals[VARIANTS[variant].label] = steps[reached.argmax()] if reached.any() else np.inf
    is_so = max(arrivals, key=arrivals.__getitem__) == "TRPO"
    return verdict_of_signs(is_so), f"steps to 0.9 of TRPO's final return: {list_values(arrivals)}"


def parts_of_the_method(label: str, baseline: str) -> Callable[[Version], Finding]:
    """Return how Table 2 judges that one variant has a larger return than another."""

    def judge(version: Version) -> Finding:
        rows = version.rows("table-2", "ring")
        labels = (label, baseline, EXPERT) if label == "proposed" else (label, baseline)
        numbers = list_values({each: mean_return(rows, each) for each in labels})
        verdict = compare_returns(rows, label, baseline)
        if label == "proposed":
            verdict = compare_with_expert(rows, label, verdict)
        return verdict, f"test seeds: {numbers}"

    return judge


def similar_return(version: Version) -> Finding:
    """Is the final return of MB-TRPO similar to that of TRPO?"""
    rows = version.rows("table-2", "ring")
    verdict = compare_returns(rows, "MB-TRPO", "TRPO")
    numbers = list_values({each: mean_return(rows, each) for each in ("MB-TRPO", "TRPO")})
    return verdict.replace(UNDECIDED, f"{HELD}: no difference is shown"), f"test seeds: {numbers}"


def model_is_unstable(version: Version) -> Finding:
    """Do trainings of MB-TRPO differ more than those of TRPO?"""
    rows = version.rows("table-2", "ring")
    ranges = {label: float(np.ptp(rows[label]["gains"])) for label in ("MB-TRPO", "TRPO")}
    return verdict_of_signs(ranges["MB-TRPO"] > ranges["TRPO"]), f"range over trainings: {list_values(ranges)}"


def framework(version: Version) -> Finding:
    """Do PPO and SAC gain within the framework?"""
    rows = version.rows("figure-9", "ring")
    pairs = [(label, f"proposed with {label}") for label in ("PPO", "SAC")]
    numbers = list_values(
        {label: mean_return(rows, label) for pair in pairs for label in pair} | {EXPERT: mean_return(rows, EXPERT)}
    )
    verdicts = [compare_with_expert(rows, two, compare_returns(rows, two, one)) for one, two in pairs]
    return worst_verdict(verdicts), f"test seeds: {numbers}"


def volumes(version: Version) -> Finding:
    """Is the paper's method best with 5, 11 and 22 vehicles?"""
    numbers, verdicts = list[str](), list[str]()
    for road, count in (("ring-5", 5), ("ring-11", 11), ("ring", 22)):
        rows = version.rows("figure-10", road)
        verdicts.append(compare_returns(rows, "proposed", *LEARNERS))
        best = max(LEARNERS, key=lambda label: mean_return(rows, label))
        numbers.append(f"{count}: {list_values({each: mean_return(rows, each) for each in ('proposed', best)})}")
    return worst_verdict(verdicts), f"test seeds: {'; '.join(numbers)}"


def training_time(version: Version) -> Finding:
    """Does the paper's method take 37 % longer than TRPO, and less than PPO and SAC?"""
    times = results_part("figure-8/time")["relative_to_trpo"]
    is_so = abs(times["proposed"] - 1.37) < 0.1 and times["proposed"] < min(times["ppo"], times["sac"])
    values = {VARIANTS[name].label: times[name] for name in ("proposed", "ppo", "sac")}
    return verdict_of_signs(is_so), f"times that of TRPO: {list_values(values, 2)}"


def model_error(version: Version) -> Finding:
    """Does eps_m fall during training?"""
    trainings = results_part(f"{version.study('theory', 'ring')[0]}/theory")["model"]["proposed"]
    ends = [(each[0]["eps_m"], each[-1]["eps_m"]) for each in trainings]
    numbers = "; ".join(f"{first:.2f} to {last:.2f}" for first, last in ends)
    numbers = f"unexplained variance, first to last iteration of {len(ends)} trainings: {numbers}"
    return verdict_of_signs(all(last < first for first, last in ends)), numbers


def percentages(version: Version) -> Finding:
    """Is the return within the framework 483 % above that of PPO?"""
    rows = version.rows("figure-9", "ring")
    values = {label: mean_return(rows, label) for label in ("PPO", "proposed with PPO", "SAC", "proposed with SAC")}
    return INCONSISTENT, f"1,057 × 5.83 = 6,162, which its Table 1 does not have; test seeds: {list_values(values)}"


def gain_over_expert(version: Version) -> Finding:
    """Is the residual worth anything beyond the expert?"""
    rows = version.rows("table-2", "ring")
    gain = beyond_own_expert(rows, "proposed", "PI (paper)")
    share = 100 * gain["mean"] / mean_return(rows, "PI (paper)")
    verdict = HELD if gain["low"] > 0 else NOT_HELD if gain["high"] < 0 else UNDECIDED
    return verdict, f"{interval_text(gain, 0, '+')} ({share:+.1f} %) compared with PI alone"


CLAIMS = (
    *map(largest_return, PAPER_ROADS),
    *map(largest_speed, PAPER_ROADS),
    *map(best_start, PAPER_ROADS),
    Claim("PPO's final return is smaller (by 42 %), ring", "table-1-ring", "ring", ppo_final_return),
    *map(ppo_slows_down, ("ring", "figure-eight")),
    *map(collisions, PAPER_ROADS),
    Claim(
        "the initial policy improves the result (proposed 1,754 against 1,633 without)",
        *("table-2", "ring", parts_of_the_method("proposed", "no initial policy")),
    ),
    Claim("a learned model alone has a return similar to TRPO's: 1,717 and 1,699", "table-2", "ring", similar_return),
    Claim(
        "MB-TRPO fluctuates (measured here: returns differ more between trainings)",
        "table-2",
        "ring",
        model_is_unstable,
    ),
    Claim("TRPO alone learns most slowly", "table-2", "ring", trpo_is_slowest),
    Claim("the residual improves its expert (the paper shows no expert alone)", "table-2", "ring", gain_over_expert),
    Claim("the framework improves PPO and SAC as well", "figure-9", "ring", framework),
    Claim("by 483 % for PPO and 34 % for SAC", "figure-9", "ring", percentages),
    Claim("best with 5, 11 and 22 vehicles", "figure-10", "ring", volumes),
    Claim(
        "37 % more training time than TRPO, 4.6 % less than PPO and SAC",
        *("figure-8", "ring", training_time),
        depends_on_filter=False,
    ),
    Claim("the model error falls during training", "theory", "ring", model_error),
)


def claims_table() -> pd.DataFrame:
    """Return all claims: what the paper says, what the studies measured, the verdict and the command."""
    people = [
        {
            "the paper says": row["the paper"],
            "we get, without the filter": row["number"],
            "with the filter": NO_VALUE_TEXT,
            "verdict": row["here"],
            "command": "`unjam reproduce figure-6`",
        }
        for row in people_claims().to_dict("records")
    ]
    return pd.DataFrame([*(claim.row() for claim in CLAIMS), *people])


def page_text() -> str:
    """Return the content of CLAIMS.md."""
    table = claims_table()
    lines = [table.columns, ["---"] * len(table.columns), *table.itertuples(index=False)]
    return INTRODUCTION + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


if __name__ == "__main__":
    atomic_write(PAGE, page_text())
