"""Makes the controller for every road that is shipped as `unjam:best`: one law for each kind of road."""

from pathlib import Path

from unjam.controller import SHIPPED_FOLDER, controller_bytes, make_driver
from unjam.drivers.by_road import ByRoad

HELD = {
    "motorway": ("unjam:on-ramp-tuned", 1.0),
    "crossing": ("unjam:figure-eight-best", 0.1),
    "loop": ("unjam:rings-tuned", 0.1),
    "elsewhere": ("idm", 0.1),
    "shared": ("unjam:shared-rings-tuned", 0.1),
}
"""drivers by kind of road, and the time between two of their decisions there [s]"""

ABOUT = "one law for each kind of road, each tuned; the car's map and messages choose: " + ", ".join(
    f"{kind} {name}" for kind, (name, _) in HELD.items()
)

if __name__ == "__main__":
    held = {kind: make_driver(name, step) for kind, (name, step) in HELD.items()}
    best = Path(SHIPPED_FOLDER) / "best.unjam"
    best.write_bytes(controller_bytes(ByRoad(**held), {"about": ABOUT}))
    print(best)
