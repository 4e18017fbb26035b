"""An episode is a pure function: `run_episode(scenario, driver, seed) -> Episode`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from unjam.drivers.driver import Driver, Memory, single_row
from unjam.drivers.local_state import LocalState
from unjam.drivers.residual import ResidualDriver
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.scenario import Scenario
from unjam.traffic.record import Episode, Floats, Trajectory
from unjam.traffic.reward import Outcome, Reward, make_reward, time_headway
from unjam.traffic.simulation import Simulation
from unjam.traffic.stepping import Traffic

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
    record_fuel: bool = False,
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
        record_fuel: whether fuel is recorded (it costs a tenth of the speed).
        simulation: an open one to use again; without it, one is opened and closed.
        progress: called now and then with the number of decisions made.

    Raises:
        InputError: driver or reward answer something that is not finite, or of a wrong shape.
        EpisodeError: SUMO cannot run the scenario.
    """
    earned = make_reward(reward or scenario.reward)
    if simulation is None:
        with Simulation() as simulation:
            return run_episode(scenario, driver, seed, reward, explore, record_fuel, simulation, progress)
    traffic = Traffic(scenario, seed, simulation, driver.plain_numbers, record_fuel)
    return _episode(traffic, seed, earned, drive_traffic(traffic, driver, explore, progress))


@dataclass(frozen=True)
class ResidualLog:
    """What a residual driver decided in an episode."""

    decisions: list[tuple[Array, Array, Array, Array]]
    """each `Decision` but its memory, which is large"""
    last_observation: Array
    memory: Memory
    """of the expert before the first decision, a row per CAV"""
    hold: int


def drive_traffic(
    traffic: Traffic, driver: Driver, explore: bool, progress: Progress | None = None
) -> ResidualLog | None:
    """Drive to the end; return what a residual driver decided, None of any other."""
    history = traffic.start(controlled=not driver.native, progress=progress)
    memory = driver.initial_memory(len(traffic.road.cav_ids))
    if history is not None and traffic.scenario.recall_warmup:
        memory = driver.recall(memory, history)
    residual = driver if isinstance(driver, ResidualDriver) else None
    remembered = {} if residual is None else residual.expert_memory(memory)
    if traffic.single:
        memory = single_row(memory)
    noise = traffic.exploration_noise() if explore else [None] * traffic.scenario.horizon
    decisions = []
    for step in range(1, traffic.scenario.horizon + 1):
        if residual is not None:
            decision = residual.decide(traffic.local_state(), memory, noise[step - 1])
            memory = decision.memory
            decisions.append(decision[:-1])
            traffic.advance(decision.acceleration)
        elif driver.native:
            traffic.advance(None)
        else:
            acceleration, memory = driver.act(traffic.local_state(), memory)
            traffic.advance(acceleration)
        if progress is not None and step % PROGRESS_STEPS == 0:
            progress(step)
        if traffic.crashed:
            break
    if residual is None:
        return None
    last = residual.observation(traffic.local_state(), memory)
    return ResidualLog(decisions, last, remembered, residual.hold)


def _episode(traffic: Traffic, seed: Sequence[int], reward: Reward, log: ResidualLog | None) -> Episode:
    """Put the record of finished traffic in order."""
    road = traffic.road
    each = traffic.scenario.steps_per_decision
    speeds, positions = (values[:, ::each] for values in traffic.speeds_and_positions())
    states = traffic.states(speeds, positions, np.arange(len(road.vehicle_ids)))
    return Episode(
        seed=tuple(seed),
        status="collision" if traffic.crashed else "completed",
        step=traffic.scenario.decision_step,
        warmup=traffic.scenario.warmup,
        drawn=road.drawn,
        loop_length=road.loop_length,
        crossings=road.crossings,
        limit_speed=road.limit_speed,
        vehicle_ids=road.vehicle_ids,
        cav_ids=road.cav_ids,
        collisions=traffic.collisions,
        speeds=np.ascontiguousarray(speeds.T),
        positions=np.ascontiguousarray(positions.T),
        gaps=np.ascontiguousarray(states.leader_gap.T),
        fuel=np.array(traffic.log_fuel) if traffic.log_fuel else np.zeros((0, 0)),
        outline=road.outline,
        trajectories=_trajectories(traffic, states, reward, log),
    )


def _trajectories(
    traffic: Traffic, states: LocalState, reward: Reward, log: ResidualLog | None
) -> tuple[Trajectory, ...]:
    """Return the trajectory of each CAV; `states` are those of all vehicles, shape (vehicles, T + 1)."""
    road = traffic.road
    places = [road.vehicle_ids.index(name) for name in road.cav_ids]
    applied, shield = traffic.applied(), traffic.shield()
    steps, cavs = applied.shape
    crashed = np.zeros(steps, bool)
    crashed[-1] = traffic.crashed
    headways = time_headway(states.leader_gap[places, 1:], states.speed[places, 1:]).T
    terms = _checked(reward(Outcome(states.speed[:, 1:].T, applied, headways, crashed)), steps)
    expert, residual = applied, np.zeros_like(applied)
    observations, memory, hold = np.zeros((1, cavs, 0)), {}, 1
    if log is not None:
        memory, hold = log.memory, log.hold
        _, experts, residuals, seen = zip(*log.decisions, strict=True)
        expert = np.array(experts).reshape(steps, cavs)
        residual = np.array(residuals).reshape(steps, cavs)
        looks = [*seen[::hold], log.last_observation]
        observations = np.array(looks).reshape(len(looks), cavs, -1)
    return tuple(
        Trajectory(
            vehicle=name,
            start=0,
            states=LocalState(*(np.ascontiguousarray(values[place]) for values in states)),
            observations=np.ascontiguousarray(observations[:, row]),
            expert=np.ascontiguousarray(expert[:, row]),
            residual=np.ascontiguousarray(residual[:, row]),
            applied=np.ascontiguousarray(applied[:, row]),
            shield=np.ascontiguousarray(shield[:, row]),
            terms=terms,
            memory={name: np.array(values[row], np.float64) for name, values in memory.items()},
            hold=hold,
            terminated=traffic.crashed,
        )
        for row, (name, place) in enumerate(zip(road.cav_ids, places, strict=True))
    )


def _checked(terms: dict[str, Floats], rows: int) -> dict[str, Floats]:
    """Return the reward's terms; raise `InputError` unless each is finite and has a value per decision."""
    for name, values in terms.items():
        if np.shape(values) != (rows,):
            raise InputError(f"reward: term {name!r} has shape {np.shape(values)}; allowed: ({rows},)")
        if not np.isfinite(values).all():
            step = int(np.argmax(~np.isfinite(values)))
            raise InputError(f"reward: step {step}: term {name!r} is {values[step]}; allowed: finite")
    return {name: np.asarray(values, np.float64) for name, values in terms.items()}
