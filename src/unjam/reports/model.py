"""What the report says and draws of a run's virtual environment."""

from collections.abc import Sequence
from math import nan
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.reports.figures import LINE_COLORS, MUTED_COLOR, PLOT_STYLE, TEXT_COLOR, new_figure
from unjam.reports.lanes import space_time_figure
from unjam.reports.results import PlotEpisode, Results

PREDICTED_QUANTITIES = {
    "speed": ("own speed", "m/s"),
    "leader_speed": ("leader's speed", "m/s"),
    "leader_gap": ("gap to the leader", "m"),
    "follower_speed": ("follower's speed", "m/s"),
    "follower_gap": ("gap of the follower", "m"),
    "reward": ("reward", ""),
}
"""what is predicted: its words and its unit"""
ERROR_KINDS = ("change", "base", "model")
"""root mean squares: of what there was to predict, of the base's error, of the model's"""
_PHYSICS = "physics, with a follower that drives as"
BASE_LABELS = {
    "idm": ("IDM alone", f"{_PHYSICS} the IDM"),
    "population": ("typical driver alone", f"{_PHYSICS} the typical one of a calibrated population"),
    "acc": ("ACC alone", f"{_PHYSICS} adaptive cruise control"),
    "ovm": ("OVM alone", f"{_PHYSICS} the optimal velocity model"),
    "none": ("nothing changes", "nothing known but that nothing changes"),
}
"""what the base alone is called, and what it is"""
WAVE_HEADINGS = ("mean speed [m/s]", "std across vehicles [m/s]", "slowest vehicle [m/s]")
ERROR_PRECISION = 1e-5
"""errors below this are those of single precision [m/s, m, reward]"""

MODEL_COLOR, BASE_COLOR, CHANGE_COLOR, RECORDED_COLOR = LINE_COLORS[2], LINE_COLORS[1], LINE_COLORS[0], TEXT_COLOR
"""colours"""
ESTIMATOR_COLORS = dict(
    zip(("unexplained", "transitions", "total_variation", "released"), LINE_COLORS[2:], strict=False)
)
REPLAYED_QUANTITIES = ("leader_speed", "leader_gap", "follower_gap")
"""numbers whose errors are drawn over the time ahead"""
ERROR_BINS = (("leader_speed", "leader_gap"), ("leader_speed", "speed"), ("reward", "leader_gap"))
"""what is drawn over what"""


