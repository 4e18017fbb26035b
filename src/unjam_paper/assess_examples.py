"""Assessments by `unjam assess` of five small roads, which are written as user networks."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from unjam.measures.recommendation import ControllerResult
from unjam.measures.statistics import Estimate, format_difference
from unjam.scenarios.motorway import ON_RAMP
from unjam.scenarios.road import Connection
from unjam.sumo_files.reader import CAV_TYPE_TEMPLATE
from unjam.training.assess import Assessment, assess
from unjam.training.assessment_request import make_request
from unjam.worlds.sumo.backend import sumo_inputs
from unjam.worlds.sumo.networks import network_file, xml_element
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.open_test_roads import (
    EPISODE_SECONDS,
    OpenTestRoad,
    RoadSection,
    write_configuration,
    write_network,
    write_road_files,
)
from unjam_paper.results_file import read_part
from unjam_paper.study import NO_VALUE_TEXT, Study

EXAMPLES_PART = "roads"
MAX_EPISODES, PRECISION = 51, 0.02
"""episodes per road, ten of them with test seeds; largest half-width of the CI of travel time, relative to its mean"""
BLOCK_LENGTH, SIGNALS, GRID_FLOW, TURNING_FLOW = 250.0, 3, 300.0, 60.0
"""distance of signals [m], signals in each direction, flow on each straight and on each turning route [veh/h]"""
MOTORWAY_FLOW, RAMP_FLOW = 3000.0, 500.0
"""flow on the motorway with SUMO's default vehicles, and on its ramp [veh/h]"""
ON_RAMP_DEMAND = replace(ON_RAMP, peak=(100.0, 700.0), horizon=int(EPISODE_SECONDS))
"""the built-in scenario that is exported"""
Example = tuple[Callable[[Path], Path], float]
"""function that writes the files of a road into a folder and returns the configuration, and the penetration rate"""


def write_grid(folder: Path) -> Path:
    """Write a grid of signals; vehicles of SUMO's default type go straight, or turn left once."""
    inside, ends = range(1, SIGNALS + 1), (0, SIGNALS + 1)
    signals = [(x, y) for x in inside for y in inside]
    points = product((0, *inside, SIGNALS + 1), repeat=2)
    arms = [(x, y) for x, y in points if (x in ends) != (y in ends)]
    kinds = {**dict.fromkeys(signals, "traffic_light"), **dict.fromkeys(arms, "priority")}
    nodes = [(f"n{x}{y}", BLOCK_LENGTH * x, BLOCK_LENGTH * y, kind) for (x, y), kind in kinds.items()]
    edges = [
        (f"{x}{y}to{to_x}{to_y}", f"n{x}{y}", f"n{to_x}{to_y}", 2, 13.89)
        for (x, y), (to_x, to_y) in product(kinds, kinds)
        if abs(x - to_x) + abs(y - to_y) == 1 and ((x, y) in signals or (to_x, to_y) in signals)
    ]
    last, routes = SIGNALS + 1, dict[str, float]()
    for row in inside:
        east, west = (_route_edges([(x, row) for x in line]) for line in (range(last + 1), range(last, -1, -1)))
        north, south = (_route_edges([(row, y) for y in line]) for line in (range(last + 1), range(last, -1, -1)))
        routes |= dict.fromkeys((east, west, north, south), GRID_FLOW)
        left = [*((x, row) for x in range(row + 1)), *((row, y) for y in range(row + 1, last + 1))]
        routes[_route_edges(left)] = TURNING_FLOW
    return write_network(folder, nodes, edges, [], _default_traffic(routes))


def _route_edges(nodes: Sequence[tuple[int, int]]) -> str:
    return " ".join(f"{x}{y}to{to_x}{to_y}" for (x, y), (to_x, to_y) in pairwise(nodes))


def write_ramp(folder: Path) -> Path:
    """Write a motorway of two lanes with an on-ramp and SUMO's default vehicles."""
    positions = {"a": (0.0, 0.0), "b": (1500.0, 0.0), "c": (1800.0, 0.0), "d": (2500.0, 0.0), "r": (1100.0, -80.0)}
    nodes = [(name, x, y, "priority") for name, (x, y) in positions.items()]
    edges = [("before", "a", "b", 2, 33.33), ("merging", "b", "c", 3, 33.33)]
    edges += [("after", "c", "d", 2, 33.33), ("ramp", "r", "b", 1, 22.22)]
    lanes = [("before", "merging", 0, 1), ("before", "merging", 1, 2), ("ramp", "merging", 0, 0)]
    lanes += [("merging", "after", 1, 0), ("merging", "after", 2, 1)]
    traffic = _default_traffic({"before merging after": MOTORWAY_FLOW, "ramp merging after": RAMP_FLOW})
    return write_network(folder, nodes, edges, [Connection(*lane) for lane in lanes], traffic)


def _default_traffic(routes: Mapping[str, float]) -> list[str]:
    """Return a flow of default vehicles for each route [veh/h]."""
    elements = [xml_element("route", id=f"r{index}", edges=edges) for index, edges in enumerate(routes)]
    departure = {"begin": 0, "end": EPISODE_SECONDS, "departLane": "best", "departSpeed": "max"}
    return elements + [
        xml_element("flow", id=f"f{index}", route=f"r{index}", vehsPerHour=flow, **departure)
        for index, flow in enumerate(routes.values())
    ]


