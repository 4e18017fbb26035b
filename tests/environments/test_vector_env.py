import re
import warnings
from collections.abc import Callable
from contextlib import closing
from math import inf, nan
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from unjam.drivers import Constant, LocalState
from unjam.drivers.safety import INSTANT_ACTUATOR
from unjam.environments.gymnasium_env import RoadEnv
from unjam.environments.vector_env import RoadVectorEnv
from unjam.errors import InputError, MissingPartError, UnjamError
from unjam.measures.metrics import METRICS, RECORDED_ROAD_METRICS
from unjam.scenarios import make_scenario
from unjam.worlds.batch.noise import draw_single_normal
from unjam.worlds.episode import run_episode
from unjam.worlds.reward import Outcome

SEEDS = [5, 6, 7]
RESETS = {13: 1, 37: 0, 61: 2}
"""environment that is reset before each of some steps"""
STEPS = 100
CRASHING: Any = {"actuation": "raw", "length": (160, 160), "safety": {"active": False}, "horizon": 90}


class Parrot:
    """A user's driver, which takes NumPy arrays."""

    def initial_memory(self, n: int) -> dict[str, Any]:
        return {"last": np.zeros(n)}

    def act(self, state: Any, memory: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return 0.1 * (state.leader_speed - state.speed + memory["last"]), {"last": state.speed}


CASES: dict[str, dict[str, Any]] = {
    "two features and an expert": {"expert": "pi", "features": ("local", "expert_memory")},
    "a warm-up": {"scenario": "ring-jammed", "warmup": 330, "expert": "pi", "features": ("local", "expert_memory")},
    "sensors with errors": {"sensors": {"gap_error": 1.0, "dropout": 0.2}, "safety": {"gap_error": 1.0}},
    "delayed actuators": {"actuator": {"delay": 0.2, "lag": 0.3}, "steps_per_control_step": 2, "reward": "eq16"},
    "a population": {"population": "unjam:ngsim"},
    "a user's expert": {"expert": Parrot},
    "collisions": CRASHING,
    "recorded": {"scenario": "recorded"},
    "figure eight": {"scenario": "figure-eight", "horizon": 40, "warmup": 30},
}


def action(step: int, row: int, arguments: dict[str, Any]) -> float:
    """A different one for each environment; with `CRASHING` the first two run into their leaders."""
    return float(row < 2) if arguments is CRASHING else 0.5 * np.sin(0.1 * step + row)


def step_single(row: int, arguments: dict[str, Any]) -> list[Any]:
    """What SUMO's environment returns: observation, reward, and whether the episode is terminated or truncated."""
    with closing(RoadEnv(**{"horizon": 40, **arguments})) as environment:
        found: list[Any] = [(environment.reset(seed=SEEDS[row])[0], 0.0, False, False)]
        has_ended = False
        for step in range(STEPS):
            if RESETS.get(step) == row:
                found.append((environment.reset(seed=100 + step)[0], 0.0, False, False))
                has_ended = False
            if has_ended:
                found.append((environment.reset()[0], 0.0, False, False))
                has_ended = False
            else:
                *values, _ = environment.step([action(step, row, arguments)])
                found.append(tuple(values))
                has_ended = values[2] or values[3]
    return found


def step_all(arguments: dict[str, Any]) -> list[list[Any]]:
    """The same of a vector environment, for each of its environments."""
    environment, count = RoadVectorEnv(len(SEEDS), **{"horizon": 40, **arguments}), len(SEEDS)
    observations, _ = environment.reset(seed=SEEDS)
    found = [[(observation, 0.0, False, False)] for observation in observations]
    for step in range(STEPS):
        if step in RESETS:
            options = {"reset_mask": np.arange(count) == RESETS[step]}
            observations, _ = environment.reset(seed=[100 + step] * count, options=options)
            found[RESETS[step]].append((observations[RESETS[step]], 0.0, False, False))
        actions = np.array([[action(step, row, arguments)] for row in range(count)])
        for row, values in enumerate(zip(*environment.step(actions)[:4], strict=True)):
            found[row].append(values)
    return found


@pytest.mark.parametrize("name", CASES)
def test_episodes_equal_those_of_single_environments_in_sumo(name: str) -> None:
    found, ends = step_all(CASES[name]), 0
    for row, rows in enumerate(found):
        expected = step_single(row, CASES[name])
        assert len(rows) == len(expected)
        for (observation, reward, *is_end), (single, single_reward, *is_single_end) in zip(rows, expected, strict=True):
            np.testing.assert_allclose(observation, single, atol=2e-6)
            assert reward == pytest.approx(single_reward, abs=1e-9)
            assert is_end == is_single_end
            ends += any(is_end)
    assert ends >= len(SEEDS) - 1
    assert any(row[2] for rows in found for row in rows) == (name == "collisions")


def test_roads_end_with_their_recordings(tmp_path: Path) -> None:
    for seconds in (20.0, 21.0, 22.5):
        times = 0.1 * np.arange(round(seconds / 0.1) + 1)
        speeds = pd.DataFrame({"time": times, "speed": 12.0 + np.sin(times + seconds)})
        speeds.to_csv(tmp_path / f"{seconds}.csv", index=False)
    arguments: dict[str, Any] = {"scenario": "recorded", "recordings": str(tmp_path)}
    environment, road = RoadVectorEnv(8, **arguments), make_scenario("recorded", {"recordings": str(tmp_path)})
    files = [environment.reset(seed=0)[1]["drawn_values"]["file"]]
    lengths, ages, counts = [], np.zeros(8, int), np.zeros(8, int)
    for _ in range(450):
        *_, truncated, info = environment.step(np.zeros((8, 1)))
        ages += 1
        for row in np.flatnonzero(truncated).tolist():
            lengths.append((files[-1][row], ages[row]))
            seed = (row, int(counts[row])) if counts[row] else (row,)
            episode = run_episode(road, Constant(), seed, backend="batch")
            for name in RECORDED_ROAD_METRICS:  # of episodes that began at different times
                expected = pytest.approx(METRICS[name].function(episode), abs=1e-9, nan_ok=True)
                assert info["episode_metrics"][name][row] == expected
        counts += truncated
        if "drawn_values" in info:
            files.append(np.where(info["_drawn_values"], info["drawn_values"]["file"], files[-1]))
            ages[info["_drawn_values"]] = 0
    assert set(lengths) == {(0.0, 200), (1.0, 210), (2.0, 225)}
    assert run_episode(road, Constant(), (0,)).control_steps == dict(lengths)[files[0][0]]


@pytest.mark.parametrize(("scenario", "steps"), [("ring", 60), ("recorded", 700)])
def test_the_metrics_of_an_episode_are_in_the_info_of_its_last_step(scenario: str, steps: int) -> None:
    environment = RoadVectorEnv(2, scenario, horizon=steps)
    environment.reset(seed=3)
    infos = [environment.step(np.full((2, 1), 0.1))[-1] for _ in range(steps)]
    assert not any("episode_metrics" in info for info in infos[:-1])
    metrics = infos[-1]["episode_metrics"]
    assert infos[-1]["_episode_metrics"].all()
    for row in range(2):
        episode = run_episode(make_scenario(scenario, {"horizon": steps}), Constant(acceleration=0.1), (3 + row,))
        names = ("return", "mean_speed", "speed_std_fleet", "cav_mean_speed", "mean_abs_accel")
        for name in (*names, *(RECORDED_ROAD_METRICS if scenario == "recorded" else ())):
            assert metrics[name][row] == pytest.approx(METRICS[name].function(episode), abs=1e-6, nan_ok=True)
        assert {*metrics} >= {*RECORDED_ROAD_METRICS} if scenario == "recorded" else "fuel_by_power" not in metrics
        assert metrics["steps"][row] == steps
        assert scenario == "ring" or np.isfinite(metrics["amplification"][row])
        terms = {name: sum(info["reward_terms"][name][row] for info in infos) for name in episode.reward_terms}
        assert terms == pytest.approx({name: values.sum() for name, values in episode.reward_terms.items()})


@pytest.mark.parametrize("name", ["two features and an expert", "recorded", "figure eight", "collisions"])
def test_single_environments_give_the_same_metrics_in_the_last_step(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unjam.measures.step_metrics.BLOCK_STEPS", 16)
    arguments = {"horizon": 40, **CASES[name]}
    environment = RoadVectorEnv(2, backend="", **arguments)
    environment.reset(seed=3)
    infos = [environment.step([[action(step, 0, CASES[name])]] * 2)[-1] for step in range(arguments["horizon"])]
    for row in range(2):
        expected = next(info["episode_metrics"] for info in infos if info.get("_episode_metrics", [False] * 2)[row])
        with closing(RoadEnv(**arguments, **({"backend": "batch"} if name == "figure eight" else {}))) as single:
            single.reset(seed=3 + row)
            found, step = {}, 0
            while "episode_metrics" not in found:
                *_, found = single.step([action(step, 0, CASES[name])])
                step += 1
        names = [each for each in expected if not each.startswith("_")]
        assert found["episode_metrics"] == pytest.approx(
            {each: expected[each][row] for each in names}, abs=1e-9, nan_ok=True
        )


@pytest.mark.parametrize("exact", [True, False])
def test_seeds_count_up_and_episodes_can_be_repeated(exact: bool) -> None:
    def run(seed: Any) -> Any:
        observations = [environment.reset(seed=seed)[0]]
        return [*observations, *(environment.step(np.ones((3, 1)))[0] for _ in range(45))]

    environment = RoadVectorEnv(3, exact=exact, horizon=20, cavs=1)
    first = run(4)
    np.testing.assert_array_equal(run([4, 5, 6]), first)
    assert np.abs(np.subtract(run(5), first)).max() > 0.01
    assert (first[0] != first[21]).any()  # the next episode has another road
    np.testing.assert_array_equal(run(4), first)


def test_without_a_seed_episodes_are_those_after_the_last_seed() -> None:
    environment, single = RoadVectorEnv(2), RoadEnv()
    environment.reset(seed=8)
    with closing(single):
        single.reset(seed=9)
        for _ in range(3):
            np.testing.assert_allclose(environment.reset()[0][1], single.reset()[0], atol=1e-6)
    assert RoadVectorEnv(2).reset()[0].shape == (2, 5)


def test_quick_episodes_have_the_same_distribution_in_single_precision() -> None:
    means: dict[bool, Any] = {}
    for exact in (True, False):
        environment = RoadVectorEnv(64, exact=exact, horizon=200)
        environment.reset(seed=0)
        *_, info = [environment.step(np.zeros((64, 1))) for _ in range(200)][-1]
        means[exact] = info["episode_metrics"]
    assert means[False]["mean_speed"].dtype == np.float32
    for name, tolerance in {"mean_speed": 0.02, "speed_std_fleet": 0.02, "return": 10.0}.items():
        assert means[False][name].mean() == pytest.approx(means[True][name].mean(), abs=tolerance)
        assert (means[False][name] != means[True][name].astype(np.float32)).any()


def test_numbers_of_the_fast_generator_are_standard_normal() -> None:
    drawn = draw_single_normal(np.random.default_rng(0), (999, 1001))
    assert (drawn.shape, drawn.dtype) == ((999, 1001), np.float32)
    moments = [(drawn.astype(np.float64) ** power).mean() for power in (1, 2, 3, 4)]
    np.testing.assert_allclose(moments, [0.0, 1.0, 0.0, 3.0], atol=0.03)
    assert abs(np.corrcoef(drawn[:499].ravel(), drawn[500:].ravel())[0, 1]) < 0.01


@pytest.mark.parametrize("name", ["two features and an expert", "recorded", "figure eight", "collisions"])
def test_tensors_are_what_arrays_are(name: str) -> None:
    arguments = {"horizon": 30, **CASES[name]}
    arrays, tensors = RoadVectorEnv(3, **arguments), RoadVectorEnv(3, device="cpu", **arguments)
    expected, found = arrays.reset(seed=1)[0], tensors.reset(seed=1)[0]
    assert found.dtype == torch.float32
    for step in range(50):
        np.testing.assert_allclose(found, expected, atol=1e-5)
        actions = np.array([[action(step, row, CASES[name])] for row in range(3)])
        expected, *numbers, info = arrays.step(actions)
        found, *others, tensor_info = tensors.step(torch.as_tensor(actions))
        for own, other in zip(numbers, others, strict=True):
            np.testing.assert_allclose(own, other, atol=1e-9)
        assert info.keys() == tensor_info.keys()
        assert all(isinstance(values, torch.Tensor) for values in tensor_info["reward_terms"].values())


def to_half_precision(values: Any) -> Any:
    return values.half() if isinstance(values, torch.Tensor) else values.astype(np.float16)


BAD_REWARDS: dict[str, tuple[Callable[[Outcome], Any], str]] = {
    "NaN": (lambda outcome: {"bad": outcome.speeds.mean(-1) * nan}, "term 'bad' is nan; allowed: finite, at most 1e"),
    "infinite": (lambda outcome: {"bad": outcome.speeds.mean(-1) - inf}, "term 'bad' is -inf; allowed: finite"),
    "infinite, of half precision": (
        lambda outcome: {"bad": to_half_precision(outcome.speeds.mean(-1)) - inf},
        "term 'bad' is -inf; allowed: finite",
    ),
    "large": (lambda outcome: {"bad": 0.0 * outcome.speeds.mean(-1) + 1e300}, r"term 'bad' is 1e\+300; allowed"),
    "opposite infinities": (
        lambda outcome: {"good": outcome.speeds.mean(-1) + 1e200, "bad": outcome.speeds.mean(-1) - 1e200},
        r"term 'good' is 1e\+200; allowed",
    ),
    "empty": (lambda outcome: {}, "it has no terms; allowed: at least one"),
    "texts": (lambda outcome: {"bad": ["a", "b"]}, "term 'bad' is not numbers|a list is not allowed for the term"),
    "objects": (lambda outcome: {"bad": np.array([None, None])}, "term 'bad' is nan; allowed|a ndarray is not allowed"),
    "complex": (lambda outcome: {"bad": 1j * outcome.speeds.mean(-1)}, "is not numbers|a Tensor is not allowed"),
}


@pytest.mark.parametrize("name", BAD_REWARDS)
@pytest.mark.parametrize("device", ["", "cpu"])
def test_a_reward_that_single_environments_refuse_is_refused(name: str, device: str) -> None:
    reward, message = BAD_REWARDS[name]
    environment = RoadVectorEnv(2, device=device, reward=reward)
    environment.reset(seed=0)
    with pytest.raises(InputError, match=message):
        environment.step(torch.zeros(2, 1) if device else np.zeros((2, 1)))


def test_a_reward_in_numpy_is_refused_where_results_are_tensors() -> None:
    environment = RoadVectorEnv(2, device="cpu", reward=lambda outcome: np.zeros(2))
    environment.reset(seed=0)
    with pytest.raises(InputError, match=r"a ndarray is not allowed for the term 'reward'; allowed: a tensor"):
        environment.step(torch.zeros(2, 1))


def test_gradients_flow_through_tensors_of_many_steps() -> None:
    def total_reward(actions: torch.Tensor) -> torch.Tensor:
        environment.reset(seed=0)
        return sum((environment.step(actions)[1].sum() for _ in range(30)), torch.zeros(()))

    environment = RoadVectorEnv(2, device="cpu", reward="eq16", horizon=20)  # with the restart of both
    actions = torch.tensor([[0.3], [-0.2]], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(total_reward(actions), actions)
    for row in range(2):
        change = torch.zeros_like(actions)
        change[row] = 1e-5
        with torch.no_grad():
            slope = (total_reward(actions + change) - total_reward(actions - change)) / 2e-5
        assert gradient[row].item() == pytest.approx(slope.item(), rel=1e-4)
    assert abs(gradient).min() > 1.0


@pytest.mark.parametrize(
    "arguments",
    [{"actuator": {"delay": 0.2, "lag": 0.3}, "expert": "pi"}, {"scenario": "figure-eight", "horizon": 40}],
    ids=["delay, lag and an expert", "figure eight"],
)
def test_after_detach_no_gradient_flows_to_earlier_steps(arguments: dict[str, Any]) -> None:
    def drive(steps: int, actions: torch.Tensor, environment: RoadVectorEnv) -> torch.Tensor:
        return [environment.step(actions)[:2] for _ in range(steps)][-1][1]

    cut, whole = (RoadVectorEnv(2, device="cpu", **arguments) for _ in range(2))
    actions = torch.full((2, 1), 0.2, requires_grad=True)
    for each in (cut, whole):
        each.reset(seed=0)
        assert drive(8, actions, each).requires_grad
    observations = cut.detach()
    assert not observations.requires_grad
    own = actions.detach().requires_grad_()
    rewards, expected = (drive(5, each, made) for each, made in ((own, cut), (own, whole)))
    assert torch.equal(rewards, expected)
    assert torch.autograd.grad(rewards.sum(), (own, actions), retain_graph=True, allow_unused=True)[1] is None
    assert torch.autograd.grad(expected.sum(), actions)[0].abs().max() > 0.0


def test_it_follows_the_conventions_of_gymnasium() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment: Any = gymnasium.make_vec("unjam/FigureEight-v0", num_envs=3, horizon=20, expert="idm")
        assert environment.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        recorded = RecordEpisodeStatistics(environment)
        observations, info = recorded.reset(seed=1)
        assert observations in environment.observation_space
        assert info["drawn_values"]["_radius"].all()
        environment.action_space.seed(0)
        steps = [recorded.step(environment.action_space.sample()) for _ in range(21)]
        *_, truncated, info = steps[19]
        assert truncated.all()
        np.testing.assert_allclose(info["episode"]["r"], info["episode_metrics"]["return"], rtol=1e-6)
        observations, rewards, *_, info = steps[20]
        assert not rewards.any()
        assert not info["_reward_terms"].any()
        assert info["_drawn_values"].all()
        as_list = DictInfoToList(environment)
        as_list.reset(seed=1)
        *_, infos = as_list.step(environment.action_space.sample())
    assert infos[2]["reward_terms"].keys() == {"speed", "acceleration"}  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            {"scenario": "merge", "cavs": 1},
            "scenario: merge is not possible in a batch (merge is not a ring); allowed: vec",
        ),
        (
            {"scenario": "on-ramp", "cavs": 1},
            "scenario: motorway is not possible in a batch (vehicles enter and leave: slots are required, for instance",
        ),
        ({"actuation": "flow"}, "actuation: flow is not allowed in a batch; allowed: raw, or shielded"),
        ({"backend": "sumo"}, "backend: is not an option of batches; allowed: vectorization_mode='async'"),
        ({"render_mode": "rgb_array"}, "render_mode: is not an option of batches"),
        ({"cavs": 2}, "cavs: several are not allowed here; allowed: 1"),
        ({"num_envs": 0}, "num_envs: 0 is not allowed; allowed: an integer from 1 to 1,000,000"),
        ({"num_envs": True}, "num_envs: True is not allowed; allowed: an integer from 1 to 1,000,000"),
        ({"num_envs": 10**12}, "num_envs: 1000000000000 is not allowed; allowed: an integer from 1 to 1,000,000"),
        ({"features": ("local", "expert_memory")}, "features: 'expert_memory' is not allowed; allowed: with an expert"),
        ({"lenght": 230}, "lenght: unknown name"),
        ({"exact": "no"}, "exact: 'no' is not allowed; allowed: True or False"),
        ({"expert": Parrot, "device": "cpu"}, "allowed: one that takes tensors, like 'pi'; or device=''"),
    ],
)
def test_what_a_batch_cannot_do_is_refused_in_one_line(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        RoadVectorEnv(**arguments)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda made: made.reset(seed=[1]), "seed: 1 seed not allowed; allowed: 2, or a single one"),
        (lambda made: made.reset(seed=-1), "seed: -1 is not allowed; allowed: an integer >= 0"),
        (
            lambda made: made.reset(seed="a"),
            "seed: 'a' is not allowed; allowed: an integer, or one for each environment",
        ),
        (lambda made: made.reset(seed=[1, 0.5]), "seed: [1, 0.5] is not allowed; allowed: an integer"),
        (lambda made: made.reset(options=5), "options: 5 is not allowed; allowed: a dict with 'reset_mask'"),
        (lambda made: made.detach(), "detach: NumPy arrays have no gradients; allowed: device='cpu'"),
        (lambda made: made.reset(options={"length": 230}), "options: 'length' is not allowed; allowed: 'reset_mask'"),
        (lambda made: made.reset(options={"reset_mask": [1, 0]}), "options: reset_mask is not 2 booleans"),
        (lambda made: made.reset(options={"reset_mask": np.zeros(2, bool)}), "options: reset_mask is not 2 booleans"),
    ],
)
def test_wrong_calls_are_refused_in_one_line(call: Callable[[Any], Any], words: str) -> None:
    made = RoadVectorEnv(2)
    made.reset(seed=0)
    with pytest.raises(InputError, match=re.escape(words)):
        call(made)


