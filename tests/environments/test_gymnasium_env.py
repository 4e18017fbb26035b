import copy
import pickle
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

import unjam
from tests.worlds.sumo.user_networks import straight
from unjam.drivers import IDM, Constant
from unjam.drivers.observation import FEATURES
from unjam.drivers.registry import driver_from_name
from unjam.environments.gymnasium_env import RoadEnv
from unjam.errors import EpisodeError, InputError, MissingPartError, UnjamError
from unjam.processes import has_display
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode

NAMES = {
    "unjam/Ring-v0": "ring",
    "unjam/FigureEight-v0": "figure-eight",
    "unjam/Merge-v0": "merge",
    "unjam/OnRamp-v0": "on-ramp",
    "unjam/Recorded-v0": "recorded",
}
OWN = "unjam/UserNetwork-v0"
OPEN = ("unjam/Merge-v0", "unjam/OnRamp-v0")
SHORT: Any = {"horizon": 60}


@pytest.fixture(params=NAMES)
def environment(request: pytest.FixtureRequest) -> Iterator[gymnasium.Env]:
    made = gymnasium.make(request.param, **SHORT)
    yield made
    made.close()


def test_passes_the_checks_of_gymnasium_and_stable_baselines3_without_warnings(environment: gymnasium.Env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("default", "another simulation is open")  # a picture is drawn by another one
        if make_scenario(NAMES[environment.spec.id if environment.spec else ""]).action_limit != 1:
            warnings.filterwarnings("ignore", ".*symmetric and normalized")  # m/s2, as the road has them
        check_env(environment.unwrapped, skip_render_check=not has_display())
        check_env_of_sb3(environment.unwrapped)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("warmup", [0, 50])
def test_steps_the_very_episode_that_run_episode_runs(name: str, warmup: int) -> None:
    changes: Any = {"horizon": 120, "warmup": warmup, "cavs": 1}
    if NAMES[name] == "recorded":  # without a warm-up, and one CAV by default
        changes = {"horizon": 120 + warmup}
    scenario = make_scenario(NAMES[name], changes)
    expected = run_episode(scenario, Constant(acceleration=0.3), (7,))
    environment = gymnasium.make(name, **changes)
    environment.reset(seed=7)
    speeds, rewards = [], []
    done = False
    while not done:
        _, reward, terminated, truncated, info = environment.step(np.array([0.3]))
        done = terminated or truncated
        speeds.append(environment.unwrapped._road.world.speeds)  # pyright: ignore[reportAttributeAccessIssue]
        rewards.append(reward)
        assert sum(info["reward_terms"].values()) == reward
    environment.close()
    (stay,) = expected.trajectories
    decided = len(stay.applied_acceleration)
    left_early = stay.start_step + decided < scenario.horizon
    assert len(rewards) == decided + left_early  # the decision in which it left is no part of its stay
    np.testing.assert_allclose(rewards[:decided], stay.reward, atol=1e-12)
    in_order = np.sort if name in OPEN else np.array  # of entry, or along the road
    for found, recorded in zip(speeds, expected.speeds[1 + stay.start_step :], strict=False):
        np.testing.assert_array_equal(in_order(found), in_order(recorded[~np.isnan(recorded)]))


def test_actions_are_added_to_an_expert(environment: gymnasium.Env) -> None:
    environment.close()
    made = RoadEnv("ring", expert="pi", features=("local", "expert_acceleration", "expert_memory"), **SHORT)
    assert made.observation_space.shape == (8,)
    made.reset(seed=3)
    speeds = []
    for _ in range(60):
        made.step(np.zeros(1))
        speeds.append(made._road.world.speeds)
    made.close()
    expected = run_episode(make_scenario("ring", SHORT), driver_from_name("pi", 0.1), (3,))
    np.testing.assert_array_equal(speeds, expected.speeds[1:])


@pytest.mark.parametrize("name", NAMES)
def test_the_horizon_truncates_and_does_not_terminate(name: str) -> None:
    horizon = 20 if name in OPEN else 60
    environment = gymnasium.make(name, horizon=horizon)
    environment.reset(seed=1)
    decided = environment.unwrapped._road.world.control_steps  # pyright: ignore[reportAttributeAccessIssue]
    ends = [environment.step(np.zeros(1))[2:4] for _ in range(horizon - decided)]
    environment.close()
    assert len(ends) > 5
    assert ends[:-1] == [(False, False)] * (len(ends) - 1)
    assert ends[-1] == (False, True)


def test_a_recorded_road_can_be_drawn_after_its_metrics_are_measured() -> None:
    with closing(RoadEnv("recorded", horizon=5, render_mode="rgb_array")) as environment:
        environment.reset(seed=1)
        *_, info = [environment.step(np.zeros(1)) for _ in range(5)][-1]
        assert info["episode_metrics"]["cav_fuel_by_power"] > 0.0
        assert environment.render().shape == (640, 640, 3)
        environment.reset()


@pytest.mark.parametrize("expert", ["", "pi"])
def test_on_the_merge_the_episode_ends_when_the_cav_leaves(expert: str) -> None:
    environment = RoadEnv("merge", horizon=200, expert=expert)  # one CAV by default
    observation, _ = environment.reset(seed=1)
    seen, ends = [observation], []
    while not ends or ends[-1] == (False, False):
        observation, _, terminated, truncated, _ = environment.step(np.zeros(1))
        seen.append(observation)
        ends.append((terminated, truncated))
    traffic = environment._road.world
    assert not traffic.cav_ids
    assert traffic.control_steps < 200
    assert ends[-1] == (False, True)
    np.testing.assert_array_equal(seen[-1], seen[-2])  # what it saw before it left
    with pytest.raises(InputError, match="cavs"):
        RoadEnv("merge", cavs=2)
    environment.close()


@pytest.mark.slow
def test_on_an_own_network_the_first_that_the_share_picks_is_driven(tmp_path: Path) -> None:
    flow = '<flow id="car" type="car" route="along" begin="0" end="60" period="2"/>'
    road: Any = {"penetration_rate": 0.5, "horizon": 300}
    file = str(straight(tmp_path, flow, length=200.0))
    expected = run_episode(make_scenario(file, {**road, "cavs": 1}), Constant(acceleration=-0.1), (2,))
    environment = gymnasium.make(OWN, scenario=file, **road)
    check_env(environment.unwrapped, skip_render_check=not has_display())
    environment.reset(seed=2)
    speeds, done = [], False
    while not done:
        observation, _, terminated, truncated, _ = environment.step(np.array([-0.1], np.float32))
        speeds.append(10.0 * observation[0])
        done = terminated or truncated
    environment.close()
    (driven,) = expected.trajectories
    assert len(speeds) == len(driven.states.speed)
    np.testing.assert_allclose(speeds[:-1], driven.states.speed[1:], atol=1e-5)


@pytest.mark.slow
def test_a_network_that_changes_between_two_episodes_is_refused(tmp_path: Path) -> None:
    flow = '<flow id="car" type="car" route="along" begin="0" end="60" period="2"/>'
    environment = RoadEnv(str(straight(tmp_path, flow)), penetration_rate=0.5, horizon=300, cavs=1)
    environment.reset(seed=2)
    demand = tmp_path / "demand.rou.xml"
    demand.write_text(demand.read_text().replace('period="2"', 'period="3"'))
    with pytest.raises(InputError, match=r"^demand\.rou\.xml: has changed since the start"):
        environment.reset(seed=2)
    environment.close()


def test_a_collision_terminates_and_does_not_truncate() -> None:
    environment = RoadEnv("ring", actuation="raw", length=(160, 160), safety={"active": False})
    environment.reset(seed=0)
    terminated = truncated = False
    while not (terminated or truncated):
        *_, terminated, truncated, _ = environment.step(np.ones(1))
    environment.close()
    assert terminated
    assert not truncated


def test_control_steps_before_the_entry_of_the_cav_count_for_the_horizon() -> None:
    with closing(RoadEnv("on-ramp", cavs=1, horizon=5, backend="batch")) as environment:
        passed = environment.reset(seed=0)[1]["control_steps"]
        steps = 0
        truncated = False
        total, info = 0.0, dict[str, Any]()
        while not truncated:
            _, reward, _, truncated, info = environment.step(np.zeros(1))
            steps, total = steps + 1, total + reward
    assert 0 < passed == 5 - steps
    assert info["episode_metrics"] == {"return": pytest.approx(total), "steps": steps}
    for horizon in (1, passed):  # with the second, the CAV enters in the last control step
        with closing(RoadEnv("on-ramp", cavs=1, horizon=horizon, backend="batch")) as environment:
            assert_refuses_an_episode_without_decisions(environment, horizon)
            with pytest.raises(UnjamError, match="call reset first"):
                environment.step(np.zeros(1))


def assert_refuses_an_episode_without_decisions(environment: Any, horizon: int) -> None:
    allowed = f"allowed: a horizon of more than {horizon} control steps, or more CAVs"
    with pytest.raises(EpisodeError, match=f"reset: no CAV enters the road before the episode ends; {allowed}"):
        environment.reset(seed=0)


@pytest.mark.parametrize("slots", [None, 2])
def test_agents_that_enter_only_at_the_horizon_are_refused(slots: int | None) -> None:
    with closing(unjam.parallel_env("merge", slots, horizon=18)) as environment:  # pyright: ignore[reportCallIssue, reportArgumentType]
        assert_refuses_an_episode_without_decisions(environment, 18)


def test_the_same_seed_starts_the_same_episode_and_later_ones_differ() -> None:
    environment = RoadEnv(**SHORT)
    first = environment.reset(seed=5)[1]["drawn_values"]
    following = [environment.reset()[1]["drawn_values"] for _ in range(6)]
    assert environment.reset(seed=5)[1]["drawn_values"] == first
    assert [environment.reset()[1]["drawn_values"] for _ in range(6)] == following
    assert len({entry["length"] for entry in following}) > 1
    environment.close()


@pytest.mark.long
def test_environments_of_one_process_do_not_disturb_each_other() -> None:
    alone, seen = RoadEnv(**SHORT), []
    alone.reset(seed=0)
    expected = [alone.step(np.full(1, 0.5))[0] for _ in range(40)]
    other, third = RoadEnv(**SHORT), RoadEnv("figure-eight", **SHORT)
    alone.reset(seed=0)
    for environment in (other, third):
        with pytest.warns(UserWarning, match="runs in a process of its own"):
            environment.reset(seed=0)
    for _ in range(40):
        third.step(np.zeros(1))
        seen.append((alone.step(np.full(1, 0.5))[0], other.step(np.full(1, 0.5))[0]))
    for environment in (alone, other, third):
        environment.close()
        environment.close()
    np.testing.assert_array_equal([first for first, _ in seen], expected)
    np.testing.assert_array_equal([second for _, second in seen], expected)


@pytest.mark.long
def test_nothing_is_said_as_a_process_ends_with_environments_open() -> None:
    code = "import gymnasium, unjam\n" + "gymnasium.make('unjam/Ring-v0', horizon=60).reset(seed=0)\n"
    code += "left = [gymnasium.make('unjam/Ring-v0', horizon=60) for _ in range(2)]\n"
    code += "[one.reset(seed=0) for one in left]"
    command = [sys.executable, "-W", "ignore", "-c", code]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert (ran.stdout, ran.stderr) == ("", "")


@pytest.mark.parametrize("make", [RoadEnv, partial(gymnasium.make, "unjam/Ring-v0")])
def test_a_window_without_a_display_is_refused_in_one_line(
    make: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unjam.environments.gymnasium_env.has_display", lambda: False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(MissingPartError, match="without one: 'rgb_array'"):
            make(render_mode="human")


def test_one_number_is_a_range_of_one() -> None:
    environment = RoadEnv(length=231, **SHORT)
    assert environment.reset(seed=0)[1]["drawn_values"] == {"length": 231.0}
    environment.close()


def test_stepping_before_a_reset_is_told() -> None:
    with pytest.raises(UnjamError, match="call reset first"):
        RoadEnv().step(np.zeros(1))


def test_several_at_once_in_processes() -> None:
    environments = gymnasium.make_vec("unjam/Ring-v0", num_envs=2, vectorization_mode="async", **SHORT)
    observations, _ = environments.reset(seed=[1, 2])  # pyright: ignore[reportArgumentType]
    assert observations.shape == (2, 5)
    observations, rewards, *_ = environments.step(np.zeros((2, 1), np.float32))
    assert observations.shape == (2, 5)
    assert rewards.shape == (2,)
    environments.close()


@pytest.mark.parametrize("scenario", ["ring", "figure-eight"])
def test_renders_the_road_with_its_cav(scenario: str) -> None:
    environment = RoadEnv(scenario, render_mode="rgb_array", **SHORT)
    environment.reset(seed=0)
    picture = environment.render()
    assert picture.shape == (640, 640, 3)
    assert picture.dtype == np.uint8
    red = (picture[..., 0] > 180) & (picture[..., 1] < 90) & (picture[..., 2] < 120)
    assert red.sum() > 20
    environment.step(np.ones(1))
    environment.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"cavs": 2}, "use unjam.parallel_env"),
        ({"render_mode": "cinema"}, "human, rgb_array"),
        ({"scenario": "moon"}, "ring, ring-warm"),
        ({"lenght": (230, 230)}, "lenght: unknown name"),
        ({"expert": "nonesuch"}, "nonesuch"),
        ({"scenario": "merge", "expert": "pacer"}, "it needs a closed road"),
        ({"features": ("expert_acceleration",)}, "features: 'expert_acceleration' is not allowed; allowed: with an ex"),
        ({"features": ("local", "expert_memory")}, "features: 'expert_memory' is not allowed; allowed: with an expert"),
        ({"scenario": 5}, "scenario: 5 is not allowed; allowed: a name, a Scenario, or its class"),
    ],
)
def test_wrong_arguments_get_one_clear_line(arguments: Any, words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        RoadEnv(**arguments)


def test_an_expert_without_memory_features_is_noted() -> None:
    with pytest.warns(UserWarning, match=r"features: 'expert_memory' adds no numbers: the expert idm.* has no memory"):
        made = RoadEnv(expert="idm", features=("local", "expert_memory"))
    assert made.observation_space.shape == (5,)


def test_gymnasium_knows_the_environments_after_importing_unjam() -> None:
    code = (
        "import unjam, gymnasium; "
        "print(sorted(n for n in gymnasium.registry if n.startswith('unjam/') and n.endswith('-v0')))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == str(sorted([*NAMES, OWN]))
    assert unjam.__version__


def test_rewards_are_for_what_happens_and_not_for_what_sensors_read() -> None:
    changes: Any = {"horizon": 60, "sensors": {"gap_error": 3.0}, "safety": {"active": False}}
    expected = run_episode(make_scenario("ring", changes), IDM(time_headway=0.4), (0,), "eq16")
    environment = RoadEnv("ring", reward="eq16", expert="idm:time_headway=0.4", **changes)
    environment.reset(seed=0)
    rewards = [environment.step(np.zeros(1))[1] for _ in range(60)]
    environment.close()
    np.testing.assert_allclose(rewards, expected.reward, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "shown", "words"),
    [
        ("merge", "lap_position", "features: 'lap_position' is not allowed on merge: it needs a closed road"),
        (
            "ring",
            "distance_to_merge",
            "features: 'distance_to_merge' is not allowed on ring: it needs distance_to_merge",
        ),
    ],
)
def test_what_the_road_does_not_tell_is_not_shown(name: str, shown: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        RoadEnv(name, features=("local", shown))


def test_a_feature_of_ones_own_is_told_what_the_road_tells(tmp_path: Path) -> None:
    file = tmp_path / "share.py"
    file.write_text("def share(state):\n    return state.penetration_rate\n")
    with closing(RoadEnv("ring", features=("local", f"{file}:share"))) as environment:
        observation, _ = environment.reset(seed=0)
    assert observation[-1] == np.float32(1 / 22)


def test_a_reward_that_is_not_finite_is_refused_as_in_an_episode(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def nothing(seen): return {'mean': seen.speeds.mean(-1) * float('nan')}")
    environment = RoadEnv("ring", reward=f"{tmp_path}/mine.py:nothing", horizon=40)
    environment.reset(seed=0)
    with pytest.raises(InputError, match=r"reward mine\.py:nothing: step 0: term 'mean' is nan; allowed: finite"):
        environment.step(np.zeros(1, np.float32))
    environment.close()


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"features": "local"}, "features: 'local' is not allowed; allowed: a list of features"),
        ({"features": []}, r"features: \[\] is not allowed; allowed: a list of features"),
        ({"features": ["locla"]}, "features: 'locla' is not allowed; .* did you mean 'local'"),
        ({"expert": "human"}, "expert: 'human' is not allowed; .* 'idm' drives like a human driver"),
    ],
)
def test_what_cannot_be_observed_or_added_to_is_told(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        RoadEnv("ring", **asked)


@pytest.mark.parametrize("action", ["abc", [0.1, 0.2], [], np.inf, [np.nan], None])
def test_an_action_that_is_not_one_finite_number_is_refused_in_one_line(action: Any) -> None:
    with (
        closing(RoadEnv("ring", horizon=5)) as single,
        closing(unjam.parallel_env("ring", cavs=2, horizon=5)) as several,
    ):
        single.reset(seed=0)
        several.reset(seed=0)
        with pytest.raises(InputError, match=r"^step: action"):
            single.step(action)
        with pytest.raises(InputError, match=r"^step: cav_"):
            several.step(dict.fromkeys(several.agents, action))


def test_options_of_a_reset_change_the_scenario_for_this_episode() -> None:
    with closing(RoadEnv("ring", length=250, horizon=40)) as environment:
        options = {"length": 230, "safety.time_gap": 1.5, "horizon": 3}
        assert environment.reset(seed=0, options=options)[1]["drawn_values"] == {"length": 230.0}
        assert [environment.step(np.zeros(1))[3] for _ in range(3)] == [False, False, True]
        assert environment.reset()[1]["drawn_values"] == {"length": 250.0}
        assert [environment.step(np.zeros(1))[3] for _ in range(3)] == [False] * 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"lenght": 230}, "lenght: unknown name; did you mean 'length'?"),
        ({1: 230}, "key: 1 is not allowed; allowed: a text"),
        ({"cavs": 2}, "reset: options: cavs: 2 is not allowed; allowed: 1, as in the constructor"),
        ({"action_limit": 3}, "reset: options: action_limit: 3.0 is not allowed; allowed: 1.0, as in the constructor"),
        ([230], "reset: options: [230] is not allowed; allowed: a dict of parameters"),
        ([], "reset: options: [] is not allowed; allowed: a dict of parameters"),
        (5, "reset: options: 5 is not allowed; allowed: a dict of parameters"),
    ],
)
def test_options_that_are_not_parameters_of_this_road_are_refused(options: Any, words: str) -> None:
    with closing(RoadEnv("ring", **SHORT)) as environment:
        environment.reset(seed=0)
        with pytest.raises(InputError, match=re.escape(words)):
            environment.reset(options=options)
        environment.step(np.zeros(1))  # the episode goes on


