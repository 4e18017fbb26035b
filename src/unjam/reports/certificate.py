"""Page of a certificate: proven properties, tested worst cases and operating domain of a controller."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.drivers.wrappers import FilteredDriver
from unjam.files import atomic_write
from unjam.reports.figures import CAV_PLOT_COLOR, LINE_COLORS, MUTED_COLOR, PLOT_STYLE, data_uri, new_figure
from unjam.reports.html import render_template

DOMAIN_QUANTITIES = (("own speed", "speed", "m/s"), ("leader speed", "leader_speed", "m/s"), ("gap", "leader_gap", "m"))

MAX_PAGE_HEAD = 2_000  # beginning of a page, which contains its generator and title [bytes]


def write_certificate_page(
    name: str, driver: FilteredDriver, certificate: dict[str, Any], verdict: str, target: Path
) -> None:
    """Write the certificate page of a controller; it begins with the verdict on string stability."""
    worst_cases, string_stability = certificate["worst_cases"], certificate["string_stability"]
    comfort = f"{certificate['comfort']['rms_acceleration']:.2f} m/s²"
    cards = [
        ("Min gap", f"{worst_cases['min_gap']:.2f} m", "in all tests"),
        ("Min time gap", f"{worst_cases['min_time_gap']:.2f} s", "while the leader brakes hard"),
        ("Max braking", f"{worst_cases['max_braking']:.1f} m/s²", "in all tests"),
        ("Ride comfort", comfort, "r.m.s.; below 0.315 is comfortable"),
    ]
    text = render_template(
        "certificate.html",
        name=name,
        driver=driver,
        worst_cases=worst_cases,
        cards=cards,
        verdict=verdict,
        notes=_certificate_notes(certificate),
        string_stability=[(point, _max_gain(point)) for point in string_stability],
        attack_figure=data_uri(_attack_figure(worst_cases["attack"])),
        string_figure=data_uri(_string_figure(string_stability)),
        domain=[(label, certificate["domain"][key], unit) for label, key, unit in DOMAIN_QUANTITIES],
    )
    atomic_write(target, text)


def is_certificate_page(path: Path) -> bool:
    """Return whether a file is a page that `write_certificate_page` wrote."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(MAX_PAGE_HEAD)
    return b'content="unjam ' in head and b"<title>Certificate: " in head


def _max_gain(point: dict[str, Any]) -> float:
    """Return the largest gain at a speed, over frequencies at which the vehicle follows; NaN if there are none."""
    return float(np.fmax.reduce(np.array(point["gains"], np.float64)))


def _certificate_notes(certificate: dict[str, Any]) -> list[str]:
    notes = []
    if not certificate["comfort"]["meets_iso_15622"]:
        notes.append("In its sample it brakes or accelerates harder than ISO 15622 allows for ACC.")
    for point in certificate["string_stability"]:
        if np.isnan(np.array(point["gains"], np.float64)).any():
            notes.append(f"At {point['speed']:g} m/s it falls behind its leader: its string stability is unknown.")
        if point["amplified_band"]:
            low, high = point["amplified_band"]
            band = f"of {low:.3g} Hz" if low == high else f"between {low:.3g} and {high:.3g} Hz"
            gain = f"by up to {_max_gain(point):.3f} times"
            notes.append(
                f"At {point['speed']:g} m/s it amplifies oscillations {band}, {gain}: it is not string stable."
            )
    return notes


@rc_context(PLOT_STYLE)
def _attack_figure(accelerations: list[float]) -> Figure:
    figure = new_figure(2.2)
    axes = figure.subplots()
    axes.stairs(accelerations, np.arange(len(accelerations) + 1.0), color=CAV_PLOT_COLOR)
    axes.set(xlabel="time [s]", ylabel="m/s²", title="Leader acceleration in the maneuver with the smallest gap")
    return figure


@rc_context(PLOT_STYLE)
def _string_figure(string_stability: list[dict[str, Any]]) -> Figure:
    figure = new_figure(2.8)
    panels = figure.subplots(1, max(1, len(string_stability)), sharey=True, squeeze=False)[0]
    for axes, point in zip(panels, string_stability, strict=False):
        axes.axhline(1.0, color=MUTED_COLOR, lw=0.8)
        gains = np.array(point["gains"], np.float64)  # null becomes NaN
        axes.semilogx(point["frequencies"], gains, color=CAV_PLOT_COLOR, label="controller")
        human = {"color": LINE_COLORS[2], "ls": "--", "label": "human driver (IDM)"}
        axes.semilogx(point["frequencies"], point["human_gains"], **human)
        axes.set(xlabel="frequency [Hz]", title=f"{point['speed']:g} m/s")
    panels[0].set_ylabel("gain")
    panels[0].legend()
    return figure
