"""How many episodes may still be driven: a number of them, minutes, or both."""

import time
from collections.abc import Callable


class Budget:
    """Counts episodes, and knows by how long those before took whether more fit into the time."""

    def __init__(
        self, episodes: int, minutes: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin to count, and the clock to run."""
        self.episodes, self.spent = episodes, 0
        self._seconds, self._clock, self._started = minutes and 60.0 * minutes, clock, clock()

    def spend(self, count: int) -> None:
        """Note that so many episodes were driven."""
        self.spent += count

    def allows(self, count: int, part: float = 1.0) -> bool:
        """Return whether so many episodes more fit into this part of the budget."""
        wanted = self.spent + count
        if wanted > part * self.episodes:
            return False
        if self._seconds is None or not self.spent:
            return True
        each = (self._clock() - self._started) / self.spent
        return each * wanted <= part * self._seconds
