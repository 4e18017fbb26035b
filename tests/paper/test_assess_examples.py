"""Do the roads of the examples of `unjam assess` load and carry traffic, and is no road assessed twice?"""

import json
from pathlib import Path
from typing import Any

import pytest

from unjam.drivers import Human
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.simulation import Simulation
from unjam_paper import assess_examples
from unjam_paper.assess_examples import EXAMPLES, Example, main


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_road_of_the_examples_carries_traffic(name: str, tmp_path: Path, simulation: Simulation) -> None:
    example = EXAMPLES[name]
    scenario = make_scenario(str(example.write(tmp_path)), {"penetration_rate": example.rate, "end": 60.0})
    episode = run_episode(scenario, Human(), (1,), simulation=simulation)
    assert (episode.status, episode.teleports, episode.warnings) == ("completed", 0, ())
    assert len(episode.vehicle_ids) > 5
    assert not [note for note in scenario.notes if "max-depart-delay" in note]


@pytest.mark.long
def test_a_road_is_assessed_once_and_its_entry_has_all_drivers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    road, out = EXAMPLES["an on-ramp with SUMO's default vehicles"], tmp_path / "assess.json"
    written = list[Path]()

    def write(folder: Path) -> Path:
        written.append(folder)
        return road.write(folder)

    short: dict[str, Example] = {"first": Example(write, 0.3)}
    monkeypatch.setattr(assess_examples, "EXAMPLES", short)
    words = ["--out", str(out), "--episodes", "15", "--seconds", "60"]
    main(words)
    found: dict[str, Any] = json.loads(out.read_text())["roads"]["first"]
    human, acc, controller = found["drivers"]
    assert (human["driver"], acc["driver"]) == ("human", "cruise")
    assert controller["driver"] in found["rejection_reasons"]
    assert controller["difference"]["count"] == found["test_seeds"] == 3
    assert controller["verdict"].startswith("3 test seeds are too few")
    assert acc["travel_time"] == pytest.approx(human["travel_time"] + acc["difference"]["mean"])
    assert len(found["sentences"]) == 2
    assert found["headline"] in capsys.readouterr().out
    short["second"] = Example(write, 0.3)
    main(words)
    assert len(written) == 2
    assert list(json.loads(out.read_text())["roads"]) == ["first", "second"]
    assert json.loads(out.read_text())["roads"]["first"] == found
