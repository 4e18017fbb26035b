"""Backends: SUMO, the batch, and one of a user's own, which docs/architecture.md shows."""

import json
import re
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import unjam
from tests.test_architecture import EXAMPLES
from unjam.drivers import IDM, Constant, Human, PISaturation
from unjam.drivers.local_state import LocalState
from unjam.drivers.road_experts import Cruise
from unjam.drivers.safety import INSTANT_ACTUATOR, SafetyFilter
from unjam.drivers.user_driver import FileReference
from unjam.environments.gymnasium_env import RoadEnv
from unjam.errors import InputError, UnjamError
from unjam.files import sha256_of_file
from unjam.measures.feasibility import feasibility
from unjam.measures.metrics import measure
from unjam.physics.arrays import Array
from unjam.reports.video import write_video
from unjam.scenarios import Merge, Ring
from unjam.scenarios.motorway import ON_RAMP
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import Scenario
from unjam.training.config import load_config
from unjam.training.fingerprint import fingerprint
from unjam.worlds.backend import DEFAULT_OPTIONS, Backend
from unjam.worlds.batch.backend import BatchBackend
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

RING = Ring(horizon=60, length=(230, 230), actuator=INSTANT_ACTUATOR)


@pytest.fixture
def own(tmp_path: Path) -> str:
    """The file of the page with a user's backend, as `path.py:name`."""
    (tmp_path / "idm_rings.py").write_text(EXAMPLES["A backend"].split("'''")[1])
    return f"{tmp_path / 'idm_rings.py'}:IDMRings"


def backend_object(reference: str) -> Any:
    return FileReference.parse(reference).load_object()()


def test_a_users_backend_runs_the_same_episode_by_name_as_an_object_and_in_a_worker(own: str) -> None:
    ring = replace(RING, cavs=2)
    here = run_episode(ring, PISaturation(), 3, backend=own)
    with WorkerPool(1) as workers:
        (there,) = workers.run([EpisodeTask(ring, PISaturation(), (3,), backend=own)])
    for episode in (run_episode(ring, PISaturation(), 3, backend=backend_object(own)), there):
        np.testing.assert_array_equal(episode.speeds, here.speeds)
    assert (here.status, here.control_steps, len(here.trajectories)) == ("completed", 60, 2)
    assert here.audit.cav_braking.samples == 2 * 60
    assert not np.array_equal(here.speeds, run_episode(ring, PISaturation(), 3).speeds)  # other human drivers


def test_environments_step_the_episodes_of_a_users_backend(own: str) -> None:
    expected = run_episode(RING, Constant(acceleration=0.3), 7, backend=own)
    rewards = []
    options: dict[str, Any] = {"length": 230, "horizon": 60, "actuator": {"delay": 0.0, "lag": 0.0}}
    with closing(gymnasium.make("unjam/Ring-v0", backend=backend_object(own), **options)) as environment:
        environment.reset(seed=7)
        truncated = False
        while not truncated:
            _, reward, _, truncated, _ = environment.step(np.array([0.3]))
            rewards.append(reward)
    np.testing.assert_allclose(rewards, expected.trajectories[0].reward, atol=1e-12)
    with closing(unjam.parallel_env("ring", cavs=2, backend=own)) as several:
        assert sorted(several.reset(seed=0)[0]) == several.agents


def test_a_users_backend_drives_in_this_process_as_an_object(own: str) -> None:
    options: dict[str, Any] = {"scenario_options": {"horizon": 20}, "workers": 1}
    by_name, as_object = (
        unjam.drive("ring", "pi", 2, backend=each, **options).rows["pi"] for each in (own, backend_object(own))
    )
    assert [row["mean_speed"] for row in by_name] == [row["mean_speed"] for row in as_object]


@pytest.mark.parametrize(("scenario", "kind"), [("ring", "batch"), ("ring", "own"), ("on-ramp", "batch")])
def test_results_of_every_backend_have_a_report(
    scenario: str, kind: str, own: str, tmp_path: Path, without_pictures: None
) -> None:
    options: dict[str, Any] = {"horizon": 40, **({"penetration_rate": 0.5} if scenario == "on-ramp" else {})}
    settings: dict[str, Any] = {"backend": own if kind == "own" else kind, "out": tmp_path / "results", "workers": 1}
    result = unjam.drive(scenario, ["human", "idm"], 1, scenario_options=options, **settings)
    assert result.report is not None
    (note,) = [each for each in result.notes if each.startswith("simulated by the backend")]
    extent = "except for rounding" if scenario == "ring" else "in distribution"
    assert (f"{own}, not by SUMO" if kind == "own" else f"batch: equal to SUMO {extent}") in note
    stored = json.loads((tmp_path / "results" / "evaluation.json").read_text())
    names = stored["backend"], result.document()["drivers"][0]["backend"]
    assert names == (settings["backend"],) * 2
    page, is_drawn = result.report.read_text(), scenario == "ring"
    assert ("The backend does not record where vehicles are" in page) is not is_drawn
    assert len(json.loads(page.split('application/json">')[1].split("</script>")[0])["drivers"]) == 2 * is_drawn
    if not is_drawn:
        with pytest.raises(InputError, match="video: the backend does not record where vehicles are"):
            write_video(result.plot_episodes["human"], tmp_path / "a.gif", "")


