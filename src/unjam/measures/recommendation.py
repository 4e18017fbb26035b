"""Are CAVs recommended on a road, and at which share? Words that follow from the numbers by rule."""

from collections.abc import Sequence
from dataclasses import dataclass

from unjam.measures.effect import Effect, harm_of, reasons_against
from unjam.measures.statistics import signed

NONE = "No CAVs are recommended on this road"


@dataclass(frozen=True)
class Judged:
    """The driver that was chosen for a share of CAVs, on seeds that chose nothing."""

    share: float
    driver: str
    effect: Effect

    @property
    def reasons(self) -> list[str]:
        """Why it is not recommended; none where it is."""
        return reasons_against(self.effect)

    @property
    def words(self) -> str:
        """What is said of this share, in a sentence or two."""
        who = f"{percent(self.share)} CAVs that drive as {self.driver}"
        if self.reasons:
            return f"{who}: not recommended, for {'; '.join(self.reasons)}."
        found = self.effect
        return (
            f"{who}: recommended. Travel time {signed(found.travel_time, 1)} s "
            f"({100 * found.relative_time:+.1f} %), flow {signed(found.flow)} veh/h, fuel "
            f"{signed(found.fuel, 1)} ml/km, on {found.travel_time.count} fresh seeds."
        )


def recommended(judged: Sequence[Judged]) -> Judged | None:
    """Return the share and driver that are recommended: who shortens travel time most among those allowed."""
    return min(
        (each for each in judged if not each.reasons),
        key=lambda each: each.effect.relative_time,
        default=None,
    )


def shown_beside(judged: Sequence[Judged]) -> Judged | None:
    """Return whose traffic pictures show beside people's: the recommended, else the quickest."""
    quickest = min(judged, key=lambda each: each.effect.relative_time, default=None)
    return recommended(judged) or quickest


def headline(judged: Sequence[Judged]) -> str:
    """Return the answer in one sentence."""
    best = recommended(judged)
    if best is None:
        if not judged:
            return f"{NONE}: all that was tried slows traffic, loses flow, or failed."
        worse = sum(bool(harm_of(each.effect)) for each in judged)
        harm = f" ({worse} of {len(judged)} slow traffic or lose flow)" if worse else ""
        return f"{NONE}: none of the shares judged on fresh seeds passes the rule{harm}."
    return (
        f"{percent(best.share)} CAVs are recommended on this road, driving as {best.driver}: travel time "
        f"{signed(best.effect.travel_time, 1)} s a vehicle ({100 * best.effect.relative_time:+.1f} %)."
    )


def percent(share: float) -> str:
    """Return a share as words say it."""
    return f"{100 * share:g} %"
