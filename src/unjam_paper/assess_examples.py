"""What `unjam assess` answers on five small roads, as networks of a user's own.

    python -m unjam_paper.assess_examples --out results/assess.json

The file is written after each road; a road whose entry has the same settings is not driven again.
"""

import argparse
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from unjam.files import atomic_write, to_json
from unjam.manifest import manifest
from unjam.measures.effect import ControllerResult
from unjam.scenarios.on_ramp import OnRamp
from unjam.training.assess import Assessment, assess, make_request
from unjam.worlds.sumo.inputs import CAV_TYPE_TEMPLATE, sumo_inputs
from unjam.worlds.sumo.networks import network_file, run_netconvert, xml_element
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.open_test_roads import EPISODE_SECONDS, OpenTestRoad, RoadSection, write_road_files

EPISODES = 51
"""of a road, at most: with the default controllers ten test seeds are left for the comparison"""
PRECISION = 0.02
"""half-width of the interval of travel time that is narrow enough, as a share of it"""
BLOCK = 250.0
"""between two signals of the grid [m]"""
SIGNALS = 3
"""of the grid, in each direction"""
GRID_FLOW, TURNING_FLOW = 300.0, 60.0
"""vehicles on each straight route through the grid, and on each that turns [veh/h]"""
MOTORWAY_FLOW, RAMP_FLOW = 3000.0, 500.0
"""vehicles on SUMO's motorway, and on its ramp [veh/h]"""
ON_RAMP = OnRamp(peak=(100.0, 700.0), horizon=int(EPISODE_SECONDS))
"""the built-in scenario that is exported; its demand is drawn once"""
DEMAND_SEED = 1


@dataclass(frozen=True)
class Example:
    """A road, and at which penetration rate CAVs are assessed there."""

    write: Callable[[Path], Path]
    """writes its files into a folder, and returns the configuration"""
    rate: float


def write_grid(folder: Path) -> Path:
    """Write a grid of signals; vehicles of SUMO's default type go straight, or turn left once."""
    inside, ends = range(1, SIGNALS + 1), (0, SIGNALS + 1)
    signals = [(x, y) for x in inside for y in inside]
    arms = [(x, y) for x in (0, *inside, SIGNALS + 1) for y in (0, *inside, SIGNALS + 1)]
    arms = [(x, y) for x, y in arms if (x in ends) != (y in ends)]
    nodes = [_node(f"n{x}{y}", BLOCK * x, BLOCK * y, "traffic_light") for x, y in signals]
    nodes += [_node(f"n{x}{y}", BLOCK * x, BLOCK * y, "priority") for x, y in arms]
    edges = [
        _edge(f"{x}{y}to{to_x}{to_y}", f"n{x}{y}", f"n{to_x}{to_y}", 2, 13.89)
        for x, y in (*signals, *arms)
        for to_x, to_y in (*signals, *arms)
        if abs(x - to_x) + abs(y - to_y) == 1 and ((x, y) in signals or (to_x, to_y) in signals)
    ]
    last, routes = SIGNALS + 1, dict[str, float]()
    for row in inside:
        east, west = (_edges([(x, row) for x in way]) for way in (range(last + 1), range(last, -1, -1)))
        north, south = (_edges([(row, y) for y in way]) for way in (range(last + 1), range(last, -1, -1)))
        routes |= dict.fromkeys((east, west, north, south), GRID_FLOW)
        left = [*((x, row) for x in range(row + 1)), *((row, y) for y in range(row + 1, last + 1))]
        routes[_edges(left)] = TURNING_FLOW
    return _write_files(folder, nodes, edges, [], routes)


