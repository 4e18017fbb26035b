"""Tables of studies, drawn from the stored results."""

import pytest

from tests.system.conftest import ROOT
from unjam_paper.studies import STUDIES

RESULTS = {name: path for name in STUDIES if (path := ROOT / f"results/{name}.json").is_file()}
RESULTS_WITHOUT_CURVES = ("eq16", "road-model-wrong-base")
"""studies with older results, which have no table of checkpoints"""


@pytest.mark.parametrize("name", RESULTS)
def test_the_tables_of_a_study_can_be_drawn_from_its_stored_results(name: str) -> None:
    for table, make_table in STUDIES[name].tables.items():
        is_empty = name in RESULTS_WITHOUT_CURVES and table == "checkpoints"
        assert make_table(RESULTS[name]).empty is is_empty, table
