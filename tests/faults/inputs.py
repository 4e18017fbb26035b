"""Wrong input of all kinds, given to the real command line, where it finds itself in odd surroundings."""

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

Words = tuple[str | bytes, ...]

RING = ("ring", "--length", "60", "--vehicles", "5", "--set", "horizon=5", "--set", "warmup=0")
DRIVE = ("drive", *RING, "-n", "1", "--workers", "1", "--no-report", "--driver")
MOST_MEMORY = 8 * 2**30
"""bytes of address space: what reads without end is refused memory, and is found out"""
LONGEST = 120
"""[s]"""
GONE = 1
"""exit code where nobody reads what is said"""
ENDS = {0: "it was done", GONE: "it ended without a word"}
SPECIAL = ("/proc", "/sys", "/dev/null", "/dev/full", "/dev/zero", "/proc/self/mem", "/proc/self/fd/1")
ODD = ("$HOME", "$(reboot)", "`id`", "[/b]", "[bold red]", "[link=x]", "%s%n", "{0}", "\x1b[31m", "a\nb", "\\", "''")


@dataclass(frozen=True)
class Try:
    """A command line, and what may become of it."""

    what: str
    words: Words
    codes: tuple[int, ...] = (2,)
    """exit codes that are right"""
    before: Callable[[], None] | None = None
    """what the process does to itself before it becomes `unjam`"""
    output: str = ""
    """where its standard output goes; empty: to who reads it"""


def one_of(generator: np.random.Generator, *choices: str) -> str:
    """Return any of them."""
    return choices[int(generator.integers(len(choices)))]


def a_place(generator: np.random.Generator, name: str) -> Words:
    """Return a command line with a name of something somewhere in it, which is not there."""
    places: tuple[Words, ...] = (
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


def long_names(folder: Path, generator: np.random.Generator) -> Try:
    """A name that no file system has."""
    return Try("a name of over 255 letters", a_place(generator, "a" * int(generator.integers(256, 5000))))


def odd_names(folder: Path, generator: np.random.Generator) -> Try:
    """A name that a shell or a terminal would take for something else."""
    name = "x" + "".join(one_of(generator, *ODD) for _ in range(int(generator.integers(1, 4))))
    return Try("a name with $, brackets and the like", a_place(generator, name))


def other_bytes(folder: Path, generator: np.random.Generator) -> Try:
    """A word that is no text, somewhere in a command line."""
    words = list(a_place(generator, "x"))
    place = int(generator.integers(len(words)))
    word = os.fsencode(words[place])
    at = int(generator.integers(len(word) + 1))
    words[place] = word[:at] + bytes([int(generator.integers(128, 256))]) + word[at:]
    return Try("bytes that are not UTF-8", tuple(words))


def dense_rings(folder: Path, generator: np.random.Generator) -> Try:
    """A ring about as full as can be; 22 vehicles on 154 m now and then."""
    vehicles = 22 if generator.random() < 0.5 else int(generator.integers(2, 40))
    length = 7 * vehicles + int(generator.integers(-2, 3))
    road = ("--vehicles", str(vehicles), "--length", str(length), "--set", "horizon=5")
    words = ("drive", "ring", *road, "-n", "1", "--workers", "1", "--no-report", "--driver", "pi")
    return Try("a ring as full as can be", words, codes=(0,) if length >= 7 * vehicles else (2,))


def bombs(folder: Path, generator: np.random.Generator) -> Try:
    """A configuration nested without end, or with an endless number."""
    deep, long = int(generator.integers(3000, 100_000)), int(generator.integers(500, 5000))
    key = one_of(
        generator, "steps", "seed", "scenario_options.horizon", "trpo.gamma", "policy.hidden", "ghost", "workers"
    )
    value = one_of(
        generator,
        *("[" * deep, "{a=" * deep, "[" * deep + "]" * deep, '"' * deep, "9" * long, "0x" + "f" * long),
        *("-" + "9" * long, "1e" + "9" * long, "0o" + "7" * long, '"' + "9" * long + '"', "nan"),
    )
    text = one_of(generator, f"{key} = {value}\n", f"[{'a.' * deep}a]\n", f"a{'.a' * deep} = 1\n")
    (folder / "bomb.toml").write_text(text)
    if generator.random() < 0.3 and len(value) < 100_000:
        return Try("a setting nested or long without end", ("train", "ring", "--set", f"{key}={value}"))
    return Try("a configuration nested or long without end", ("train", "--config", "bomb.toml"))


def nuls(folder: Path, generator: np.random.Generator) -> Try:
    """A configuration that names a file with NUL in its path."""
    key = one_of(generator, "expert", "reward", "scenario", "preset", "scenario_options.population", "agent")
    ending = one_of(generator, ".py:x", ".unjam", ".sumocfg", ".json", "")
    (folder / "nul.toml").write_text(f'{key} = "x\\u0000{ending}"\n')
    return Try("NUL in a path", ("train", "--config", "nul.toml"))


def closed_outputs(folder: Path, generator: np.random.Generator) -> Try:
    """A standard output that is closed, full, or that nobody reads."""
    verb = one_of(generator, "scenarios", "drivers", "verify", "--version", "drive")
    words: Words = (*DRIVE, "pi") if verb == "drive" else ("verify", "it.unjam") if verb == "verify" else (verb,)
    output = one_of(generator, "closed", "/dev/full", "nobody")
    codes = {"closed": (0,), "/dev/full": (74,), "nobody": (GONE,)}[output]
    return Try(f"standard output: {output}", words, codes, output=output)


def no_folder(folder: Path, generator: np.random.Generator) -> Try:
    """A working folder that was removed."""
    place = folder / "removed"

    def leave() -> None:
        place.mkdir()
        os.chdir(place)
        place.rmdir()

    words = (a_place(generator, "x"), (*DRIVE[:-2], "--out", "new", "-d", "pi"), ("keys", "maker"))
    return Try("a working folder that was removed", words[int(generator.integers(3))], (2, 74), leave)


def few_descriptors(folder: Path, generator: np.random.Generator) -> Try:
    """A process that may open few files."""
    most = int(generator.integers(16, 40))

    def few() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))

    return Try("few file descriptors", (*DRIVE, "pi", "--workers", "4", "-n", "4"), (0, 2), few)


