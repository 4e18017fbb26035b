"""Read the warnings of an episode from SUMO's error log, one entry for each kind."""

import re
from collections import Counter
from pathlib import Path

from unjam.worlds.record import SumoWarning
from unjam.worlds.sumo.networks import MESSAGE_TOTAL_MARKER

MAX_LOG_BYTES = 2**20
"""bytes of a log that are read; SUMO writes one example and one total for most kinds"""
MAX_EXAMPLE_LENGTH = 300
"""characters of an example"""
MAX_EXAMPLES_OPTION = "1"
"""value of SUMO's option aggregate-warnings: further messages of a kind are only counted"""
_TOTAL_PATTERN = re.compile(rf"(\d+) {MESSAGE_TOTAL_MARKER} (.*)")
_VARIABLE_PATTERN = re.compile(r"'[^']*'|(?<==)[^\s,;]*[^\s,;.!]|[-+]?\b\d+(?:\.\d+)?\b")
"""variable parts of the messages of a kind: quoted names, values after =, and numbers"""
SEPARATELY_COUNTED = re.compile(
    r"Teleporting vehicle|ends teleporting|teleports beyond|collision with|performs emergency braking"
)
"""messages about teleports, collisions and hard braking, which unjam counts itself"""


def read_warnings(log_path: Path) -> tuple[SumoWarning, ...]:
    """Return the warnings and errors in a complete log, except those that unjam counts itself.

    SUMO must have written it with `aggregate-warnings` at `MAX_EXAMPLES_OPTION` and closed it.
    """
    try:
        with log_path.open(errors="replace") as file:
            text = file.read(MAX_LOG_BYTES)
            text = text.rpartition("\n")[0] if file.read(1) else text  # without an incomplete message
    except OSError:
        return ()
    messages = re.findall(r"^(?:Warning|Error): (.*(?:\n(?!Warning:|Error:).*)*)", text, re.MULTILINE)
    examples, counts = dict[str, str](), Counter[str]()
    totals = list[tuple[int, str]]()
    for message in (" ".join(each.split()) for each in messages):
        if total := _TOTAL_PATTERN.fullmatch(message):
            totals.append((int(total[1]), total[2]))
        elif not SEPARATELY_COUNTED.search(message):
            kind = warning_kind(message)
            examples.setdefault(kind, message)
            counts[kind] += 1
    for count, form in totals:  # includes the example
        pattern = re.compile(".*".join(map(re.escape, form.split("%"))))
        for kind in [kind for kind, message in examples.items() if pattern.fullmatch(message)][:1]:
            counts[kind] += count - 1
    return tuple(SumoWarning(kind, message[:MAX_EXAMPLE_LENGTH], counts[kind]) for kind, message in examples.items())


def warning_kind(message: str) -> str:
    """Return a message with the placeholder % instead of quoted names, values and numbers."""
    return _VARIABLE_PATTERN.sub(lambda match: "'%'" if match[0].startswith("'") else "%", message)