@pytest.mark.parametrize("seed", [np.int64(3), np.array(3)])
def test_integers_of_numpy_are_seeds(seed: Any) -> None:
    with closing(RoadEnv("ring", **SHORT)) as environment:
        assert environment.reset(seed=seed)[1] == environment.reset(seed=3)[1]


@pytest.mark.parametrize("seed", ["1", 0.5, -1, True, [1, 2], np.zeros(2)])
@pytest.mark.parametrize("make", [RoadEnv, unjam.parallel_env])
def test_seeds_that_are_no_integers_are_refused(make: Callable[..., Any], seed: Any) -> None:
    words = re.escape(f"seed: {seed!r} is not allowed; allowed: an integer >= 0")
    with closing(make("ring", **SHORT)) as environment, pytest.raises(InputError, match=words):
        environment.reset(seed=seed)


def test_documentation_names_all_environments_and_features() -> None:
    for name in [*NAMES, OWN]:
        assert name in (unjam.__doc__ or "")
        assert name in (RoadEnv.__doc__ or "")
    assert [name for name in FEATURES if f"``{name}``" not in (RoadEnv.__doc__ or "")] == []


def test_an_expert_accelerates_exactly_as_in_an_episode() -> None:
    changes: Any = {"horizon": 400}
    (cav,) = run_episode(make_scenario("ring", changes), IDM(), (3,)).trajectories
    found = []
    with closing(RoadEnv("ring", expert="idm", **changes)) as environment:
        environment.reset(seed=3)
        for _ in range(400):
            environment.step(np.zeros(1))
            found.append(environment._road.world.last_applied_acceleration())
    np.testing.assert_array_equal(found, cav.applied_acceleration)


