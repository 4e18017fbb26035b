"""Draw the picture of the README: python docs/readme_picture.py."""

from pathlib import Path

import unjam
from unjam.reports.figures import png_bytes
from unjam.reports.results import to_plot_episode
from unjam.reports.space_time import space_time_figure

TITLES = {
    "human": "22 vehicles: human",
    "unjam:ring-jammed-tuned": "tuned expert",
    "unjam:ring-jammed-best": "expert and learned residual",
}
"""title of the panel of each driver"""
FILE = Path(__file__).parent / "pictures" / "ring.png"

result = unjam.drive("ring-jammed", driver=[*TITLES], episodes=1, scenario_options={"horizon": 1500})
panels = [to_plot_episode(title, result.plot_episodes[driver]) for driver, title in TITLES.items()]
FILE.write_bytes(png_bytes(space_time_figure(panels)))
