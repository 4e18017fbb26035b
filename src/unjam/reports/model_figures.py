"""Pictures of the virtual environment; `wide` for a screen, otherwise for a phone."""

from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.reports.figures import INK, LINES, MUTED, STYLE
from unjam.reports.model_story import NUMBERS, base_name

MODEL, BASE, CHANGE, ACTUAL = LINES[2], LINES[1], LINES[0], INK
"""colours"""
ESTIMATORS = {"unexplained": LINES[2], "total_variation": LINES[3], "released": LINES[4]}
REPLAYED = ("leader_speed", "leader_gap", "follower_gap")
"""numbers whose errors are drawn over the time ahead"""
PLACED = (("leader_speed", "leader_gap"), ("leader_speed", "speed"), ("reward", "leader_gap"))
"""what is drawn over what"""


def _panels(rows: int, columns: int, wide: bool, height: float) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels: a grid on a screen, one below the other on a phone."""
    shape = (rows, columns) if wide else (rows * columns, 1)
    figure = Figure(figsize=(10.5 if wide else 4.4, height * shape[0] + 0.4), layout="constrained")
    return figure, figure.subplots(*shape, squeeze=False).ravel()


def _named(name: str) -> str:
    label, unit = NUMBERS[name]
    return f"{label} [{unit}]" if unit else label


def _titled(axes: Axes, title: str, horizontal: str) -> None:
    axes.set_title(title, loc="left", fontsize=9, color=INK)
    axes.set_xlabel(horizontal)
    axes.margins(x=0.02)


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=columns, fontsize=9)


def trust(progress: list[dict[str, Any]], facts: dict[str, Any], wide: bool = True) -> Figure:
    """Draw over training how far the model is trusted, why, and what came of it; and the bound by length.

    Args:
        progress: rows of progress of a run with a virtual environment.
        facts: of its `model.json`.
        wide: for a screen.
    """
    with rc_context(STYLE):
        figure, (lengths, errors, returns, bounds) = _panels(2, 2, wide, 2.3)
        steps = np.array([row["actual_steps"] for row in progress]) / 1000
        virtual = [row["virtual"] for row in progress]

        def over_steps(axes: Axes, values: list[Any], colour: str, label: str, **look: Any) -> None:
            known = np.array([np.nan if value is None else value for value in values], float)
            axes.plot(steps, known, color=colour, lw=1.4, marker="o", ms=2.5, label=label, **look)

        over_steps(lengths, [each["k_star"] for each in virtual], MODEL, "k*")
        lengths.set_ylim(bottom=0)
        _titled(lengths, "rollout length k* [decisions]", "actual steps [thousands]")
        for name, colour in ESTIMATORS.items():
            found = [each["eps_m_by_estimator"][name] for each in virtual]
            over_steps(errors, found, colour, name.replace("_", " "))
        errors.set_ylim(bottom=0)
        errors.legend(fontsize=8)
        _titled(errors, "model error eps_m, by estimator", "actual steps [thousands]")
        over_steps(returns, [each.get("return_actual") for each in virtual], ACTUAL, "actual")
        over_steps(returns, [each.get("return_virtual") for each in virtual], MODEL, "virtual", ls="--")
        returns.legend(fontsize=8)
        _titled(returns, "earned in k* decisions from the same states", "actual steps [thousands]")
        if facts["bound"] is None:
            bounds.set_visible(False)
        else:
            _bound(bounds, facts["bound"])
        return figure


def _bound(axes: Axes, bound: dict[str, Any]) -> None:
    axes.plot(bound["k"], bound["C"], color=MODEL, lw=1.4, label="bound C")
    axes.axhline(bound["largest_return"], color=MUTED, lw=1.1, ls="--", label="largest return there can be")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(bottom=bound["largest_return"] / 3)
    axes.legend(fontsize=8)
    _titled(axes, "the paper's bound C on virtual less actual return", "rollout length k [decisions]")


def errors(facts: dict[str, Any], wide: bool = True) -> Figure:
    """Draw how wrong model and base are: the longer ahead; and one step ahead, by gap and by speed."""
    with rc_context(STYLE):
        figure, panels = _panels(2, 3, wide, 2.4 if wide else 2.0)
        later, where = panels[:3], panels[3:]
        seconds = facts["replay"]["seconds"]
        for axes, name in zip(later, REPLAYED, strict=True):
            found = facts["replay"]["numbers"][name]
            axes.plot(seconds, found["change"], color=CHANGE, lw=1.1, ls=":", label="how far it changes")
            axes.plot(seconds, found["base"], color=BASE, lw=1.4, ls="--", label=base_name(facts))
            axes.plot(seconds, found["model"], color=MODEL, lw=1.6, label="model, a member")
            axes.plot(seconds, found["spread"], color=MODEL, lw=0.9, ls="-.", label="spread of the members")
            if facts["k_star"]:
                trusted = facts["k_star"] * facts["decision_step"]
                axes.axvline(trusted, color=MUTED, lw=0.9, label="k*, the end of rollouts")
            axes.set_ylim(bottom=0)
            _titled(axes, f"error: {_named(name)}", "time ahead [s]")
        for axes, (name, by) in zip(where, PLACED, strict=True):
            found = facts["where"][by]
            axes.plot(found["at"], found["base"][name], color=BASE, lw=1.4, ls="--", marker="o", ms=3)
            axes.plot(found["at"], found["model"][name], color=MODEL, lw=1.6, marker="o", ms=3)
            axes.set_ylim(bottom=0)
            label = NUMBERS[name][0]
            _titled(axes, f"error one step ahead: {label}", _named(by))
        _legend(figure, later[0], 5 if wide else 2)
        return figure


def examples(facts: dict[str, Any], wide: bool = True) -> Figure:
    """Draw virtual against actual: the same accelerations from the same start, each member a thin line."""
    with rc_context(STYLE):
        found, seconds = facts["replay"]["examples"], facts["replay"]["seconds"]
        numbers = list(found[0]["numbers"])
        figure, panels = _panels(len(numbers), len(found), wide, 2.1 if wide else 1.8)
        pairs = (
            [(name, each) for name in numbers for each in range(len(found))]
            if wide
            else [(name, each) for each in range(len(found)) for name in numbers]
        )
        for axes, (name, each) in zip(panels, pairs, strict=True):
            example, begins = found[each]["numbers"][name], found[each]["begins"]
            for number, member in enumerate(example["members"]):
                label = "model, each member" if number == 0 else None
                axes.plot(seconds, member, color=MODEL, lw=0.9, alpha=0.8, label=label)
            axes.plot(seconds, example["base"], color=BASE, lw=1.1, ls="--", label=base_name(facts))
            axes.plot(seconds, example["actual"], color=ACTUAL, lw=1.6, label="actual")
            if name == "leader_gap":
                axes.set_ylim(bottom=0)
            _titled(axes, f"{_named(name)}, from {begins:.0f} s on", "time ahead [s]")
        _legend(figure, panels[0], 3 if wide else 2)
        return figure
