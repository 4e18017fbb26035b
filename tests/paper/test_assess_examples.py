"""Roads and results of the examples of `unjam assess`."""

from pathlib import Path
from typing import Any

import pytest

from unjam.drivers import Human
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam_paper import assess_examples, open_test_roads
from unjam_paper.assess_examples import ASSESS_EXAMPLES, EXAMPLES, EXAMPLES_PART, Example, examples_table
from unjam_paper.results_file import read_part
from unjam_paper.study import StudyFolder


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_road_of_the_examples_carries_traffic(name: str, tmp_path: Path, sumo: SumoBackend) -> None:
    write_files, rate = EXAMPLES[name]
    scenario = make_scenario(str(write_files(tmp_path)), {"penetration_rate": rate, "end": 60.0})
    episode = run_episode(scenario, Human(), (1,), backend=sumo)
    assert (episode.status, episode.teleports, episode.warnings) == ("completed", 0, ())
    assert len(episode.vehicle_ids) > 5
    assert not [note for note in scenario.notes if "max-depart-delay" in note]


@pytest.mark.slow
def test_a_road_is_assessed_once_and_its_results_have_all_drivers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (write_files, _), out = EXAMPLES["an on-ramp with SUMO's default vehicles"], tmp_path / "out"
    out.mkdir()
    written = list[Path]()

    def write(folder: Path) -> Path:
        written.append(folder)
        return write_files(folder)

    short: dict[str, Example] = {"first": (write, 0.3)}
    monkeypatch.setattr(assess_examples, "EXAMPLES", short)
    monkeypatch.setattr(assess_examples, "MAX_EPISODES", 15)
    monkeypatch.setattr(open_test_roads, "EPISODE_SECONDS", 60.0)
    ASSESS_EXAMPLES.run(StudyFolder(tmp_path), 1, out, 2)
    results: dict[str, Any] = read_part(out, EXAMPLES_PART)["first"]
    human, acc, controller = results["drivers"]
    assert (human["driver"], acc["driver"]) == ("human", "cruise")
    assert controller["driver"] in results["rejection_reasons"]
    assert controller["difference"]["count"] == results["test_seeds"] == 3
    assert controller["verdict"].startswith("3 test seeds, where 10 are needed")
    assert acc["travel_time"] == pytest.approx(human["travel_time"] + acc["difference"]["mean"])
    assert len(results["sentences"]) == 2
    assert list(examples_table(out)["driver"]) == ["human", "cruise", controller["driver"]]
    short["second"] = (write, 0.3)
    ASSESS_EXAMPLES.run(StudyFolder(tmp_path), 1, out, 2)
    assert len(written) == 2
    assert list(read_part(out, EXAMPLES_PART)) == ["first", "second"]
    assert read_part(out, EXAMPLES_PART)["first"] == results
