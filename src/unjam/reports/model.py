"""Texts, tables and figures on the learned model of a run."""

from collections.abc import Sequence
from math import nan
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.reports.figures import LINE_COLORS, MUTED_COLOR, PLOT_STYLE, TEXT_COLOR, new_figure
from unjam.reports.results import PlotEpisode, Results
from unjam.reports.space_time import space_time_figure
from unjam.text import format_count

PREDICTED_QUANTITIES = {
    "speed": ("own speed", "m/s"),
    "leader_speed": ("leader speed", "m/s"),
    "leader_gap": ("leader gap", "m"),
    "follower_speed": ("follower speed", "m/s"),
    "follower_gap": ("follower gap", "m"),
    "reward": ("reward", ""),
}  # label and unit of each predicted quantity
ERROR_KINDS = ("change", "base", "model")
"""quantities with a root mean square: predicted changes, errors of the base model, errors of the learned model"""
BASE_LABELS = {
    "idm": ("IDM alone", "physics with an IDM follower"),
    "population": (
        "typical driver alone",
        "physics with a follower like the typical driver of a calibrated population",
    ),
    "acc": ("ACC alone", "physics with an adaptive cruise control follower"),
    "ovm": ("OVM alone", "physics with a follower of the optimal velocity model"),
    "none": ("no change", "the assumption that nothing changes"),
}  # label and description of each base model
WAVE_HEADINGS = ("mean speed [m/s]", "std across vehicles [m/s]", "slowest vehicle [m/s]")
ERROR_PRECISION = 1e-5  # smaller errors are rounding errors of single precision [m/s, m, reward]

MODEL_COLOR, BASE_COLOR, CHANGE_COLOR, RECORDED_COLOR = LINE_COLORS[2], LINE_COLORS[1], LINE_COLORS[0], TEXT_COLOR
ESTIMATORS = ("unexplained_variance", "transitions", "total_variation", "training_loss")
REPLAYED_QUANTITIES = ("leader_speed", "leader_gap", "follower_gap")  # errors are drawn over the time ahead
ERROR_BINS = (("leader_speed", "leader_gap"), ("leader_speed", "speed"), ("reward", "leader_gap"))
"""pairs of a quantity and the state over which its errors are drawn"""
STEPS_LABEL = "environment steps [thousands]"


