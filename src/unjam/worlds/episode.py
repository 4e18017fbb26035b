"""An episode is a pure function: `run_episode(scenario, driver, seed) -> Episode`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import index
from typing import SupportsIndex

import numpy as np

from unjam.drivers.driver import Driver
from unjam.drivers.observation import feature
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import EpisodeError, InputError, NoCavError, SumoInputError, UnjamError, as_unjam_error, invalid_value
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import UserNetwork
from unjam.worlds.drive import drive_world
from unjam.worlds.episode_reward import episode_reward_terms
from unjam.worlds.record import Episode
from unjam.worlds.reward import Reward, make_reward
from unjam.worlds.sumo import make_traffic
from unjam.worlds.sumo.sandboxed import open_simulation
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.world import ProgressCallback


@dataclass(frozen=True)
class Task:
    """One road of a training; a training takes a list of them, and one road is a list of one."""

    scenario: Scenario
    expert: Driver
    """who drives before anything is learned, and whom the residual is added to"""
    reward: str = ""
    """name, or `path.py:name`; empty: the scenario's own"""
    weight: float = 1.0
    """share of the actual steps, beside the weights of the other tasks"""
    name: str = ""
    """in progress, tables and folders; empty where there is one task alone"""


def run_episode(
    scenario: Scenario,
    driver: DriverLike,
    seed: SupportsIndex | Sequence[int],
    reward: str = "",
    explore: float = 0.0,
    record_details: bool = False,
    simulation: Simulation | None = None,
    on_progress: ProgressCallback | None = None,
    stop_at_contact: bool = True,
) -> Episode:
    """Run one episode and return all of it.

    The result depends on scenario, driver, seed, reward, `explore` and `stop_at_contact` alone: not on the
    process, on what ran in it before, or on the clock.

    Args:
        scenario: road, traffic and horizon.
        driver: of every CAV: a driver, anything with `act` and `initial_memory`, or a function of the state.
        seed: an integer or several; everything random comes from them.
        reward: name, or `path.py:name`; empty: the scenario's own.
        explore: by how much a residual driver's exploration noise counts: 1, -1 for the opposite, or 0.
        full: whether fuel is recorded and, on roads with ends, where on the plane vehicles are (it costs a
            tenth of the speed).
        simulation: an open one to use again; without it, one is opened and closed. It runs in a process of
            its own on a network of your own, which may neither write nor listen, and, with a warning, where
            libsumo already holds a simulation in this process, yours or unjam's.
        progress: called now and then with the number of decisions made.
        stop_at_contact: whether contact of a CAV ends an episode on a network of your own, as in training.
            Otherwise the traffic goes on as plain SUMO's would, and the contact is recorded.

    Raises:
        InputError: driver or reward answer something that is not finite, or of a wrong shape.
        RefusedError: SUMO refuses files or options, at once or when it comes to them.
        EpisodeError: SUMO cannot run the scenario for another reason, or other code in this process has
            started, stepped or closed a simulation through libsumo meanwhile (`LostWorkerError`).
        UnjamError: another episode runs in `simulation`.
    """
    driver, seed = as_driver(driver), as_seed(seed)
    check_can_drive(driver, scenario)
    paid = make_reward(reward or scenario.reward)
    if simulation is None:
        with open_simulation(scenario) as simulation:
            how = (reward, explore, record_details, simulation, on_progress, stop_at_contact)
            return run_episode(scenario, driver, seed, *how)
    if not simulation.episode_lock.acquire(blocking=False):
        raise UnjamError("simulation: an episode is running in it; allowed: one at a time")
    try:
        traffic = make_traffic(
            scenario, seed, simulation, driver.accepts_floats, record_details, driver.measured_fields
        )
        traffic.stop_at_contact = stop_at_contact
        episode = drive_world(traffic, driver, explore, on_progress=on_progress)
        episode = replace(episode, warnings=simulation.finish())
    except Exception as error:
        simulation.check()  # or other code's changes would be reported as an error of SUMO
        known = as_unjam_error(error)
        if isinstance(scenario, UserNetwork) and type(known) is EpisodeError and simulation.has_refused():
            raise SumoInputError(str(known)) from error  # what a file holds further on
        raise
    finally:
        simulation.episode_lock.release()
    if isinstance(scenario, UserNetwork):
        scenario.check_vehicles(bool(episode.vehicle_ids), [each.example for each in episode.warnings])
    check_has_cavs(episode, driver)
    return add_reward_terms(episode, paid)


def as_seed(seed: SupportsIndex | Sequence[int]) -> tuple[int, ...]:
    """Return a seed's integers; raise `InputError` where one is negative."""
    found = tuple(map(int, seed)) if isinstance(seed, Sequence | np.ndarray) else (index(seed),)
    if min(found, default=0) < 0:
        raise invalid_value("seed", seed, ">= 0")
    return found


def check_can_drive(driver: Driver, scenario: Scenario) -> None:
    """Raise `InputError` where a driver cannot drive on a scenario's road."""
    if not can_drive(driver, scenario):
        raise InputError(f"driver: it is not allowed on {scenario.title}: it needs a closed road")
    check_policy_inputs(driver.policy_inputs, scenario, "driver: its network's feature")


def check_policy_inputs(features: Sequence[str], scenario: Scenario, context: str) -> None:
    """Raise `InputError` where features look at what a scenario's road does not tell."""
    for name in features:
        needs, told = feature(name).road_requirement, feature(name).required_fields
        if needs == "loop" and not scenario.is_closed:
            raise InputError(f"{context}: {name!r} is not allowed on a road with ends")
        if not set(told) <= set(scenario.provided_fields):
            raise InputError(f"{context}: {name!r} is not allowed on {scenario.title}")
        if needs == "coordinate" and not scenario.has_coordinate:
            raise InputError(f"{context}: {name!r} is not allowed on a network of one's own")


def check_has_cavs(episode: Episode, driver: Driver) -> None:
    """Raise `NoCavError` where a driver had no CAV."""
    if not episode.cav_ids and not driver.is_native:
        raise NoCavError(f"no CAV was on the road in {episode.control_steps} decisions: let more vehicles be CAVs")


def can_drive(driver: Driver, scenario: Scenario) -> bool:
    """Return whether a driver can drive a scenario: some need a loop."""
    return scenario.is_closed or not driver.needs_loop


def add_reward_terms(episode: Episode, reward: Reward) -> Episode:
    """Return an episode with what was earned in it; raise `InputError` where a term is not finite."""
    crashed = episode.status == "collision"
    terms = episode_reward_terms(reward, episode.speeds, episode.trajectories, crashed, episode.backlog)
    trajectories = tuple(
        replace(each, reward_terms={name: values[each.step_slice] for name, values in terms.items()})
        for each in episode.trajectories
    )
    return replace(episode, reward_terms=terms, trajectories=trajectories)
