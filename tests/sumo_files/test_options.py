"""What becomes of a configuration's options: passed, replaced, left out or refused."""

import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.sumo_files.test_sumo_files import configuration
from unjam.errors import InputError
from unjam.sumo_files import REFUSED_OPTIONS, classify_option, read_sumo_files
from unjam.sumo_files.reader_program import FILE_OPTIONS, canonical_option
from unjam.worlds.sumo.networks import sumo_program

VALUES = {"BOOL": "true", "INT": "1", "FLOAT": "1", "TIME": "1"}
ONLY_REPORTS = {"configuration", "output", "report", "traci_server", "gui_only"}
"""groups of options that change no vehicle"""
NO_EFFECT = {
    *("device.rerouting.output", "device.rerouting.threads", "device.taxi.dispatch-algorithm.output"),
    *("device.taxi.idle-algorithm.output", "device.toc.file", "emissions.volumetric-fuel"),
    *("load-state.offset", "load-state.remove-vehicles"),
}
"""options of other groups that change none either, or none without another option"""
DEVICES_THAT_WRITE = ("ssm", "example", "fcd", "tripinfo", "vehroute", "btreceiver", "btsender", "fcd-replay")
DECIDED = {"step-length", "collision.action", "collision.check-junctions", "collision.mingap-factor"}
"""options that unjam reads, or decides for all networks"""


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, str, list[str]]]:
    """All options of SUMO: group, kind of value and other names."""
    template = tmp_path_factory.mktemp("template") / "template.xml"
    subprocess.run([sumo_program("sumo"), "--save-template", str(template)], check=True, capture_output=True)
    return {
        option.tag: (group.tag, option.attrib["type"], option.get("synonymes", "").split())
        for group in ElementTree.parse(template).getroot()
        for option in group
    }


def fate(name: str, kind: str) -> str:
    """What becomes of an option with a value that is not its default."""
    try:
        return classify_option("mine.sumocfg", canonical_option(name), VALUES.get(kind, "some"))
    except InputError:
        return "refused"


def test_every_option_of_sumo_is_passed_or_refused_unless_it_changes_no_vehicle(
    options: dict[str, tuple[str, str, list[str]]],
) -> None:
    fates: dict[str, set[str]] = {}
    for name, (group, kind, _) in options.items():
        if name in FILE_OPTIONS or name in DECIDED:
            continue
        device = name.removeprefix("person-").removeprefix("device.").partition(".")[0]
        harmless = group in ONLY_REPORTS or name in NO_EFFECT or device in DEVICES_THAT_WRITE
        found = fate(name, kind)
        fates.setdefault(found, set()).add(name)
        if harmless and name not in REFUSED_OPTIONS:
            assert found in ("dropped", "ignored"), name
        else:
            assert found in ("passed", "replaced", "refused"), name
    assert fates["refused"] == {*REFUSED_OPTIONS}
    assert fates["replaced"] == {"seed", "random", "max-depart-delay", "threads"}


def test_synonyms_of_an_option_are_treated_alike(options: dict[str, tuple[str, str, list[str]]]) -> None:
    for name, (_, kind, others) in options.items():
        for other in others:
            if name in FILE_OPTIONS:
                assert canonical_option(other) == name
            else:
                assert fate(other, kind) == fate(name, kind), other


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        ('<load-state value="state.xml"/>', "load-state: 'state.xml' is not allowed; allowed: no file, as episodes"),
        ('<astar.all-distances value="d"/>', "astar.all-distances: 'd' is not allowed; allowed: no file"),
        ('<device.fcd-replay.file value="d"/>', "device.fcd-replay.files: 'd' is not allowed; allowed: no file"),
        ('<phemlight-path value="mine"/>', "phemlight-path: 'mine' is not allowed; allowed: ./PHEMlight/"),
        ('<laterl-resolution value="1"/>', "SUMO 1.28 has no such option; did you mean 'lateral-resolution'?"),
        ('<Begin value="1"/>', "Begin: SUMO 1.28 has no such option; did you mean 'begin'?"),
        ('<begin value="1"/><b value="1"/>', "b: it is set twice"),
        ('<begin value="1" v="2"/>', "begin: it is set twice"),
        ("<begin>1</begin>", "'1' is not allowed; allowed: <option value=\"...\"/>"),
        ('<n value="other.net.xml"/>', "n: it is set twice"),
    ],
)
def test_unsupported_options_are_refused(inside: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read_sumo_files(configuration(tmp_path, inside))
    assert words in str(caught.value)
    assert str(caught.value).startswith("road.sumocfg: ")


@pytest.mark.parametrize(
    "inside",
    [
        '<load-state value=""/><b value=""/>',
        '<phemlight-path value="./PHEMlight/"/>',
        '<mesosim value="false"/><configuration-file value="other.sumocfg"/>',
        '<device.fcd-replay.probability value="-1"/>',
        "<!-- text --> <processing/>",
    ],
)
def test_options_at_their_defaults_change_nothing(inside: str, tmp_path: Path) -> None:
    found = read_sumo_files(configuration(tmp_path, inside))
    assert (found.replaced_options, found.begin) == ((), 0.0)


def test_files_of_a_configuration_may_name_variables_that_are_not_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SUMO_HOME", raising=False)
    path = configuration(tmp_path, '<scale value="${SUMO_HOME}2"/>')
    path.write_text(path.read_text().replace("road.rou", "${SUMO_HOME}road.rou"))
    found = read_sumo_files(path)
    assert (found.route_files, found.options) == ((tmp_path / "road.rou.xml",), {"scale": "2"})


@pytest.mark.parametrize(
    ("inside", "field"),
    [
        ("", "route-files"),
        ('<scale value="${SECRET}"/>', "scale"),
        ('<scale-suffix value="a${SECRET}"/>', "scale-suffix"),
    ],
)
def test_other_variables_of_the_environment_stay_secret(
    inside: str, field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "topsecret42")
    path = configuration(tmp_path, inside + '<tripinfo-output value="${SECRET}.xml"/>')
    if not inside:
        path.write_text(path.read_text().replace("road.rou", "${SECRET}/road.rou"))
    with pytest.raises(InputError, match=r"SECRET.* is not allowed; allowed: \$\{HOME\}") as caught:
        read_sumo_files(path)
    assert f": {field}: " in str(caught.value)
    assert "topsecret42" not in str(caught.value)
