"""Which expert is worth tuning for all roads at once? Each as it is, on the roads that are seen.

    python results/tried/every_expert.py FILE.json

Mean gain as `unjam tune everywhere` has it, of which 1 is a road without waves or delay, on the two tuning
seeds of each road that its settings meet there. Who needs a closed road is left out.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np

from unjam.drivers.registry import DRIVERS
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.gain import ceiling, gain
from unjam.measures.statistics import Estimate
from unjam.measures.table import PEOPLE
from unjam.studies.everywhere import driven, kept_of
from unjam.training.family import roads_of
from unjam.training.seeds import tuning_seeds
from unjam.training.tune import OF_EACH
from unjam.worlds.workers import Workers


def main() -> None:
    """Drive them, and write what each gains, road by road."""
    experts = [name for name, kind in DRIVERS.items() if not (kind.native or kind.needs_loop)]
    found: dict[str, dict[str, Estimate]] = {name: {} for name in experts}
    with Workers(2) as workers:
        run = partial(workers.run_each, keep=kept_of)
        for road, scenario in roads_of("everywhere", "seen").items():
            rows = driven(scenario, {name: name for name in (PEOPLE, *experts)}, tuning_seeds(OF_EACH), run)
            best = [ceiling(row) for row in rows[PEOPLE]]
            for name in experts:
                found[name][road] = gain(rows[name], rows[PEOPLE], best)
            print(road, {name: round(of[road].mean, 2) for name, of in found.items()}, flush=True)
    mean = {name: float(np.mean([each.mean for each in gains.values()])) for name, gains in found.items()}
    gains = {name: {road: each.mean for road, each in of.items()} for name, of in found.items()}
    write_whole(Path(sys.argv[1]), to_json({"manifest": manifest(), "mean": mean, "gains": gains}, indent=1))


if __name__ == "__main__":
    main()
