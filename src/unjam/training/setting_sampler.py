"""Proposals of settings for a tuning, none of which has too large a string gain."""

from collections.abc import Callable
from typing import Any

from optuna import create_study
from optuna.samplers import TPESampler
from optuna.trial import Trial, TrialState

from unjam.drivers.driver import label_with_parameters
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError, UnjamError
from unjam.training.search_space import SearchSpace

MAX_REFUSED_SETTINGS = 60
"""settings in a row with too large string gains, after which there seem to be no others"""


def invalid_reason(driver: str) -> str:
    """Return why a driver cannot be made, as for parameters that contradict each other; or an empty text."""
    try:
        driver_from_name(driver, 1.0)
    except InputError as error:
        return str(error)
    return ""


class SettingSampler:
    """Proposes settings of an expert by Optuna's TPE; it learns from scores and from refused settings."""

    def __init__(
        self,
        expert: str,
        space: SearchSpace,
        seed: int,
        string_gain: Callable[[str], float],
        max_string_gain: float = 0.0,
    ) -> None:
        """Take the function that measures the string gain of a driver's name; it is not called with the limit 0."""
        self._expert, self._space = expert, space
        self._string_gain, self._max_string_gain = string_gain, max_string_gain
        self._study = create_study(direction="maximize", sampler=TPESampler(seed=seed, multivariate=True))

    def ask(self, count: int) -> list[tuple[Trial, dict[str, Any]]]:
        """Return new settings; raise `UnjamError` if too many in a row have too large a string gain."""
        accepted: list[tuple[Trial, dict[str, Any]]] = []
        refused: list[float] = []
        while len(accepted) < count:
            trial = self._study.ask(dict(self._space))
            values = {key: _round_digits(value) for key, value in trial.params.items()}
            if self._max_string_gain and not self._is_allowed(trial, values, refused):
                continue
            accepted.append((trial, values))
            refused = []
        return accepted

    def tell(self, trial: Trial, score: float | None) -> None:
        """Report the score of a setting; None: it is infeasible."""
        self._study.tell(trial, score, state=TrialState.FAIL if score is None else None)

    def _is_allowed(self, trial: Trial, values: dict[str, Any], refused: list[float]) -> bool:
        """Return whether the string gain is allowed; if not, tell the sampler, and add it to `refused`."""
        driver = label_with_parameters(self._expert, values)
        gain = 0.0 if invalid_reason(driver) else self._string_gain(driver)
        trial.set_constraint("excess_gain", gain - self._max_string_gain)
        if gain <= self._max_string_gain:
            return True
        self._study.tell(trial, 0.0)
        refused.append(gain)
        if len(refused) == MAX_REFUSED_SETTINGS:
            reason = f"{len(refused)} settings of {self._expert} in a row have a string gain of at least"
            allowed = f"allowed: at most {self._max_string_gain:g}, or another expert, such as smooth-acc"
            raise UnjamError(f"tune: {reason} {min(refused):.3g}; {allowed}")
        return False


def _round_digits(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value
