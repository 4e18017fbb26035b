"""Harmful files are read in a separate process, and refused in one line."""

import gzip
import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.sumo_files.test_sumo_files import NETWORK, ROUTES, configuration
from unjam import sandbox, sumo_files
from unjam.errors import DiskError, InputError
from unjam.sumo_files import read_lanes, read_sumo_files, write_harmless_copy
from unjam.sumo_files import reader_program as reader
from unjam.sumo_files.variants import write_variant

LAUGHS = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10 if n else "lol"}">' for n in range(10))
DEFINITIONS = {
    "entities that grow without end": f"<!DOCTYPE net [{LAUGHS}]>",
    "another file": '<!DOCTYPE net [<!ENTITY it SYSTEM "file:///etc/passwd">]>',
    "a definition from elsewhere": '<!DOCTYPE net SYSTEM "http://127.0.0.1:9/net.dtd">',
    "a definition after a comment": "<!-- harmless --><!DOCTYPE net>",
}


def refusal_message(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_sumo_files(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", DEFINITIONS)
@pytest.mark.parametrize("file", ["road.net.xml", "road.rou.xml", "road.sumocfg"])
def test_a_document_type_is_refused(name: str, file: str, tmp_path: Path) -> None:
    path = configuration(tmp_path)
    (tmp_path / file).write_text(DEFINITIONS[name] + (tmp_path / file).read_text())
    assert refusal_message(path) == f"{file}: a document type (<!DOCTYPE ...>) is not allowed"


def test_the_word_doctype_in_a_comment_is_harmless(tmp_path: Path) -> None:
    path = configuration(tmp_path, network="<!-- <!DOCTYPE net> -->" + NETWORK)
    assert read_sumo_files(path).used_types == {"car"}


@pytest.mark.parametrize("file", ["road.net.xml", "road.rou.xml", "road.rou.xml.gz"])
def test_a_huge_element_is_refused_before_it_takes_time_or_memory(file: str, tmp_path: Path) -> None:
    path = configuration(tmp_path)
    content = (tmp_path / file.removesuffix(".gz")).read_text().replace(' id="', f' id="{"a" * 9_000_000}', 1).encode()
    (tmp_path / file).write_bytes(gzip.compress(content, 1) if file.endswith(".gz") else content)
    if file.endswith(".gz"):
        path.write_text(path.read_text().replace("road.rou.xml", file))
    assert re.fullmatch(f"{file}: line \\d+ is too long; allowed: .* 4,194,304 bytes", refusal_message(path))


def test_reading_that_takes_too_long_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = configuration(tmp_path)
    monkeypatch.setattr(sumo_files, "MAX_READER_TIME", 0.001)
    assert refusal_message(path) == "road.sumocfg: its files cannot be read within 4 GiB, 0.001 s"


def test_a_lost_reader_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = configuration(tmp_path)
    monkeypatch.setattr(sumo_files, "READER_PROGRAM", tmp_path / "none.py")
    assert "cannot be read within" in refusal_message(path)


def test_the_reader_needs_only_the_standard_library(tmp_path: Path) -> None:
    program = [sys.executable, "-I", "-S", sandbox.__file__, str(2**30), "60", "", str(sumo_files.READER_PROGRAM)]
    ran = subprocess.run([*program, "configuration", str(configuration(tmp_path))], capture_output=True, check=True)
    assert json.loads(ran.stdout)["result"]["used_types"] == ["car"]


def test_lanes_are_read_with_their_edges(tmp_path: Path) -> None:
    path = tmp_path / "road.net.xml"
    lane = '<lane id="a_b_0" length="10.5" speed="13.9" shape="0,0 10.5,1,3"/>'
    path.write_text(f'<net version="1"><edge id="a_b">{lane}</edge></net>')
    assert read_lanes(path) == [("a_b", 10.5, 13.9, [(0.0, 0.0), (10.5, 1.0)])]


@pytest.mark.parametrize("lane", ['<lane id="a_0"/>', '<lane id="a_0" length="1" speed="1" shape="0"/>'])
def test_invalid_lanes_are_refused(lane: str, tmp_path: Path) -> None:
    path = tmp_path / "road.net.xml"
    path.write_text(f'<net version="1"><edge id="a">{lane}</edge></net>')
    with pytest.raises(InputError, match=r"road\.net\.xml: cannot be read: "):
        read_lanes(path)


def test_the_reader_answers_in_this_process_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = configuration(tmp_path, routes=ROUTES)
    reader._main("configuration", str(path))
    assert json.loads(capsys.readouterr().out)["result"]["network"] == str(tmp_path / "road.net.xml")
    reader._main("lanes", str(tmp_path / "none"))
    assert "there is no such file" in json.loads(capsys.readouterr().out)["error"]


INCLUDES = {
    "it is missing": ({"road.rou.xml": ["none.xml"]}, "none.xml': there is no such file"),
    "a name that no file has": ({"road.rou.xml": ["a" * 5000]}, "': there is no such file"),
    "a folder": ({"road.rou.xml": ["."]}, "': there is no such file"),
    "itself": ({"road.rou.xml": ["road.rou.xml"]}, "road.rou.xml: it includes itself"),
    "each other": ({"road.rou.xml": ["b.xml"], "b.xml": ["./road.rou.xml"]}, "road.rou.xml: it includes itself"),
    "what is no XML": ({"road.rou.xml": ["b.xml"], "b.xml": None}, "b.xml: cannot be read: no element found"),
    "more and more": (
        {"road.rou.xml": ["1.xml"] * 9} | {f"{n}.xml": [f"{n + 1}.xml"] * 9 for n in range(1, 9)} | {"9.xml": []},
        ".xml: it includes more than 1000 files",
    ),
}


@pytest.mark.parametrize("name", INCLUDES)
def test_harmful_included_files_are_refused(name: str, tmp_path: Path) -> None:
    files, words = INCLUDES[name]
    path = configuration(tmp_path)
    for file, included in files.items():
        inside = "".join(f'<include href="{other}"/>' for other in included or ())
        (tmp_path / file).write_text("" if included is None else f"<routes>{inside}</routes>")
    assert words in refusal_message(path)


def test_included_files_are_read_wherever_they_are_included(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "types.xml").write_text(
        '<routes><vType id="a"/><edgeData id="e" file="x"/><include href="more.xml"/></routes>'
    )
    (tmp_path / "deep" / "more.xml").write_text('<routes><vehicle id="w" type="a"/></routes>')
    mixture = '<vTypeDistribution id="m"><include href="deep/types.xml"/></vTypeDistribution>'
    path = configuration(tmp_path, routes=f'<routes>{mixture}<flow id="f" type="m"/></routes>')
    found = read_sumo_files(path)
    routes, types, more = (tmp_path / name for name in ("road.rou.xml", "deep/types.xml", "deep/more.xml"))
    assert found.used_types == {"a"}
    assert found.dropped_items == ("edgeData",)
    assert found.copy_sources == {routes: (routes, types, more)}
    assert found.sources == (path, tmp_path / "road.net.xml", routes, more, types)
    more.write_text('<routes><vehicle id="w" type="b"/></routes>')
    assert read_sumo_files(path).used_types == {"a", "b"}
    write_harmless_copy(routes, tmp_path / "copy.xml")
    (copied,) = ElementTree.parse(tmp_path / "copy.xml").iter("vTypeDistribution")
    assert [each.tag for each in copied.iter()][1:] == ["routes", "vType", "routes", "vehicle"]


@pytest.mark.parametrize("folder", ["mine", "elsewhere"])
@pytest.mark.parametrize("is_included", [True, False])
def test_a_file_that_is_none_of_sumo_is_refused_in_any_folder(is_included: bool, folder: str, tmp_path: Path) -> None:
    for name in ("mine", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / folder / "secret.xml").write_text('<settings><param key="password" value="hunter2"/></settings>')
    if folder != "mine":
        (tmp_path / "mine" / "secret.xml").symlink_to(tmp_path / folder / "secret.xml")
    include = '<include href="secret.xml"/>' if is_included else ""
    path = configuration(tmp_path / "mine", routes=ROUTES.replace("<routes>", f"<routes>{include}"))
    if not is_included:
        path.write_text(path.read_text().replace("road.rou.xml", "road.rou.xml,secret.xml"))
    assert refusal_message(path).startswith("secret.xml: it begins with <settings>; allowed: an element of SUMO")


def test_copies_have_neither_elements_unknown_to_sumo_nor_text(tmp_path: Path) -> None:
    inside = '<server password="hunter2"><vType id="a"/></server><vType id="b">hunter2</vType>'
    path = configuration(tmp_path, routes=ROUTES.replace("<routes>", f"<routes>{inside}"))
    found = read_sumo_files(path)
    assert found.dropped_items == ("element server",)
    assert "b" in found.types
    assert "a" not in found.types
    (tmp_path / "new").mkdir()
    write_variant(found, {}, 1.0, tmp_path / "new" / "other.sumocfg")
    copied = "".join(file.read_text() for file in (tmp_path / "new").iterdir())
    assert "hunter2" not in copied
    assert 'id="b"' in copied


def test_elements_for_vehicle_types_apply_to_their_cavs(tmp_path: Path) -> None:
    rerouter = '<rerouter id="r" edges="a" vTypes="car bus"/>'
    routes = f'<routes>{rerouter}<vTypeDistribution id="m" vTypes="car"/><vehicle id="v" type="m"/></routes>'
    path = configuration(tmp_path, routes=routes)
    assert list(read_sumo_files(path).copy_sources) == [tmp_path / "road.rou.xml"]
    write_harmless_copy(tmp_path / "road.rou.xml", tmp_path / "copy.xml")
    lists = [each.get("vTypes") for each in ElementTree.parse(tmp_path / "copy.xml").iter() if each.get("vTypes")]
    assert lists == ["car bus cav_of_car cav_of_bus", "car"]


def test_a_full_disk_is_named_as_such(tmp_path: Path) -> None:
    routes = f'<routes><vType id="car" color="{"1" * 99_999}"/><vehicle id="v"/></routes>'
    path = configuration(tmp_path, routes=routes)
    assert path.is_file()
    with pytest.raises(DiskError, match="cannot write /dev/full: No space left"):
        write_harmless_copy(tmp_path / "road.rou.xml", Path("/dev/full"))


def test_lists_of_types_have_the_types_of_calibrated_drivers_too(tmp_path: Path) -> None:
    light = '<tlLogic id="t" type="actuated"><param key="vTypes" value="car"/><param key="show" value="car"/></tlLogic>'
    path = configuration(tmp_path, routes=f'<routes>{light}<e1Detector vTypes="car"/><vehicle id="v"/></routes>')
    assert list(read_sumo_files(path).copy_sources) == [tmp_path / "road.rou.xml"]
    write_harmless_copy(tmp_path / "road.rou.xml", tmp_path / "copy.xml", driver_count=2)
    elements = ElementTree.parse(tmp_path / "copy.xml")
    drivers = ["car_of_driver_0", "car_of_driver_1"]
    names = " ".join(["car", *drivers, "cav_of_car", *(f"cav_of_{each}" for each in drivers)])
    assert [each.get("value") for each in elements.iter("param")] == [names, "car"]
    assert [each.get("vTypes") for each in elements.iter("e1Detector")] == [names]


@pytest.mark.parametrize(
    ("key", "stays"), [("logan_street_0", True), ("profile", True), ("file", False), ("device.ssm.range", False)]
)
def test_parameters_that_write_are_left_out(key: str, stays: bool, tmp_path: Path) -> None:
    light = f'<tlLogic id="t" type="actuated"><param key="{key}" value="d1"/></tlLogic>'
    path = configuration(tmp_path, routes=f'<routes>{light}<vehicle id="v"/></routes>')
    assert (read_sumo_files(path).dropped_items == ()) == stays


@pytest.mark.long
def test_a_large_file_takes_no_memory_and_needs_no_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sumo_files, "MAX_READER_MEMORY", 100 * 2**20)
    vehicle = '<vehicle id="v" type="car" depart="7.5" departLane="best"><route edges="a b"/></vehicle>\n'
    found = read_sumo_files(configuration(tmp_path, routes=f"<routes>{vehicle * 300_000}</routes>"))
    assert (found.used_types, found.copy_sources, found.first_departure) == ({"car"}, {}, 7.5)


@pytest.mark.parametrize(
    ("routes", "first"),
    [
        ('<vehicle id="a" depart="20"/><trip id="b" depart="0:00:09"/><flow id="c" begin="12"/>', 9.0),
        ('<vehicle id="a" depart="triggered"/><trip id="b" depart="9"/>', None),
        ('<flow id="a" begin="1:00:00:00" end="90000"/>', 86400.0),
        ('<flow id="a"/>', 0.0),
        ('<flow id="a" begin="9"/><person id="p" depart="1"/>', None),
    ],
)
def test_the_first_departure_is_known_if_files_define_it(routes: str, first: float | None, tmp_path: Path) -> None:
    assert read_sumo_files(configuration(tmp_path, routes=f"<routes>{routes}</routes>")).first_departure == first
