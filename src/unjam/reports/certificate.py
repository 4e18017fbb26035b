"""The page of a certificate: what is proven of a controller, what was tried, and where it was seen."""

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.drivers.wrappers import FilteredDriver
from unjam.files import atomic_write
from unjam.reports.figures import CAV_PLOT_COLOR, LINE_COLORS, MUTED_COLOR, PLOT_STYLE, data_uri, new_figure
from unjam.reports.html import read_page_file, render_template

DOMAIN_QUANTITIES = (
    ("own speed", "speed", "m/s"),
    ("leader's speed", "leader_speed", "m/s"),
    ("gap", "leader_gap", "m"),
)


def write_certificate_page(name: str, driver: FilteredDriver, certificate: dict[str, Any], target: Path) -> None:
    """Write the page of a controller; `certificate` is that of its file."""
    worst, comfort = certificate["worst"], certificate["comfort"]
    cards = [
        ("Smallest gap", f"{worst['min_gap']:.2f} m", "in all that was tried"),
        ("Smallest headway", f"{worst['min_time_gap']:.2f} s", "while the leader brakes hard"),
        ("Hardest braking", f"{worst['max_braking']:.1f} m/s²", "in all that was tried"),
        ("Riding along", f"{comfort['acceleration']:.2f} m/s²", "r.m.s.; below 0.315 is comfortable"),
    ]
    text = render_template(
        "certificate.html",
        name=name,
        driver=driver.describe(),
        worst=worst,
        cards=cards,
        notes=_certificate_notes(certificate),
        safety=driver.safety,
        step=f"{driver.time_step:g}",
        strings=certificate["strings"],
        attack=data_uri(_attack_figure(worst["attack"])),
        strings_picture=data_uri(_string_figure(certificate["strings"])),
        downloads=Markup(read_page_file("downloads.js")),
        domain=[(label, certificate["domain"][key], unit) for label, key, unit in DOMAIN_QUANTITIES],
    )
    atomic_write(target, text)


def _certificate_notes(certificate: dict[str, Any]) -> list[str]:
    notes = []
    if not certificate["comfort"]["meets_iso_15622"]:
        notes.append("On its road it brakes or speeds up harder than ISO 15622 lets a cruise control.")
    for each in certificate["strings"]:
        if each["amplified"]:
            low, high = each["amplified"]
            notes.append(
                f"At {each['speed']:g} m/s it amplifies sway between {low:.2f} and {high:.2f} rad/s, up to "
                f"{max(each['gains']):.2f} times; so no people behind it are stabilised there."
            )
    return notes


@rc_context(PLOT_STYLE)
def _attack_figure(accelerations: list[float]) -> Figure:
    figure = new_figure(2.2)
    axes = figure.subplots()
    axes.stairs(accelerations, np.arange(len(accelerations) + 1.0), color=CAV_PLOT_COLOR)
    axes.set(xlabel="time [s]", ylabel="m/s²", title="The manoeuvre that came closest: leader's acceleration")
    return figure


@rc_context(PLOT_STYLE)
def _string_figure(string_stability: list[dict[str, Any]]) -> Figure:
    figure = new_figure(2.8)
    found = figure.subplots(1, max(1, len(string_stability)), sharey=True, squeeze=False)[0]
    for axes, each in zip(found, string_stability, strict=False):
        axes.axhline(1.0, color=MUTED_COLOR, lw=0.8)
        axes.semilogx(each["frequencies"], each["gains"], color=CAV_PLOT_COLOR, label="controller")
        axes.semilogx(each["frequencies"], each["people"], color=LINE_COLORS[2], ls="--", label="people (IDM)")
        axes.set(xlabel="frequency [rad/s]", title=f"{each['speed']:g} m/s")
    found[0].set_ylabel("gain")
    found[0].legend()
    return figure
