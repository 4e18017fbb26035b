"""What string stability costs: the study of tuned experts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from unjam.controller import string_stability as gains
from unjam.scenarios import Ring, Scenario, make_scenario
from unjam_paper import string_stability as study
from unjam_paper.results_file import write_part
from unjam_paper.string_stability import measure_human_baseline, measure_tuned, string_figure, string_table


@pytest.mark.slow
def test_experts_are_tuned_within_their_limits_and_compared_with_human_drivers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    roads = ("ring", "ring-jammed")

    def short_road(name: str) -> Scenario:
        ring = make_scenario(name)
        assert isinstance(ring, Ring)
        return replace(ring, horizon=40, warmup=200, vehicles=8, length=(80, 90))

    monkeypatch.setattr(study, "make_scenario", short_road)
    monkeypatch.setattr(study, "STRING_SEEDS", 2)
    monkeypatch.setattr(study, "TUNING_STEPS", dict.fromkeys(roads, (12 * 8 + 2 * 8) * 40))
    monkeypatch.setattr(study, "STRING_ROADS", roads)
    monkeypatch.setattr(gains, "OSCILLATION_FREQUENCIES", np.geomspace(0.01, 0.2, 3))
    monkeypatch.setattr(gains, "SETTLING_SECONDS", 30.0)
    for name in roads:
        rows = [measure_tuned(name, "smooth-acc", limit, 1)[0] for limit in (1.1, 0.0)]
        assert rows[0]["gain"] <= 1.1
        write_part(tmp_path, name, [*measure_human_baseline(name, 1), *rows])
        table = string_table(name, tmp_path)
        assert list(table["largest gain allowed"])[1:] == ["1.1", "any"]
        assert table["return, difference to human"].iloc[1:].str.contains(" to ").all()
    assert len(string_figure(tmp_path).axes) == len(roads)
