import re
import warnings
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import unjam
from unjam.controller import make_expert
from unjam.environments.slotted_vector_env import SlottedRoadVectorEnv, make_vector_env
from unjam.errors import EpisodeError, InputError
from unjam.measures.metrics import METRICS, mean_travel_time
from unjam.measures.step_metrics import open_road_metrics, open_road_sums
from unjam.physics.arrays import Floats
from unjam.scenarios import make_scenario
from unjam.worlds.batch.run import run_batches
from unjam.worlds.record import Episode
from unjam.worlds.reward import Outcome
from unjam.worlds.worker_pool import EpisodeTask

ROAD: Any = {
    "length": 900.0,
    "ramps.0.position": 450.0,
    "ramps.0.merging_length": 200.0,
    "penetration_rate": 0.4,
    "peak": (20.0, 1500.0),
    "horizon": 100,
}
"""a motorway that vehicles leave after half a minute"""
SEEDS, SLOTS, RESTART, OTHER_SEED = [5, 6, 7], 3, 40, 50
"""before step `RESTART`, the second environment continues with the episode of `OTHER_SEED`"""
JAM_AHEAD: Any = {"expert": "jam-ahead", "features": ("local", "lane_speeds", "expert_acceleration")}
CASES: dict[str, Any] = {
    "one lane": {"scenario": "on-ramp-1", "expert": "cruise"},
    "speeds ahead": JAM_AHEAD,
    "late messages of CAVs": {
        **JAM_AHEAD,
        **{"roadside.source": "cavs", "roadside.averaging_time": 20.0},
        **{"roadside.latency": 4.0, "roadside.smoothing_time": 9.0},
    },
}


def actions_of(step: int) -> Any:
    """Actions of the slots of a road in a control step of its episode."""
    return 0.5 * np.sin(0.1 * step + np.arange(SLOTS))


def drive_all(arguments: Any) -> list[list[dict[str, Any]]]:
    """Return the results of each episode: those of three seeds, and of `OTHER_SEED`."""
    environment = SlottedRoadVectorEnv(len(SEEDS), SLOTS, **{**ROAD, **arguments})
    episodes: list[list[dict[str, Any]]] = [[] for _ in SEEDS]
    current = dict(enumerate(episodes))
    observations, info = environment.reset(seed=SEEDS)

    def add(row: int, **values: Any) -> None:
        names = "is_occupied", "has_left", "slot_rewards"
        current[row].append(
            values | {"observation": observations[row]} | {name: info[name][row] for name in names if name in info}
        )

    for row in current:
        add(row)
    for step in range(ROAD["horizon"] + RESTART):
        if step == RESTART:
            mask = np.arange(len(SEEDS)) == 1
            observations, info = environment.reset(seed=[OTHER_SEED] * 3, options={"reset_mask": mask})
            assert not observations[1].any()
            assert not info["is_occupied"][1].any()
            episodes.append([])
            current[1] = episodes[-1]
            add(1)
        actions = np.array([actions_of(len(current.get(row, [0])) - 1) for row in range(len(SEEDS))])
        observations, rewards, terminated, truncated, info = environment.step(actions)
        assert not terminated.any()
        for row in list(current):
            add(row, reward=rewards[row], truncated=truncated[row])
            if truncated[row]:
                del current[row]
    assert not current
    return episodes