@pytest.mark.parametrize(
    ("backend", "message"),
    [
        ("carla", r"backend: 'carla' is not allowed; allowed: sumo, sumo-gui, batch, path\.py:name"),
        (object(), r"backend: object has no supports\(\) and no open\(\)"),
        ("missing.py:Backend", "is not a file"),
    ],
)
def test_what_is_no_backend_is_refused_in_one_line(backend: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        run_episode(RING, IDM(), 0, backend=backend)


FAULTY_BACKENDS = """
class NeedsArguments(IDMRings):
    def __init__(self, address): pass

class AnswersYes(IDMRings):
    def supports(self, scenario): return True

class AnswersNothing(IDMRings):
    def supports(self, scenario): pass

class ReturnsTheWorld(IDMRings):
    def open(self, scenario, seed, options): return IDMRing(scenario, seed)

def make_backend(name, **methods):
    world = type(name + "World", (IDMRing,), methods)
    return type(name, (IDMRings,), {"open": lambda self, *arguments: nullcontext(world(*arguments[:2]))})

def set_nan(self, commands):
    IDMRing.simulate(self, commands)
    if self.control_steps == 20: self.speeds[3] = np.nan
NaNSpeed = make_backend("NaNSpeed", simulate=set_nan)

def reverse(self, commands):
    IDMRing.simulate(self, commands)
    if self.control_steps == 20: self.speeds[3] = -1.0
Reverses = make_backend("Reverses", simulate=reverse)

change_state = lambda **fields: lambda self: IDMRing.exact_state(self)._replace(**fields)
NaNGap = make_backend("NaNGap", exact_state=change_state(leader_gap=np.full(1, np.nan)))
WrongShape = make_backend("WrongShape", exact_state=change_state(leader_gap=np.ones(7)))
NoState = make_backend("NoState", exact_state=lambda self: {})
NoGap = make_backend("NoGap", exact_state=change_state(leader_gap=None))

def forget_step(self, command):
    IDMRing.advance(self, command)
    self.control_steps = 0
NoCount = make_backend("NoCount", advance=forget_step)

def move_on(self, commands):
    IDMRing.simulate(self, commands)
    self.positions = self.positions + 0.02
Drifts = make_backend("Drifts", simulate=move_on)

def stretch(self, log):
    episode = IDMRing.record(self, log)
    return replace(episode, positions=1.5 * episode.positions)
Stretches = make_backend("Stretches", record=stretch)

Fails = make_backend("Fails", simulate=lambda self, commands: 1 / 0)
NoRecord = make_backend("NoRecord", record=lambda self, log: None)
DropsSteps = make_backend("DropsSteps", record=lambda self, log: replace(
    IDMRing.record(self, log), speeds=np.zeros((3, 22))))

def ignore(self, command):
    accelerations = self.limited_accelerations(command)
    self.recorder.series["requested_accelerations"].extend(accelerations)
    self.recorder.series["safe_accelerations"].extend(accelerations)
    self.recorder.series["commanded_speeds"].append(0.0)
    self.simulate([])
    self.control_steps += 1
Ignores = make_backend("Ignores", advance=ignore)
"""


@pytest.fixture
def faulty(own: str) -> str:
    """The path of the file of the page with faulty backends."""
    path = Path(own.rpartition(":")[0])
    imports = "from contextlib import nullcontext\nfrom dataclasses import replace\n"
    path.write_text(imports + path.read_text() + FAULTY_BACKENDS)
    return str(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("NeedsArguments", "TypeError: .*'address'"),
        ("AnswersYes", r"supports\(\) returns True; allowed: a reason"),
        ("AnswersNothing", r"supports\(\) returns None; allowed: a reason"),
        ("ReturnsTheWorld", r"open\(\) returns IDMRing; allowed: a context manager"),
        ("NaNSpeed", "speed of human_3 is nan at 2.1 s; allowed: finite"),
        ("Reverses", "speed of human_3 is -1.00 at 2.1 s; allowed: at least 0"),
        ("NoCount", "control_steps is 0 at 0.1 s; allowed: 1"),
        ("Fails", r"ZeroDivisionError: division by zero \(idm_rings.py, line \d+\)"),
        ("NaNGap", "leader_gap of cav_0 is nan at 6 s; allowed: finite"),
        ("WrongShape", r"leader_gap has shape \(7,\) at 6 s; allowed: \(1,\)"),
        ("NoState", r"local_state\(\) returns dict at 6 s; allowed: LocalState"),
        ("NoGap", r"local_state\(\) has no leader_gap at 6 s"),
        ("NoRecord", r"record\(\) returns NoneType at 6 s; allowed: Episode"),
        ("DropsSteps", r"record\(\) has 2 control steps at 6 s; allowed: 60"),
        ("Stretches", r"_\d+ has moved .* m according to its positions at 6 s; allowed: .* m, the sum"),
        ("Drifts", r"route_position of cav_0 is .* in the state at 6 s; allowed: .*, as in the record"),
    ],
)
def test_a_faulty_backend_is_named_with_the_fault_in_one_line(name: str, message: str, faulty: str) -> None:
    with pytest.raises(InputError, match=rf"^backend: .*idm_rings.py:{name}: .*{message}"):
        run_episode(RING, Human(), 0, backend=f"{faulty}:{name}")


