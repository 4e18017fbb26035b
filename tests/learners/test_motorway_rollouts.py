"""Model rollouts on on-ramps: the same vehicles as in recorded episodes, with new driver errors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.learners.test_road_rollouts import network_of
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError
from unjam.learners.agent import AgentSpec
from unjam.learners.model_rollouts import ModelRollouts, full_policy
from unjam.learners.settings import PolicySettings
from unjam.models import motorway_model
from unjam.models.ensemble import torch_generator
from unjam.models.motorway_model import learned_correction, motorway_samples
from unjam.models.road_model import RoadEnsemble
from unjam.models.settings import ModelSettings
from unjam.models.whole_road_models import MotorwayModel
from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import MOTORWAY_SCENARIOS, ON_RAMP, Motorway
from unjam.worlds.batch.motorway.world import MotorwayBatch, ReplayOptions
from unjam.worlds.batch.run import run_batch
from unjam.worlds.drive import DriveLoop, finish_drive
from unjam.worlds.episode import Task, run_episode
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask

ROAD = replace(ON_RAMP, horizon=160, peak=(20.0, 160.0), penetration_rate=0.2)
TWO_RAMPS = replace(MOTORWAY_SCENARIOS["two-ramps"], horizon=160, peak=(20.0, 160.0), penetration_rate=0.2)
EXPERT = driver_from_name("jam-ahead", 1.0)
POLICY = PolicySettings(hidden=(8,), inputs=("local",), action_duration=5.0, exploration="antithetic")
MODEL = ModelSettings(kind="road", rollout_starts="first", k_max=160, model_ratio=1.0, max_fit_rows=2000)
TASK = Task(ROAD, EXPERT)


def rollouts_of(settings: ModelSettings, task: Task = TASK) -> tuple[ModelRollouts, MotorwayModel]:
    model_rollouts = ModelRollouts(AgentSpec([task], POLICY, settings, 0.99, 0))
    assert isinstance(model_rollouts.world_model, MotorwayModel)
    return model_rollouts, model_rollouts.world_model


@pytest.fixture(scope="module")
def batch_episodes() -> list[Episode]:
    return run_batch([EpisodeTask(ROAD, EXPERT, (seed,)) for seed in range(4)], allow_statistical=True)


@pytest.fixture
def short_sample_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motorway_model, "MAX_SAMPLE_INTERVAL", 10)


def replay(has_errors: bool, correction: float = 0.0, seed: int = 9, road: Motorway = ROAD) -> Episode:
    def learned(speed: Floats, leader_speed: Floats, gap: Floats, known: Floats) -> Floats:
        return np.full(len(speed), correction)

    options = ReplayOptions([((seed,), (8,))], road.horizon, has_errors, learned if correction else None)
    world = MotorwayBatch(road, [(0,)], replay=options)
    world.measured_fields = EXPERT.requirements().measured_fields
    (episode,) = finish_drive(DriveLoop(world, EXPERT))
    return episode


@pytest.mark.slow
def test_rollouts_have_the_same_vehicles_with_new_driver_errors(batch_episodes: list[Episode]) -> None:
    one, other = replay(True), replay(True, seed=10)
    for episode in (one, other):
        assert set(episode.vehicle_ids[:40]) == set(batch_episodes[0].vehicle_ids[:40])
        assert episode.cav_ids[:3] == batch_episodes[0].cav_ids[:3]
    moments = min(len(each.speeds) for each in (one, other)) // 2
    assert np.nanmean(one.speeds[:moments]) == pytest.approx(np.nanmean(other.speeds[:moments]), rel=0.05)
    assert np.nanmean(one.speeds) != np.nanmean(other.speeds)
    np.testing.assert_array_equal(replay(False).speeds, replay(False, seed=10).speeds)


@pytest.mark.slow
def test_correction_changes_speeds_per_control_step() -> None:
    without, with_correction = replay(False), replay(False, correction=-0.05)
    assert np.nanmean(with_correction.speeds[40:]) < np.nanmean(without.speeds[40:]) - 0.2
    assert np.nanmean(replay(False, correction=1e-9).speeds) == pytest.approx(np.nanmean(without.speeds), rel=1e-6)


@pytest.mark.long
@pytest.mark.usefixtures("short_sample_interval")
def test_base_step_differs_from_the_record_by_perception_errors(batch_episodes: list[Episode]) -> None:
    samples = motorway_samples(batch_episodes[0], 0, ROAD)
    errors = samples.human_rows.next_speed - samples.human_rows.base_speed
    assert len(errors) > 200
    change = float((samples.human_rows.next_speed - samples.human_rows.speed).std())
    assert float(np.median(np.abs(errors))) < 0.4 * change
    assert 0.3 < samples.noise_variance / float(np.square(errors).mean()) < 1.5


@pytest.mark.long
@pytest.mark.usefixtures("short_sample_interval")
@pytest.mark.parametrize("road", [ROAD, TWO_RAMPS])
def test_base_predicts_drivers_without_errors_except_for_their_memory(road: Motorway) -> None:
    samples = motorway_samples(replace(replay(False, road=road), seed=(0,), trajectories=()), 0, road)
    errors = np.abs(samples.human_rows.next_speed - samples.human_rows.base_speed)
    # What they remember of lane changes, and when they last began to start, is not in the record.
    assert float(np.median(errors)) < 1e-3
    assert float(np.quantile(errors, 0.9)) < 0.2


@pytest.mark.slow
@pytest.mark.usefixtures("short_sample_interval")
def test_rollouts_have_the_set_ratio_in_antithetic_pairs(batch_episodes: list[Episode]) -> None:
    model_rollouts, model = rollouts_of(replace(MODEL, model_ratio=2.0))
    model_rollouts.learn(batch_episodes, 1)
    assert model_rollouts.k_star == 160
    network = replace(network_of(0.05, POLICY), episode_noise=True)
    found = model_rollouts.roll_out(network, 1)
    assert found is not None
    assert model_rollouts.model_steps == 2 * len(batch_episodes) * 160
    assert model_rollouts.facts["return_model"] == pytest.approx(model_rollouts.facts["return_environment"], rel=0.1)
    assert model_rollouts.facts["crash_share"] == 0.0
    facts, tensors = model_rollouts.state()
    other, _ = rollouts_of(replace(MODEL, model_ratio=2.0))
    other.restore(facts, tensors)
    other.k_star = model_rollouts.k_star
    repeated = other.roll_out(network, 1)
    assert repeated is not None
    np.testing.assert_array_equal(repeated.observations, found.observations)
    np.testing.assert_array_equal(repeated.rewards, found.rewards)
    driver = full_policy(TASK, POLICY, network)
    seeds = [((1,), (2,)), ((1,), (2,))]
    one, antithetic = model.simulate(driver, model.samples[:1] * 2, 20, None, seeds, [1.0, -1.0])
    first, second = one.trajectories[0], antithetic.trajectories[0]
    without = network(first.observations[:1])
    assert first.residual[0] + second.residual[0] == pytest.approx(2.0 * without[0])


@pytest.mark.usefixtures("short_sample_interval")
def test_shorter_rollouts_are_more_and_none_without_cavs(batch_episodes: list[Episode]) -> None:
    model_rollouts, _ = rollouts_of(replace(MODEL, k_max=80))
    model_rollouts.learn(batch_episodes[:2], 1)
    network = replace(network_of(0.05, POLICY), episode_noise=True)
    assert model_rollouts.roll_out(network, 1) is not None
    assert model_rollouts.model_steps == 2 * 160
    model_rollouts.k_star = 5
    assert model_rollouts.roll_out(network, 2, 0, 64) is None


def test_antithetic_pairs_are_held_out_together(batch_episodes: list[Episode], monkeypatch: pytest.MonkeyPatch) -> None:
    fitted_numbers = list[NDArray[np.int64]]()
    monkeypatch.setattr(
        motorway_model, "fit_human_model", lambda model, rows, *_, **__: fitted_numbers.append(rows.episode)
    )
    samples = [motorway_samples(batch_episodes[0], number, ROAD, "idm") for number in (6, 7, 8)]
    for group_size, numbers in ((1, {6, 7, 8}), (2, {3, 4})):
        motorway_model.fit_motorway_model(RoadEnsemble(MODEL, (0,)), samples, MODEL, (0,), group_size)
        assert set(fitted_numbers[-1].tolist()) == numbers


def test_base_none_predicts_constant_speed() -> None:
    model = RoadEnsemble(replace(MODEL, base="none"), (0,))
    model.noise.fill_(0.3)
    speed, known = np.linspace(5.0, 25.0, 4000), np.linspace(25.0, 5.0, 4000)
    without, noisy = (
        learned_correction(model, torch_generator((0,), "cpu"), ROAD.steps_per_control_step, noise)
        for noise in (False, True)
    )
    assert without is not None
    assert noisy is not None
    np.testing.assert_allclose(known + without(speed, speed, speed, known), speed, atol=1e-12)
    per_step = (known + noisy(speed, speed, speed, known) - speed) / ROAD.steps_per_control_step
    assert per_step.std() * ROAD.steps_per_control_step**0.5 == pytest.approx(0.3, rel=0.05)


@pytest.mark.long
@pytest.mark.usefixtures("short_sample_interval")
def test_networks_are_used_only_if_the_base_is_wrong(batch_episodes: list[Episode]) -> None:
    others = {"time_headways": (1.6, 1.6), "accelerations": (0.73, 0.73), "decelerations": (1.67, 1.67)}
    for humans, learned in (({}, []), (others, ["speed"])):
        model_rollouts, _ = rollouts_of(replace(MODEL, epochs=60), Task(replace(ROAD, **humans), EXPERT))
        model_rollouts.learn(batch_episodes, 1)
        assert model_rollouts.facts["learned_targets"] == learned


@pytest.mark.long
@pytest.mark.usefixtures("short_sample_interval")
def test_networks_without_base_learn_car_following(batch_episodes: list[Episode]) -> None:
    settings = replace(MODEL, base="none", epochs=60)
    model_rollouts, _ = rollouts_of(settings)
    model_rollouts.learn(batch_episodes, 1)
    step = model_rollouts.facts["one_step"]["speed"]
    assert model_rollouts.facts["learned_targets"] == ["speed"]
    assert step["base"] == pytest.approx(step["change"], rel=0.05)  # the base: nothing changes
    assert step["model"] < 0.9 * step["base"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (replace(MODEL, rollout_starts="newest"), "model.rollout_starts: newest is not allowed"),
        (replace(MODEL, base="acc"), "model.base: acc is not allowed; allowed: idm"),
        (replace(MODEL, calibrate_base=True), "model.calibrate_base: true is not allowed"),
    ],
)
def test_unsupported_settings_are_refused(settings: ModelSettings, words: str) -> None:
    with pytest.raises(InputError, match=words):
        rollouts_of(settings)


@pytest.mark.slow
@pytest.mark.usefixtures("short_sample_interval")
@pytest.mark.parametrize("road", [ROAD, TWO_RAMPS])
def test_base_predicts_drivers_in_sumo_as_well_as_in_the_batch(road: Motorway) -> None:
    squares, counts, noises = list[float](), list[int](), list[float]()
    tasks = [EpisodeTask(road, EXPERT, (seed,)) for seed in range(4)]
    for episodes in (
        run_batch(tasks, allow_statistical=True),
        [run_episode(road, EXPERT, each.seed) for each in tasks],
    ):
        samples = [motorway_samples(episode, 0, road) for episode in episodes]
        errors = np.concatenate([one.human_rows.next_speed - one.human_rows.base_speed for one in samples])
        squares.append(float(np.square(errors).mean()))
        counts.append(len(errors))
        noises.append(float(np.mean([one.noise_variance for one in samples])))
    assert counts[1] == pytest.approx(counts[0], rel=0.2)
    assert noises[1] == pytest.approx(noises[0], rel=0.2)
    assert squares[1] < 1.3 * squares[0]


def test_record_that_skips_steps_is_refused(batch_episodes: list[Episode]) -> None:
    with pytest.raises(InputError, match="skips steps"):
        motorway_samples(replace(batch_episodes[0], snapshot_stride=2), 0, ROAD)
