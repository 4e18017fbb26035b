"""Run the real command line with invalid input of many kinds, and in unusual environments."""

import os
import resource
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.controller.test_verify import content_of
from tests.faults.outcome import Outcome
from tests.system.conftest import PLAIN, UNJAM
from tests.system.test_invalid_inputs import one_line, with_weights_of
from unjam.controller.signature import make_keys

Arguments = tuple[str | bytes, ...]

RING = ("ring", "--length", "60", "--vehicles", "5", "--set", "horizon=5", "--set", "warmup=0")
DRIVE = ("drive", *RING, "-n", "1", "--workers", "1", "--no-report", "--driver")
MAX_MEMORY = 8 * 2**30
"""maximum address space of a command [bytes]: a command that reads without end fails"""
TIMEOUT = 120
"""maximum duration of a command [s]"""
NO_READER_CODE = 1
"""exit code if the reader of the output has ended"""
OUTCOMES = {0: "success", NO_READER_CODE: "it ended without a message"}
"""outcome by exit code; of other codes one line of error"""
SPECIAL_FILES = ("/proc", "/sys", "/dev/null", "/dev/full", "/dev/zero", "/proc/self/mem", "/proc/self/fd/1")
SPECIAL_TEXTS = (
    "$HOME",
    "$(reboot)",
    "`id`",
    "[/b]",
    "[bold red]",
    "[link=x]",
    "%s%n",
    "{0}",
    "\x1b[31m",
    "a\nb",
    "\\",
    "''",
)


@dataclass(frozen=True)
class CommandCase:
    """A command line, and its allowed outcomes."""

    description: str
    arguments: Arguments
    allowed_codes: tuple[int, ...] = (2,)
    """allowed exit codes"""
    prepare_process: Callable[[], None] | None = None
    """function that the new process calls before it runs `unjam`"""
    output: str = ""
    """destination of its standard output; empty: a reader"""


def draw_one(generator: np.random.Generator, *choices: str) -> str:
    """Return one of the choices at random."""
    return choices[int(generator.integers(len(choices)))]


def arguments_with_name(generator: np.random.Generator, name: str) -> Arguments:
    """Return the arguments of a random command that names a missing file, driver or scenario."""
    places: tuple[Arguments, ...] = (
        (*DRIVE, name),
        (*DRIVE, f"{name}.py:gentle"),
        (*DRIVE, f"{name}.unjam"),
        (*DRIVE, f"pi+{name}.unjam"),
        (*DRIVE, f"pi:{name}=1"),
        (*DRIVE, "pi", "--reward", f"{name}.py:calm"),
        (*DRIVE, "pi", "--humans", f"{name}.json"),
        ("drive", f"{name}.sumocfg", "--driver", "pi"),
        ("drive", name, "--driver", "pi"),
        ("train", "ring", "--config", f"{name}.toml"),
        ("train", "ring", "--expert", name),
        ("train", "--resume", f"{name}/run"),
        ("verify", name),
        ("verify", "it.unjam", "--signer", f"{name}.pub"),
        ("sign", "it.unjam", "--key", f"{name}.key"),
        ("certify", f"{name}.unjam"),
        ("report", name),
        ("runs", "--folder", name),
        ("fit-drivers", f"{name}.csv"),
    )
    return places[int(generator.integers(len(places)))]


