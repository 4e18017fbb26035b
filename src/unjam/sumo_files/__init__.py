"""Read users' SUMO files in a resource-limited subprocess, as SUMO could crash on them, write files or listen."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any, Literal, NamedTuple

from unjam import sandbox
from unjam.child_processes import child_environment, python_command
from unjam.errors import InputError, disk_error, invalid_value
from unjam.sumo_files.reader import ALLOWED_VARIABLES, UNKNOWN_VARIABLE, FileStamp, file_stamp
from unjam.text import spelling_hint

READER_PROGRAM = Path(__file__).with_name("reader_program.py")
MAX_READER_MEMORY, MAX_READER_TIME = 4 * 2**30, 120  # limits of the reader process: memory [bytes] and time [s]

LaneShape = tuple[str, float, float, list[tuple[float, float]]]
"""id of the edge, length [m], speed limit [m/s], and points (x, y) of the center line [m]"""
_PASSED = """
begin end junction-taz weight-attribute step-method.ballistic extrapolate-departpos lateral-resolution route-steps
no-internal-links ignore-junction-blocker ignore-route-errors ignore-accidents intermodal-collision.action
collision.stoptime collision.action collision.mingap-factor collision.check-junctions intermodal-collision.stoptime
collision.check-junctions.mingap keep-after-arrival max-num-vehicles max-num-persons max-num-teleports scale
scale-suffix sloppy-insert eager-insert emergency-insert insertion-checks random-depart-offset waiting-time-memory
startup-wait-threshold slope-centered time-to-impatience pedestrian.model pedestrian.timegap-crossing mesosim
use-stop-ended use-stop-started routing-algorithm replay-rerouting time-to-teleport thread-rngs phemlight-year
phemlight-temperature
"""
_PASSED_PREFIXES = """
time-to-teleport. lanechange. tls. railsignal. railsignal-moving-block default. overhead-wire. emergencydecel.
parking. pedestrian.striping. ride. mapmatch. weights. persontrip. railway. device.rerouting. person-device.rerouting.
device.driverstate. device.bluelight. device.glosa. device.toc. device.taxi. device.emissions. device.battery.
device.friction. device.stationfinder. device.elechybrid. pedestrian.jupedsim. meso-
"""
_IGNORED = """
step-length no-step-log no-warnings aggregate-warnings verbose start duration-log.disable duration-log.statistics
xml-validation xml-validation.net xml-validation.routes gui-settings-file quit-on-end delay precision step-log.period
print-options human-readable-time registry-viewport aggregate-warnings language log.timestamps log.processid help
version device.rerouting.threads emissions.volumetric-fuel load-state.offset load-state.remove-vehicles
configuration-file configuration c game game.mode breakpoints edgedata-files data-files alternative-net-file
selection-file demo disable-textures window-size window-pos tracker-interval gui-testing gui-testing-debug
suppress-warnings no-duration-log
"""
PASSED_OPTIONS = set(_PASSED.split())  # options that unjam passes to SUMO: they only define how to simulate
PASSED_OPTION_PREFIXES = tuple(_PASSED_PREFIXES.split())  # prefixes of further options that unjam passes to SUMO
IGNORED_OPTIONS = {*_IGNORED.split(), *"vtgdHWXVQGSDTBmN?"}
"""options that unjam sets itself, or that do not affect traffic; unjam drops them without a report"""
REPLACED_OPTIONS = ("seed", "random", "max-depart-delay", "threads")  # options that affect traffic; unjam sets them
OUTPUT_OPTIONS = re.compile(
    r"output|^(write-|save-|netstate|ndump|dump-|summary$|tripinfo$|personinfo$|vehroutes|personroutes$)"
    r"|^(log|log-file|message-log|error-log|precision\.geo|person-fcd|remote-port|num-clients|l|C)$"
    r"|^(person-)?device\.(fcd|ssm|tripinfo|vehroute|btsender|btreceiver|example)\."
    r"|^device\.toc\.file$|^device\.fcd-replay\.(?!files)|^pedestrian\.jupedsim\.(wkt|py)"
)
"""pattern of options for SUMO's output and connections, which do not affect traffic"""
REFUSED_OPTIONS = {
    "load-state": "no file, as episodes begin on an empty road; begin earlier, with --set warmup=600",
    **dict.fromkeys(
        ("astar.all-distances", "astar.landmark-distances", "device.fcd-replay.files"),
        "no file, as unjam cannot check its content",
    ),
    "phemlight-path": "./PHEMlight/, SUMO's default",
}
"""allowed values of options that affect traffic but cannot be passed to SUMO"""
HARMFUL_OPTION_PARTS = ("file", "output", "threads", ".wkt", ".py")
"""texts in the names of harmful options, although these begin with one of `PASSED_OPTION_PREFIXES`"""


