"""Car-following dynamics that are known exactly, with which models are compared."""

from typing import Any

import numpy as np

from unjam.drivers import IDM, LocalState
from unjam.drivers.check import random_state
from unjam.drivers.residual import EXPERT_KEY, ResidualDriver
from unjam.drivers.safety import INSTANT_ACTUATOR, ActuatorState, SafetyFilter
from unjam.models.environment_data import EnvironmentData, Recording
from unjam.models.rollouts import AT_REST, ModelDynamics, ModelTransition
from unjam.physics.arrays import Array, as_column, namespace, stack_columns
from unjam.scenarios import Ring
from unjam.tree import map_leaves
from unjam.worlds.reward import Outcome, released_reward

LOOP = 230.0
RING = Ring(length=(int(LOOP), int(LOOP)), safety=SafetyFilter(active=False), actuator=INSTANT_ACTUATOR)


class ToyDynamics(ModelDynamics):
    """IDM behind; ahead a vehicle that settles at a speed that depends on its gap to the CAV.

    `leader` 0: it keeps its speed, so that the base model `idm` is all there is to know.
    """

    def __init__(self, leader: float = 1.0, bonus: float = 1.0) -> None:
        self.leader = leader
        self.bonus = bonus

    def step(
        self, state: LocalState, acceleration: Array, drawn_values: Array, actuators: ActuatorState = AT_REST
    ) -> ModelTransition:
        """Move all three by 0.1 s; a part of the reward does not depend on speeds."""
        step = 0.1
        follower_state = state._replace(
            speed=state.follower_speed, leader_speed=state.speed, leader_gap=state.follower_gap
        )
        follower_acceleration, _ = IDM().act(follower_state, {})
        leader_acceleration = self.leader * (0.4 * (5.0 - state.leader_speed) + 0.1 * (12.0 - state.leader_gap)).clip(
            -1, 1
        )
        speed = (state.speed + step * acceleration).clip(0.0, None)
        follower_speed = (state.follower_speed + step * follower_acceleration).clip(0.0, None)
        leader_speed = (state.leader_speed + step * leader_acceleration).clip(0.0, None)
        leader_gap = state.leader_gap + step * (leader_speed - speed)
        follower_gap = state.follower_gap + step * (speed - follower_speed)
        crashed = (leader_gap <= 0.0) | (follower_gap <= 0.0)
        next_state = LocalState(
            speed=speed,
            leader_speed=leader_speed,
            leader_gap=leader_gap,
            follower_speed=follower_speed,
            follower_gap=follower_gap,
            route_position=(state.route_position + step * speed) % state.loop_length,
            loop_length=state.loop_length,
        )
        speeds = stack_columns((speed, leader_speed, follower_speed))
        time_gaps = as_column(leader_gap / speed.clip(1e-3, None))
        terms = released_reward(Outcome(speeds, as_column(acceleration), time_gaps, crashed, 0.0 * acceleration, None))
        reward = sum(terms.values()) + self.bonus * 0.1 * (state.leader_gap / 20.0) * ~crashed
        xp = namespace(speed)
        zeros = xp.zeros_like(speed)
        return ModelTransition(next_state, reward, crashed, xp.stack([zeros, zeros, zeros]))


def drive(
    world: ToyDynamics, driver: ResidualDriver, seed: int, control_steps: int, explore: bool = True, episode: int = 0
) -> Recording:
    """Drive from a random start to the last control step or a crash, and record it."""
    generator = np.random.default_rng(seed)
    state = random_state(generator, 1)._replace(
        leader_gap=generator.uniform(10, 30, 1), follower_gap=generator.uniform(10, 30, 1)
    )
    state = state._replace(leader_speed=state.speed + 0.1, follower_speed=state.speed * 0.9)
    memory = driver.initial_memory(1)
    initial_memory = map_leaves(lambda values: np.array(values[0]), memory[EXPERT_KEY])
    states, accelerations, rewards, crashed = [state], [], [], False
    while len(accelerations) < control_steps and not crashed:
        noise = generator.standard_normal(1)
        decision = driver.decide(state, memory, (lambda: noise) if explore else None)  # noqa: B023
        memory = decision.memory
        step = world.step(state, decision.command.acceleration, np.zeros((1, 0)))
        state, crashed = step.state, bool(step.crashed[0])
        states.append(state)
        accelerations.append(decision.command.acceleration[0])
        rewards.append(step.reward[0])
    return recording(
        states=states[0].map(lambda *values: np.concatenate(values), *states[1:]),
        accelerations=np.array(accelerations),
        reward=np.array(rewards),
        memory=initial_memory,
        action_repeat=driver.action_repeat,
        terminated=crashed,
        drawn=np.array([0.3]),
        episode=episode,
    )


def recording(
    states: LocalState,
    accelerations: np.ndarray,
    reward: np.ndarray,
    memory: dict[str, Any] | None = None,
    action_repeat: int = 1,
    terminated: bool = False,
    drawn: np.ndarray | None = None,
    episode: int = 0,
) -> Recording:
    """Return a recording without observations and decisions of a driver."""
    zeros = np.zeros_like(accelerations)
    return Recording(
        *(
            "cav",
            0,
            states,
            np.zeros((1, 0)),
            accelerations,
            zeros,
            accelerations,
            zeros,
            zeros,
            memory or {},
            action_repeat,
        ),
        terminated=terminated,
        reward_terms={"reward": reward},
        drawn_values=np.zeros(0) if drawn is None else drawn,
        episode=episode,
    )


def environment_data(
    world: ToyDynamics, driver: ResidualDriver, episodes: int, control_steps: int, explore: bool = True
) -> EnvironmentData:
    """Return the data of some episodes, one trajectory each."""
    data = EnvironmentData(episodes * control_steps)
    data.recordings = [drive(world, driver, seed, control_steps, explore, episode=seed) for seed in range(episodes)]
    data.episode_count = episodes
    return data
