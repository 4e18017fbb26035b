"""The three forms of a controller agree: the policy that learned, the NumPy driver, the ONNX graph."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.adapters.onnx_policies import linear
from tests.controller.test_file import residual
from tests.controller.test_sample import perceived
from tests.drivers.test_experts import EXPERTS
from tests.learners.test_trpo_ppo import mean_of
from tests.learners.toy_task import make_policy, shake
from unjam.controller.file import replay_states
from unjam.controller.onnx_graph import describe_graph, onnx_graph
from unjam.controller.verify import check_graph, run_graph
from unjam.drivers import ACC, IDM, LACC, Driver, FollowerStopper, Human, Pacer, PISaturation, ResidualDriver
from unjam.drivers.car_following import Constant
from unjam.drivers.network import Network
from unjam.drivers.observation import feature, observation_size
from unjam.drivers.policy import PolicyDescription
from unjam.drivers.registry import driver_from_name
from unjam.drivers.requirements import merge_requirements
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.user_driver import FileDriver
from unjam.drivers.wrappers import FilteredDriver, MixedDriver
from unjam.errors import InputError, MissingPartError
from unjam.learners.sac_td3 import SquashedResidualPolicy
from unjam.learners.settings import PolicySettings
from unjam.learners.trpo_ppo import ResidualPolicy
from unjam.onnx_models import parse_model
from unjam.parameters import build_dataclass, parse_toml
from unjam.scenarios import Ring, make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Trajectory
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation

pytest.importorskip("onnxscript")
onnxruntime = pytest.importorskip("onnxruntime")

torch.set_num_threads(1)
PARTS = PolicySettings().inputs
UNDRAWN = "human", "gap-maker"
PARITY = 1e-6
"""[m/s2]"""


def driver_of(network: Network, expert: Driver, hold: int = 10) -> ResidualDriver:
    return ResidualDriver(expert, network, 1.0, PARTS, hold)


def longest_stay(scenario: Scenario, driver: Driver, simulation: Simulation) -> Trajectory:
    episode = run_episode(scenario, driver, (3,), backend=SumoBackend(simulation))
    return max(episode.trajectories, key=lambda trajectory: len(trajectory.applied_acceleration))


def agree(driver: Driver, stay: Trajectory) -> None:
    """Driver and graph, given what was perceived, answer what was commanded on the road."""
    states = stay.states.select(slice(-1))
    np.testing.assert_allclose(replay_states(driver, states, 1.0), stay.applied_acceleration, rtol=0, atol=1e-9)
    part = onnx_graph(driver, 1.0)
    check_graph(part, driver)
    np.testing.assert_allclose(run_graph(part, driver, states), stay.applied_acceleration, rtol=0, atol=PARITY)


@pytest.mark.slow
def test_policy_driver_and_graph_agree_on_a_whole_episode_of_the_ring(simulation: Simulation) -> None:
    expert = PISaturation()
    policy = make_policy(ResidualPolicy, inputs=observation_size(PARTS, expert))
    shake(policy, 1)
    driver = driver_of(policy.network(), expert)
    stay = longest_stay(Ring(), driver, simulation)
    assert len(stay.applied_acceleration) == 3000
    chosen, _ = stay.actions_and_rewards
    assert chosen.std() > 0.1
    seen = stay.observations[:-1].astype(np.float32)
    np.testing.assert_allclose(mean_of(policy, seen), chosen, rtol=0, atol=PARITY)
    agree(driver, stay)


@pytest.mark.slow
def test_policy_driver_and_graph_of_sac_agree_where_vehicles_come_and_go(simulation: Simulation) -> None:
    expert = FollowerStopper(time_step=1.0)
    policy = make_policy(SquashedResidualPolicy, inputs=observation_size(PARTS, expert))
    shake(policy.actor, 2)
    driver = driver_of(policy.network(), expert, hold=1)
    stay = longest_stay(make_scenario("merge", {"horizon": 150}), driver, simulation)
    seen = torch.as_tensor(stay.observations[:-1], dtype=torch.float32)
    with torch.no_grad():
        chosen = policy.authority * policy.actor(seen, deterministic=True)[:, 0].numpy()
    assert stay.residual.std() > 0.01
    np.testing.assert_allclose(chosen, stay.residual, rtol=0, atol=PARITY)
    agree(driver, stay)


@pytest.mark.slow
def test_driver_and_graph_agree_where_the_place_on_the_road_counts(simulation: Simulation) -> None:
    driver = residual(Pacer(harmonics=(7, -0.8, 0.7, -1.3, 0.7), gathering_gap=0.1), hold=3)
    agree(driver, longest_stay(make_scenario("figure-eight", {"horizon": 400}), driver, simulation))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in EXPERTS if name.partition(":")[0] not in UNDRAWN])
def test_the_graph_of_every_expert_answers_what_the_expert_answers(name: str) -> None:
    same(driver_from_name(name, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize(
    "driver",
    [
        residual(residual(PISaturation(), 1, hold=3), 2, hold=5),
        MixedDriver((PISaturation(), IDM(), residual(ACC()))),
        residual(Human()),
        FilteredDriver(Constant(1.0), 1.0, SafetyFilter(), 0.1),
        FilteredDriver(Constant(1.0), 1.0, SafetyFilter(), 0.1, Actuator(delay=0.2, lag=0.3)),
    ],
    ids=["nested", "mixed", "residual on human", "filter", "filter with actuator"],
)
def test_the_graph_of_drivers_put_together_answers_what_they_answer(driver: Driver) -> None:
    same(driver)


def same(driver: Driver) -> None:
    states = perceived(900)
    part = onnx_graph(driver, 1.0)
    check_graph(part, driver)
    np.testing.assert_allclose(run_graph(part, driver, states), replay_states(driver, states, 1.0), atol=PARITY)


@pytest.mark.long
def test_the_graph_takes_any_number_of_vehicles_and_names_nothing_of_this_machine() -> None:
    driver = LACC()
    part = onnx_graph(driver, 0.5)
    states = perceived(7)
    seen = {name: getattr(states, name) for name in driver.requirements().input_fields}
    fed = {**seen, "memory.acceleration": np.zeros(7)}
    session = onnxruntime.InferenceSession(part, providers=["CPUExecutionProvider"])
    found, after = session.run(None, fed)
    expected, memory = driver.act(states, driver.initial_memory(7))
    np.testing.assert_allclose(found, expected.clip(-0.5, 0.5), atol=1e-12)
    np.testing.assert_allclose(after, memory["acceleration"], atol=1e-12)
    assert b".py" not in part
    assert b"unjam" not in part


@pytest.mark.parametrize("name", ["human", "own", "mixed"])
def test_a_driver_that_cannot_be_drawn_says_so_in_one_line(name: str, my_drivers: Path) -> None:
    own = FileDriver(my_drivers, "gentle")
    driver = {"human": Human(), "own": residual(own), "mixed": MixedDriver((own, IDM()))}[name]
    with pytest.raises(InputError, match="is not allowed; allowed: drivers that run on tensors") as caught:
        onnx_graph(driver, 1.0)
    assert "\n" not in str(caught.value)


def test_who_asks_for_time_headways_is_not_drawn_without_them() -> None:
    with pytest.raises(InputError, match="gap-maker is not allowed: a graph cannot command time gaps"):
        onnx_graph(driver_from_name("gap-maker", 0.1), 1.0)


def test_without_onnxscript_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(MissingPartError, match=r"pip install 'unjam\[train\]'"):
        onnx_graph(IDM(), 1.0)


@pytest.mark.parametrize("name", ["jam-ahead", "pi", "cruise", "ovm"])
def test_a_described_graph_needs_of_a_road_what_its_driver_needs(name: str) -> None:
    driver = driver_from_name(name, 0.1)
    content = describe_graph(linear(1, [1.0]).SerializeToString(), driver, 1.0, 0.1)
    (text,) = (metadata_prop.value for metadata_prop in parse_model(content).metadata_props)
    described = build_dataclass(PolicyDescription, parse_toml(text), "")
    found = merge_requirements(*(feature(each).requirements for each in described.inputs))
    expected = driver.requirements()
    assert (found.needs_loop, found.needs_coordinate) == (expected.needs_loop, expected.needs_coordinate)
    assert found.required_fields >= expected.required_fields
