"""Makes the controller for every road that is shipped as `unjam:best`: one law for each kind of road.

The law of roads that cross themselves is also written to the folder of certificates; there go on
`unjam export crossing.unjam --scenario figure-eight --to crossing.unjam` and `unjam certify crossing.unjam`.
"""

from pathlib import Path

from unjam.controller import SHIPPED_FOLDER, controller_bytes, make_driver
from unjam.drivers.by_road import ByRoad
from unjam.drivers.driver import Driver
from unjam.drivers.while_gathered import WhileGathered
from unjam.studies.everywhere import PI_ON_ALL

HELD = {
    "motorway": ("unjam:on-ramp-tuned", 1.0),
    "crossing": ("unjam:figure-eight-best", 0.1),
    "loop": ("unjam:rings-tuned", 0.1),
    "elsewhere": ("idm", 0.1),
    "shared": ("unjam:shared-rings-tuned", 0.1),
}
"""drivers by kind of road, and the time between two of their decisions there [s]"""
CROSSING, OTHERWISE = "crossing", PI_ON_ALL
"""on which kind of road a queue is led, and who drives where it does not hold"""

ABOUT = (
    "one law for each kind of road, each tuned; the car's map and messages choose: "
    + ", ".join(f"{kind} {name}" for kind, (name, _) in HELD.items())
    + "; on a crossing PI tuned on all roads, where no queue holds"
)

if __name__ == "__main__":
    held: dict[str, Driver] = {kind: make_driver(name, step) for kind, (name, step) in HELD.items()}
    step = HELD[CROSSING][1]
    held[CROSSING] = WhileGathered(held[CROSSING], make_driver(OTHERWISE, step), step)
    files = {
        Path(SHIPPED_FOLDER) / "best.unjam": ByRoad(**held),
        Path(__file__).parent / f"certified/{CROSSING}.unjam": held[CROSSING],
    }
    for file, driver in files.items():
        file.write_bytes(controller_bytes(driver, {"about": ABOUT}))
        print(file)
