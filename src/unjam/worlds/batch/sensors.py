"""What the CAVs of many rings sense: each ring's misread what those of SUMO's episode of its seed do."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Ahead
from unjam.drivers.sensors import Readings
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.noise import Numbers
from unjam.worlds.batch.record import as_numpy


class RingReadings:
    """Readings of W rings: each has generators of its own, which are asked as SUMO's worlds ask theirs."""

    def __init__(
        self,
        scenario: Scenario,
        names: Sequence[str],
        seeds: Sequence[Sequence[np.random.SeedSequence]],
        numbers: Numbers,
    ) -> None:
        """Take the names of a ring's CAVs, and the seeds of each ring, of `Scenario.of_seed`."""
        sensors, braking = scenario.sensors, scenario.safety.leader_braking
        self._rings = [
            Readings(sensors, braking, scenario.simulation_step, sensed)
            for *_, sensed in (() if sensors.exact else seeds)
        ]
        self._names, self._numbers, self._shape = names, numbers, (len(names), len(seeds))
        self._perceived: tuple[int, LocalState] | None = None

    def of_drivers(self, decision: int, state: LocalState) -> LocalState:
        """Return what drivers perceive where `state` is true, the same however often a decision asks."""
        if not self._rings:
            return state
        if self._perceived is None or self._perceived[0] != decision:
            true = state.each(lambda values: as_numpy(values).reshape(self._shape))
            first, *others = (
                readings.of_driver(self._names, true.at(np.s_[:, ring]))
                for ring, readings in enumerate(self._rings)
            )
            read = first.each(lambda *values: self._numbers(np.stack(values, 1).reshape(-1)), *others)
            self._perceived = decision, read
        return self._perceived[1]

    def of_filters(self, true: Ahead) -> Ahead:
        """Return what filters may rely on where `true` is so, once in each simulation step."""
        if not self._rings:
            return true
        cars = product(self._names, self._rings)
        rows = np.stack([as_numpy(values) for values in true], 1).tolist()
        read = [ring.of_filter(name, Ahead(*row)) for (name, ring), row in zip(cars, rows, strict=True)]
        return Ahead(*self._numbers(np.array(read).T))