def test_other_wrong_uses_are_refused() -> None:
    with pytest.raises(UnjamError, match="call reset first"):
        RoadVectorEnv(2).step(np.zeros((2, 1)))
    with pytest.raises(InputError, match="reset_mask is not allowed in the first reset"):
        RoadVectorEnv(2).reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(
        MissingPartError, match="device: 'nonesuch' is not available to torch; allowed: 'cpu', or '' for NumPy"
    ):
        RoadVectorEnv(2, device="nonesuch")
    with pytest.raises(MissingPartError, match=r"device: 1\.5 is not available to torch"):
        RoadVectorEnv(2, device=1.5)  # pyright: ignore[reportArgumentType]
    made = RoadVectorEnv(2, reward=lambda outcome: {"mine": outcome.speeds.mean(-1) / 0.0 * np.array([1.0, 0.0])})
    made.reset(seed=0)
    numpy_feature = RoadVectorEnv(
        2, device="cpu", features=("local", lambda state: state.speed), actuator=INSTANT_ACTUATOR
    )
    numpy_feature.reset(seed=0)
    with pytest.raises(InputError, match=r"<lambda>: feature has no gradient; allowed: within torch\.no_grad\(\)"):
        numpy_feature.step(torch.zeros((2, 1), requires_grad=True))
    with (
        np.errstate(all="ignore"),
        pytest.raises(InputError, match=r"environment 0: term 'mine' is (inf|nan); allowed"),
    ):
        made.step(np.zeros((2, 1)))


