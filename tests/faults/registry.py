"""All faults that are injected, by name."""

from tests.faults.commands import jumping_clocks, killed_commands, many_drivers, packed_tables
from tests.faults.files import checkpoints, configurations, controllers, full_disks, results, signatures
from tests.faults.inputs import inputs
from tests.faults.limits import large_networks, little_memory, long_environments, other_users
from tests.faults.links import links
from tests.faults.outcome import Fault
from tests.faults.processes import hostile, killed_runs, lost_workers, networks, resets
from tests.faults.trust import caches, cheats, codes, crash_points, lineages, locks, replacements, sandboxes

FAULTS: dict[str, Fault] = {
    "checkpoints": Fault(
        "checkpoint damaged: bits flipped, cut off, doubled, empty, missing, parts of another, an old schema",
        checkpoints,
        quick_count=60,
        long_count=1000,
    ),
    "controllers": Fault(
        "controller damaged: bits flipped, cut off, doubled, swapped", controllers, quick_count=60, long_count=1000
    ),
    "configurations": Fault(
        "configuration with an invalid value, an unknown name, a repeated line, or cut off", configurations, 40, 200
    ),
    "results": Fault(
        "folder of results damaged: files cut off, empty, missing, nested, a value removed or replaced",
        results,
        10,
        300,
    ),
    "full disk": Fault("disk full after some bytes of a checkpoint", full_disks, quick_count=20, long_count=200),
    "networks": Fault("network, demand or configuration of SUMO broken", networks, quick_count=6, long_count=500),
    "hostile files": Fault(
        "network of another user that makes SUMO write, listen or read another file", hostile, 8, 200
    ),
    "sandbox": Fault(
        "program next to the reader of networks, and SUMO, that write or open a socket", sandboxes, 12, 300
    ),
    "cached networks": Fault("network in the cache edited, cut, emptied or removed", caches, 8, 300),
    "code in folders": Fault(
        "run folder that names Python code, given to verify, drive, watch, assess, train, search, evaluate, "
        "export and certify",
        codes,
        quick_count=8,
        long_count=300,
    ),
    "drivers that change": Fault(
        "driver that modifies its observations, on every kind of road", cheats, quick_count=5, long_count=200
    ),
    "crash points": Fault(
        "run killed, or the disk full, before, within or after each thing that it does to its folder",
        crash_points,
        quick_count=30,
        long_count=600,
    ),
    "lineage": Fault(
        "run that goes on with other settings, another expert, reward, network or checkpoint",
        lineages,
        quick_count=8,
        long_count=200,
    ),
    "locks": Fault("folder that another process writes, which is then killed", locks, quick_count=3, long_count=100),
    "lost workers": Fault(
        "worker killed, crashed or stopped in an episode", lost_workers, quick_count=2, long_count=200
    ),
    "resets": Fault("episodes one after the other in one process", resets, quick_count=100, long_count=10_000),
    "killed runs": Fault("training run killed (signal 9)", killed_runs, quick_count=4, long_count=12, is_slow=True),
    "signatures": Fault(
        "signed controller changed by a forger that adapts the hashes, signed by another, or not at all",
        signatures,
        quick_count=60,
        long_count=1000,
    ),
    "inputs": Fault(
        "command line with long or unusual names, bytes that are not UTF-8, deeply nested configurations, NUL, special "
        "files, invalid weights; with a closed output, in a removed folder, with few file descriptors",
        inputs,
        quick_count=6,
        long_count=200,
    ),
    "replaced code": Fault(
        "user's Python file, or a module that it imports, replaced after it was read or trusted, or with "
        "bytecode next to it",
        replacements,
        quick_count=12,
        long_count=500,
    ),
    "links": Fault(
        "links to files, folders or nothing elsewhere, and hard links, planted in a run folder that goes on",
        links,
        quick_count=40,
        long_count=500,
    ),
    "killed commands": Fault(
        "tune, search and reproduce killed (signal 9)", killed_commands, quick_count=3, long_count=21, is_slow=True
    ),
    "clocks": Fault("clock that jumps by up to a day", jumping_clocks, quick_count=2, long_count=50),
    "packed tables": Fault(
        "recorded traffic in files of a few megabytes that unpack to gigabytes, or have a huge line or element",
        packed_tables,
        quick_count=4,
        long_count=40,
    ),
    "many drivers": Fault("drivers compared in one command", many_drivers, quick_count=20, long_count=500),
    "large networks": Fault("vehicles at once on a user network", large_networks, quick_count=300, long_count=5000),
    "long environments": Fault(
        "steps of one environment in one process", long_environments, quick_count=2000, long_count=1_000_000
    ),
    "little memory": Fault(
        "command that may take less memory than it needs", little_memory, quick_count=2, long_count=20, is_slow=True
    ),
    "other users": Fault("command of a user without a home", other_users, quick_count=2, long_count=10, is_slow=True),
}
