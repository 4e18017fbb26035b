"""An episode is a pure function: `run_episode(scenario, driver, seed) -> Episode`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np

from unjam.drivers.driver import Driver, Memory, single_row
from unjam.drivers.residual import ResidualDriver
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode, Floats, Trajectory, outcome_of
from unjam.worlds.reward import Reward, make_reward
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.stepping import make_traffic
from unjam.worlds.sumo.traffic import Stay, Traffic, TrafficLog

PROGRESS_STEPS = 10
"""decisions between two reports of progress"""

Progress = Callable[[int], None]
"""told now and then how many decisions have been made"""


def run_episode(
    scenario: Scenario,
    driver: Driver,
    seed: Sequence[int],
    reward: str = "",
    explore: bool = False,
    full: bool = False,
    simulation: Simulation | None = None,
    progress: Progress | None = None,
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
    log = drive_traffic(traffic, driver, explore, progress)
    if traffic.entered == 0 and not driver.native:
        raise InputError(
            f"no CAV was on the road in {traffic.decisions} decisions: let more vehicles be CAVs"
        )
    return _episode(traffic, seed, earned, log)


def can_drive(driver: Driver, scenario: Scenario) -> bool:
    """Return whether a driver can drive a scenario: some need a loop."""
    return scenario.closed or not driver.needs_loop


@dataclass(frozen=True)
class ResidualLog:
    """What a residual driver decided in an episode."""

    decisions: list[tuple[Array, Array, Array, Array]]
    """each `Decision` but its memory, which is large"""
    last_observation: Array
    memories: list[Memory]
    """before the first decision, of each CAV by itself, in order of entry"""
    hold: int


def drive_traffic(
    traffic: Traffic, driver: Driver, explore: bool, progress: Progress | None = None
) -> ResidualLog | None:
    """Drive to the end; return what a residual driver decided, None of any other."""
    history = traffic.start(controlled=not driver.native, progress=progress)
    memory = driver.initial_memory(len(traffic.cavs))
    if history is not None and traffic.scenario.recall_warmup:
        memory = driver.recall(memory, history)
    residual = driver if isinstance(driver, ResidualDriver) else None
    memories: list[Memory] = []
    _note_newcomers(memories, memory, traffic)
    if traffic.single:
        memory = single_row(memory)
    noise = traffic.exploration_noise() if explore else repeat(None)
    decisions = []
    for step in range(1, traffic.scenario.horizon + 1):
        if residual is not None:
            decision = residual.decide(traffic.local_state(), memory, next(noise))
            memory = decision.memory
            decisions.append(decision[:-1])
            traffic.advance(decision.acceleration)
        elif driver.native:
            traffic.advance(None)
        else:
            acceleration, memory = driver.act(traffic.local_state(), memory)
            traffic.advance(acceleration)
        memory = traffic.carry(memory, driver)
        if traffic.entered > len(memories):
            _note_newcomers(memories, memory, traffic)
        if progress is not None and step % PROGRESS_STEPS == 0:
            progress(step)
        if traffic.crashed or traffic.over:
            break
    if residual is None:
        return None
    last = residual.observation(traffic.local_state(), memory)
    return ResidualLog(decisions, last, list(map(residual.expert_memory, memories)), residual.hold)


def _note_newcomers(memories: list[Memory], memory: Memory, traffic: Traffic) -> None:
    """Add the memory of each CAV that has just entered: the last rows of `memory`."""
    count = len(traffic.cavs)
    for row in range(count - traffic.entered + len(memories), count):
        memories.append({name: np.array(values[row], np.float64) for name, values in memory.items()})


def _episode(traffic: Traffic, seed: Sequence[int], reward: Reward, log: ResidualLog | None) -> Episode:
    """Put the record of finished traffic in order."""
    found = traffic.log()
    outcome = outcome_of(found.speeds.T, found.stays, traffic.crashed)
    terms = _checked(reward(outcome), traffic.decisions)
    return Episode(
        seed=tuple(seed),
        status="collision" if traffic.crashed else "completed",
        step=traffic.scenario.decision_step,
        warmup=traffic.scenario.warmup,
        drawn=traffic.road.drawn,
        vehicle_ids=found.vehicle_ids,
        cav_ids=found.cav_ids,
        collisions=traffic.collisions,
        speeds=np.ascontiguousarray(found.speeds.T),
        positions=np.ascontiguousarray(found.positions.T),
        gaps=np.ascontiguousarray(found.gaps.T),
        fuel=found.fuel,
        terms=terms,
        trajectories=_trajectories(traffic, found, terms, log),
        **found.pictured,
    )


def _trajectories(
    traffic: Traffic, found: TrafficLog, terms: dict[str, Floats], log: ResidualLog | None
) -> tuple[Trajectory, ...]:
    """Return the trajectory of each stay."""
    trajectories = []
    for stay in found.stays:
        during = slice(stay.start, stay.start + len(stay.applied))
        decided = {
            "observations": np.zeros((1, 0)),
            "expert": stay.applied,
            "residual": np.zeros_like(stay.applied),
            "memory": {},
            "hold": 1,
        }
        if log is not None:
            decided = _decided(log, stay, traffic.single)
        trajectories.append(
            Trajectory(
                vehicle=stay.vehicle,
                start=stay.start,
                states=stay.states,
                applied=stay.applied,
                shield=stay.shield,
                terms={name: values[during] for name, values in terms.items()},
                terminated=traffic.crashed and during.stop == traffic.decisions,
                **decided,
            )
        )
    return tuple(trajectories)


def _decided(log: ResidualLog, stay: Stay, single: bool) -> dict[str, Any]:
    """Return what a residual driver decided during a stay, as entries of its trajectory."""
    steps = range(stay.start, stay.start + len(stay.applied))
    seen = [decision[3] for decision in log.decisions] + [log.last_observation]
    looks = [*steps[:: log.hold], steps.stop]
    if single:
        experts, residuals = (np.array([decision[part] for decision in log.decisions]) for part in (1, 2))
        observations = [seen[step] for step in looks]
    else:
        experts, residuals = (
            np.array([log.decisions[step][part][row] for step, row in zip(steps, stay.rows, strict=False)])
            for part in (1, 2)
        )
        observations = [seen[step][stay.rows[step - stay.start]] for step in looks]
    return {
        "observations": np.array(observations, np.float64).reshape(len(looks), -1),
        "expert": experts,
        "residual": residuals,
        "memory": log.memories[stay.number],
        "hold": log.hold,
    }


def _checked(terms: dict[str, Floats], rows: int) -> dict[str, Floats]:
    """Return the reward's terms; raise `InputError` unless each is finite and has a value per decision."""
    for name, values in terms.items():
        if np.shape(values) != (rows,):
            raise InputError(f"reward: term {name!r} has shape {np.shape(values)}; allowed: ({rows},)")
        if not np.isfinite(values).all():
            step = int(np.argmax(~np.isfinite(values)))
            raise InputError(f"reward: step {step}: term {name!r} is {values[step]}; allowed: finite")
    return {name: np.asarray(values, np.float64) for name, values in terms.items()}
