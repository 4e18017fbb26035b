"""What it is worth on the on-ramp when CAVs want other lanes than people do: the same people in SUMO.

A CAV's lanes are SUMO's, as people's are. Here its lane changes have other parameters (SUMO's LC2013); it
drives as `unjam:on-ramp-tuned`, 5 % CAVs, tuning seeds.
"""

import argparse
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

from unjam.controller import make_driver
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.statistics import estimate
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.scenarios.scenario import Actuation
from unjam.training.seeds import tuning_seeds
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.simulation import Simulation

ROAD = replace(ON_RAMP, cav_share=0.05)
FIRST = 20_010
"""of the tuning seeds"""
WISHES = {
    "keeps right five times as eagerly": {"lcKeepRight": 5.0},
    "does not keep right": {"lcKeepRight": 0.0},
    "overtakes five times as eagerly": {"lcSpeedGain": 5.0},
    "never overtakes": {"lcSpeedGain": 0.0},
    "makes room for nobody": {"lcCooperative": 0.0},
}


class OtherLanes(Simulation):
    """SUMO in which CAVs change lanes otherwise: a type that is given later changes nothing of that."""

    lane_changes: dict[str, float]

    def take_control(
        self, ids: Iterable[str], actuation: Actuation, right_of_way: bool = True, types: str = "cav"
    ) -> None:
        """Make `ids` CAVs, and tell each how it shall change lanes."""
        names = list(ids)
        super().take_control(names, actuation, right_of_way, types)
        for name in names:
            for key, value in self.lane_changes.items():
                self._sumo.vehicle.setParameter(name, f"laneChangeModel.{key}", str(value))


def main() -> None:
    """Drive all on the same seeds, and write how they differ."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seeds", type=int, default=40)
    arguments.add_argument("--out", type=Path, default=Path(__file__).with_name("on-ramp-lane-wishes.json"))
    asked = arguments.parse_args()
    driver = make_driver("unjam:on-ramp-tuned", ROAD.decision_step)
    found: dict[str, list[float]] = {}
    with OtherLanes() as simulation:
        for name, simulation.lane_changes in {"as people": dict[str, float](), **WISHES}.items():
            found[name] = [
                measure(run_episode(ROAD, driver, seed, simulation=simulation))["travel_time"]
                for seed in tuning_seeds(asked.seeds, FIRST)
            ]
            print(name, estimate(found[name]), flush=True)
    plain = found.pop("as people")
    beyond = {
        name: asdict(estimate([one - other for one, other in zip(times, plain, strict=True)]))
        for name, times in found.items()
    }
    document = {"manifest": manifest(), "plain": asdict(estimate(plain)), "beyond": beyond}
    write_whole(asked.out, to_json(document, indent=1))


if __name__ == "__main__":
    main()
