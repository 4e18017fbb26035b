from typing import get_args

import pytest

from unjam.errors import InputError
from unjam.parameters import build
from unjam.virtual.model import BASES
from unjam.virtual.settings import BaseName, VirtualSettings


def test_every_base_can_be_chosen() -> None:
    assert set(get_args(BaseName)) == set(BASES)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"base": "krauss"},
            "virtual.base: 'krauss' is not allowed; allowed: 'idm', 'population', 'acc', 'ovm' or 'none'",
        ),
        ({"error": "loss"}, "virtual.error: 'loss' is not allowed; allowed: 'unexplained'"),
        ({"members": 0}, "virtual.members: 0 is not allowed"),
        ({"holdout": 1.0}, "virtual.holdout: 1.0 is not allowed"),
        ({"hidden": ()}, "virtual.hidden"),
        ({"epochs": 0}, "virtual.epochs: 0"),
        ({"length": 3}, "virtual.length: unknown name"),
        (
            {"members": 1, "error": "total_variation"},
            "virtual.members: 1 is not allowed with total_variation",
        ),
    ],
)
def test_what_is_wrong_is_named(values: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        build(VirtualSettings, values, "virtual")
