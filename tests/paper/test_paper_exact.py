"""The convergence rule of the paper, and the model error over training."""

from typing import Any

from unjam.training.config import load_config
from unjam_paper.comparison import paper_convergence, transition_model_errors

WINDOW = load_config(preset="paper-exact").evaluation.convergence_window


def rows(returns: list[float]) -> list[dict[str, Any]]:
    """Progress with a return for each window of iterations."""
    return [
        {"environment_steps": 6000 * (number + 1), "return_mean": returns[number // WINDOW]}
        for number in range(WINDOW * len(returns))
    ]


def test_a_training_has_converged_when_a_window_has_no_larger_return_than_the_one_before() -> None:
    assert paper_convergence(rows([1.0, 3.0, 4.0, 4.0, 5.0])) == {"steps": 4 * WINDOW * 6000, "return": 4.0}
    assert paper_convergence(rows([1.0, 3.0])) is None


def test_model_errors_are_those_of_the_first_and_the_last_tenth() -> None:
    errors = [{"model": {"eps_m_by_estimator": {"transitions": value / 20}}} for value in range(20)]
    assert transition_model_errors(errors) == [0.025, 0.925]
    assert transition_model_errors([{"model": {}}]) is None
