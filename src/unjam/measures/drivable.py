"""Could a car have driven so? A verdict on what was measured of a driver, or the first reason against it."""

from collections.abc import Sequence
from math import isnan
from typing import Any

FLOOR_MET = 0.9
"""share of the demanded time headway that must be left at any moment"""
USUAL_FLOOR = 1.0
"""time headway that is demanded where a road names none [s]"""
SMALLEST_TTC = 1.0
"""[s]"""
HARDEST_BRAKING = 6.0
"""[m/s2]"""
TOLERANCE = 1e-6

DRIVABLE = "drivable"


def drivable(row: dict[str, Any], people_alone: float = 0.0) -> str:
    """Return the verdict on an episode: `drivable`, or the first reason why not.

    Empty where nobody automated drove, or the episode failed.

    Args:
        row: what was measured of it.
        people_alone: how often in a million moments people brake beyond 4.5 m/s2 where there are no CAVs.
    """
    if row["status"] == "failed" or isnan(row["cav_max_braking"]):
        return ""
    floor = row["floor"] or USUAL_FLOOR
    checks = (
        (row["collisions"] > 0, f"{row['collisions']:.0f} vehicles in contact"),
        (
            row["min_headway"] < FLOOR_MET * floor - TOLERANCE,
            f"follows at {row['min_headway']:.2f} s (floor {floor:g} s)",
        ),
        (row["cav_min_ttc"] < SMALLEST_TTC - TOLERANCE, f"{row['cav_min_ttc']:.2f} s to a collision"),
        (
            row["cav_max_braking"] > HARDEST_BRAKING + TOLERANCE,
            f"brakes with {row['cav_max_braking']:.1f} m/s2",
        ),
        (row["overridden"] > 0, f"SUMO overrides {100 * row['overridden']:.2g} % of its commands"),
        (
            row["people_beyond_4_5"] > people_alone,
            f"people brake beyond 4.5 m/s2 {row['people_beyond_4_5']:.0f} times in a million moments "
            f"({people_alone:.0f} without CAVs)",
        ),
    )
    return next((reason for fails, reason in checks if fails), DRIVABLE)


def verdicts(rows_by_driver: dict[str, list[dict[str, Any]]]) -> dict[str, str]:
    """Return the verdict on each driver of a road; people alone, where they are among them, are `human`."""
    people = rows_by_driver.get("human", [])
    return {label: drivable_in_all(rows, people) for label, rows in rows_by_driver.items()}


def drivable_in_all(rows: Sequence[dict[str, Any]], people: Sequence[dict[str, Any]] = ()) -> str:
    """Return one verdict on all episodes of a driver: the first reason against any of them, and how many.

    `people` are the episodes of the same road in which nobody is automated: what people do there is no
    driver's fault.
    """
    alone = [row["people_beyond_4_5"] for row in people if row["status"] != "failed"]
    share = sum(alone) / len(alone) if alone else 0.0
    verdicts = [drivable({**row, "people_beyond_4_5": 0.0}) for row in rows]
    wrong = [verdict for verdict in verdicts if verdict not in ("", DRIVABLE)]
    if wrong:
        return f"{wrong[0]} ({len(wrong)} of {len(verdicts)})"
    judged = [row for row, verdict in zip(rows, verdicts, strict=True) if verdict]
    if not judged:
        return ""
    mean = sum(row["people_beyond_4_5"] for row in judged) / len(judged)
    return drivable({**judged[0], "people_beyond_4_5": mean}, share)