@pytest.mark.parametrize("name", CASES)
def test_slots_are_those_of_the_environment_of_one_road(name: str) -> None:
    arguments = {"scenario": "on-ramp", **ROAD, **CASES[name]}
    episodes, seeds = drive_all(CASES[name]), [*SEEDS, OTHER_SEED]
    left, without_slot = 0, set[str]()
    for episode, seed in zip(episodes, seeds, strict=True):
        if seed == SEEDS[1]:
            continue  # it was not driven to its end
        with closing(unjam.parallel_env(slots=SLOTS, backend="batch", **arguments)) as single:
            observations, infos = single.reset(seed=seed)
            step = single._road.world.control_steps
            for before in episode[:step]:
                assert not before["is_occupied"].any()
            while single.agents:
                results = episode[step]
                for number, slot in enumerate(observations):
                    np.testing.assert_allclose(results["observation"][number], observations[slot], atol=1e-6)
                    for mask in ("is_occupied", "has_left"):
                        assert results[mask][number] == infos[slot][mask]
                    left += infos[slot]["has_left"]
                observations, rewards, _, truncations, infos = single.step(
                    {slot: [value] for slot, value in zip(observations, actions_of(step), strict=True)}
                )
                step += 1
                assert single._road.world.control_steps == step  # there is always a CAV on the road
                expected = [rewards[slot] for slot in observations]
                np.testing.assert_allclose(episode[step]["slot_rewards"], expected, atol=1e-12)
                if any(expected):
                    assert episode[step]["reward"] == pytest.approx(min(expected), abs=1e-12)
                assert episode[step]["truncated"] == any(truncations.values())
            without_slot |= single._without_slot
        for number, slot in enumerate(observations):  # there, CAVs that enter in the last step get no slot
            if infos[slot]["is_occupied"]:
                np.testing.assert_allclose(episode[-1]["observation"][number], observations[slot], atol=1e-6)
    assert left > 10
    assert len(without_slot) > 3


@pytest.mark.parametrize("name", ["speeds ahead", "late messages of CAVs"])
def test_with_zero_actions_episodes_are_those_of_the_batch_alone(name: str) -> None:
    changes = {**ROAD, **{key: value for key, value in CASES[name].items() if key.startswith("roadside")}}
    environment = SlottedRoadVectorEnv(3, 2, **{**ROAD, **CASES[name]})
    environment.reset(seed=SEEDS)
    found = []
    for step in range(2 * ROAD["horizon"] + 1 + RESTART):
        if step == RESTART:  # the third one then is at another step than the others
            environment.reset(seed=[OTHER_SEED] * 3, options={"reset_mask": np.arange(3) == 2})
        info = environment.step(np.zeros((3, 2, 1)))[-1]
        for row in np.flatnonzero(info.get("_episode_metrics", ())).tolist():
            metrics = info["episode_metrics"]
            found.append((row, {metric: metrics[metric][row] for metric in metrics if not metric.startswith("_")}))
    seeds = {0: [(5,), (5, 1)], 1: [(6,), (6, 1)], 2: [(OTHER_SEED,), (OTHER_SEED, 1)]}
    scenario = make_scenario("on-ramp", changes)
    driver = make_expert(CASES[name]["expert"], scenario.control_step)
    for row, own in seeds.items():
        alone = run_batches([EpisodeTask(scenario, driver, seed) for seed in own], allow_statistical=True)
        for metrics, episode in zip([each for number, each in found if number == row], alone, strict=True):
            assert metrics.pop("steps") == episode.control_steps == ROAD["horizon"]
            assert metrics == pytest.approx({metric: METRICS[metric].function(episode) for metric in metrics}, abs=1e-9)
            assert metrics.keys() == {"return", "mean_speed", "travel_time", "insertion_backlog_veh"}


SHORT_ROAD: Any = {"penetration_rate": 0.3, "expert": "cruise", "horizon": 320, "peak": (60.0, 300.0)}


def drive_short_road(count: int, exact: bool) -> tuple[Floats, Floats]:
    """The speeds of all CAVs in all steps, and the returns."""
    environment = SlottedRoadVectorEnv(count, 4, exact=exact, **SHORT_ROAD)
    environment.reset(seed=0)
    speeds, returns = [], np.zeros(count)
    for _ in range(320):
        observations, rewards, *_, info = environment.step(np.zeros((count, 4)))
        assert observations.dtype == np.float32
        speeds.append(observations[info["is_occupied"]][:, 0])
        returns += np.where(info["is_occupied"].any(1), rewards, 0.0)
    return np.concatenate(speeds), returns


def test_all_columns_have_single_precision_if_they_are_not_exact() -> None:
    fast = SlottedRoadVectorEnv(2, 4, exact=False, **SHORT_ROAD)
    fast.reset(seed=0)
    for _ in range(100):
        fast.step(np.zeros((2, 4)))
    vehicles = fast._running_episodes.world._traffic.vehicles
    assert {vehicle.dtype for vehicle in vehicles if vehicle.dtype.kind == "f"} == {np.dtype(np.float32)}, (
        "half of the time"
    )


