"""Notes report early ends, SUMO's warnings and missing demand."""

from typing import Any

import pytest

from unjam.errors import InputError
from unjam.measures.notes import MAX_WARNING_KINDS, check_baseline, count_early_ends, episode_notes


def rows_of(count: int, **changes: Any) -> list[dict[str, Any]]:
    usual = {"status": "completed", "reason": "", "teleports": 0, "insertion_backlog_veh": 0.0, "vehicles": 50}
    return [{**usual, "warnings": [], "seed": seed, **changes} for seed in range(count)]


def warning(kind: str, example: str, count: int = 1) -> dict[str, Any]:
    return {"kind": kind, "example": example, "count": count}


def test_complete_episodes_without_warnings_have_no_notes() -> None:
    failed = {"seed": 9, "status": "failed", "teleports": 0, "reason": "no", "warnings": []}
    assert episode_notes({"human": rows_of(3), "pi": [*rows_of(2), failed]}) == []


def test_note_has_driver_count_and_reasons_of_early_ends() -> None:
    stopped = rows_of(1, status="teleports", reason="more than 0 teleports (max-num-teleports)")
    rows = [*rows_of(2), *rows_of(2, status="collision"), *stopped]
    assert count_early_ends(rows) == {"collision": 2, "more than 0 teleports (max-num-teleports)": 1}
    assert episode_notes({"human": rows_of(5), "pi": rows, "acc": stopped}) == [
        "pi: 3 of 5 episodes ended early: collision (2), more than 0 teleports (max-num-teleports) (1); "
        "means are over complete episodes only",
        "acc: 1 of 1 episode ended early: more than 0 teleports (max-num-teleports); "
        "means are over complete episodes only",
    ]


@pytest.mark.parametrize(("own", "unfinished", "has_note"), [(2400.0, 0, True), (2390.0, 0, False), (2400.0, 1, False)])
def test_flow_that_is_the_demand_with_all_drivers_is_noted(own: float, unfinished: int, has_note: bool) -> None:
    arrived = {"delay_share_at_end": 0.0}
    human = rows_of(2, outflow_veh_per_h=2400.0, unfinished_trips=0, **arrived)
    driven = rows_of(2, outflow_veh_per_h=own, unfinished_trips=unfinished, **arrived)
    notes = episode_notes({"human": human, "acc": driven})
    assert [note.startswith("flow: equal to the demand") for note in notes] == [True] * has_note
    assert episode_notes({"human": human}) == []


def test_note_counts_drives_that_episodes_repeat() -> None:
    def drives(*files: int, begin: float = 0.0) -> list[dict[str, Any]]:
        return [{**row, "file": file, "part": 0, "begin": begin} for row, file in zip(rows_of(9), files, strict=False)]

    consequence = (
        "episodes of the same drive differ only in the noise of human drivers: they count as one in paired "
        "differences, and confidence intervals of single drivers are too narrow"
    )
    assert episode_notes({"human": drives(0, 1, 0), "pi": drives(0, 1)}) == [
        f"3 episodes of 2 recorded drives: {consequence}"
    ]
    assert episode_notes({"pi": drives(2, 2)}) == [f"2 episodes of 1 recorded drive: {consequence}"]
    assert episode_notes({"pi": [*drives(0, 1), *drives(0, begin=9.0)]}) == []


def test_warnings_are_grouped_and_missing_demand_comes_first() -> None:
    stops = [warning("stop %", f"stop {number}", 3) for number in range(3)]
    lost = warning("Route file should be sorted by departure time, ignoring '%'!", "ignoring 'c'!")
    rows = {"human": rows_of(2, warnings=[stops[0], lost]), "pi": rows_of(1, warnings=[stops[1]])}
    assert episode_notes(rows) == [
        "demand is missing, SUMO warns: ignoring 'c'! (2 warnings of this kind in 2 of 3 episodes)",
        "SUMO warns: stop 0 (9 warnings of this kind in 3 of 3 episodes)",
    ]
    assert episode_notes({"human": rows_of(1, warnings=[warning("x", "x")])}) == ["SUMO warns: x"]


def test_number_of_warning_notes_is_limited() -> None:
    kinds = [warning(f"kind {number}", f"kind {number}", 100 - number) for number in range(40)]
    *shown, rest = episode_notes({"human": rows_of(1, warnings=kinds)})
    assert len(shown) == MAX_WARNING_KINDS
    assert shown[0].startswith("SUMO warns: kind 0 ")
    assert rest == "SUMO gives 30 less frequent kinds of warnings"


@pytest.mark.parametrize(("backlog", "noted"), [(2.0, False), (10.0, True)])
def test_insertion_backlog_is_noted(backlog: float, noted: bool) -> None:
    notes = episode_notes({"human": rows_of(2, insertion_backlog_veh=backlog)})
    assert (
        notes
        == ["human: 20 of 120 vehicles had not entered by the end: they wait in the insertion backlog"][: int(noted)]
    )


@pytest.mark.parametrize(
    ("unfinished", "delay_share", "words"), [(2, 0.9, None), (20, 0.2, ""), (20, 0.9, " (traffic is still congested)")]
)
def test_trips_that_have_not_ended_are_noted(unfinished: int, delay_share: float, words: str | None) -> None:
    rows = rows_of(2, unfinished_trips=unfinished, delay_share_at_end=delay_share)
    note = (
        f"human; pi: up to 40 % of the vehicles are under way or waiting at the end{words}; their travel time counts "
        "until then, and a later --end shows more of it"
    )
    assert episode_notes({"human": rows, "pi": rows}) == ([] if words is None else [note])


def test_teleports_are_noted() -> None:
    note = "human: SUMO teleported or removed 6 vehicles, which had waited longer than time-to-teleport or collided"
    assert episode_notes({"human": rows_of(2, teleports=3)}) == [note]


@pytest.mark.parametrize(
    ("early", "complete", "planned", "refused"),
    [(1, 19, 0, False), (2, 18, 0, True), (1, 1, 20, False), (2, 0, 20, True), (1, 1, 0, True), (0, 2, 0, False)],
)
def test_baseline_with_many_early_ends_is_refused(early: int, complete: int, planned: int, refused: bool) -> None:
    rows = [*rows_of(complete), *rows_of(early, status="teleports", reason="more than 0 teleports")]
    if not refused:
        check_baseline(rows, planned)
        return
    words = f"human: {early} of {early + complete} episodes ended early: more than 0 teleports; allowed: 5 %"
    with pytest.raises(InputError, match=words):
        check_baseline(rows, planned)
