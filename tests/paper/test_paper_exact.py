"""Where the paper's rule ends a training, and which way its model error goes."""

from typing import Any

from unjam.training.config import load_config
from unjam_paper.paper_exact import paper_convergence, transition_model_errors

SPAN = load_config(preset="paper-exact").evaluation.convergence_window


def rows(returns: list[float]) -> list[dict[str, Any]]:
    """Progress with a return for each span of iterations."""
    return [
        {"environment_steps": 6000 * (number + 1), "return_mean": returns[number // SPAN]}
        for number in range(SPAN * len(returns))
    ]


def test_a_training_has_converged_where_a_span_earns_no_more_than_the_one_before() -> None:
    assert paper_convergence(rows([1.0, 3.0, 4.0, 4.0, 5.0])) == {"steps": 4 * SPAN * 6000, "return": 4.0}
    assert paper_convergence(rows([1.0, 3.0])) is None


def test_the_error_of_the_model_is_that_of_the_first_and_of_the_last_tenth() -> None:
    errors = [{"virtual": {"eps_m_by_estimator": {"transitions": value / 20}}} for value in range(20)]
    assert transition_model_errors(errors) == [0.025, 0.925]
    assert transition_model_errors([{"virtual": {}}]) is None