def mix(state: LocalState) -> np.ndarray:
    return 0.1 * (np.mean(state.leader_speed) - state.speed)


class Counting:
    count = 0

    def initial_memory(self, n: int) -> dict[str, Any]:
        return {}

    def act(self, state: LocalState, memory: dict[str, Any]) -> Any:
        self.count += 1
        return np.full(len(state.speed), 0.01 * self.count), memory


@pytest.mark.parametrize("expert", [mix, Counting()])
def test_experts_that_couple_environments_are_refused(expert: Any) -> None:
    with pytest.raises(InputError, match="driver"):
        RoadVectorEnv(3, expert=expert)


def test_a_reward_that_writes_into_its_outcome_changes_no_episode() -> None:
    def destructive(outcome: Outcome) -> dict[str, Any]:
        mean = np.array(outcome.speeds.mean(-1))
        outcome.speeds[:] = 0.0
        outcome.cav_speeds[:] = 0.0
        return {"mean": mean}

    made = [RoadVectorEnv(2, horizon=30), RoadVectorEnv(2, horizon=30, reward=destructive)]
    for each in made:
        each.reset(seed=1)
    for _ in range(25):
        np.testing.assert_array_equal(*(each.step(np.full((2, 1), 0.5))[0] for each in made))


def test_reserved_seeds_of_any_environment_are_warned_of() -> None:
    with pytest.warns(UserWarning, match="seed=1000000 is reserved"):
        RoadVectorEnv(2, horizon=5).reset(seed=999_999)


