"""How closely cars have to follow for SUMO's own motorway ramp to gain: a survey in bare SUMO.

One passenger car in ten follows otherwise than people there, SUMO's default Krauss drivers with 1 s and
imperfection; lanes remain SUMO's. The ramp is driven for 700 s, nobody is teleported, and whoever waits to
enter counts.
"""

import argparse
import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import libsumo
import numpy as np
import sumo

from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.statistics import estimate

RAMP = Path(sumo.SUMO_HOME) / "tools/game/ramp.sumocfg"
SHARE, END, STEP = 0.1, 700.0, 0.2
FLOW_FROM = 400.0
BRISK = 'accel="2.5" decel="4.5"'
FOLLOWERS = {
    **{
        f"Krauss, {t} s": f'carFollowModel="Krauss" sigma="0" tau="{t}" {BRISK}'
        for t in (1.0, 1.1, 1.2, 1.3, 1.5)
    },
    "SUMO's ACC, 1.1 s": f'carFollowModel="ACC" tau="1.1" {BRISK}',
    "IDM, 1.1 s": f'carFollowModel="IDM" tau="1.1" {BRISK}',
    "IDM, 1.1 s, comfortable": 'carFollowModel="IDM" tau="1.1" accel="2.5" decel="2"',
}


@dataclass
class Found:
    """One episode."""

    travel_time: float
    flow: float
    below_one: float
    """share of the time behind the same leader for more than 5 s in which those cars follow below 1 s"""
    below_08: float


def episode(seed: int, follower: str, folder: Path) -> Found:
    """Drive the ramp with people alone, or with a follower's cars among them."""
    types = folder / "followers.add.xml"
    if follower:
        line = (
            f'<vType id="car" length="5" minGap="2.5" speedFactor="1" speedDev="0.1" {FOLLOWERS[follower]}/>'
        )
        types.write_text(f"<additional>{line}</additional>")
    command = ["sumo", "-c", RAMP, "--seed", seed, "--end", END, "--step-length", STEP]
    command += ["--no-step-log", "--no-warnings"]
    command += ["--time-to-teleport", -1, "--max-depart-delay", -1, "--collision.action", "warn"]
    command += ["--additional-files", types if follower else folder / "nothing.add.xml"]
    libsumo.start([str(word) for word in command])
    cars: set[str] = set()
    behind: dict[str, tuple[str, float]] = {}
    wanted = waiting = arrived = 0
    spent, followed, below_one, below_08 = 0.0, 0, 0, 0
    while (time := libsumo.simulation.getTime()) < END - STEP / 2:
        libsumo.simulationStep()
        for name in libsumo.simulation.getDepartedIDList():
            wanted += 1
            if follower and libsumo.vehicle.getTypeID(name) == "passenger" and chosen(name, seed):
                cars.add(name)
                libsumo.vehicle.setType(name, "car")
        waiting, driving = len(libsumo.simulation.getPendingVehicles()), libsumo.vehicle.getIDList()
        spent += STEP * (waiting + len(driving))
        arrived += libsumo.simulation.getArrivedNumber() if time >= FLOW_FROM else 0
        for name in cars.intersection(driving):
            leader, gap = libsumo.vehicle.getLeader(name, 100.0) or ("", 0.0)
            before, since = behind.get(name, ("", time))
            behind[name] = (leader, since if leader == before else time)
            speed = libsumo.vehicle.getSpeed(name)
            if leader and leader == before and time - since > 5.0 and speed > 1.0:
                headway = (gap + 2.5) / speed
                followed += 1
                below_one += headway < 1.0
                below_08 += headway < 0.8
    libsumo.close()
    flow = arrived * 3600.0 / (END - FLOW_FROM)
    return Found(spent / (wanted + waiting), flow, below_one / max(followed, 1), below_08 / max(followed, 1))


def chosen(name: str, seed: int) -> bool:
    """Say whether a car follows otherwise: the same ones for each follower."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:4], "big") < SHARE * 2**32


def main() -> None:
    """Drive all, paired, and write how they differ from people alone."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seeds", type=int, default=20)
    arguments.add_argument("--out", type=Path, default=Path(__file__).with_name("ramp-followers.json"))
    asked = arguments.parse_args()
    folder = Path("runs")
    folder.mkdir(exist_ok=True)
    (folder / "nothing.add.xml").write_text("<additional/>")
    people = [episode(seed, "", folder) for seed in range(asked.seeds)]
    rows = []
    for follower in FOLLOWERS:
        found = [episode(seed, follower, folder) for seed in range(asked.seeds)]
        pairs = list(zip(found, people, strict=True))
        rows.append({
            "follower": follower,
            "travel_time": asdict(estimate([one.travel_time - alone.travel_time for one, alone in pairs])),
            "flow": asdict(estimate([one.flow - alone.flow for one, alone in pairs])),
            "below_one": float(np.mean([one.below_one for one in found])),
            "below_08": float(np.mean([one.below_08 for one in found])),
        })  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    alone = {
        "travel_time": float(np.mean([one.travel_time for one in people])),
        "flow": float(np.mean([one.flow for one in people])),
    }
    write_whole(asked.out, to_json({"manifest": manifest(), "people": alone, "followers": rows}, indent=1))


if __name__ == "__main__":
    main()