def test_episodes_in_single_precision_are_others_of_the_same_distribution() -> None:
    (speeds, returns), (others, other_returns) = (drive_short_road(24, exact) for exact in (True, False))
    assert not np.allclose(returns, other_returns, rtol=1e-3)
    assert others.mean() == pytest.approx(speeds.mean(), rel=0.03)
    assert other_returns.mean() == pytest.approx(returns.mean(), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False])
def test_episodes_have_the_distribution_of_sumo(exact: bool) -> None:
    count = 8
    speeds, returns = drive_short_road(count, exact)
    sumo_speeds, sumo_returns = [], np.zeros(count)
    with closing(unjam.parallel_env("on-ramp", slots=4, **SHORT_ROAD)) as single:
        for seed in range(count):
            single.reset(seed=seed)
            while single.agents:
                found, rewards, *_, infos = single.step(dict.fromkeys(single.agents, 0.0))
                sumo_speeds += [found[slot][0] for slot in found if infos[slot]["is_occupied"]]
                sumo_returns[seed] += min(rewards.values())
    assert speeds.mean() == pytest.approx(np.mean(sumo_speeds), rel=0.05)
    assert returns.mean() == pytest.approx(sumo_returns.mean(), rel=0.05)


def test_a_collision_ends_the_episode_of_its_road_only() -> None:
    environment = SlottedRoadVectorEnv(2, 2, **ROAD)
    environment.reset(seed=1)
    for _ in range(30):
        environment.step(np.zeros((2, 2)))
    world: Any = environment._running_episodes.world
    world._log.end_steps[1] = world.control_steps + 1
    observations, rewards, terminated, truncated, info = environment.step(np.zeros((2, 2)))
    assert (terminated.tolist(), truncated.tolist()) == ([False, True], [False, False])
    assert rewards[1] < 10.0 * rewards[0]  # the reward of a collision
    assert info["episode_metrics"]["steps"].tolist() == [0, 31]
    observations, rewards, terminated, _, info = environment.step(np.full((2, 2), [[0.0], [np.nan]]))
    assert not observations[1].any()
    assert (rewards[1], terminated.any()) == (0.0, False)
    assert observations[0].any()
    assert info["is_occupied"].any(1).tolist() == [True, False]


def test_vehicles_under_way_at_a_collision_count_for_the_planned_time() -> None:
    speeds = np.array([[np.nan, np.nan, np.nan], [5.0, np.nan, np.nan], [6.0, 7.0, np.nan], [np.nan, 8.0, 9.0]])
    backlog = np.array([0.0, 0.0, 1.0, 2.0])
    episode = Episode(
        seed=(0,),
        speeds=speeds,
        backlog=backlog,
        status="collision",
        vehicle_ids=("a", "b", "c"),
        control_step=0.5,
        planned_duration=5.0,
    )
    empty = np.zeros((1, 0))
    outcomes = [
        Outcome(speeds[[step]], empty, empty, np.array([step == 3]), backlog[[step]], empty) for step in (1, 2, 3)
    ]
    sums = {name: sum(open_road_sums(outcome)[name] for outcome in outcomes) for name in open_road_sums(outcomes[0])}
    found = open_road_metrics(sums, outcomes[-1], np.array([3]), np.array([10 - 3]), 0.5)
    assert found["travel_time"] == pytest.approx(mean_travel_time(episode))


def test_an_episode_ends_when_no_cav_will_be_on_the_road_again() -> None:
    environment = SlottedRoadVectorEnv(1, 2, **{**ROAD, "cavs": 2, "horizon": 500, "peak": (0.0, 60.0)})
    environment.reset(seed=3)
    left, truncated, info = 0, False, dict[str, Any]()
    while not truncated:
        *_, (truncated,), info = environment.step(np.zeros((1, 2)))
        left += info["has_left"].sum()
    assert left == 2
    assert info["episode_metrics"]["steps"] < 500


