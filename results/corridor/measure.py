"""What hours of a motorway corridor cost: time beside bare SUMO, memory, and what is written.

Run: python results/corridor/measure.py [hours]. It writes corridor.json beside itself, some ten minutes on a
core. SUMO alone and `unjam drive` on the same files in turns, so that both see the same machine; processor
seconds, which other work changes little.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.worlds.sumo.networks import sumo_program

NODES = """<nodes><node id="west" x="0" y="0"/><node id="merge" x="5000" y="0"/>
<node id="end" x="5300" y="0"/><node id="east" x="7000" y="0"/><node id="south" x="4600" y="-60"/></nodes>"""
EDGES = """<edges><edge id="before" from="west" to="merge" numLanes="4" speed="29"/>
<edge id="section" from="merge" to="end" numLanes="5" speed="29"/>
<edge id="after" from="end" to="east" numLanes="4" speed="29"/>
<edge id="ramp" from="south" to="merge" numLanes="1" speed="22"/></edges>"""
LINKS = "".join(
    f'<connection from="before" to="section" fromLane="{lane}" toLane="{lane + 1}"/>'
    f'<connection from="section" to="after" fromLane="{lane + 1}" toLane="{lane}"/>'
    for lane in range(4)
)
LINKS += '<connection from="ramp" to="section" fromLane="0" toLane="0"/>'
PEOPLE = (
    'carFollowModel="IDM" tau="1.66" minGap="2.94" accel="2.37" decel="3.21" lcAssertive="4.8" '
    'lcKeepRight="0" speedDev="0.1" emissionClass="HBEFA4/PC_petrol_Euro-6d"'
)
"""calibrated on I-24 (four lanes), as the benchmark page of this package's issue names them"""
TRAFFIC = """<routes><vType id="car" {people}/>
<route id="main" edges="before section after"/><route id="on" edges="ramp section after"/>
<flow id="main" type="car" route="main" end="{end}" vehsPerHour="4200" departLane="best" departSpeed="last"/>
<flow id="on" type="car" route="on" end="{end}" vehsPerHour="600" departSpeed="15"/></routes>"""
CONFIGURATION = """<configuration><input><net-file value="net.net.xml"/><route-files value="traffic.rou.xml"/>
</input><time><begin value="0"/><end value="{end}"/><step-length value="0.5"/></time></configuration>"""


def corridor(folder: Path, hours: float) -> Path:
    """Write 7 km of four lanes with an on-ramp, 4,800 vehicles an hour; return the configuration."""
    end = round(3600 * hours)
    connections = (
        f'<connections>{LINKS}<connection from="ramp" to="section" fromLane="0" toLane="0"/></connections>'
    )
    texts = {"nodes.nod.xml": NODES, "edges.edg.xml": EDGES, "links.con.xml": connections}
    texts["traffic.rou.xml"] = TRAFFIC.format(people=PEOPLE, end=end)
    texts["corridor.sumocfg"] = CONFIGURATION.format(end=end)
    for name, text in texts.items():
        (folder / name).write_text(text)
    given = ("-n", "nodes.nod.xml", "-e", "edges.edg.xml", "-x", "links.con.xml", "-o", "net.net.xml")
    quiet = ("--no-internal-links", "true", "--no-turnarounds", "true", "--no-warnings", "true")
    subprocess.run(
        [sumo_program("netconvert"), *given, *quiet], cwd=folder, check=True, stdout=subprocess.DEVNULL
    )
    return folder / "corridor.sumocfg"


def used(command: list[str]) -> dict[str, Any]:
    """Run a command; return its processor seconds, the most memory of each process, and of all at once [MB].

    What processes share, libraries above all, counts in each of them.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    most: dict[int, float] = {}
    together = [0.0]

    def watch() -> None:
        while process.poll() is None:
            running = (process.pid, *_children(process.pid))
            for pid in running:
                most[pid] = max(most.get(pid, 0.0), _memory(pid, "VmHWM"))
            together.append(sum(_memory(pid, "VmRSS") for pid in running))
            time.sleep(0.05)

    watching = threading.Thread(target=watch)
    watching.start()
    said, _ = process.communicate()
    watching.join()
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with code {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu": cpu, "memory": sorted(most.values()), "together": max(together), "said": said}


def _children(pid: int) -> list[int]:
    """Return the processes that a process has started, by any of its threads."""
    found: list[int] = []
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return found


def _memory(pid: int, what: str) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) / 1000 for line in lines if line.startswith(f"{what}:"))


def main() -> None:
    """Measure, and write what was found."""
    hours = float(sys.argv[1]) if len(sys.argv) > 1 else 5.5
    with tempfile.TemporaryDirectory() as folder:
        file, out = corridor(Path(folder), hours), Path(folder) / "out"
        alone = [
            sumo_program("sumo"),
            "-c",
            str(file),
            "--device.emissions.probability",
            "1",
            "--no-step-log",
        ]
        asked = [
            "drive",
            str(file),
            "-d",
            "cruise",
            "--cav-share",
            "0.05",
            "--episodes",
            "1",
            "--workers",
            "1",
        ]
        first = used(alone)
        driven = used([sys.executable, "-m", "unjam", *asked, "--json", "--out", str(out)])
        second = used(alone)
        row = json.loads(driven["said"])["episodes"][0]
        shown = json.loads((out / "evaluation.json").read_text())["shown"][0]
        sizes = {path.name: path.stat().st_size / 1e6 for path in out.iterdir()}
    sumo = (first["cpu"] + second["cpu"]) / 2
    found = {
        "hours": hours,
        "vehicles": len(shown["vehicle_ids"]),
        "cavs": len(shown["cav_ids"]),
        "seconds_between_pictures": shown["step"],
        "mean_speed": row["mean_speed"],
        "flow": row["throughput_veh_per_h"],
        "seconds_of_sumo_with_emissions": sumo,
        "seconds_of_unjam": driven["cpu"],
        "share_of_sumo": sumo / driven["cpu"],
        "memory_mb": {"of each process": driven["memory"], "together": driven["together"]},
        "written_mb": sizes,
        "load": os.getloadavg(),
        "manifest": manifest(),
    }
    write_whole(Path(__file__).with_name("corridor.json"), to_json(found, indent=1))
    print(to_json({name: value for name, value in found.items() if name != "manifest"}, indent=1))


if __name__ == "__main__":
    main()