def long_names(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A name that is too long for file systems."""
    return CommandCase(
        "a name of over 255 letters", arguments_with_name(generator, "a" * int(generator.integers(256, 5000)))
    )


def odd_names(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A name with characters that a shell or a terminal interprets."""
    name = "x" + "".join(draw_one(generator, *SPECIAL_TEXTS) for _ in range(int(generator.integers(1, 4))))
    return CommandCase("a name with $, brackets and the like", arguments_with_name(generator, name))


def other_bytes(folder: Path, generator: np.random.Generator) -> CommandCase:
    """An argument that is not UTF-8."""
    arguments = list(arguments_with_name(generator, "x"))
    path = int(generator.integers(len(arguments)))
    word = os.fsencode(arguments[path])
    at = int(generator.integers(len(word) + 1))
    arguments[path] = word[:at] + bytes([int(generator.integers(128, 256))]) + word[at:]
    return CommandCase("bytes that are not UTF-8", tuple(arguments))


def dense_rings(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A ring with a length close to the minimum for its vehicles."""
    vehicles = 22 if generator.random() < 0.5 else int(generator.integers(2, 40))
    length = 7 * vehicles + int(generator.integers(-2, 3))
    road = ("--vehicles", str(vehicles), "--length", str(length), "--set", "horizon=5")
    arguments = ("drive", "ring", *road, "-n", "1", "--workers", "1", "--no-report", "--driver", "pi")
    return CommandCase("a ring as full as can be", arguments, allowed_codes=(0,) if length >= 7 * vehicles else (2,))


def bombs(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A configuration that is nested very deeply, or with a very long number."""
    depth, digits = int(generator.integers(3000, 100_000)), int(generator.integers(500, 5000))
    key = draw_one(
        generator, "steps", "seed", "scenario_options.horizon", "trpo.gamma", "policy.hidden", "ghost", "workers"
    )
    value = draw_one(
        generator,
        *("[" * depth, "{a=" * depth, "[" * depth + "]" * depth, '"' * depth, "9" * digits, "0x" + "f" * digits),
        *("-" + "9" * digits, "1e" + "9" * digits, "0o" + "7" * digits, '"' + "9" * digits + '"', "nan"),
    )
    text = draw_one(generator, f"{key} = {value}\n", f"[{'a.' * depth}a]\n", f"a{'.a' * depth} = 1\n")
    (folder / "bomb.toml").write_text(text)
    if generator.random() < 0.3 and len(value) < 100_000:
        return CommandCase("a setting nested or long without end", ("train", "ring", "--set", f"{key}={value}"))
    return CommandCase("a configuration nested or long without end", ("train", "--config", "bomb.toml"))


def nuls(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A configuration that names a file with NUL in its path."""
    key = draw_one(generator, "expert", "reward", "scenario", "preset", "scenario_options.population", "agent")
    ending = draw_one(generator, ".py:x", ".unjam", ".sumocfg", ".json", "")
    (folder / "nul.toml").write_text(f'{key} = "x\\u0000{ending}"\n')
    return CommandCase("NUL in a path", ("train", "--config", "nul.toml"))


def closed_outputs(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A standard output that is closed, full, or without a reader."""
    verb = draw_one(generator, "scenarios", "drivers", "verify", "--version", "drive")
    arguments: Arguments = (
        (*DRIVE, "pi") if verb == "drive" else ("verify", "it.unjam") if verb == "verify" else (verb,)
    )
    output = draw_one(generator, "closed", "/dev/full", "no reader")
    allowed_codes = {"closed": (0,), "/dev/full": (74,), "no reader": (NO_READER_CODE,)}[output]
    return CommandCase(f"standard output: {output}", arguments, allowed_codes, output=output)


def no_folder(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A working folder that was removed."""
    path = folder / "removed"

    def remove_working_folder() -> None:
        path.mkdir()
        os.chdir(path)
        path.rmdir()

    arguments = (arguments_with_name(generator, "x"), (*DRIVE[:-2], "--out", "new", "-d", "pi"), ("keys", "maker"))
    return CommandCase(
        "a working folder that was removed", arguments[int(generator.integers(3))], (2, 74), remove_working_folder
    )


def few_descriptors(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A process that can open only a few files."""
    limit = int(generator.integers(16, 40))

    def limit_descriptors() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))

    return CommandCase("few file descriptors", (*DRIVE, "pi", "--workers", "4", "-n", "4"), (0, 2), limit_descriptors)


def strange_weights(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A controller with weights of a type that networks do not have."""
    kind = (np.complex64, np.bool_)[int(generator.integers(2))]
    (folder / "strange.unjam").write_bytes(with_weights_of(kind))
    arguments = (
        (*DRIVE, "strange.unjam"),
        ("verify", "strange.unjam"),
        ("export", "strange.unjam", "--out", "x.unjam"),
    )
    commands: tuple[Arguments, ...] = (
        *arguments,
        ("certify", "strange.unjam"),
        ("sign", "strange.unjam", "--key", "maker.key"),
    )
    return CommandCase("complex or boolean weights", commands[int(generator.integers(len(commands)))])


def special_files(folder: Path, generator: np.random.Generator) -> CommandCase:
    """A device or a kernel file as input or output."""
    path, read = draw_one(generator, *SPECIAL_FILES), generator.random() < 0.4
    if read:
        verbs: tuple[Arguments, ...] = (
            (*DRIVE, path),
            (*DRIVE, "pi", "--humans", path),
            ("train", "ring", "--config", path),
            ("verify", path),
            ("verify", "it.unjam", "--signer", path),
            ("sign", "it.unjam", "--key", path),
            ("train", "--resume", path),
            ("fit-drivers", path),
        )
        return CommandCase("a special file that is read", verbs[int(generator.integers(len(verbs)))])
    small = ("--set", "horizon=5")
    verbs = (
        ("drive", *RING, "-n", "1", "--driver", "pi", "--out", path),
        ("drive", *RING, "-n", "1", "--driver", "pi", "--out", f"{path}/new"),
        ("train", "ring", "--steps", "10", "--out", f"{path}/new"),
        ("search", "ring", "--vary", "trpo.gamma=0.9,0.99", "--out", f"{path}/new"),
        ("tune", "ring", "--steps", "8000", *small, "--out", f"{path}/new"),
        ("export", "pi", "--out", f"{path}/it.unjam"),
        ("keys", f"{path}/maker"),
        ("report", ".", "--out", f"{path}/page.html"),
        ("watch", *RING, "--driver", "pi", "--video", f"{path}/film.gif"),
    )
    return CommandCase("a special file that is written", verbs[int(generator.integers(len(verbs)))], (2, 74))


KINDS: tuple[Callable[[Path, np.random.Generator], CommandCase], ...] = (
    *(long_names, odd_names, other_bytes, dense_rings, bombs, nuls, closed_outputs, no_folder),
    *(few_descriptors, strange_weights, special_files),
)


def inputs(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Run `count` cases, with equally many of each kind."""
    outcome = Outcome()
    working_folder, temporary = folder / "here", folder / "temporary"
    for each in (working_folder, temporary):
        each.mkdir()
    make_keys(working_folder / "maker")
    (working_folder / "it.unjam").write_bytes(content_of())
    folders = {"UNJAM_CACHE": str(folder / "cache"), "UNJAM_STATE": str(folder / "state")}
    environment = {**os.environ, **PLAIN, **folders, "TMPDIR": str(temporary)}
    for number in range(count):
        case = KINDS[number % len(KINDS)](working_folder, generator)
        before = folder_contents(working_folder)
        code, output, errors = run_case(case, working_folder, environment)
        assert code in case.allowed_codes, (case, code, errors)
        assert "Traceback" not in errors, (case, errors)
        assert (
            code == 0 or is_clear_error(errors, 74 in case.allowed_codes) or (code == NO_READER_CODE and not errors)
        ), (case, errors)
        assert not output or code == 0, (case, output)
        assert folder_contents(working_folder) == before, case
        assert not list(temporary.iterdir()), case
        outcome.happened[f"{case.description}: {OUTCOMES.get(code, 'one line')}"] += 1
    return outcome


def is_clear_error(errors: str, has_started: bool) -> bool:
    """Return whether errors are one line, after lines of progress if the command `has_started`."""
    lines = [line for line in errors.splitlines() if line]
    return one_line(errors) or (has_started and [line for line in lines if line.startswith("unjam: ")] == lines[-1:])


def folder_contents(folder: Path) -> dict[str, bytes]:
    """Return the content of all files below a folder, by path."""
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def run_case(case: CommandCase, folder: Path, environment: dict[str, str]) -> tuple[int, str, str]:
    """Run the command line; return its exit code, its output, and its errors."""

    def prepare() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
        if case.prepare_process:
            case.prepare_process()
        if case.output == "closed":
            os.close(1)

    output, reader = subprocess.PIPE, None
    if case.output == "/dev/full":
        output = os.open(case.output, os.O_WRONLY)
    elif case.output == "no reader":
        reader, output = os.pipe()
        os.close(reader)
    process = subprocess.run(
        [UNJAM, *case.arguments],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.PIPE,
        timeout=TIMEOUT,
        preexec_fn=prepare,
        check=False,
    )
    if output != subprocess.PIPE:
        os.close(output)
    return process.returncode, (process.stdout or b"").decode(), process.stderr.decode(errors="replace")