@pytest.mark.parametrize("device", ["", "cpu"])
def test_wrong_actions_are_refused_in_one_line_except_where_they_are_ignored(device: str) -> None:
    made, zeros = RoadVectorEnv(2, horizon=5, device=device), np.zeros((2, 1))
    made.reset(seed=1)
    cases = {
        "actions: inf of environment 1 is not allowed; allowed: finite numbers of shape (2, 1)": [[0.0], [np.inf]],
        "actions of shape (3,) are not allowed; allowed: (2, 1)": np.zeros(3),
        "actions is not numbers: array([['a'], ['b']], dtype='<U1'); allowed: finite": np.array([["a"], ["b"]]),
        "actions is not numbers: [[0.0], [0.0, 0.0]]; allowed: finite numbers of shape (2, 1)": [[0.0], [0.0, 0.0]],
    }
    for words, actions in cases.items():
        with pytest.raises(InputError, match=f"^step: {re.escape(words)}"):
            made.step(actions)
    ends = [made.step(zeros)[3].all() for _ in range(5)]
    assert ends[-1]
    made.step(np.full((2, 1), np.nan))


@pytest.mark.filterwarnings("error")
def test_fast_recorded_roads_have_the_positions_of_exact_ones_without_a_warning() -> None:
    found = []
    for exact in (True, False):
        environment = RoadVectorEnv(2, "recorded", exact=exact)
        environment.reset(seed=1)
        for _ in range(3):
            environment.step(np.zeros((2, 1), np.float32))
        found.append(environment._running_episodes.world.local_state().route_position)
    np.testing.assert_allclose(*found, rtol=1e-4)