def test_it_follows_the_conventions_of_gymnasium() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment: Any = gymnasium.make_vec("unjam/OnRamp-v0", num_envs=2, slots=4, horizon=30, penetration_rate=0.5)
        assert isinstance(environment.unwrapped, SlottedRoadVectorEnv)
        assert environment.single_action_space.shape == (4, 1)
        recorded = RecordEpisodeStatistics(environment)
        observations, _ = recorded.reset(seed=1)
        assert observations in environment.observation_space
        environment.action_space.seed(0)
        steps = [recorded.step(environment.action_space.sample()) for _ in range(31)]
        *_, truncated, info = steps[29]
        assert truncated.all()
        np.testing.assert_allclose(info["episode"]["r"], info["episode_metrics"]["return"], rtol=1e-6)
        assert info["is_occupied"].any()
        observations, rewards, *_, info = steps[30]
        assert not observations.any()
        for values in (rewards, info["slot_rewards"], info["_reward_terms"]):
            assert not values.any()
        as_list = DictInfoToList(environment)
        as_list.reset(seed=1)
        *_, infos = as_list.step(environment.action_space.sample())
    assert infos[1]["is_occupied"].shape == (4,)  # pyright: ignore[reportArgumentType]
    assert type(make_vector_env(1)).__name__ == "RoadVectorEnv"


def test_actions_are_needed_only_in_occupied_slots() -> None:
    environment = SlottedRoadVectorEnv(2, 2, **ROAD)
    environment.reset(seed=1)
    info: Any = {"is_occupied": np.zeros((2, 2), bool)}
    for _ in range(20):
        *_, info = environment.step(np.where(info["is_occupied"], 0.0, np.nan))
    assert info["is_occupied"].any()
    with pytest.raises(InputError, match=r"step: actions: nan of environment [01] is not allowed; allowed: finite"):
        environment.step(np.full((2, 2, 1), np.nan))
    with pytest.raises(InputError, match=re.escape("shape (2, 1) are not allowed; allowed: (2, 2, 1)")):
        environment.step(np.zeros((2, 1)))


@pytest.mark.parametrize("arguments", [{}, {"device": "cpu"}, {"scenario": "figure-eight"}, ROAD | {"slots": 2}])
def test_closed_environments_are_refused_until_new_ones_are_made(arguments: dict[str, Any]) -> None:
    environment = make_vector_env(2, **arguments)
    environment.reset(seed=1)
    environment.close()
    environment.close()
    for call in (lambda: environment.step(np.zeros(environment.action_space.shape or ())), environment.reset):
        with pytest.raises(
            ClosedEnvironmentError, match=r"are closed; allowed: new environments of gymnasium\.make_vec"
        ):
            call()


def test_an_episode_without_cavs_is_refused_with_its_environment() -> None:
    environment = SlottedRoadVectorEnv(3, 2, **ROAD | {"penetration_rate": 0.1, "horizon": 10})
    reason = "motorway of seed 4: no CAV enters the road before the episode ends; allowed: a horizon of more than 10"
    with pytest.raises(EpisodeError, match=f"^reset: environment 2: {reason}"):
        environment.reset(seed=[3, 7, 4])
    environment.reset(seed=[3, 7, 3])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"slots": 0}, "slots: 0 is not allowed; allowed: an integer >= 1"),
        ({"exact": 1}, "exact: 1 is not allowed; allowed: True or False"),
        ({"device": "cpu"}, "device: is not an option of motorways"),
        ({"backend": "sumo"}, "backend: is not an option of batches"),
        ({"scenario": "ring"}, "ring is not possible in a batch (its vehicles stay: slots are only allowed on"),
        ({"scenario": "merge"}, "merge is not possible in a batch (merge is not a ring)"),
        ({"expert": "jam-ahead+pi"}, "driver: step 0: row 1 gave"),
        ({"lanes": 3}, "motorway is not possible in a batch (lanes: 3 is not allowed in a batch; allowed: 1, 2)"),
        ({"roadside.source": "detectors"}, "(roadside.source: detectors is not allowed with slots; allowed: veh"),
    ],
)
def test_what_has_no_slots_is_refused_in_one_line(arguments: Any, words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        make_vector_env(**{"num_envs": 2, "slots": 2, "scenario": "on-ramp", **arguments})
