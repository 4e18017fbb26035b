from typing import get_args

import pytest

from unjam.errors import InputError
from unjam.models.row_model import BASE_DRIVERS
from unjam.models.settings import BaseName, ModelSettings
from unjam.parameters import build_dataclass


def test_every_base_is_allowed() -> None:
    assert set(get_args(BaseName)) == set(BASE_DRIVERS)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"base": "krauss"},
            "model.base: 'krauss' is not allowed; allowed: 'idm', 'population', 'acc', 'ovm' or 'none'",
        ),
        ({"error_estimator": "loss"}, "model.error_estimator: 'loss' is not allowed; allowed: 'unexplained_variance'"),
        ({"members": 0}, "model.members: 0 is not allowed"),
        ({"holdout": 1.0}, "model.holdout: 1.0 is not allowed"),
        ({"hidden": ()}, "model.hidden"),
        ({"epochs": 0}, "model.epochs: 0"),
        ({"length": 3}, "model.length: unknown name"),
        ({"members": 1, "error_estimator": "total_variation"}, "model.members: 1 is not allowed with total_variation"),
    ],
)
def test_invalid_settings_are_named(values: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        build_dataclass(ModelSettings, values, "model")
