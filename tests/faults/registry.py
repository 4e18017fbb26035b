"""All faults that are injected, by name."""

from tests.faults.files import checkpoints, configurations, controllers, full_disks, results
from tests.faults.outcome import Fault
from tests.faults.processes import hostile, killed_runs, lost_workers, networks, resets

FAULTS: dict[str, Fault] = {
    "checkpoints": Fault(
        "checkpoint damaged: bits flipped, cut off, doubled, empty, missing, parts of another, an old schema",
        checkpoints,
        quick=60,
        long=1000,
    ),
    "controllers": Fault(
        "controller damaged: bits flipped, cut off, doubled, swapped", controllers, quick=60, long=1000
    ),
    "configurations": Fault(
        "configuration with a nonsensical value, an unknown name, a line twice, torn", configurations, 40, 200
    ),
    "results": Fault(
        "folder of results damaged: torn, empty, missing, nested, a value gone or another", results, 20, 300
    ),
    "full disk": Fault("disk full after some bytes of a checkpoint", full_disks, quick=20, long=200),
    "networks": Fault("network, demand or configuration of SUMO broken", networks, quick=12, long=500),
    "hostile files": Fault(
        "network of others that wants SUMO to write, to listen or to read another file", hostile, 8, 200
    ),
    "lost workers": Fault("worker killed, crashed or stopped in an episode", lost_workers, quick=2, long=200),
    "resets": Fault("episodes one after the other in one process", resets, quick=100, long=10_000),
    "killed runs": Fault("training run killed (signal 9)", killed_runs, quick=4, long=12, slow=True),
}
