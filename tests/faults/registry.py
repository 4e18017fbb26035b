"""All faults that are injected, by name."""

from tests.faults.files import checkpoints, configurations, controllers, full_disks, results, signatures
from tests.faults.inputs import inputs
from tests.faults.links import links
from tests.faults.outcome import Fault
from tests.faults.processes import hostile, killed_runs, lost_workers, networks, resets
from tests.faults.trust import caches, cheats, codes, crash_points, lineages, locks, replacements, sandboxes

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
        "folder of results damaged: torn, empty, missing, nested, a value gone or another", results, 10, 300
    ),
    "full disk": Fault("disk full after some bytes of a checkpoint", full_disks, quick=20, long=200),
    "networks": Fault("network, demand or configuration of SUMO broken", networks, quick=6, long=500),
    "hostile files": Fault(
        "network of others that wants SUMO to write, to listen or to read another file", hostile, 8, 200
    ),
    "sandbox": Fault(
        "program beside the reader of networks, and SUMO, that write or open a socket", sandboxes, 12, 300
    ),
    "cached networks": Fault("network in the cache edited, cut, emptied or removed", caches, 8, 300),
    "code in folders": Fault(
        "run folder that names Python code, given to verify, drive, watch, assess, train, search, evaluate, "
        "export and certify",
        codes,
        quick=8,
        long=300,
    ),
    "drivers that change": Fault(
        "driver that changes all that it is shown, on every kind of road", cheats, quick=5, long=200
    ),
    "crash points": Fault(
        "run killed, or the disk full, before, within or after each thing that it does to its folder",
        crash_points,
        quick=30,
        long=600,
    ),
    "lineage": Fault(
        "run that goes on with other settings, another expert, reward, network or checkpoint",
        lineages,
        quick=8,
        long=200,
    ),
    "locks": Fault("folder that another process writes, which is then killed", locks, quick=3, long=100),
    "lost workers": Fault("worker killed, crashed or stopped in an episode", lost_workers, quick=2, long=200),
    "resets": Fault("episodes one after the other in one process", resets, quick=100, long=10_000),
    "killed runs": Fault("training run killed (signal 9)", killed_runs, quick=4, long=12, slow=True),
    "signatures": Fault(
        "signed controller changed by a forger who makes the hashes fit, signed by another, or not at all",
        signatures,
        quick=60,
        long=1000,
    ),
    "inputs": Fault(
        "command line with names too long, odd or no text, configurations without end, NUL, special files, "
        "weights that are none; with a closed output, in a removed folder, with few file descriptors",
        inputs,
        quick=6,
        long=200,
    ),
    "replaced code": Fault(
        "user's Python file, or a module that it imports, replaced after it was read or trusted, or with "
        "bytecode beside it",
        replacements,
        quick=12,
        long=500,
    ),
    "links": Fault(
        "links to files, folders or nothing elsewhere, and hard links, planted in a run folder that goes on",
        links,
        quick=40,
        long=500,
    ),
}
