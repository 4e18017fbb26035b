"""A certificate states what is true, and a false one is detected."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from unjam.cli import app
from unjam.controller import certificate as certificates
from unjam.controller import string_stability
from unjam.controller.certificate import (
    OperatingDomain,
    certify_driver,
    describe_string_stability,
    describe_worst_cases,
    make_certificate,
)
from unjam.controller.domain import outside_domain_share
from unjam.controller.file import (
    CERTIFICATE_PART,
    MANIFEST_PART,
    SAMPLE_PART,
    Controller,
    add_certificate,
    controller_bytes,
    pack_parts,
    read_controller,
    sample_bytes,
    unpack_parts,
)
from unjam.controller.string_stability import human_gain, string_gains
from unjam.controller.verify import verify_controller_file
from unjam.drivers import ACC, IDM, Driver, FollowerStopper, LocalState, PISaturation
from unjam.drivers.car_following import Constant
from unjam.drivers.safety import INSTANT_ACTUATOR, Actuator, SafetyFilter
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError
from unjam.files import sha256_of
from unjam.physics.idm import PAPER_IDM, IDMParameters, equilibrium_gap
from unjam.reports.certificate import write_certificate_page
from unjam.scenarios import Ring
from unjam.training.run_folder import controller_origin


@pytest.fixture(autouse=True)
def few_attacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(certificates, "ATTACK_POPULATION", 24)
    monkeypatch.setattr(certificates, "ATTACK_GENERATIONS", 3)
    monkeypatch.setattr(string_stability, "OSCILLATION_FREQUENCIES", np.geomspace(0.02, 0.5, 5))
    monkeypatch.setattr(string_stability, "SETTLING_SECONDS", 100.0)


SLOW_CAR = Actuator(delay=0.2, lag=0.3)


def filter_driver(driver: Driver, actuator: Actuator = INSTANT_ACTUATOR, **changes: Any) -> FilteredDriver:
    return FilteredDriver(driver, 1.0, SafetyFilter(**changes), 0.1, actuator)


def visited_states(count: int = 60) -> LocalState:
    speed = np.linspace(0.0, 5.0, count)
    return LocalState(
        speed, speed[::-1].copy(), 8.0 + 3.0 * speed, speed, 9.0 + speed, speed * 0.0, speed * 0.0 + 245.0
    )


@pytest.mark.parametrize("actuator", [INSTANT_ACTUATOR, SLOW_CAR])
def test_a_reckless_driver_behind_its_filter_has_no_contact(actuator: Actuator) -> None:
    worst = certify_driver(filter_driver(Constant(1.0), actuator), visited_states(), PAPER_IDM).worst_cases
    assert worst.contacts == 0
    assert worst.min_gap >= 1.0 - 1e-6
    assert worst.min_gap < (1.0 + 1e-6 if actuator.is_instant else 4.0)
    assert worst.min_time_gap > 1.0
    assert 1.0 < worst.max_braking <= 6.0 + 1e-9
    assert worst.steps > 30_000


def test_a_filter_that_does_not_act_is_found_out() -> None:
    bare = filter_driver(Constant(1.0), active=False)
    assert certify_driver(bare, visited_states(), PAPER_IDM).worst_cases.contacts > 0


@pytest.mark.parametrize(
    ("step", "states", "message"),
    [
        (0.1, visited_states()._replace(leader_gap=np.zeros(60), leader_speed=np.zeros(60)), "cannot avoid contact"),
        (60.0, visited_states(), "control step: 60.0 is not allowed; allowed: at most 20 s"),
    ],
)
def test_a_sample_or_control_step_without_an_answer_is_refused(step: float, states: LocalState, message: str) -> None:
    driver = FilteredDriver(Constant(1.0), 1.0, SafetyFilter(), step, INSTANT_ACTUATOR)
    with pytest.raises(InputError, match=message):
        certify_driver(driver, states, PAPER_IDM)


@pytest.mark.parametrize("humans", [PAPER_IDM, IDMParameters(time_headway=1.6, max_acceleration=2.0)])
def test_the_measured_gain_of_an_idm_is_that_of_the_linearised_one(humans: IDMParameters) -> None:
    idm = FilteredDriver(IDM(**asdict(humans)), 3.0, SafetyFilter(time_gap=0.0), 0.1)
    for each in certify_driver(idm, visited_states(), humans).string_stability:
        assert each.speed in (1.2, 2.5, 3.8)
        np.testing.assert_allclose(each.gains, each.human_gains, atol=0.05)


@pytest.mark.parametrize(("acceleration", "stable"), [(0.6, False), (1.0, False), (1.6, False), (3.0, True)])
def test_people_amplify_sway_exactly_where_the_idm_is_known_to_be_unstable(acceleration: float, stable: bool) -> None:
    humans, v = IDMParameters(max_acceleration=acceleration), 4.0
    s, wanted = equilibrium_gap(v, humans), 2.0 + v
    f_s = 2.0 * acceleration * wanted**2 / s**3
    f_v = -acceleration * (4.0 * v**3 / 30.0**4 + 2.0 * wanted / s**2)
    f_dv = acceleration * 2.0 * wanted / s**2 * v / (2.0 * np.sqrt(acceleration * 1.5))
    assert (f_v**2 / 2.0 - f_v * f_dv >= f_s) == stable  # Treiber and Kesting 2013, Eq. 15.31
    low = np.geomspace(1e-3, 3.0, 200) / (2.0 * np.pi)
    assert (human_gain(low, v, humans).max() <= 1.0 + 1e-6) == stable


def test_a_vehicle_that_stands_still_does_not_count_as_string_stable(tmp_path: Path) -> None:
    still = certify_driver(filter_driver(Constant(-1.0)), visited_states(), PAPER_IDM)
    assert all(np.isnan(each.gains).all() and not each.max_stable_followers for each in still.string_stability)
    file = written(tmp_path, filter_driver(Constant(-1.0)))
    controller = read_controller(file)
    certificate = make_certificate(controller)
    verdict = describe_string_stability(certificate, filter_driver(Constant(-1.0)))
    assert verdict.startswith("string stability is unknown, ")
    assert verdict.endswith("m/s it falls behind its leader")
    write_certificate_page("still", filter_driver(Constant(-1.0)), certificate, verdict, tmp_path / "page.html")
    assert "it falls behind its leader: its string stability is unknown" in (tmp_path / "page.html").read_text()
    add_certificate(file, controller, certificate)
    verify_controller_file(file)


def test_a_state_outside_of_the_domain_is_told_from_one_within() -> None:
    domain = OperatingDomain((0.0, 5.0), (0.0, 6.0), (2.0, 30.0))
    states = visited_states(3)._replace(speed=np.array([4.0, 5.5, 4.0]), leader_gap=np.array([9.0, 9.0, 40.0]))
    assert domain.contains(states).tolist() == [True, False, False]


def written(folder: Path, driver: Driver | None = None) -> Path:
    driver = driver or filter_driver(PISaturation())
    file, ring = folder / "ring.unjam", Ring(actuator=INSTANT_ACTUATOR)
    sample = sample_bytes(driver, visited_states(), 6.0)
    file.write_bytes(controller_bytes(driver, controller_origin(ring, driver), {SAMPLE_PART: sample}))
    return file


@pytest.mark.long
def test_a_certificate_becomes_a_part_of_the_file_and_is_tried_again(tmp_path: Path) -> None:
    file = written(tmp_path)
    controller = read_controller(file)
    found = make_certificate(controller)
    add_certificate(file, controller, found)
    assert json.loads(read_controller(file).parts[CERTIFICATE_PART]) == json.loads(json.dumps(found))
    (said,) = [each.detail for each in verify_controller_file(file) if each.part == "certificate"]
    assert "0 contacts" in said
    write_certificate_page(file.name, filter_driver(PISaturation()), found, "not string stable", tmp_path / "page.html")
    assert "No contact in" in (tmp_path / "page.html").read_text()


@pytest.mark.slow
def test_a_certificate_that_was_changed_is_refused_even_with_a_right_hash(tmp_path: Path) -> None:
    file = written(tmp_path)
    controller = read_controller(file)
    found = make_certificate(controller)
    found["worst_cases"]["min_gap"] += 0.5
    add_certificate(file, controller, found)
    with pytest.raises(InputError, match=r"certificate\.worst_cases\.min_gap: 1\.5"):
        verify_controller_file(file)
    parts = {**read_controller(file).parts, CERTIFICATE_PART: b"{}"}
    manifest = json.loads(parts.pop(MANIFEST_PART))
    manifest["sha256"] = {name: sha256_of(part) for name, part in parts.items()}
    file.write_bytes(pack_parts({MANIFEST_PART: json.dumps(manifest).encode(), **parts}))
    with pytest.raises(InputError, match=r"certificate\.comfort: nothing is not allowed"):
        verify_controller_file(file)


@pytest.mark.slow
def test_the_certificate_of_another_controller_is_refused_even_with_a_right_hash(tmp_path: Path) -> None:
    file = written(tmp_path, filter_driver(FollowerStopper()))
    other = make_certificate(read_controller(file))
    file = written(tmp_path)
    own = make_certificate(read_controller(file))
    assert own["worst_cases"]["contacts"] == other["worst_cases"]["contacts"], "both say that nothing was touched"
    for copied in (other, {**own, "worst_cases": other["worst_cases"]}):
        add_certificate(written(tmp_path), read_controller(file), copied)
        with pytest.raises(InputError, match="controller: certificate"):
            verify_controller_file(file)


@pytest.mark.slow
def test_counts_and_answers_of_a_certificate_are_compared_exactly(tmp_path: Path) -> None:
    file = written(tmp_path)
    for change in (
        lambda found: found["worst_cases"].update(steps=found["worst_cases"]["steps"] + 1),
        lambda found: found["worst_cases"].update(contacts=False),
        lambda found: found["comfort"].update(meets_iso_15622=int(found["comfort"]["meets_iso_15622"])),
        lambda found: found.update(another=1),
    ):
        found = make_certificate(read_controller(written(tmp_path)))
        change(found)
        add_certificate(file, read_controller(file), found)
        with pytest.raises(InputError, match="controller: certificate"):
            verify_controller_file(file)


@pytest.mark.parametrize("driver", [PISaturation(), filter_driver(PISaturation(), active=False)])
def test_what_has_no_filter_has_no_certificate(driver: Driver, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="without safety filter"):
        make_certificate(read_controller(written(tmp_path, driver)))


def test_a_controller_that_names_no_road_is_not_certified(tmp_path: Path) -> None:
    file = written(tmp_path)
    parts = unpack_parts(file)
    manifest = json.loads(parts.pop(MANIFEST_PART))
    del manifest["scenario"]
    file.write_bytes(pack_parts({MANIFEST_PART: json.dumps(manifest).encode(), **parts}))
    with pytest.raises(InputError, match="a controller without a scenario is not allowed"):
        make_certificate(read_controller(file))


def test_speeds_that_nobody_behind_would_drive_are_left_out_of_the_strings() -> None:
    slow = IDMParameters(desired_speed=4.0)
    found = certify_driver(filter_driver(PISaturation()), visited_states(), slow)
    assert found.string_stability
    assert all(each.speed < 4.0 for each in found.string_stability)


def test_a_filter_for_another_actuator_than_that_of_its_road_is_not_certified(tmp_path: Path) -> None:
    file = written(tmp_path)
    parts = unpack_parts(file)
    manifest = json.loads(parts.pop(MANIFEST_PART))
    manifest["scenario"]["actuator"]["lag"] = 0.5
    file.write_bytes(pack_parts({MANIFEST_PART: json.dumps(manifest).encode(), **parts}))
    with pytest.raises(InputError, match=r"a filter for Actuator.* is not allowed on its road; allowed: .*lag=0.5"):
        make_certificate(read_controller(file))


@pytest.mark.parametrize("actuator", [INSTANT_ACTUATOR, SLOW_CAR])
def test_the_gain_of_an_acc_is_that_of_its_transfer_function(actuator: Actuator) -> None:
    acc, step = ACC(time_gap=2.0), 0.1
    driver = FilteredDriver(acc, 3.0, SafetyFilter(active=False), step, actuator)
    frequencies = string_stability.OSCILLATION_FREQUENCIES
    z, remaining = np.exp(2j * np.pi * frequencies * step), np.exp(-step / actuator.lag) if actuator.lag else 0.0
    actuated = (1.0 - remaining) / (1.0 - remaining / z) * z ** -actuator.delay_steps(step)
    following = acc.speed_gain + acc.gap_gain * step * z / (z - 1.0)  # gaps change with the speeds after the step
    expected = np.abs(following / ((z - 1.0) / (step * actuated) + following + acc.gap_gain * acc.time_gap))
    np.testing.assert_allclose(string_gains(driver, [3.0], PAPER_IDM)[0], expected, atol=0.01)


@pytest.mark.long
def test_a_damaged_certificate_is_one_line_and_costs_no_drive(tmp_path: Path) -> None:
    file = written(tmp_path)
    add_certificate(file, read_controller(file), make_certificate(read_controller(file)))
    parts = {**unpack_parts(file), CERTIFICATE_PART: b"{]"}
    manifest = json.loads(parts.pop(MANIFEST_PART))
    manifest["sha256"] = {name: sha256_of(part) for name, part in parts.items()}
    file.write_bytes(pack_parts({MANIFEST_PART: json.dumps(manifest).encode(), **parts}))
    with pytest.raises(InputError, match="the controller is damaged: JSONDecodeError"):
        verify_controller_file(file)
    assert outside_domain_share(read_controller(file), visited_states()) == 0.0


def test_the_line_of_a_certificate_names_what_it_assumes() -> None:
    driver = filter_driver(PISaturation(), leader_braking=7.5)
    text = describe_worst_cases(asdict(certify_driver(driver, visited_states(), PAPER_IDM)), driver)
    assert "brake with at most 7.5 m/s2, from " in text
    assert " states at 0 to 5 m/s with gaps of 8 to 23 m: 0 contacts" in text


def test_gaps_on_a_closed_road_may_be_nearly_as_long_as_the_road() -> None:
    wide = visited_states()._replace(leader_gap=np.full(60, 250.0), loop_length=np.full(60, 420.0))
    assert certify_driver(filter_driver(PISaturation()), wide, PAPER_IDM).domain.leader_gap == (250.0, 250.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"leader_gap": np.full(60, 1e9)}, "gap of the sample is not allowed; allowed: 0 to 245 in each state"),
        ({"leader_gap": np.full(60, -3.0)}, "gap of the sample is not allowed"),
        (
            {"leader_gap": np.full(60, 1e9), "loop_length": np.full(60, 1e12)},
            r"gap of the sample is not allowed; allowed: 0 to 1e\+07",
        ),
        ({"speed": np.full(60, np.nan)}, "speed of the sample is not allowed; allowed: 0 to 100"),
    ],
)
def test_states_that_no_cav_observes_are_not_certified(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=f"certify: {words}"):
        certify_driver(filter_driver(PISaturation()), visited_states()._replace(**change), PAPER_IDM)
    with pytest.raises(InputError, match="certify: a sample of 5 states is not allowed; allowed: 21 or more"):
        certify_driver(filter_driver(PISaturation()), visited_states(5), PAPER_IDM)


@pytest.mark.parametrize("page", [None, "<html>"])
def test_a_certificate_that_is_not_stored_leaves_no_page(
    page: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, target = written(tmp_path), tmp_path / "page.html"
    certificate = make_certificate(read_controller(file))
    if page:
        target.write_text(page)

    def change_controller(controller: Controller) -> dict[str, Any]:
        written(tmp_path, filter_driver(ACC()))
        return certificate

    monkeypatch.setattr(certificates, "make_certificate", change_controller)
    ran = CliRunner().invoke(app, ["certify", str(file), "--out", str(target)])
    assert isinstance(ran.exception, InputError)
    assert "changed" in str(ran.exception)
    assert (target.read_text() if target.exists() else None) == page