def error_rows(facts: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each quantity: errors one control step ahead and, with `final_`, at the end of the replay.

    A row has a label, a unit, the errors of each of the `ERROR_KINDS`, and the errors as texts in `cells`. Final errors
    of the reward are None, because it is not replayed.
    """
    rows = []
    for name, (label, unit) in PREDICTED_QUANTITIES.items():
        replayed = facts["replay"]["quantities"].get(name)
        final = {f"final_{kind}": replayed[kind][-1] if replayed else None for kind in ERROR_KINDS}
        errors = facts["one_step"][name] | final
        cells = [error_text(errors[f"{prefix}{kind}"]) for prefix in ("", "final_") for kind in ERROR_KINDS]
        rows.append({"label": label, "unit": unit, **errors, "cells": cells})
    return rows


def error_headings(facts: dict[str, Any]) -> list[str]:
    """Return the headings of the cells of `error_rows`."""
    names = ("change", _base_label(facts), "model")
    times = facts["control_step"], facts["replay"]["times"][-1]
    return [f"{name}, {time:g} s" for time in times for name in names]


def wave_rows(facts: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Return the labels and cells of a recorded episode and of rollouts from its start.

    The cells below `WAVE_HEADINGS` are means over the second half, after errors have grown.
    """
    rows: list[tuple[str, list[str]]] = []
    for label, road in facts["waves"].items():
        speeds = np.array(road["speeds"], np.float64)
        second_half = speeds[len(speeds) // 2 :]
        minima = np.nanmin(second_half, 1)
        values = (np.nanmean(second_half), np.nanstd(second_half, 1).mean(), minima.mean())
        rows.append((_base_label(facts) if label == "base" else label, [f"{value:.2f}" for value in values]))
    return rows


def error_text(value: float | None) -> str:
    """Return an error with two significant digits, or a dash for None."""
    if value is None:
        return "–"
    if abs(value) < ERROR_PRECISION:
        return "0"
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def error_verdict(facts: dict[str, Any]) -> str:
    """Return sentences on errors of the model that are smaller or larger than those of its base."""
    sentences = []
    for prefix, time in (("", "One step"), ("final_", f"{facts['replay']['times'][-1]:g} s")):
        smaller, larger = [], []
        for row in error_rows(facts):
            base, model = row[f"{prefix}base"], row[f"{prefix}model"]
            if base is None or max(base, model) < ERROR_PRECISION:
                continue
            text = row["label"]
            if base >= ERROR_PRECISION:  # relative to an exact base there is no percentage
                text += f" (by {100 * abs(1.0 - model / base):.0f}\u00a0%)"
            if model < 0.98 * base:
                smaller.append(text)
            elif model > 1.02 * base:
                larger.append(text)
        groups = (("smaller for ", smaller), ("larger for ", larger))
        comparison = ", and ".join(prefix + ", ".join(texts) for prefix, texts in groups if texts)
        sentences.append(f"{time} ahead, the model's errors relative to its base are {comparison or 'equal'}.")
    return " ".join(sentences)


def rollout_summary(progress: Sequence[dict[str, Any]]) -> str:
    """Return sentences on the length and the returns of model rollouts in the last iteration."""
    last = progress[-1]["model"]
    text = (
        f"In the last iteration rollouts are k* = {last['k_star']} control steps long: the model error "
        f"eps_m is {last['eps_m']:.3g}."
    )
    in_model, in_environment = last.get("return_model"), last.get("return_environment")
    if in_model is None or in_environment is None:
        return text
    return (
        f"{text} Over k* control steps from the same states, the return of the same policy is {in_model:.2f} in "
        f"the model and {in_environment:.2f} in the environment."
    )


def bound_summary(facts: dict[str, Any]) -> str:
    """Return sentences on the bound C for different rollout lengths, relative to the largest possible return."""
    if (bound := facts["bound"]) is None:
        return ""
    k, values, max_return = bound["k"], bound["bound"], bound["largest_return"]
    smallest = min(values)
    verdict = (
        f"even the smallest bound is {smallest / max_return:,.0f} times as large, so it is not informative"
        if smallest > max_return
        else f"the smallest bound is {smallest / max_return:.2f} of it"
    )
    return (
        f"The paper's bound C limits how much the return in the environment may be below that in the model. With the "
        f"length of rollouts it changes from {values[0]:,.0f} (k = {k[0]}) over {smallest:,.0f} "
        f"(k = {k[values.index(smallest)]:,}) to {values[-1]:,.0f} (k = {k[-1]:,}). The largest possible discounted "
        f"return is R_max / (1 - gamma) = {max_return:,.0f}: {verdict}."
    )


def model_section(result: Results) -> dict[str, Any] | None:
    """Return the content of the page on the learned model; None if there is no such model."""
    facts = result.model
    if facts is None or not result.progress:
        return None
    networks = f"plus an ensemble of {format_count(facts['members'], 'network')} for the remaining errors"
    if "waves" in facts:
        base = _base_label(facts).removesuffix(" alone")
        return {
            "description": "Between episodes in the environment the agent also learns from model rollouts of whole "
            f"roads, with all vehicles: the human drivers follow a base model ({base}), {networks}. "
            f"{_wave_caption(facts)}"
        }
    return {
        "description": "Between episodes in the environment the agent also learns from rollouts in a learned model "
        f"(the virtual environment of the paper): {BASE_LABELS[facts['base']][1]}, {networks}. All errors are measured "
        f"on {facts['validation_steps']:,} control steps of episodes that no network was trained on.",
        "replay": facts["replay"],
        "verdict": error_verdict(facts),
        "rollouts": f"{rollout_summary(result.progress)} {bound_summary(facts)}",
        "headings": error_headings(facts),
        "table": error_rows(facts),
    }


def _base_label(facts: dict[str, Any]) -> str:
    return BASE_LABELS[facts["base"]][0]


def _wave_caption(facts: dict[str, Any]) -> str:
    episode, start = "an episode in the environment that no network was trained on", "from its start"
    cavs = "CAVs repeat their recorded accelerations, but noise"
    if facts.get("lane_names"):
        episode += ", with its traffic demand"
        start = "with the same demand"
        cavs = "Only the expert drives the CAVs, and the perception error of human drivers"
    return (
        f"Left: {episode}; then rollouts {start}, with the learned model and with the base model alone. {cavs} is "
        "drawn again: waves are as frequent and as fast, but occur at other times."
    )


def wave_figure(facts: dict[str, Any]) -> Figure:
    """Draw a recorded episode and rollouts from its start; waves are dark bands."""
    lane_names, episodes = tuple(facts.get("lane_names", ())), list[PlotEpisode]()
    common: dict[str, Any] = {"control_step": facts["control_step"], "lane_names": lane_names}
    common["loop_length"] = nan if facts["loop_length"] is None else facts["loop_length"]
    common["outline"] = np.zeros((0 if lane_names else 1, 3))
    for label, road in facts["waves"].items():
        arrays = (road.get(name, np.zeros((0, 0))) for name in ("speeds", "positions", "lanes"))
        speeds, positions, lanes = (np.array(array, np.float64) for array in arrays)
        columns = tuple(str(column) for column in range(speeds.shape[1]))
        driver = _base_label(facts) if label == "base" else label
        ids: dict[str, Any] = {"vehicle_ids": columns, "cav_ids": tuple(columns[cav] for cav in road["cav_columns"])}
        values: dict[str, Any] = {"speeds": speeds, "positions": positions, "lane_indices": lanes}
        episodes.append(PlotEpisode(**common, **ids, **values, driver=driver))
    return space_time_figure(episodes)


@rc_context(PLOT_STYLE)
def rollout_figure(progress: Sequence[dict[str, Any]], facts: dict[str, Any]) -> Figure:
    """Draw rollout length, model error and returns over environment steps, and the bound over the rollout length."""
    figure, (lengths, estimates, returns, bounds) = _panels(2, 2, 2.3)
    steps = np.array([row["environment_steps"] for row in progress]) / 1000
    rows = [row["model"] for row in progress]

    def plot_over_steps(axes: Axes, values: list[Any], color: str, label: str, **style: Any) -> None:
        axes.plot(steps, np.array(values, float), color=color, lw=1.4, marker="o", ms=2.5, label=label, **style)

    plot_over_steps(lengths, [row["k_star"] for row in rows], MODEL_COLOR, "k*")
    _label_axes(lengths, "rollout length k* [control steps]", STEPS_LABEL, bottom=0)
    for name, color in zip(ESTIMATORS, LINE_COLORS[2:], strict=False):
        values = [row["eps_m_by_estimator"].get(name) for row in rows]
        plot_over_steps(estimates, values, color, name.replace("_", " "))
    estimates.legend(fontsize=8)
    _label_axes(estimates, "model error eps_m, by estimator", STEPS_LABEL, bottom=0)
    plot_over_steps(returns, [row.get("return_environment") for row in rows], RECORDED_COLOR, "environment")
    plot_over_steps(returns, [row.get("return_model") for row in rows], MODEL_COLOR, "model", ls="--")
    returns.legend(fontsize=8)
    _label_axes(returns, "return over k* control steps from the same states", STEPS_LABEL)
    bound = facts["bound"]
    if bound is None:
        bounds.set_visible(False)
        return figure
    max_return = bound["largest_return"]
    bounds.plot(bound["k"], bound["bound"], color=MODEL_COLOR, lw=1.4, label="bound C")
    bounds.axhline(max_return, color=MUTED_COLOR, lw=1.1, ls="--", label="largest possible return")
    bounds.set(xscale="log", yscale="log")
    bounds.legend(fontsize=8)
    title = "the paper's bound C on return in the model minus in the environment"
    _label_axes(bounds, title, "rollout length k [control steps]", bottom=max_return / 3)
    return figure


@rc_context(PLOT_STYLE)
def error_figure(facts: dict[str, Any]) -> Figure:
    """Draw the errors of the model and its base over the time ahead, and one step ahead over gap and speed."""
    figure, panels = _panels(2, 3, 2.4)
    base = {"color": BASE_COLOR, "lw": 1.4, "ls": "--"}
    model = {"color": MODEL_COLOR, "lw": 1.6}
    times = facts["replay"]["times"]
    for axes, name in zip(panels[:3], REPLAYED_QUANTITIES, strict=True):
        errors = facts["replay"]["quantities"][name]
        axes.plot(times, errors["change"], color=CHANGE_COLOR, lw=1.1, ls=":", label="size of the change")
        axes.plot(times, errors["base"], **base, label=_base_label(facts))
        axes.plot(times, errors["model"], **model, label="model, one member")
        axes.plot(times, errors["spread"], color=MODEL_COLOR, lw=0.9, ls="-.", label="spread of the members")
        if facts["k_star"]:
            length = facts["k_star"] * facts["control_step"]
            axes.axvline(length, color=MUTED_COLOR, lw=0.9, label="k*, the end of rollouts")
        _label_axes(axes, f"error: {_quantity_label(name)}", "time ahead [s]", bottom=0)
    for axes, (name, state) in zip(panels[3:], ERROR_BINS, strict=True):
        errors = facts["by_state"][state]
        axes.plot(errors["values"], errors["base"][name], **base, marker="o", ms=3)
        axes.plot(errors["values"], errors["model"][name], **model, marker="o", ms=3)
        title = f"error one step ahead: {PREDICTED_QUANTITIES[name][0]}"
        _label_axes(axes, title, _quantity_label(state), bottom=0)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=5)
    return figure


@rc_context(PLOT_STYLE)
def example_figure(facts: dict[str, Any]) -> Figure:
    """Draw recordings, and the model with the same accelerations and starts; each member is a thin line."""
    examples, times = facts["replay"]["examples"], facts["replay"]["times"]
    quantities = list(examples[0]["quantities"])
    figure, panels = _panels(len(quantities), len(examples), 2.1)
    pairs = [(name, example) for name in quantities for example in examples]
    for axes, (name, example) in zip(panels, pairs, strict=True):
        values = example["quantities"][name]
        for index, member in enumerate(values["members"]):
            label = "model, each member" if index == 0 else None
            axes.plot(times, member, color=MODEL_COLOR, lw=0.9, alpha=0.8, label=label)
        axes.plot(times, values["base"], color=BASE_COLOR, lw=1.1, ls="--", label=_base_label(facts))
        axes.plot(times, values["recorded"], color=RECORDED_COLOR, lw=1.6, label="recorded")
        title = f"{_quantity_label(name)}, from {example['start_time']:.0f} s on"
        _label_axes(axes, title, "time ahead [s]", bottom=0 if name == "leader_gap" else None)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


def _panels(rows: int, columns: int, height: float) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels, row by row; each is `height` inches high."""
    figure = new_figure(height * rows + 0.4)
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def _quantity_label(name: str) -> str:
    label, unit = PREDICTED_QUANTITIES[name]
    return f"{label} [{unit}]" if unit else label


def _label_axes(axes: Axes, title: str, x_label: str, bottom: float | None = None) -> None:
    axes.set(title=title, xlabel=x_label)
    axes.margins(x=0.02)
    if bottom is not None:
        axes.set_ylim(bottom=bottom)