class SumoFiles(NamedTuple):
    """A .sumocfg file and the content of the files that it names."""

    path: Path
    network: Path
    additional_files: tuple[Path, ...]
    route_files: tuple[Path, ...]
    weight_files: tuple[Path, ...]  # files with travel times of edges, for vehicles that choose their route
    sources: tuple[Path, ...]  # all files that were read, with those that they include
    begin: float  # begin of the simulation [s]
    end: float | None  # end of the simulation [s]; None: when the last vehicle has arrived
    first_departure: float | None  # earliest departure of a vehicle [s]; None: unknown
    calibrated_until: float  # latest time at which calibrators may add vehicles [s]; zero: there are none
    step: float  # time step of the simulation [s]
    options: dict[str, str]  # values of the options that unjam passes to SUMO, by name
    dropped_items: tuple[str, ...]  # dropped options and elements: they only write files or open ports
    replaced_options: tuple[str, ...]  # options in the configuration that are `REPLACED_OPTIONS`
    copy_sources: dict[Path, tuple[Path, ...]]
    """sources of the harmless copy that SUMO reads instead of a file, by file; it reads other files directly"""
    types: dict[str, dict[str, str]]  # attributes of all vehicle types, by id
    type_parameters: dict[str, dict[str, str]]
    """values of the `<param>` elements of each type, by key"""
    used_types: frozenset[str]  # ids of the types that vehicles have
    removes_jammed_vehicles: bool  # whether SUMO removes jammed vehicles instead of teleporting them
    has_bicycle_lanes: bool  # whether lanes are for bicycles only
    has_opposite_lanes: bool  # whether vehicles may overtake on lanes of the opposite direction
    has_spread_flows: bool  # whether SUMO spreads the vehicles of a flow until the end of the simulation


_read_files: dict[Path, tuple[dict[Path, FileStamp], SumoFiles]] = {}
"""stamps and content of all files, by path of the configuration"""
_answers: dict[str, dict[str, Any]] = {}  # answers of the reader process, by path of the configuration


def read_sumo_files(path: Path) -> SumoFiles:
    """Return the content of a .sumocfg file and of the files that it names; changed files are read again.

    Raise `InputError` if a file is missing, broken or too large, the network has no version, or there are no vehicles.
    """
    if path in _read_files:
        stamps, files = _read_files[path]
        if all(file.is_file() and file_stamp(file) == stamp for file, stamp in stamps.items()):
            return files
    return store_answer(str(path), _run_reader("configuration", path))


def stored_answer(path: str) -> dict[str, Any] | None:
    """Return the answer of the reader process for a configuration, to store in another process; None without one."""
    return _answers.get(path)


