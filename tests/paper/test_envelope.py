from pathlib import Path

import pytest

from unjam.controller import PACKAGED_PREFIX, certificate, packaged_names, string_stability
from unjam.scenarios import Ring
from unjam_paper import envelope
from unjam_paper.envelope import ENVELOPE
from unjam_paper.study import StudyFolder


def test_all_packaged_controllers_for_closed_roads_are_tested() -> None:
    closed = {f"{PACKAGED_PREFIX}{name}" for name in packaged_names() if not name.startswith(("on-ramp", "recorded"))}
    assert {*envelope.CONTROLLER_ROADS, *envelope.USUAL_CAR_ROADS} == closed


def test_rings_have_the_documented_range() -> None:
    rings = [ring for _, ring in envelope.envelope_rings()]
    assert {ring.vehicles for ring in rings} == {5, 11, 22, 44}
    assert {ring.cavs for ring in rings} == {1, 2, 3}
    assert {ring.warmup > 0 for ring in rings} == {True, False}
    lengths_of_22 = [ring.length for ring in rings if ring.vehicles == 22]
    assert min(low for low, _ in lengths_of_22) < 220 < 270 < max(high for _, high in lengths_of_22)


def test_without_the_safety_checks_of_sumo_the_safety_filter_is_active() -> None:
    lanes = envelope.envelope_lanes(), envelope.envelope_lanes(**envelope.RING_STEPS)
    for roads in (envelope.envelope_rings(actuation="raw"), *lanes):
        for _, road in roads:
            assert road.actuation == "raw"
            assert road.safety.active


@pytest.mark.slow
def test_all_tables_can_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    controller = "unjam:ring-gap-tuned"
    for name in ("CONTROLLER_ROADS", "USUAL_CAR_ROADS"):
        monkeypatch.setattr(envelope, name, {controller: "ring"})
    for name in ("IMPAIRED_DRIVERS", "RING_CONTROLLERS", "USUAL_CAR_CONTROLLERS", "USUAL_CAR_PACERS"):
        monkeypatch.setattr(envelope, name, (controller,))
    for name in ("ENVELOPE_SEEDS", "RAW_ACTUATION_SEEDS", "IMPAIRED_SEEDS"):
        monkeypatch.setattr(envelope, name, 1)
    short = Ring(length=(60, 60), vehicles=5, horizon=60)
    for name in ("envelope_rings", "envelope_figure_eights"):
        monkeypatch.setattr(envelope, name, lambda *_, **changes: iter([("a short ring", short)]))
    monkeypatch.setattr(envelope, "LANE_SECONDS", 60.0)
    monkeypatch.setattr(envelope, "impaired_rings", lambda warmup: iter([("late", short)]))
    monkeypatch.setattr(certificate, "ATTACK_GENERATIONS", 1)
    monkeypatch.setattr(string_stability, "OPERATING_SPEED_RATIOS", ())

    ENVELOPE.run(StudyFolder(tmp_path), 1, tmp_path, 1)

    tables = {name: table(tmp_path) for name, table in ENVELOPE.tables.items()}
    assert {name: len(table) for name, table in tables.items()} == {**dict.fromkeys(tables, 1), "lanes-raw": 2}
    assert tables["worst"].loc[0, "contacts"] == 0
    assert tables["rings"].loc[0, "feasible on"] == "1 of 1 roads"
    assert tables["rings-raw-usual-car"].loc[0, ["control steps", "in contact"]].tolist() == ["60", 0]
    assert tables["lanes-raw"]["control steps"].tolist() == ["180", "1,800"], "on three lanes for 60 s"
    assert tables["impaired"].columns.tolist() == ["impairment", "human", controller]
