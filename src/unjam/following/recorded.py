"""How files of trajectories are read, and what was found in one."""

from dataclasses import dataclass, field

from unjam.following.pairs import Pair

LISTED = 5
"""bad rows that a message names"""


@dataclass(frozen=True)
class Reading:
    """How a file is read."""

    cut_bad: bool = False
    """whether bad rows are cut out, and end their trajectory, instead of refused"""
    shortest: float = 20.0
    """trajectories shorter than that are left out, and counted [s]"""
    driver: tuple[str, ...] = ()
    """plain tables: columns that together name the driver, where `driver` is not one"""
    kind: tuple[str, ...] = ()
    """plain tables: columns that together name the kind of driver, where `kind` is not one"""


@dataclass(frozen=True)
class BadRow:
    """A row that cannot be used."""

    line: int
    """in the file, its header being line 1"""
    why: str


@dataclass(frozen=True)
class Recorded:
    """What a file holds."""

    pairs: list[Pair] = field(repr=False)
    rows: int
    """in the file"""
    bad: list[BadRow]
    """rows that were cut out, with what was wrong"""
    left_out: dict[str, int]
    """rows that are not wrong but of no use, by reason"""

    def words(self) -> list[str]:
        """Return lines that say what was read and what was not."""
        moments = sum(len(pair.speed) for pair in self.pairs)
        lines = [f"{len(self.pairs)} trajectories with {moments:,} of {self.rows:,} rows"]
        lines += [f"left out: {count:,} rows: {why}" for why, count in self.left_out.items() if count]
        lines += [f"cut out: line {row.line}: {row.why}" for row in self.bad[:LISTED]]
        if len(self.bad) > LISTED:
            lines.append(f"cut out: {len(self.bad) - LISTED} more bad rows")
        return lines