def store_answer(file: str, answer: dict[str, Any]) -> SumoFiles:
    """Store an answer of the reader process, and return the content of the .sumocfg file."""
    path, fields = Path(file), dict(answer)
    stamps = {Path(source): (time, size) for source, (time, size) in fields.pop("stamps").items()}
    fields |= {name: tuple(map(Path, fields[name])) for name in ("additional_files", "route_files", "weight_files")}
    fields["network"], fields["sources"] = Path(fields["network"]), tuple(stamps)
    copy_sources = fields["copy_sources"].items()
    fields["copy_sources"] = {Path(original): tuple(map(Path, sources)) for original, sources in copy_sources}
    fields["used_types"], options = frozenset(fields["used_types"]), fields["options"]
    treatments = {name: classify_option(path.name, name, value) for name, value in options.items()}
    fields["options"] = {name: value for name, value in options.items() if treatments[name] == "passed"}
    for name, value in fields["options"].items():
        if variable := UNKNOWN_VARIABLE.search(value):
            raise invalid_value(f"{path.name}: {name}", variable[0], ALLOWED_VARIABLES)
    dropped = [f"option {name}" for name in options if treatments[name] == "dropped"]
    fields["dropped_items"] = (*dropped, *fields["dropped_items"])
    fields["replaced_options"] = tuple(name for name in options if treatments[name] == "replaced")
    files = SumoFiles(path, **fields)
    _read_files[path], _answers[file] = (stamps, files), answer
    return files


def classify_option(file: str, name: str, value: str) -> Literal["passed", "ignored", "replaced", "dropped"]:
    """Return how unjam treats an option; `InputError` if SUMO has no such option, or its value is not allowed."""
    if is_passed_option(name):
        return "passed"
    if name in IGNORED_OPTIONS:
        return "ignored"
    if name in REPLACED_OPTIONS:
        return "replaced"
    if OUTPUT_OPTIONS.search(name):
        return "dropped"
    if name not in REFUSED_OPTIONS:
        known = [*PASSED_OPTIONS, *IGNORED_OPTIONS, *REPLACED_OPTIONS, *REFUSED_OPTIONS]
        raise InputError(f"{file}: {name}: SUMO 1.28 has no such option{spelling_hint(name, known)}")
    if value == REFUSED_OPTIONS[name].partition(",")[0]:  # as in a configuration that lists all defaults
        return "ignored"
    raise invalid_value(f"{file}: {name}", value, REFUSED_OPTIONS[name])


def read_lanes(path: Path) -> list[LaneShape]:
    """Return all lanes of a network file; raise `InputError` if it is broken or too large."""
    lanes = _run_reader("lanes", path)
    return [(edge, length, limit, [(x, y) for x, y in line]) for edge, length, limit, line in lanes]


def write_harmless_copy(path: Path, copy: Path, driver_count: int = 0, types: Path | None = None) -> None:
    """Write a copy of a SUMO file without harmful elements.

    Vehicle types get the attributes that the JSON file `types` has for their ids. Lists of vehicle types also name the
    types of CAVs and of `driver_count` calibrated drivers. Raise `InputError` if the file is broken or too large,
    `DiskError` if the copy cannot be written.
    """
    _run_reader("copy", path, copy, str(driver_count), *([str(types)] if types else []))


def _run_reader(
    command: Literal["configuration", "lanes", "copy"], path: Path, copy: Path | None = None, *options: str
) -> Any:
    """Return the answer of the reader process; raise `InputError` if the process reports an error or is lost."""
    limits = [str(MAX_READER_MEMORY), str(MAX_READER_TIME), str(copy.parent) if copy else ""]
    program = python_command("-I", "-S", sandbox.__file__, *limits, str(READER_PROGRAM), command)
    arguments = [*program, str(path), *([str(copy)] if copy else []), *options]
    try:
        process = subprocess.run(arguments, capture_output=True, timeout=MAX_READER_TIME, env=child_environment())
        answer = json.loads(process.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        limit = f"{MAX_READER_MEMORY / 2**30:g} GiB, {MAX_READER_TIME:g} s"
        raise InputError(f"{path.name}: its files cannot be read within {limit}") from None
    if "error" in answer:
        raise InputError(answer["error"])
    if "disk_error" in answer:
        raise disk_error(OSError(*answer["disk_error"]), copy)
    return answer["result"]


def is_passed_option(name: str) -> bool:
    """Return whether unjam passes an option to SUMO, as it only defines how to simulate."""
    is_harmful = any(text in name for text in HARMFUL_OPTION_PARTS)
    return name in PASSED_OPTIONS or (name.startswith(PASSED_OPTION_PREFIXES) and not is_harmful)
