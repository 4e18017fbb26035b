import pytest

from tests.following.made_up import idm_driver
from unjam.errors import InputError
from unjam.following.calibration import CalibrationSettings
from unjam.following.fit_drivers import FitDriversSettings, fit_drivers
from unjam.following.multi_step import MultiStepSettings
from unjam.following.pairs import Pair
from unjam.physics.idm import IDMParameters

HEADWAYS = (0.9, 1.1, 1.3, 1.5, 1.7)
QUICK = CalibrationSettings(generations=15)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return [
        idm_driver(IDMParameters(time_headway=headway), f"driver {headway}", seed, seconds=25.0)
        for seed, headway in enumerate(HEADWAYS)
    ]


def test_every_driver_has_its_headway_and_what_suits_all(pairs: list[Pair]) -> None:
    told: list[tuple[int, int]] = []
    found = fit_drivers(pairs, FitDriversSettings(calibration=QUICK), lambda *done: told.append(done))
    headways = [one.time_headway for one in found.drivers]
    assert headways == sorted(headways)
    assert all(one.max_acceleration == found.typical.max_acceleration for one in found.drivers)
    assert [detail["name"] for detail in found.details] == [pair.driver for pair in pairs]
    assert all(detail["gap_error"] < found.about["fit"]["together"]["gap_error"] for detail in found.details)
    assert found.residual is None
    assert told[-1] == (5, 5)


def test_a_residual_is_kept_where_it_is_better(pairs: list[Pair]) -> None:
    steps = MultiStepSettings(hidden=(4,), seconds=5.0, batch=8, steps=2, validate_every=1)
    settings = FitDriversSettings(
        calibration=CalibrationSettings(generations=2), residual=True, multi_step=steps
    )
    found = fit_drivers(pairs, settings)
    fit = found.about["fit"]
    assert fit["residual_is_better"] == (min(fit["residual_gap_errors"]) < fit["residual_gap_errors"][0])
    assert (found.residual is not None) == fit["residual_is_better"]


def test_what_cannot_be_fitted(pairs: list[Pair]) -> None:
    with pytest.raises(InputError, match=r"drivers: 2 is not allowed; allowed: >= 5 for a residual"):
        fit_drivers(pairs[:2], FitDriversSettings(residual=True))
    with pytest.raises(InputError, match="own: 'exponent' is not allowed"):
        fit_drivers(pairs, FitDriversSettings(own=("exponent",)))