def write_ramp(folder: Path) -> Path:
    """Write a motorway of two lanes that a ramp joins; SUMO's default vehicles."""
    places = {"a": (0.0, 0.0), "b": (1500.0, 0.0), "c": (1800.0, 0.0), "d": (2500.0, 0.0), "r": (1100.0, -80.0)}
    nodes = [_node(name, x, y, "priority") for name, (x, y) in places.items()]
    edges = [
        *(_edge("before", "a", "b", 2, 33.33), _edge("merging", "b", "c", 3, 33.33)),
        *(_edge("after", "c", "d", 2, 33.33), _edge("ramp", "r", "b", 1, 22.22)),
    ]
    links = [
        xml_element("connection", **{"from": start, "to": end}, fromLane=lane, toLane=next_lane)
        for start, end, lane, next_lane in (
            *(("before", "merging", 0, 1), ("before", "merging", 1, 2), ("ramp", "merging", 0, 0)),
            *(("merging", "after", 1, 0), ("merging", "after", 2, 1)),
        )
    ]
    routes = {"before merging after": MOTORWAY_FLOW, "ramp merging after": RAMP_FLOW}
    return _write_files(folder, nodes, edges, links, routes)


def write_on_ramp(folder: Path) -> Path:
    """Write the built-in scenario `on-ramp` as files of a user's own: network, types and drawn vehicles."""
    road = ON_RAMP.draw(np.random.default_rng(DEMAND_SEED))
    shutil.copy(network_file(road.network), folder / "road.net.xml")
    files = sumo_inputs(ON_RAMP, road)
    own_types = f'id="{CAV_TYPE_TEMPLATE.format("")}'  # of CAVs: unjam adds them again
    lines = [line for line in files.traffic.splitlines() if own_types not in line]
    (folder / "road.rou.xml").write_text("\n".join(lines))
    names = (name.removeprefix("--") for name in files.options[::2])
    options = dict(zip(names, files.options[1::2], strict=True))
    del options["max-depart-delay"]  # it has SUMO's default
    return _write_configuration(folder, options)


EXAMPLES: dict[str, Example] = {
    "a free road": Example(partial(write_road_files, OpenTestRoad((RoadSection(3000.0, 2, 25.0),), (0.15,))), 0.1),
    "a signalised grid": Example(write_grid, 0.1),
    "a road with 15 % trucks": Example(
        partial(write_road_files, OpenTestRoad((RoadSection(3000.0, 2, 33.0),), (0.75,), trucks=0.15)), 0.1
    ),
    "an on-ramp with SUMO's default vehicles": Example(write_ramp, 0.05),
    "the scenario on-ramp as files": Example(write_on_ramp, 0.1),
}
"""by name"""


def assess_examples(
    out: Path,
    workers: int = 2,
    episodes: int = EPISODES,
    seconds: float | None = None,
    examples: dict[str, Example] | None = None,
) -> None:
    """Assess the roads that `out` has no entry of with these settings, and write it after each of them.

    Args:
        out: the JSON file.
        workers: processes that drive.
        episodes: of each road, at most.
        seconds: of an episode; None: as the configuration says.
        examples: the roads by name; None: all of them.
    """
    known = json.loads(out.read_text(encoding="utf-8"))["roads"] if out.is_file() else {}
    about, found = {key: value for key, value in manifest().items() if key != "command"}, dict[str, Any]()
    for name, example in (EXAMPLES if examples is None else examples).items():
        settings = {"rate": example.rate, "episodes": episodes, "seconds": seconds, "precision": PRECISION}
        found[name] = known.get(name)
        if found[name] is None or found[name]["settings"] != settings:
            with TemporaryDirectory() as place:
                answer = _assess_road(example, Path(place), workers, episodes, seconds)
            found[name] = {"settings": settings, **answer, "commit": about["commit"]}
            # Entries of further roads stay, whatever their settings.
            atomic_write(out, to_json({"manifest": about, "roads": {**known, **found}}, indent=1))
        print(f"{name}: {found[name]['headline']}", flush=True)


def _assess_road(example: Example, folder: Path, workers: int, episodes: int, seconds: float | None) -> dict[str, Any]:
    (folder / "road").mkdir()
    file = example.write(folder / "road")
    changes = {} if seconds is None else {"end": seconds}
    asked = make_request(str(file), [example.rate], episodes, PRECISION, changes=changes)
    with WorkerPool(workers) as pool:
        answer = assess(asked, folder / "answer", pool, on_message=partial(print, flush=True))
    return {
        "headline": answer.document["headline"],
        "sentences": [each.words for each in (*answer.judged, *answer.acc)],
        "notes": answer.document["notes"],
        "drivers": driver_table(answer),
        "rejection_reasons": {each["driver"]: each["rejection_reasons"] for each in answer.document["tried"]},
        "test_seeds": answer.document["seeds"]["judging"],
        "episodes": answer.document["episodes"],
    }


