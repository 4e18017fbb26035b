"""What the report says of a run's virtual environment, in words and figures."""

from collections.abc import Sequence
from typing import Any

from unjam.reports.results import Results

NUMBERS = {
    "speed": ("own speed", "m/s"),
    "leader_speed": ("leader's speed", "m/s"),
    "leader_gap": ("gap to the leader", "m"),
    "follower_speed": ("follower's speed", "m/s"),
    "follower_gap": ("gap of the follower", "m"),
    "reward": ("reward", ""),
}
"""what is predicted: its words and its unit"""
BASES = {
    "idm": "IDM alone",
    "population": "typical driver alone",
    "acc": "ACC alone",
    "ovm": "OVM alone",
    "none": "nothing changes",
}
"""what the base alone is called"""
_BASES_IN_WORDS = {
    "idm": "physics, with a follower that drives as the IDM",
    "population": "physics, with a follower that drives as the typical one of a calibrated population",
    "acc": "physics, with a follower that drives as adaptive cruise control",
    "ovm": "physics, with a follower that drives as the optimal velocity model",
    "none": "nothing known but that nothing changes",
}
NOTHING = 1e-5
"""errors below this are those of single precision [m/s, m, reward]"""


def base_name(facts: dict[str, Any]) -> str:
    """Return what the base alone is called."""
    return BASES[facts["base"]]


def error_rows(facts: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the errors of base and model by number: one step ahead, and at the end of the replay.

    Root mean squares: `change` (of what there was to predict), `base`, `model`, and with `later_` before
    the name the same at the end; None for the reward, which is not replayed.
    """
    rows = []
    for name, (label, unit) in NUMBERS.items():
        row: dict[str, Any] = {"number": label, "unit": unit, **facts["one_step"][name]}
        later = facts["replay"]["numbers"].get(name, {})
        row |= {f"later_{kind}": later[kind][-1] if later else None for kind in ("change", "base", "model")}
        rows.append(row)
    return rows


def error_text(value: float | None) -> str:
    """Return an error to two digits, or that there is none."""
    if value is None:
        return "–"
    if abs(value) < NOTHING:
        return "0"
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def headings(facts: dict[str, Any]) -> list[str]:
    """Return the headings of the table of `error_rows`, after the number's own."""
    now, end = f"{facts['decision_step']:g} s", f"{facts['replay']['seconds'][-1]:g} s"
    kinds = ("change", base_name(facts), "model")
    return [f"{kind}, {after}" for after in (now, end) for kind in kinds]


def cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of a row of `error_rows`, as `headings` has them."""
    return [
        error_text(row[f"{prefix}{kind}"])
        for prefix in ("", "later_")
        for kind in ("change", "base", "model")
    ]


def verdict_of(facts: dict[str, Any]) -> str:
    """Return where the model is better than its base, one step ahead and at the end, and where not."""
    end = f"{facts['replay']['seconds'][-1]:g} s"
    parts = [
        _better(error_rows(facts), prefix, after) for prefix, after in (("", "one step"), ("later_", end))
    ]
    return " ".join(parts)


def _better(rows: list[dict[str, Any]], prefix: str, after: str) -> str:
    """Return for one moment which numbers the networks make better, and which worse."""
    better, worse = [], []
    for row in rows:
        base, model = row[f"{prefix}base"], row[f"{prefix}model"]
        if base is None or max(base, model) < NOTHING:
            continue
        if model < 0.98 * base:
            better.append((row["number"], 1.0 - model / base))
        elif model > 1.02 * base:
            worse.append((row["number"], model / base - 1.0))
    words = []
    if better:
        words.append("less wrong than the base in " + _list(better))
    if worse:
        words.append("more wrong in " + _list(worse))
    return (
        f"{after[:1].upper()}{after[1:]} ahead the model is {', and '.join(words) or 'as wrong as its base'}."
    )


def _list(found: list[tuple[str, float]]) -> str:
    return ", ".join(f"{name} (by {100 * share:.0f}\u00a0%)" for name, share in found)


def trust_of(progress: Sequence[dict[str, Any]]) -> str:
    """Return how far the model was trusted in the last iteration, and what came of it."""
    newest = progress[-1]["virtual"]
    words = (
        f"In the last iteration rollouts are k* = {newest['k_star']} decisions long: the model error "
        f"eps_m is {newest['eps_m']:.3g}."
    )
    virtual, actual = newest.get("return_virtual"), newest.get("return_actual")
    if virtual is None or actual is None:
        return words
    return (
        f"{words} In so many decisions from the same actual states the same policy earns {virtual:.2f} in "
        f"the virtual environment, and earned {actual:.2f} in the actual one."
    )


def bound_of(facts: dict[str, Any]) -> str:
    """Return what the bound C says: nothing, at these discounts, and how it moves with k."""
    bound = facts["bound"]
    if bound is None:
        return ""
    k, values, most = bound["k"], bound["C"], bound["largest_return"]
    smallest = min(values)
    verdict = (
        f"even at its best it is {smallest / most:,.0f} times that, so it says nothing"
        if smallest > most
        else f"at its best it is {smallest / most:.2f} of that"
    )
    return (
        f"The paper's bound C, by which the actual return may fall short of the virtual one, moves with the "
        f"length of rollouts from {values[0]:,.0f} (k = {k[0]}) over {smallest:,.0f} "
        f"(k = {k[values.index(smallest)]:,}) to {values[-1]:,.0f} (k = {k[-1]:,}). No discounted return is "
        f"larger than R_max / (1 - gamma) = {most:,.0f}: {verdict}."
    )


def model_section(result: Results) -> dict[str, Any] | None:
    """Return what the page says of the virtual environment; None without one."""
    facts = result.model
    if facts is None or not result.progress:
        return None
    replay = facts["replay"]
    return {
        "about": (
            "Between actual episodes the agent also learns in a virtual environment: "
            f"{_BASES_IN_WORDS[facts['base']]}, plus an ensemble of {facts['members']} networks for what "
            f"that leaves. All that follows is measured on {facts['held_out']:,} decisions of episodes that "
            "no network learned from."
        ),
        "examples": (
            "The recorded accelerations, driven again from the same states in the virtual environment, "
            f"without noise; {len(replay['examples'])} of {replay['starts']} starts, drawn at random. Where "
            "the thin lines part, the ensemble knows that it does not know."
        ),
        "errors": (
            "Above: how far the virtual state is from the actual one, root mean square over all starts; "
            "rollouts that are learned from end at k*. "
            f"Below: how wrong a single step is, in bins of equally many decisions. {verdict_of(facts)}"
        ),
        "trust": f"{trust_of(result.progress)} {bound_of(facts)}",
        "headings": headings(facts),
        "table": [
            {"label": row["number"], "unit": row["unit"], "cells": cells(row)} for row in error_rows(facts)
        ],
    }
