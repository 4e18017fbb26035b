"""Text for users: counts, durations, lists of names, and untrusted texts without hidden characters."""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from unicodedata import category

MAX_LISTED_NAMES = 20  # maximum number of names that a message lists
INVISIBLE_LETTERS = {
    *"\u034f\u115f\u1160\u17b4\u17b5\u2800\u3164\uffa0",
    *map(chr, (*range(0x180B, 0x1810), *range(0xFE00, 0xFE10), *range(0xE0100, 0xE01F0))),
}
"""invisible letters and marks that Unicode does not count as control characters"""


def to_one_line(value: object, length: int = 200) -> str:
    """Return an untrusted text on one line without control characters, cut with `…` to `length` characters."""
    text = printable(" ".join(str(value).split()))
    return text if len(text) <= length else f"{text[: length - 1]}…"


def printable(text: str) -> str:
    """Replace characters that move the cursor, change the direction of text, or are invisible by `?`."""
    letters = set(text) - {"\n"}
    hidden = {letter for letter in letters if not letter.isprintable() and category(letter) != "Zs"}
    hidden |= letters & INVISIBLE_LETTERS
    return "".join("?" if letter in hidden else letter for letter in text) if hidden else text


def format_count(count: float, noun: str, plural: str = "") -> str:
    """Return a number with its noun: `1 file`, `2,000 files`; `plural` is for a noun with an irregular plural."""
    return f"{count:,.0f} {noun if count == 1 else plural or f'{noun}s'}"


def format_duration(seconds: float) -> str:
    """Return a duration for a line of progress."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def shorten_list(names: Iterable[str], max_names: int = MAX_LISTED_NAMES, max_letters: int | None = None) -> str:
    """Return the first names joined by commas, each cut to `max_letters`, and the number of the remaining names."""
    all_names = list(names)
    more = len(all_names) - max_names
    listed = ", ".join(name[:max_letters] for name in all_names[:max_names])
    return listed + (f" and {more} more" if more > 0 else "")


def split_label(label: str) -> list[str]:
    """Split a name after punctuation, where a line may break in addition to spaces."""
    return re.split(r"(?<=[:,=/_-])", label)


def spelling_hint(value: object, names: Iterable[str], similarity: float = 0.6) -> str:
    """Return `; did you mean 'ring'?`, or an empty text if no name has the `similarity`, where 1 means equal."""
    matches = get_close_matches(str(value), list(names), 1, similarity)
    return f"; did you mean {matches[0]!r}?" if matches else ""