def driver_table(answer: Assessment) -> list[dict[str, Any]]:
    """Return a row for the human baseline, for ACC vehicles and for the controller.

    Differences are paired, with 95 % confidence intervals: `difference` to the human baseline and
    `difference_to_acc` [s], `flow_difference` to the human baseline [veh/h].
    """
    people = answer.document["people"]
    time, flow = people["travel_time"]["mean"], people["outflow_veh_per_h"]["mean"]
    rows: list[dict[str, Any]] = [{"driver": "human", "travel_time": time, "flow": flow}]
    for each in (*answer.acc, *answer.judged):
        effect = each.effect
        row = {
            "driver": getattr(each, "driver", "cruise"),
            "rate": each.share,
            "travel_time": effect.baseline_travel_time + effect.travel_time.mean,
            "difference": asdict(effect.travel_time),
            "flow": effect.baseline_flow + effect.flow.mean,
            "flow_difference": asdict(effect.flow),
            "feasibility": effect.drivable,
        }
        if isinstance(each, ControllerResult):
            row["difference_to_acc"] = asdict(each.difference_to_acc)
            row["verdict"] = "; ".join(each.reasons) or "recommended"
        rows.append(row)
    return rows


def _write_files(
    folder: Path, nodes: Sequence[str], edges: Sequence[str], links: Sequence[str], routes: dict[str, float]
) -> Path:
    """Write a road, and a flow of default vehicles for each route [veh/h]; return the configuration."""
    inputs = {
        ("--node-files", "road.nod.xml"): _document("nodes", nodes),
        ("--edge-files", "road.edg.xml"): _document("edges", edges),
    }
    if links:
        inputs["--connection-files", "road.con.xml"] = _document("connections", links)
    run_netconvert(inputs, ["--no-turnarounds=true"], folder)
    traffic = [xml_element("route", id=f"r{number}", edges=edges) for number, edges in enumerate(routes)]
    enters = {"begin": 0, "end": EPISODE_SECONDS, "departLane": "best", "departSpeed": "max"}
    traffic += [
        xml_element("flow", id=f"f{number}", route=f"r{number}", vehsPerHour=flow, **enters)
        for number, flow in enumerate(routes.values())
    ]
    (folder / "road.rou.xml").write_text(_document("routes", traffic))
    return _write_configuration(folder, {})


def _write_configuration(folder: Path, options: dict[str, str]) -> Path:
    files = {"net-file": "road.net.xml", "route-files": "road.rou.xml", "end": EPISODE_SECONDS, "step-length": 0.5}
    path = folder / "road.sumocfg"
    lines = [xml_element(name, value=value) for name, value in {**files, **options}.items()]
    path.write_text(_document("configuration", lines))
    return path


def _document(root: str, elements: Sequence[str]) -> str:
    return f"<{root}>{''.join(elements)}</{root}>"


def _node(name: str, x: float, y: float, kind: str) -> str:
    return xml_element("node", id=name, x=x, y=y, type=kind)


def _edge(name: str, start: str, end: str, lanes: int, speed: float) -> str:
    return xml_element("edge", id=name, **{"from": start, "to": end}, numLanes=lanes, speed=speed, priority=3)


def _edges(way: Sequence[tuple[int, int]]) -> str:
    """Return the edges of a way through the grid."""
    return " ".join(f"{x}{y}to{to_x}{to_y}" for (x, y), (to_x, to_y) in pairwise(way))


def main(words: Sequence[str] | None = None) -> None:
    """Assess all roads as the command line says."""
    parser = argparse.ArgumentParser(description="Assess five small roads, and write one JSON file.")
    parser.add_argument("--out", type=Path, required=True, help="JSON file; roads that it holds are kept")
    parser.add_argument("--workers", type=int, default=2, help="worker processes")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="episodes of each road, at most")
    parser.add_argument("--seconds", type=float, help="length of an episode, for a trial")
    asked = parser.parse_args(words)
    assess_examples(asked.out, asked.workers, asked.episodes, asked.seconds)


if __name__ == "__main__":
    main()
