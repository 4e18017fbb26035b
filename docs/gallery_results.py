"""Drive packaged controllers on their roads for the gallery: python docs/gallery_results.py [NAME ...]."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tables import RESULTS, results_part

import unjam
from unjam.controller.certificate import describe_string_stability, make_certificate
from unjam.controller.domain import road_description
from unjam.controller.file import packaged_file, read_controller
from unjam.drivers.safety import STANDARD_ACTUATOR
from unjam.drivers.wrappers import FilteredDriver
from unjam.manifest import manifest
from unjam.measures.effect import compute_effect
from unjam.measures.feasibility import overall_feasibility
from unjam.measures.statistics import metric_estimate
from unjam.reports.figures import png_bytes
from unjam.reports.results import to_plot_episode
from unjam.reports.space_time import space_time_figure
from unjam.training.export import read_exported_controller
from unjam_paper.results_file import write_results

ROADS: dict[str, tuple[str, dict[str, Any]]] = {
    "ring-best": ("ring", {}),
    "ring-tuned": ("ring-jammed", {}),
    "ring-jammed-best": ("ring-jammed", {}),
    "figure-eight-tuned": ("figure-eight", {}),
    "figure-eight-best": ("figure-eight", {}),
    "on-ramp-tuned": ("on-ramp", {"penetration_rate": 0.05}),
}
"""road of each controller, and changes to the road"""
PICTURES = Path(__file__).parent / "pictures"


def certify(name: str) -> dict[str, Any]:
    """Return the string stability and the operating domain of a controller in a usual car."""
    controller = read_exported_controller(f"unjam:{name}", {"actuator": asdict(STANDARD_ACTUATOR)})
    assert isinstance(controller.driver, FilteredDriver)
    certificate = make_certificate(controller)
    text = describe_string_stability(certificate, controller.driver)
    return {"string_stability": text, "domain": certificate["domain"]}


def measure_card(name: str) -> dict[str, Any]:
    """Return the content of the card of a controller, and write its picture."""
    road, changes = ROADS[name]
    driver, is_open = f"unjam:{name}", road == "on-ramp"
    result = unjam.drive(
        road, ["human", driver], episodes=20 if is_open else 10, scenario_options=changes, workers=2, test_seeds=True
    )
    titles = {"human": "human", driver: driver}
    panels = [to_plot_episode(title, result.plot_episodes[label]) for label, title in titles.items()]
    (PICTURES / f"gallery-{name}.png").write_bytes(png_bytes(space_time_figure(panels)))
    rows, human_rows = result.rows[driver], result.rows["human"]
    return {
        "road": road,
        "changes": changes,
        "made_for": road_description(read_controller(packaged_file(name)).manifest),
        "compared with the human baseline": compute_effect(rows, human_rows).summary,
        "seeds": len(rows),
        "min_time_gap": metric_estimate(rows, "min_time_gap").mean,
        "max_braking": metric_estimate(rows, "cav_max_braking").mean,
        "feasibility": overall_feasibility(rows, human_rows),
        **({"string_stability": "", "domain": None} if is_open else certify(name)),
        "manifest": manifest(),
    }


def main(names: list[str]) -> None:
    """Measure and store the cards of the named controllers, or of all."""
    cards = results_part("gallery/cards")
    for name in names or ROADS:
        cards[name] = measure_card(name)
    write_results(RESULTS / "gallery.json", {"manifest": manifest(), "cards": cards})


if __name__ == "__main__":
    main(sys.argv[1:])