def error_rows(facts: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the errors of base and model by number: one step ahead, and at the end of the replay.

    Each has its `KINDS`, and with `later_` before the name the same at the end; None for the reward, which is
    not replayed.
    """
    rows = []
    for name, (label, unit) in PREDICTED_QUANTITIES.items():
        later = facts["replay"]["numbers"].get(name)
        at_end = {f"later_{kind}": later[kind][-1] if later else None for kind in ERROR_KINDS}
        rows.append({"number": label, "unit": unit, **facts["one_step"][name], **at_end})
    return rows


def error_headings(facts: dict[str, Any]) -> list[str]:
    """Return the headings of the table of `error_rows`, after the number's own."""
    names = ("change", BASE_LABELS[facts["base"]][0], "model")
    return [
        f"{name}, {after:g} s" for after in (facts["control_step"], facts["replay"]["seconds"][-1]) for name in names
    ]


def wave_rows(facts: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Return what an actual road and those imagined from its start on are like: label and cells of each.

    The cells are those of `WAVE_HEADINGS`: means over the second half, when what is wrong has had time to
    grow.
    """
    found: list[tuple[str, list[str]]] = []
    for label, road in facts["waves"].items():
        speeds = np.array(road["speeds"], np.float64)
        later = speeds[len(speeds) // 2 :]
        numbers = (np.nanmean(later), np.nanstd(later, 1).mean(), np.nanmin(later, 1).mean())
        found.append((BASE_LABELS[facts["base"]][0] if label == "base" else label, [f"{n:.2f}" for n in numbers]))
    return found


def error_cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of a row of `error_rows`, as `error_headings` has them."""
    return [error_text(row[f"{prefix}{kind}"]) for prefix in ("", "later_") for kind in ERROR_KINDS]


def error_text(value: float | None) -> str:
    """Return an error to two digits, or that there is none."""
    if value is None:
        return "–"
    if abs(value) < ERROR_PRECISION:
        return "0"
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def error_verdict(facts: dict[str, Any]) -> str:
    """Return where the model is better than its base, one step ahead and at the end, and where not."""
    sentences = []
    for prefix, after in (("", "One step"), ("later_", f"{facts['replay']['seconds'][-1]:g} s")):
        better, worse = [], []
        for row in error_rows(facts):
            base, model = row[f"{prefix}base"], row[f"{prefix}model"]
            if base is None or max(base, model) < ERROR_PRECISION:
                continue
            change = row["number"]
            if base >= ERROR_PRECISION:  # a base that knows it exactly is left behind by no share
                change += f" (by {100 * abs(1.0 - model / base):.0f}\u00a0%)"
            if model < 0.98 * base:
                better.append(change)
            elif model > 1.02 * base:
                worse.append(change)
        found = (("less wrong than the base in ", better), ("more wrong in ", worse))
        words = ", and ".join(start + ", ".join(changes) for start, changes in found if changes)
        sentences.append(f"{after} ahead the model is {words or 'as wrong as its base'}.")
    return " ".join(sentences)


def rollout_summary(progress: Sequence[dict[str, Any]]) -> str:
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


def bound_summary(facts: dict[str, Any]) -> str:
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
    if "waves" in facts:
        known = BASE_LABELS[facts["base"]][0].removesuffix(" alone")
        return {
            "about": (
                "Between actual episodes the agent also learns on imagined roads, on which everybody drives: "
                f"people by what is known ({known}), plus an ensemble of {facts['members']} networks for "
                f"what that leaves. {_wave_caption(facts)}"
            )
        }
    return {
        "about": (
            "Between actual episodes the agent also learns in a virtual environment: "
            f"{BASE_LABELS[facts['base']][1]}, plus an ensemble of {facts['members']} networks for what "
            f"that leaves. All that follows is measured on {facts['held_out']:,} decisions of episodes that "
            "no network learned from."
        ),
        "replay": facts["replay"],
        "verdict": error_verdict(facts),
        "trust": f"{rollout_summary(result.progress)} {bound_summary(facts)}",
        "headings": error_headings(facts),
        "table": [
            {"label": row["number"], "unit": row["unit"], "cells": error_cells(row)} for row in error_rows(facts)
        ],
    }


def _wave_caption(facts: dict[str, Any]) -> str:
    """Return what is on the pictures of waves."""
    left, where = "an actual episode that no network learned from", "from its start on"
    who = "CAVs do what they did, and noise"
    if facts.get("lane_names"):
        left = "the actual road with the people of an episode that no network learned from"
        where, who = "where they come once more", "The expert alone drives CAVs, and what people misjudge"
    return (
        f"Left {left}; then what is imagined {where}, with what was learned and by what was known alone. "
        f"{who} is drawn anew: waves come as often and travel as fast, not at the same moment."
    )


def wave_figure(facts: dict[str, Any]) -> Figure:
    """Draw an actual road beside those imagined from its start on: waves are dark bands."""
    shown, lane_names = list[PlotEpisode](), tuple(facts.get("lane_names", ()))
    for label, road in facts["waves"].items():
        names, none = ("speeds", "positions", "lanes"), np.zeros((0, 0))
        speeds, positions, lanes = (np.array(road.get(name, none), np.float64) for name in names)
        columns = tuple(str(column) for column in range(speeds.shape[1]))
        cavs = road.get("cavs", facts.get("cavs", []))  # earlier versions wrote them once
        shown.append(
            PlotEpisode(
                driver=BASE_LABELS[facts["base"]][0] if label == "base" else label,
                control_step=facts["step"],
                loop_length=nan if facts["loop_length"] is None else facts["loop_length"],
                lane_names=lane_names,
                outline=np.zeros((0 if lane_names else 1, 3)),
                vehicle_ids=columns,
                cav_ids=tuple(columns[cav] for cav in cavs),
                speeds=speeds,
                positions=positions,
                lane_indices=lanes,
            )
        )
    return space_time_figure(shown)


@rc_context(PLOT_STYLE)
def rollout_figure(progress: Sequence[dict[str, Any]], facts: dict[str, Any]) -> Figure:
    """Draw over training how far the model is trusted, why, and what came of it; and the bound by length."""
    figure, (lengths, estimates, returns, bounds) = _panels(2, 2, 2.3)
    steps = np.array([row["environment_steps"] for row in progress]) / 1000
    virtual = [row["virtual"] for row in progress]

    def plot_over_steps(axes: Axes, values: list[Any], color: str, label: str, **style: Any) -> None:
        known = np.array(values, float)  # None becomes NaN
        axes.plot(steps, known, color=color, lw=1.4, marker="o", ms=2.5, label=label, **style)

    plot_over_steps(lengths, [each["k_star"] for each in virtual], MODEL_COLOR, "k*")
    lengths.set_ylim(bottom=0)
    _label_axes(lengths, "rollout length k* [decisions]", "actual steps [thousands]")
    for name, colour in ESTIMATOR_COLORS.items():
        found = [each["eps_m_by_estimator"].get(name) for each in virtual]
        plot_over_steps(estimates, found, colour, name.replace("_", " "))
    estimates.set_ylim(bottom=0)
    estimates.legend(fontsize=8)
    _label_axes(estimates, "model error eps_m, by estimator", "actual steps [thousands]")
    plot_over_steps(returns, [each.get("return_actual") for each in virtual], RECORDED_COLOR, "actual")
    plot_over_steps(returns, [each.get("return_virtual") for each in virtual], MODEL_COLOR, "virtual", ls="--")
    returns.legend(fontsize=8)
    _label_axes(returns, "earned in k* decisions from the same states", "actual steps [thousands]")
    bound = facts["bound"]
    if bound is None:
        bounds.set_visible(False)
        return figure
    most = bound["largest_return"]
    bounds.plot(bound["k"], bound["C"], color=MODEL_COLOR, lw=1.4, label="bound C")
    bounds.axhline(most, color=MUTED_COLOR, lw=1.1, ls="--", label="largest return there can be")
    bounds.set_xscale("log")
    bounds.set_yscale("log")
    bounds.set_ylim(bottom=most / 3)
    bounds.legend(fontsize=8)
    _label_axes(bounds, "the paper's bound C on virtual less actual return", "rollout length k [decisions]")
    return figure


@rc_context(PLOT_STYLE)
def error_figure(facts: dict[str, Any]) -> Figure:
    """Draw how wrong model and base are: the longer ahead; and one step ahead, by gap and by speed."""
    figure, panels = _panels(2, 3, 2.4)
    seconds = facts["replay"]["seconds"]
    for axes, name in zip(panels[:3], REPLAYED_QUANTITIES, strict=True):
        found = facts["replay"]["numbers"][name]
        axes.plot(seconds, found["change"], color=CHANGE_COLOR, lw=1.1, ls=":", label="how far it changes")
        axes.plot(seconds, found["base"], color=BASE_COLOR, lw=1.4, ls="--", label=BASE_LABELS[facts["base"]][0])
        axes.plot(seconds, found["model"], color=MODEL_COLOR, lw=1.6, label="model, a member")
        axes.plot(seconds, found["spread"], color=MODEL_COLOR, lw=0.9, ls="-.", label="spread of the members")
        if facts["k_star"]:
            trusted = facts["k_star"] * facts["control_step"]
            axes.axvline(trusted, color=MUTED_COLOR, lw=0.9, label="k*, the end of rollouts")
        axes.set_ylim(bottom=0)
        _label_axes(axes, f"error: {_quantity_label(name)}", "time ahead [s]")
    for axes, (name, by) in zip(panels[3:], ERROR_BINS, strict=True):
        found = facts["where"][by]
        axes.plot(found["at"], found["base"][name], color=BASE_COLOR, lw=1.4, ls="--", marker="o", ms=3)
        axes.plot(found["at"], found["model"][name], color=MODEL_COLOR, lw=1.6, marker="o", ms=3)
        axes.set_ylim(bottom=0)
        _label_axes(axes, f"error one step ahead: {PREDICTED_QUANTITIES[name][0]}", _quantity_label(by))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=5)
    return figure


@rc_context(PLOT_STYLE)
def example_figure(facts: dict[str, Any]) -> Figure:
    """Draw virtual against actual: the same accelerations from the same start, each member a thin line."""
    found, seconds = facts["replay"]["examples"], facts["replay"]["seconds"]
    numbers = list(found[0]["numbers"])
    figure, panels = _panels(len(numbers), len(found), 2.1)
    pairs = [(name, each) for name in numbers for each in found]
    for axes, (name, each) in zip(panels, pairs, strict=True):
        example = each["numbers"][name]
        for number, member in enumerate(example["members"]):
            label = "model, each member" if number == 0 else None
            axes.plot(seconds, member, color=MODEL_COLOR, lw=0.9, alpha=0.8, label=label)
        axes.plot(seconds, example["base"], color=BASE_COLOR, lw=1.1, ls="--", label=BASE_LABELS[facts["base"]][0])
        axes.plot(seconds, example["actual"], color=RECORDED_COLOR, lw=1.6, label="actual")
        if name == "leader_gap":
            axes.set_ylim(bottom=0)
        _label_axes(axes, f"{_quantity_label(name)}, from {each['begins']:.0f} s on", "time ahead [s]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


def _panels(rows: int, columns: int, height: float) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels, row by row, each `height` inches high."""
    figure = new_figure(height * rows + 0.4)
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def _quantity_label(name: str) -> str:
    label, unit = PREDICTED_QUANTITIES[name]
    return f"{label} [{unit}]" if unit else label


def _label_axes(axes: Axes, title: str, x_label: str) -> None:
    axes.set_title(title)
    axes.set_xlabel(x_label)
    axes.margins(x=0.02)