def strange_weights(folder: Path, generator: np.random.Generator) -> Try:
    """A controller with weights of a kind that no network has."""
    kind = (np.complex64, np.bool_)[int(generator.integers(2))]
    (folder / "strange.unjam").write_bytes(with_weights_of(kind))
    words = ((*DRIVE, "strange.unjam"), ("verify", "strange.unjam"), ("export", "strange.unjam", "--out", "x.unjam"))
    more: tuple[Words, ...] = (*words, ("certify", "strange.unjam"), ("sign", "strange.unjam", "--key", "maker.key"))
    return Try("complex or boolean weights", more[int(generator.integers(len(more)))])


def special_files(folder: Path, generator: np.random.Generator) -> Try:
    """A device or a file of the kernel, to be written or read."""
    place, read = one_of(generator, *SPECIAL), generator.random() < 0.4
    if read:
        verbs: tuple[Words, ...] = (
            (*DRIVE, place),
            (*DRIVE, "pi", "--humans", place),
            ("train", "ring", "--config", place),
            ("verify", place),
            ("verify", "it.unjam", "--signer", place),
            ("sign", "it.unjam", "--key", place),
            ("train", "--resume", place),
            ("fit-drivers", place),
        )
        return Try("a special file that is read", verbs[int(generator.integers(len(verbs)))])
    small = ("--set", "horizon=5")
    verbs = (
        ("drive", *RING, "-n", "1", "--driver", "pi", "--out", place),
        ("drive", *RING, "-n", "1", "--driver", "pi", "--out", f"{place}/new"),
        ("train", "ring", "--steps", "10", "--out", f"{place}/new"),
        ("search", "ring", "--vary", "trpo.gamma=0.9,0.99", "--out", f"{place}/new"),
        ("tune", "ring", "--steps", "8000", *small, "--out", f"{place}/new"),
        ("export", "pi", "--out", f"{place}/it.unjam"),
        ("keys", f"{place}/maker"),
        ("report", ".", "--out", f"{place}/page.html"),
        ("watch", *RING, "--driver", "pi", "--video", f"{place}/film.gif"),
    )
    return Try("a special file that is written", verbs[int(generator.integers(len(verbs)))], (2, 74))


KINDS: tuple[Callable[[Path, np.random.Generator], Try], ...] = (
    *(long_names, odd_names, other_bytes, dense_rings, bombs, nuls, closed_outputs, no_folder),
    *(few_descriptors, strange_weights, special_files),
)


def inputs(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Give wrong input, or odd surroundings, to the command line; each kind as often as the others."""
    outcome = Outcome()
    here, temporary = folder / "here", folder / "temporary"
    for each in (here, temporary):
        each.mkdir()
    make_keys(here / "maker")
    (here / "it.unjam").write_bytes(content_of())
    kept = {"UNJAM_CACHE": str(folder / "cache"), "UNJAM_STATE": str(folder / "state")}
    environment = {**os.environ, **PLAIN, **kept, "TMPDIR": str(temporary)}
    for number in range(count):
        tried = KINDS[number % len(KINDS)](here, generator)
        before = contents(here)
        code, said, errors = ran(tried, here, environment)
        assert code in tried.codes, (tried, code, errors)
        assert "Traceback" not in errors, (tried, errors)
        assert code == 0 or is_clear_error(errors, 74 in tried.codes) or (code == GONE and not errors), (tried, errors)
        assert not said or code == 0, (tried, said)
        assert contents(here) == before, tried
        assert not list(temporary.iterdir()), tried
        outcome.happened[f"{tried.what}: {ENDS.get(code, 'one line')}"] += 1
    return outcome


def is_clear_error(errors: str, has_started: bool) -> bool:
    """Return whether errors are one line; where the work may have begun, after its progress."""
    lines = [line for line in errors.splitlines() if line]
    return one_line(errors) or (has_started and [line for line in lines if line.startswith("unjam: ")] == lines[-1:])


def contents(folder: Path) -> dict[str, bytes]:
    """Return what lies in a folder."""
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def ran(tried: Try, folder: Path, environment: dict[str, str]) -> tuple[int, str, str]:
    """Run the command line; return its exit code, what it said, and its errors."""

    def prepare() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
        if tried.before:
            tried.before()
        if tried.output == "closed":
            os.close(1)

    output, reader = subprocess.PIPE, None
    if tried.output == "/dev/full":
        output = os.open(tried.output, os.O_WRONLY)
    elif tried.output == "nobody":
        reader, output = os.pipe()
        os.close(reader)
    done = subprocess.run(
        [UNJAM, *tried.words],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.PIPE,
        timeout=LONGEST,
        preexec_fn=prepare,
        check=False,
    )
    if output != subprocess.PIPE:
        os.close(output)
    return done.returncode, (done.stdout or b"").decode(), done.stderr.decode(errors="replace")