def write_on_ramp(folder: Path) -> Path:
    """Write the built-in scenario `on-ramp` as a user network, with its vehicle types and one drawn demand."""
    road = ON_RAMP_DEMAND.draw(np.random.default_rng(1))
    shutil.copy(network_file(road.network), folder / "road.net.xml")
    files = sumo_inputs(ON_RAMP_DEMAND, road)
    cav_type = f'id="{CAV_TYPE_TEMPLATE.format("")}'  # unjam adds the types of CAVs
    lines = [line for line in files.traffic_xml.splitlines() if cav_type not in line]
    (folder / "road.rou.xml").write_text("\n".join(lines))
    names = (name.removeprefix("--") for name in files.options[::2])
    options = dict(zip(names, files.options[1::2], strict=True))
    del options["max-depart-delay"]  # SUMO's default applies
    return write_configuration(folder, options)


TRUCK_ROAD = OpenTestRoad((RoadSection(3000.0, 2, 33.0),), (0.75,), trucks=0.15)
EXAMPLES: dict[str, Example] = {
    "a free road": (partial(write_road_files, OpenTestRoad((RoadSection(3000.0, 2, 25.0),), (0.15,))), 0.1),
    "a signalised grid": (write_grid, 0.1),
    "a road with 15 % trucks": (partial(write_road_files, TRUCK_ROAD), 0.1),
    "an on-ramp with SUMO's default vehicles": (write_ramp, 0.05),
    "the scenario on-ramp as files": (write_on_ramp, 0.1),
}


def assess_example(name: str, rate: float, max_episodes: int, precision: float, workers: int) -> dict[str, Any]:
    """Return the assessment of an example at a penetration rate."""
    with TemporaryDirectory() as folder, WorkerPool(workers) as pool:
        road, results = Path(folder, "road"), Path(folder, "assessment")
        road.mkdir()
        write_files, _ = EXAMPLES[name]
        request = make_request(str(write_files(road)), [rate], max_episodes, precision)
        assessment = assess(request, results, pool, on_message=partial(print, flush=True))
    document = assessment.document
    return {
        "settings": {"rate": rate, "episodes": max_episodes, "seconds": None, "precision": precision},
        "headline": document["headline"],
        "sentences": [result.summary for result in (*assessment.controller_results, *assessment.acc_results)],
        "notes": document["notes"],
        "drivers": driver_rows(assessment),
        "rejection_reasons": {row["driver"]: row["rejection_reason"] for row in document["candidates"]},
        "test_seeds": document["seeds"]["test"],
        "episodes": document["episodes"],
    }


def driver_rows(assessment: Assessment) -> list[dict[str, Any]]:
    """Return a row for the human baseline, for ACC vehicles and for the controller, with paired differences.

    `difference` [s] and `flow_difference` [veh/h] refer to the human baseline, `difference_to_acc` [s] to ACC vehicles.
    """
    baseline = assessment.document["baseline"]
    time, flow = baseline["travel_time"]["mean"], baseline["outflow_veh_per_h"]["mean"]
    rows: list[dict[str, Any]] = [{"driver": "human", "travel_time": time, "flow": flow}]
    for result in (*assessment.acc_results, *assessment.controller_results):
        effect = result.effect
        row = {"driver": getattr(result, "driver", "cruise"), "rate": result.penetration_rate}
        row |= {"travel_time": effect.baseline_travel_time + effect.travel_time.mean}
        row |= {"difference": asdict(effect.travel_time), "flow": effect.baseline_flow + effect.flow.mean}
        row |= {"flow_difference": asdict(effect.flow), "feasibility": effect.feasibility}
        if isinstance(result, ControllerResult):
            row["difference_to_acc"] = asdict(result.difference_to_acc)
            row["verdict"] = "; ".join(result.reasons) or "recommended"
        rows.append(row)
    return rows


def examples_table(folder: Path) -> pd.DataFrame:
    """Return travel time and flow of the human baseline, of ACC vehicles and of the controller on each road."""
    rows = []
    for name, results in read_part(folder, EXAMPLES_PART).items():
        for row in results["drivers"]:
            cells = {"road": name, "CAVs": f"{100 * row['rate']:g} %" if "rate" in row else "none"}
            cells |= {"driver": row["driver"], "travel time [s]": f"{row['travel_time']:.1f}"}
            cells |= {"difference to human baseline [s]": _difference_text(row, "difference", 1)}
            cells |= {"difference to ACC [s]": _difference_text(row, "difference_to_acc", 1)}
            cells |= {"flow, difference to human baseline [veh/h]": _difference_text(row, "flow_difference", 0)}
            rows.append({**cells, "feasible": row.get("feasibility", NO_VALUE_TEXT)})
    return pd.DataFrame(rows)


def _difference_text(row: Mapping[str, Any], name: str, digits: int) -> str:
    return format_difference(Estimate(**row[name]), digits) if name in row else NO_VALUE_TEXT


ASSESS_EXAMPLES = Study(
    title="assessments of five small roads",
    make_parts=lambda study_folder, seeds: {
        f"{EXAMPLES_PART}/{name}": (assess_example, (name, rate, MAX_EPISODES, PRECISION))
        for name, (_, rate) in EXAMPLES.items()
    },
    minutes=25.0,
    tables={"roads": examples_table},
)
