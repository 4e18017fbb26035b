"""Draw four CAVs behind a recorded drive for docs/recorded.md: python docs/recorded_picture.py RECORDING."""

import sys
from pathlib import Path

import unjam
from unjam.reports.figures import png_bytes
from unjam.reports.results import to_plot_episode
from unjam.reports.space_time import space_time_figure

PICTURE = Path(__file__).parent / "pictures" / "recorded-waves.png"
TITLES = {"human": "human", "unjam:recorded-tuned": "four CAVs (red)"}


def main(recording: str) -> None:
    """Drive 24 vehicles behind a recording, with and without CAVs, and write the picture."""
    options = {"recordings": recording, "platoon": " ".join(["cav human*5"] * 4)}
    result = unjam.drive("recorded", list(TITLES), episodes=1, scenario_options=options, backend="batch")
    panels = [to_plot_episode(title, result.plot_episodes[name]) for name, title in TITLES.items()]
    PICTURE.write_bytes(png_bytes(space_time_figure(panels)))


if __name__ == "__main__":
    main(sys.argv[1])