@pytest.mark.parametrize("backend", ["sumo", "batch"])
def test_environments_are_copied_before_the_first_reset_only(backend: str) -> None:
    with closing(RoadEnv("ring", backend=backend, horizon=5)) as environment:
        other = copy.copy(environment)
        observation, _ = environment.reset(seed=3)
        for make_copy in (copy.copy, copy.deepcopy, pickle.dumps):
            with pytest.raises(InputError, match="a copy after reset is not allowed"):
                make_copy(environment)
    with closing(other):
        np.testing.assert_array_equal(other.reset(seed=3)[0], observation)


@pytest.mark.parametrize("options", [None, {"horizon": 50}])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("road.toml", 'kind = "ring"\nvehicles = 22\n'),
        ("road.py", "from unjam.scenarios import Ring\n\nroad = Ring(vehicles=22)\n"),
    ],
)
def test_an_environment_of_a_road_whose_file_has_changed_is_not_reset(
    name: str, text: str, options: dict[str, Any] | None, tmp_path: Path
) -> None:
    file = tmp_path / name
    file.write_text(text)
    with closing(RoadEnv(f"{file}:road" if name.endswith("py") else str(file))) as environment:
        environment.reset(seed=0, options=options)
        file.write_text(text.replace("22", "12"))
        with pytest.raises(InputError, match=f"{name}: has changed since the start"):
            environment.reset(seed=0, options=options)
