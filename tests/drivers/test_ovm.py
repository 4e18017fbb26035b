import numpy as np
import pytest

from tests.conftest import state_of
from unjam.drivers import OVM


def test_gives_the_reference_values_of_flow() -> None:
    accelerations, _ = OVM().act(state_of([0] * 3, [0] * 3, [0, 10, 5]), {})
    np.testing.assert_allclose(accelerations, [0.0, 20.319073, 3.772339], atol=1e-6)


def test_optimal_speed_is_the_largest_beyond_the_go_gap() -> None:
    acceleration, _ = OVM(max_speed=12).act(state_of([12], [12], [40]), {})
    assert acceleration[0] == pytest.approx(0.0)