@pytest.mark.parametrize(
    ("name", "message"),
    [("NaNGap", "leader_gap of cav_0 is nan at 0 s"), ("NaNSpeed", "speed of human_3 is nan at 2.1 s")],
)
def test_the_fault_of_a_backend_is_not_that_of_the_driver_nor_of_an_environment(
    name: str, message: str, faulty: str
) -> None:
    with pytest.raises(InputError, match=f"idm_rings.py:{name}: {message}"):
        run_episode(RING, PISaturation(), 0, backend=f"{faulty}:{name}")
    with closing(RoadEnv("ring", backend=f"{faulty}:{name}")) as environment:

        def step_often() -> None:
            environment.reset(seed=0)
            for _ in range(30):
                environment.step(np.zeros(1))

        with pytest.raises(InputError, match=message):
            step_often()


def test_commands_that_a_backend_does_not_carry_out_are_counted(own: str, faulty: str) -> None:
    def stop(state: LocalState) -> Array:  # a standing vehicle cannot brake any more
        return np.where(state.route_position < 1.0, 0.5, -0.73)

    shares = [measure(run_episode(RING, each, 0, backend=own))["override_share"] for each in (IDM(), stop)]
    assert shares == [0.0, 0.0]
    row = measure(run_episode(RING, IDM(), 0, backend=f"{faulty}:Ignores"))
    assert row["override_share"] > 0.5
    assert feasibility(row).startswith("the simulator overrides")


def test_a_backend_is_given_as_a_class_too(own: str) -> None:
    kind = type(backend_object(own))
    by_class, by_name = (run_episode(RING, IDM(), 0, backend=each).speeds for each in (kind, own))
    np.testing.assert_array_equal(by_class, by_name)
    assert unjam.drive("ring", "idm", 1, scenario_options={"horizon": 5}, backend=kind, workers=1).rows["idm"]


def test_a_backend_without_optional_fields_serves_drivers_that_do_not_need_them(own: str) -> None:
    for driver in (lambda state: 0.0 * state.speed, unjam.make_driver("unjam:best", RING.control_step)):
        assert run_episode(replace(RING, horizon=5), driver, 0, backend=own).status == "completed"


def test_a_scenario_that_a_backend_does_not_support_is_refused_with_its_reason(own: str) -> None:
    for attempt in (
        lambda: run_episode(Merge(), Human(), 0, backend=own),
        lambda: RoadEnv("merge", cavs=1, backend=own),
        lambda: unjam.drive("merge", "idm", 1, backend=own),
        lambda: unjam.train(load_config(changes={"scenario": "figure-eight", "backend": own}), "run"),
    ):
        with pytest.raises(InputError, match=r"scenario: (merge|figure-eight) is not a ring"):
            attempt()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"warmup": 100}, r"warmup: 100 is not allowed: the backend does not read it; allowed: 0"),
        ({"population": "unjam:ngsim"}, r"population: 'unjam:ngsim' is not allowed: .*; allowed: ''"),
        ({"actuation": "raw"}, r"actuation: 'raw' is not allowed: .*; allowed: 'shielded'"),
        ({"safety": SafetyFilter(time_gap=2.0)}, r"safety: SafetyFilter\(.*time_gap=2.0.* is not allowed"),
    ],
)
def test_a_setting_that_a_backend_does_not_read_must_have_its_default(
    change: dict[str, Any], message: str, own: str
) -> None:
    supports = backend_object(own).supports
    assert not supports(replace(RING, noise=0.4, cavs=3))
    assert re.match(message, supports(replace(RING, **change)))
    with_default = type("Mine", (Ring,), change)  # of its class, not of the kind that the backend knows
    assert re.match(message, supports(with_default()))


