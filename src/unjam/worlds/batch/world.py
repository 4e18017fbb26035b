"""W whole rings as one world to drive in: vehicles times rings, stepped as arrays, free of the simulator.

Arrays have the vehicles of a ring along their first axis, in road order, and the rings along their second; a
row of the vehicles' speeds comes again at the end, so that who is ahead is a slice. CAVs' rows are ring after
ring of the first CAV, then of the second, and so on.
"""

from collections.abc import Callable, Collection, Sequence
from functools import reduce
from typing import cast

import numpy as np

from unjam.drivers.command import Command, accelerations_of_many
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Ahead, Cars
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array, at_least, at_most, namespace
from unjam.physics.kinematics import gap_on_loop, next_position, next_speed
from unjam.scenarios.ring import Loop
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.audit import MOVING_SPEED
from unjam.worlds.batch.begun import Begun
from unjam.worlds.batch.crossing import Memory
from unjam.worlds.batch.eight import beginnings, touching_across
from unjam.worlds.batch.lanes import CONTACT, Leader, touching
from unjam.worlds.batch.movement import EightMovement
from unjam.worlds.batch.noise import Numbers, SeededNoise, noise_of
from unjam.worlds.batch.people import People, parameters_of, people_speed, speed_on_ring
from unjam.worlds.batch.possible import check_together
from unjam.worlds.batch.record import RingLog, Rings, as_numpy
from unjam.worlds.batch.sensors import RingReadings
from unjam.worlds.closed import HISTORY
from unjam.worlds.reward import Outcome, make_reward, time_headway
from unjam.worlds.world import Driven, OnProgress


