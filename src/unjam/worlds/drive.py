"""Driving: the one loop in which a driver and a world meet; and an episode, a pure function of its seed."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from unjam.drivers.driver import Decision, Driver, Memory, carried, single_row
from unjam.drivers.residual import EXPERT
from unjam.errors import InputError
from unjam.scenarios.scenario import Scenario
from unjam.tree import mapped
from unjam.worlds.record import Episode, Floats, outcome_of
from unjam.worlds.reward import Reward, make_reward
from unjam.worlds.sumo import make_traffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.world import Driven, OnProgress, Recorded, World

PROGRESS_STEPS = 10
"""decisions between two reports of progress"""


class Drive:
    """A driver in a world, decision by decision: iterate over it."""

    def __init__(
        self,
        world: World[Recorded],
        driver: Driver,
        explore: bool = False,
        memory: Memory | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Start the world; nothing is decided yet.

        Args:
            world: where.
            driver: of every CAV.
            explore: whether what was learned adds its exploration noise.
            memory: what the driver remembers already; None: nothing but what the world began with.
            on_progress: called now and then with the number of decisions made.
        """
        self.world, self.driver, self._on_progress = world, driver, on_progress
        self._noise = world.noise if explore else None
        history = world.start(not driver.native, on_progress)
        self.memory = driver.initial_memory(world.rows) if memory is None else memory
        if history is not None:
            self.memory = driver.recall(self.memory, history)
        self.memories: list[Memory] = []
        """of each CAV by itself before its first decision, in order of entry"""
        self._note_newcomers()
        if world.single:
            self.memory = single_row(self.memory)

    def __iter__(self) -> Iterator[Decision | None]:
        """Yield each decision once it is carried out; None where the simulator itself drives."""
        world, driver, noise, made = self.world, self.driver, self._noise, 0
        perceive, decide, advance = world.perceive, driver.decide, world.advance
        while not world.ended:
            if driver.native:
                decision = None
                advance(None)
            else:
                decision = decide(perceive(), self.memory, noise)
                self.memory = decision.memory
                advance(decision.command)
            self._carry()
            made += 1
            if self._on_progress is not None and made % PROGRESS_STEPS == 0:
                self._on_progress(made)
            yield decision

    def _carry(self) -> None:
        """Give each CAV that is on the road now a row of memory, newcomers at the end."""
        kept, entered = self.world.kept, self.world.entered
        if kept is not None:
            new = self.world.rows - len(kept)
            fresh = self.driver.initial_memory(entered) if new else {}
            self.memory = carried(self.memory, kept, fresh, new)
        if entered > len(self.memories):
            self._note_newcomers()

    def _note_newcomers(self) -> None:
        """Add the memory of each CAV that has just entered: the last rows."""
        rows = self.world.rows
        for row in range(rows - self.world.entered + len(self.memories), rows):
            self.memories.append(mapped(lambda values: np.array(values[row], np.float64), self.memory))  # noqa: B023


def drive(
    world: World[Recorded],
    driver: Driver,
    explore: bool = False,
    memory: Memory | None = None,
    on_progress: OnProgress | None = None,
) -> Recorded:
    """Drive to the end, and return the world's record of it; arguments as `Drive` takes them."""
    driving = Drive(world, driver, explore, memory, on_progress)
    decisions = [
        decision[1:4] for decision in driving if decision is not None and decision.observation is not None
    ]
    last = driver.observation(world.perceive(), driving.memory) if decisions else None
    if last is None:
        return world.record(Driven())
    memories = [each[EXPERT] for each in driving.memories]
    return world.record(Driven(decisions, last, memories, driver.hold))


def run_episode(
    scenario: Scenario,
    driver: Driver,
    seed: Sequence[int],
    reward: str = "",
    explore: bool = False,
    full: bool = False,
    simulation: Simulation | None = None,
    progress: OnProgress | None = None,
) -> Episode:
    """Run one episode and return all of it.

    The result depends on scenario, driver, seed, reward and `explore` alone: not on the process, on what
    ran in it before, or on the clock.

    Args:
        scenario: road, traffic and horizon.
        driver: of every CAV.
        seed: integers; everything random comes from them.
        reward: name, or `path.py:name`; empty: the scenario's own.
        explore: whether a residual driver adds its exploration noise.
        full: whether fuel is recorded and, on roads with ends, where on the plane vehicles are (it costs a
            tenth of the speed).
        simulation: an open one to use again; without it, one is opened and closed.
        progress: called now and then with the number of decisions made.

    Raises:
        InputError: driver or reward answer something that is not finite, or of a wrong shape.
        EpisodeError: SUMO cannot run the scenario.
    """
    if not can_drive(driver, scenario):
        raise InputError(f"driver: it is not allowed on {scenario.title}: it needs a closed road")
    earned = make_reward(reward or scenario.reward)
    if simulation is None:
        with Simulation() as simulation:
            return run_episode(scenario, driver, seed, reward, explore, full, simulation, progress)
    traffic = make_traffic(scenario, seed, simulation, driver.plain_numbers, full)
    episode = drive(traffic, driver, explore, on_progress=progress)
    if traffic.entered == 0 and not driver.native:
        raise InputError(f"no CAV was on the road in {episode.steps} decisions: let more vehicles be CAVs")
    return rewarded(episode, earned)


def can_drive(driver: Driver, scenario: Scenario) -> bool:
    """Return whether a driver can drive a scenario: some need a loop."""
    return scenario.closed or not driver.needs_loop


def rewarded(episode: Episode, reward: Reward) -> Episode:
    """Return an episode with what was earned in it; raise `InputError` where a term is not finite."""
    # Columns one behind the other: sums over vehicles are rounded in the order of memory.
    speeds = np.asfortranarray(episode.speeds)
    outcome = outcome_of(speeds, episode.trajectories, episode.status == "collision")
    terms = _checked(reward(outcome), episode.steps)
    trajectories = tuple(
        replace(each, terms={name: values[each.during] for name, values in terms.items()})
        for each in episode.trajectories
    )
    return replace(episode, terms=terms, trajectories=trajectories)


def _checked(terms: dict[str, Floats], rows: int) -> dict[str, Floats]:
    """Return the reward's terms; raise `InputError` unless each is finite and has a value per decision."""
    for name, values in terms.items():
        if np.shape(values) != (rows,):
            raise InputError(f"reward: term {name!r} has shape {np.shape(values)}; allowed: ({rows},)")
        if not np.isfinite(values).all():
            step = int(np.argmax(~np.isfinite(values)))
            raise InputError(f"reward: step {step}: term {name!r} is {values[step]}; allowed: finite")
    return {name: np.asarray(values, np.float64) for name, values in terms.items()}