def test_a_member_of_a_users_class_that_a_backend_does_not_read_is_refused(own: str) -> None:
    supports = backend_object(own).supports
    assert not supports(type("Stretched", (Ring,), {"draw": TrackScenario.draw})())
    assert supports(type("Fast", (Ring,), {"top_speed": 5.0})()).startswith(
        "Fast.top_speed is not allowed: the backend"
    )


@dataclass(frozen=True)
class Track(ClosedRoad):
    """A kind of road that no backend of unjam knows."""


@dataclass(frozen=True)
class TrackScenario(Ring):
    def draw(self, generator: np.random.Generator) -> ClosedRoad:
        return Track(**vars(super().draw(generator)))


def test_an_opened_backend_refuses_what_it_cannot_simulate(sumo: SumoBackend) -> None:
    refused: tuple[tuple[Backend, Scenario, str], ...] = (
        (sumo, TrackScenario(), "scenario: Track is not allowed as the road of SUMO; allowed: ClosedRoad"),
        (BatchBackend(), Merge(), "scenario: .*merge"),
    )
    for backend, scenario, message in refused:
        with pytest.raises(InputError, match=message), backend.open(scenario, (0,), DEFAULT_OPTIONS):
            pass


def test_batches_of_motorways_refuse_other_arrays_than_those_of_numpy() -> None:
    with pytest.raises(InputError, match=r"to_array: .*allowed: numpy\.asarray"):
        run_batch([EpisodeTask(ON_RAMP, Cruise(), (0,))], torch.as_tensor, allow_statistical=True)


def test_the_code_of_a_backend_belongs_to_the_fingerprint_of_a_training(own: str) -> None:
    files = fingerprint(load_config(changes={"backend": own}))["files"]
    assert files[own.partition(":")[0]] == sha256_of_file(Path(own.partition(":")[0]))


def test_a_training_refuses_an_unknown_backend_at_once() -> None:
    with pytest.raises(InputError, match=r"backend: 'bach' is not allowed; .* did you mean 'batch'"):
        load_config(changes={"backend": "bach"})


def test_another_backend_has_no_window(own: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unjam.environments.gymnasium_env.has_display", lambda: True)
    with pytest.raises(InputError, match="render_mode: 'human' is not allowed; allowed: rgb_array"):
        RoadEnv("ring", render_mode="human", backend=own)
    with closing(RoadEnv("ring", render_mode="rgb_array", backend=own)) as environment:
        environment.reset(seed=0)
        with pytest.raises(UnjamError, match="this backend draws no pictures"):
            environment.render()


def test_a_users_backend_needs_no_sumo(own: str) -> None:
    before = set(sys.modules)
    run_episode(replace(RING, horizon=2), IDM(), 0, backend=own)
    assert not {name for name in set(sys.modules) - before if name.startswith(("libsumo", "traci"))}


def test_a_ring_of_the_batch_is_that_of_sumo() -> None:
    ring = replace(RING, warmup=30)
    batch, sumo = (run_episode(ring, PISaturation(), 3, backend=backend) for backend in ("batch", "sumo"))
    np.testing.assert_allclose(batch.speeds, sumo.speeds, atol=1e-9)
    seen = []
    for backend in ("batch", "sumo"):
        with closing(RoadEnv("ring", length=230, horizon=20, backend=backend, render_mode="rgb_array")) as environment:
            environment.reset(seed=2)
            steps = [environment.step(np.array([0.2]))[:2] for _ in range(19)]
            seen.append([*(np.append(*step) for step in steps), environment.render().mean()])
    np.testing.assert_allclose(seen[0][:-1], seen[1][:-1], atol=1e-6)
    assert seen[0][-1] == pytest.approx(seen[1][-1], abs=1e-3)


def test_an_on_ramp_of_the_batch_is_stepped_as_an_environment() -> None:
    scenario = replace(ON_RAMP, peak=(0.0, 60.0), horizon=60, penetration_rate=0.3)
    episode = run_episode(scenario, Constant(acceleration=0.2), 1, backend="batch")
    options: dict[str, Any] = {"peak": (0.0, 60.0), "horizon": 60, "penetration_rate": 0.3}
    with closing(unjam.parallel_env("on-ramp", backend="batch", **options)) as environment:
        environment.reset(seed=1)
        while environment.agents:
            environment.step({agent: np.array([0.2]) for agent in environment.agents})
        world = environment._road.world
        assert (world.control_steps, world.has_crashed) == (episode.control_steps, episode.status == "collision")
        speeds = episode.speeds[-1]
        np.testing.assert_allclose(np.sort(world.speeds), np.sort(speeds[~np.isnan(speeds)]))
