"""Drives each shipped controller on its road beside people alone: what docs/gallery.md shows, and a film.

Ten held-out seeds, twenty on the on-ramp; a quarter of an hour on two cores. `python
results/gallery/gallery.py`, or with the names of those that are to be driven anew.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageChops, ImageSequence

import unjam
from unjam.controller import make_driver, shipped_file
from unjam.controller.domain import road_of
from unjam.controller.file import CERTIFICATE, read_controller
from unjam.files import to_json
from unjam.manifest import manifest
from unjam.measures.drivable import verdicts
from unjam.measures.effect import beside_people
from unjam.measures.statistics import estimate_of
from unjam.reports.figures import png_bytes
from unjam.reports.film import draw_road, scenes, write_video
from unjam.reports.lanes import space_time_of
from unjam.reports.results import shown_of
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode

ROADS = {
    "ring-best": ("ring", {}),
    "ring-tuned": ("ring-jammed", {}),
    "ring-jammed-best": ("ring-jammed", {}),
    "figure-eight-tuned": ("figure-eight", {}),
    "figure-eight-best": ("figure-eight", {}),
    "on-ramp-tuned": ("on-ramp", {"cav_share": 0.05}),
}
"""where each controller is shown, and what is changed of the road"""
SEEN_AT = {"ring": 280.0, "figure-eight": 60.0, "merge": 400.0}
"""when there is something to see on roads that a picture holds [s]"""
HERE = Path(__file__).parent
PICTURES = HERE.parents[1] / "docs" / "pictures"


def film(road: str, name: str) -> None:
    """Write the film of the documentation's front page: half of the size that `unjam watch` gives it."""
    scenario = make_scenario(road, {"horizon": 1500})
    driver = make_driver(f"unjam:{name}", scenario.decision_step)
    target = PICTURES / "film.webp"
    write_video(run_episode(scenario, driver, (0,), full=True), target, f"unjam:{name}", pace=30.0)
    with Image.open(target) as whole:
        frames = [each.convert("RGB").resize((420, 420)) for each in ImageSequence.Iterator(whole)]
    frames[0].save(target, save_all=True, append_images=frames[1:], duration=50, loop=0, quality=55)


def seen_from_above(road: str, seconds: float) -> None:
    """Write the picture of a road's page: people alone at one moment, without the paper around."""
    scenario = make_scenario(road)
    scenario = make_scenario(road, {"horizon": int(seconds / scenario.decision_step) + 1})
    episode = run_episode(scenario, make_driver("human", scenario.decision_step), (0,), full=True)
    [scene] = scenes(episode, [int(seconds / episode.step)])
    image = draw_road(scene, float(np.nanmax(episode.speeds)), "")
    ink = ImageChops.difference(image, Image.new("RGB", image.size, "white")).getbbox()
    image.crop(ink).quantize(64).save(PICTURES / f"road-{road}.png")


def main(names: Sequence[str]) -> None:
    """Drive, draw and write the cards; what is driven anew has a manifest of its own."""
    target, about = HERE / "gallery.json", manifest()  # later the pictures are a change of the tree
    if not names:
        film("ring-jammed", "ring-tuned")
        for road, seconds in SEEN_AT.items():
            seen_from_above(road, seconds)
    found = json.loads(target.read_text()) if names else {"manifest": about, "cards": {}}
    cards = found["cards"]
    for name in names or ROADS:
        road, changes = ROADS[name]
        label = f"unjam:{name}"
        count = 20 if road == "on-ramp" else 10
        result = unjam.drive(road, ["human", label], episodes=count, road=changes, workers=2, held_out=True)
        named = (("human", "people alone"), (label, label))
        figure = space_time_of([shown_of(title, result.shown[driver]) for driver, title in named])
        (PICTURES / f"gallery-{name}.png").write_bytes(png_bytes(figure, dpi=90))
        driven, controller = result.rows[label], read_controller(shipped_file(name))
        certified = controller.parts.get(CERTIFICATE)
        cards[name] = {
            "road": road,
            "changes": changes,
            "made_for": road_of(controller.manifest),
            "beside people alone": beside_people(result.rows)[label].words,
            "seeds": len(driven),
            "headway": estimate_of(driven, "min_headway").mean,
            "braking": estimate_of(driven, "cav_max_braking").mean,
            "drivable": verdicts(result.rows)[label],
            "domain": json.loads(certified)["domain"] if certified else None,
            **({"manifest": about} if names else {}),
        }
        print(name, cards[name]["beside people alone"], flush=True)
    target.write_text(to_json(found, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