class RingBatch:
    """W closed roads of the same kind, each with a seed of its own; rings equal SUMO's, but for rounding.

    With noise that is drawn quickly people follow the car ahead and nobody else. SUMO's also look at the last
    car of the next lane, and no farther than they must: see `unjam.worlds.batch.lanes`.
    """

    single, kept = False, None
    asked: Collection[str] = ()
    """fields of a `LocalState` that the driver looks at: of those that are told, only these are"""
    begun: Sequence[Begun] = ()
    """each ring after its warm-up, where that was run before"""

    def __init__(
        self,
        scenarios: Sequence[Loop],
        seeds: Sequence[Sequence[int]],
        numbers: Numbers = np.asarray,
        reward: str = "",
        keep: bool = True,
        draw: Callable[[tuple[int, ...]], Array] | None = None,
        people: People | None = None,
        statistical: bool = False,
    ) -> None:
        """Put the vehicles on the roads; nothing moves yet.

        Args:
            scenarios: of each ring; they differ in their lengths alone.
            seeds: of each ring, as `run_episode` takes them.
            numbers: makes the arrays that are stepped, as NumPy's or torch's, in any precision.
            reward: name; empty: the scenario's own.
            keep: whether all is kept for episodes, some 16 bytes for each vehicle and step in float64.
            draw: of all noise, for arrays of a shape; None: each ring draws what SUMO's episode would.
            people: how they drive where no junction binds them, if it is not as SUMO's IDM does.
            statistical: whether roads are allowed that equal SUMO's in distribution alone.

        Raises:
            InputError: a scenario cannot be stepped so, or they are not alike.
        """
        check_together(scenarios, statistical)
        scenario = self.scenario = scenarios[0]
        drawn = [each.of_seed(seed) for each, seed in zip(scenarios, seeds, strict=True)]
        roads, seeded = [cast(ClosedRoad, road) for road, _ in drawn], [others for _, others in drawn]
        self._scenarios, self._seeds, self._keep, self._numbers = scenarios, seeds, keep, numbers
        self.roads, self._controlled = roads, False
        worlds, vehicles, cavs = len(roads), len(roads[0].vehicle_ids), len(roads[0].cav_ids)
        self.limits, self.decisions = scenario.limits, 0
        self.rows = self.entered = cavs * worlds
        places = np.array([roads[0].vehicle_ids.index(name) for name in roads[0].cav_ids])
        self._places, self._ahead, self._behind = (
            each.tolist() for each in (places, places + 1, (places - 1) % vehicles)
        )
        self._shape = cavs, worlds
        start = np.stack([road.start_positions for road in roads], 1)
        loops = np.array([road.loop_length for road in roads])
        self._loop = numbers(loops)
        self._loops = numbers(np.tile(loops, cavs))
        self._gap = numbers(gap_on_loop(start, np.roll(start, -1, 0), loops, VEHICLE_LENGTH))
        self._position = numbers(start)
        self._speed = numbers(np.zeros((vehicles + 1, worlds)))
        self._people, self._drives = parameters_of(roads, scenario.humans, numbers), people
        across = bool(roads[0].crossings)
        self._eight = EightMovement(scenario, roads, self._places, numbers, people) if across else None
        self._touching = touching_across if across else touching
        self._crossings = [numbers(np.tile(each, cavs)) for each in beginnings(roads)]
        step = scenario.simulation_step
        self._scale = numbers(np.full((vehicles, 1), scenario.noise_per_step * step))
        self._cars, self._brakes = Cars(scenario.safety, scenario.actuator, step), scenario.cav_brakes * step
        self._readings = RingReadings(scenario, roads[0].cav_ids, seeded, numbers)
        self._noise = noise_of(seeded, vehicles, (scenario.horizon, cavs), numbers, draw)
        self._reward, self._quick = make_reward(reward or scenario.reward), draw is not None
        self._forget()

    def _forget(self) -> None:
        """Begin the log and the sums anew."""
        self._log = RingLog(as_numpy(self._position), [self._speed[:-1]], self._touching)
        ring = self._loop * 0.0
        each_cav = self._loops.reshape(self._shape) * 0.0
        self._running, self._made = ring + 1.0, ring
        self._sums, self._driven, self._crashed = dict[str, Array](), ring, ring > 0.0
        self._headway, self._braking = each_cav + np.inf, each_cav

    def place(self, speeds: Array, positions: Array, waits: Sequence[Memory | None]) -> None:
        """Put vehicles elsewhere before the start [m/s, m], (vehicles, W), on eights with those who wait."""
        if self._eight:
            self._eight.remember(cast(Sequence[Memory], waits))
        self._speed = self._numbers(np.concatenate([speeds, speeds[:1]]))
        self._position = self._numbers(positions)
        gap = gap_on_loop(positions, np.roll(positions, -1, 0), as_numpy(self._loop), VEHICLE_LENGTH)
        self._gap = self._numbers(gap)
        self._forget()

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> LocalState | None:
        """Run the warm-up, unless it is `begun`; then hand the CAVs over, or they stay human.

        Returns:
            What the CAVs perceived in the last minute of the warm-up at the times of decisions, NumPy arrays
            of shape (CAVs * W, moments), oldest first; None without a warm-up that may be remembered.
        """
        seen = self._go_on(self.begun) if self.begun else self._warm_up()
        if bool(self._crashed.any()):
            raise EpisodeError("collision in the all-human warm-up of a ring")
        self._controlled = controlled
        if controlled:
            self._scale[self._places] = 0.0
            self._noise.begin_anew()
            if self._eight:
                self._eight.hand_over()
        self._forget()
        return seen

    def _warm_up(self) -> LocalState | None:
        """Let people drive as long as the scenario says, and return what `start` does."""
        scenario, seen = self.scenario, list[LocalState]()
        each, longest = scenario.steps_per_decision, round(HISTORY / scenario.decision_step)
        for step in range(scenario.warmup):
            left = scenario.warmup - step
            if left % each == 0 and left // each <= longest:
                seen.append(self._state().each(as_numpy))
            self._simulate(None)
        if not seen or not scenario.recall_warmup:
            return None
        return seen[0].each(lambda *values: np.stack(values, 1), *seen[1:])

    def warmed_up(self) -> list[Begun]:
        """Run the warm-up, and return each ring after it; with arrays of NumPy, and noise as SUMO's."""
        seen, states = self._warm_up(), cast(SeededNoise, self._noise).states()
        by_ring = seen and seen.each(lambda values: values.reshape(*self._shape, -1).swapaxes(0, 1).copy())
        speed, position, gap = (values.T.copy() for values in (self._speed, self._position, self._gap))
        found = []
        for ring, noise in enumerate(states):
            crashed, remembered = bool(self._crashed[ring]), by_ring and by_ring.at(ring)
            waits = self._eight and Memory(*(as_numpy(each)[:, ring] for each in self._eight.memory))
            found.append(Begun(speed[ring], position[ring], gap[ring], crashed, noise, remembered, waits))
        return found

    def _go_on(self, begun: Sequence[Begun]) -> LocalState | None:
        """Go on where rings had begun, and return what `start` does."""
        speeds, positions, gaps, crashed, noise, seen, waits = zip(*begun, strict=True)
        self._speed, self._position, self._gap, self._crashed = (
            self._numbers(np.stack(each, -1)) for each in (speeds, positions, gaps, crashed)
        )
        cast(SeededNoise, self._noise).go_on(noise)
        if self._eight:
            self._eight.remember(waits)
        if seen[0] is None:
            return None
        return seen[0].each(lambda *values: np.stack(values, 1).reshape(self.rows, -1), *seen[1:])

    @property
    def ended(self) -> bool:
        """Whether the horizon is reached; a ring on which vehicles collided goes on, and counts no more."""
        return self.decisions >= self.scenario.horizon

    def perceive(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs * W,)."""
        state = self._state()  # of which some is the world's own
        state = state.read_only() if isinstance(state.speed, np.ndarray) else state
        return self._readings.of_drivers(self.decisions, state)

    def _state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        speed, gap = self._speed, self._gap
        share, place = self.roads[0].share_told(self.asked), self._rows_at(self._position, self._places)
        ways = [(start - place) % self._loops for start in self._crossings]
        return LocalState(
            *self._followed(),
            self._rows_at(speed, self._behind),
            self._rows_at(gap, self._behind),
            place % self._loops,
            self._loops,
            to_crossing=reduce(namespace(place).minimum, ways) if ways else None,
            cav_share=None if share is None else self._loops * 0.0 + share,
        )

    def _followed(self) -> Ahead:
        """Return what exact sensors would tell the CAVs' filters."""
        speed, own = self._speed, self._places
        return Ahead(
            self._rows_at(speed, own), self._rows_at(speed, self._ahead), self._rows_at(self._gap, own)
        )

    def _rows_at(self, values: Array, places: list[int]) -> Array:
        """Return what is at some places, ring after ring of each, shape (CAVs * W,)."""
        return values[places[0]] if len(places) == 1 else values[places].reshape(-1)

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its simulation steps; None: the CAVs stay human."""
        each, before = self.scenario.steps_per_decision, self._rows_at(self._speed, self._places)
        told_all = self.limits, self.rows, self.decisions
        wanted = accelerations_of_many(command, *told_all) if self._controlled else None
        log = self._log
        if wanted is not None and self._keep:
            log.wanted.append(wanted)
        told = [self._simulate(wanted) for _ in range(each)]
        self.decisions += 1
        after, _, gap = self._followed()
        applied: Array = (
            sum(told) / each if told[0] is not None else (after - before) / self.scenario.decision_step
        )
        outcome = Outcome(
            speeds=self._speed[:-1].T,
            accelerations=applied.reshape(self._shape).T,
            headways=time_headway(gap, after).reshape(self._shape).T,
            crashed=self._crashed,
            waiting=self._running * 0.0,
        )
        for name, term in self._reward(outcome).items():
            self._sums[name] = self._sums.get(name, 0.0) + term * self._running
        self._made = self._made + self._running
        self._driven = self._driven + outcome.speeds.mean(-1) * self._running
        self._running = self._running * ~self._crashed

    def _people_speed(self, speed: Array, ahead: Leader) -> Array:
        """Return the speeds after this step of all vehicles, if people drive them, shape (vehicles, W)."""
        people, step = self._people, self.scenario.simulation_step
        if self._drives is not None:
            return self._drives(speed, *ahead)
        if self._quick:
            return people_speed(speed, *ahead, people, step)
        return speed_on_ring(speed, self._position, ahead, self._loop, people, step)

    def _simulate(self, wanted: Array | None) -> Array:
        """Simulate one step, and return what CAVs were told; None: they are human."""
        step, speed = self.scenario.simulation_step, self._speed
        cavs, told, commanded = self._followed(), None, None
        if wanted is not None:
            told, done = self._cars.carry_out("all", wanted, self._readings.of_filters(cavs))
            commanded = next_speed(cavs.speed, done, step)
            if self._keep:
                self._log.told.append(told)
                self._log.commanded.append(commanded)
        moved, speeds = self._moved(speed[:-1], Leader(speed[1:], self._gap), commanded)
        xp = namespace(moved)
        ahead = xp.concatenate([moved[1:], moved[:1]])
        self._gap = self._gap + (ahead - moved) * step
        self._position = next_position(self._position, moved, step)
        if self._eight or bool((self._gap < CONTACT).any()):
            self._crashed = self._crashed | self._touching(self._position, self._gap, self._loop).any(0)
        self._speed = xp.concatenate([speeds, speeds[:1]])
        if self._keep:
            self._log.moved.append(moved)
            self._log.speeds.append(speeds)
        self._sum_up(cavs)
        return told

    def _moved(self, speed: Array, ahead: Leader, commanded: Array | None) -> tuple[Array, Array]:
        """Return the speeds with which all move in this step, and those after it, (vehicles, W) each."""
        told = None if commanded is None else commanded.reshape(self._shape)
        if self._eight:
            noise = self._noise.of_people() * self._scale if self.scenario.noise > 0 else 0.0
            return (self._eight.moved(speed, self._position, ahead, noise, told),) * 2
        moved = self._people_speed(speed, ahead)
        if told is not None:
            slowest = speed[self._places] - self._brakes
            moved[self._places] = at_most(at_least(told, slowest), self.scenario.top_speed)
        if self.scenario.noise > 0:
            return moved, at_least(moved + self._noise.of_people() * self._scale, 0.0)
        return moved, moved

    def _sum_up(self, before: Ahead) -> None:
        """Note how the CAVs follow at the beginning of a step, and how hard they brake in it."""
        braking = (before.speed - self._rows_at(self._speed, self._places)) / self.scenario.simulation_step
        counted = braking.reshape(self._shape) * self._running
        self._braking = namespace(counted).maximum(self._braking, counted)
        self._headway = self._with_headway(before)

    def _with_headway(self, cavs: Ahead) -> Array:
        """Return the smallest headways with those at a moment, shape (CAVs, W)."""
        speed, gap = (each.reshape(self._shape) for each in (cavs.speed, cavs.gap))
        xp, counts = namespace(speed), (speed > MOVING_SPEED) * (self._running > 0)
        return xp.where(counts, xp.minimum(self._headway, gap / at_least(speed, MOVING_SPEED)), self._headway)

    def noise(self, lasting: int = 0) -> Array:
        """Return standard normal noise of this decision, shape (CAVs * W,), or what lasts."""
        return self._noise.lasting(lasting) if lasting else self._noise.of_networks(self.decisions)

    def record(self, driven: Driven) -> Rings:
        """Return what happened since the start."""
        headway, share = self._with_headway(self._followed()), self.roads[0].share_told(self.asked)
        made, crashed = as_numpy(self._made), 1.0 - as_numpy(self._running)
        kept = self._scenarios, self.roads, self._seeds, made, crashed
        return Rings(
            decisions=made,
            crashed=crashed,
            terms={name: as_numpy(total) for name, total in self._sums.items()},
            mean_speed=as_numpy(self._driven) / made,
            headway=as_numpy(headway).min(0),
            braking=as_numpy(self._braking).max(0),
            episodes=self._log.episodes(*kept, driven, share) if self._keep else (),
        )
