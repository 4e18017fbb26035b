"""Files that would harm who reads them: read in a process of their own, and refused in one line."""

import gzip
import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.sumo_files.test_sumo_files import NETWORK, ROUTES, configuration
from unjam import sandbox, sumo_files
from unjam.errors import InputError
from unjam.sumo_files import program as reader
from unjam.sumo_files import read_lanes, read_sumo_files

LAUGHS = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10 if n else "lol"}">' for n in range(10))
DEFINITIONS = {
    "entities that grow without end": f"<!DOCTYPE net [{LAUGHS}]>",
    "another file": '<!DOCTYPE net [<!ENTITY it SYSTEM "file:///etc/passwd">]>',
    "a definition from elsewhere": '<!DOCTYPE net SYSTEM "http://127.0.0.1:9/net.dtd">',
    "a definition after a comment": "<!-- harmless --><!DOCTYPE net>",
}


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_sumo_files(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", DEFINITIONS)
@pytest.mark.parametrize("file", ["road.net.xml", "road.rou.xml", "road.sumocfg"])
def test_a_document_type_is_refused(name: str, file: str, tmp_path: Path) -> None:
    path = configuration(tmp_path)
    (tmp_path / file).write_text(DEFINITIONS[name] + (tmp_path / file).read_text())
    assert refused(path) == f"{file}: a document type (<!DOCTYPE ...>) is not allowed"


def test_the_word_in_a_comment_or_a_text_is_harmless(tmp_path: Path) -> None:
    path = configuration(tmp_path, network="<!-- <!DOCTYPE net> -->" + NETWORK)
    assert read_sumo_files(path).used_types == {"car"}


@pytest.mark.long
def test_what_unpacks_to_too_much_is_refused_and_takes_no_memory_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sumo_files, "LARGEST_MEMORY", 150 * 2**20)
    path = configuration(tmp_path)
    bomb = b'<routes name="' + b"a" * 200_000_000 + b'"/>'
    (tmp_path / "road.rou.xml.gz").write_bytes(gzip.compress(bomb, 1))
    path.write_text(path.read_text().replace("road.rou.xml", "road.rou.xml.gz"))
    assert "road.rou.xml.gz: cannot be read: out of memory" in refused(path)


def test_what_takes_too_long_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = configuration(tmp_path)
    monkeypatch.setattr(sumo_files, "LONGEST_TIME", 0.001)
    assert refused(path) == "road.sumocfg: its files cannot be read within 4 GiB, 0.001 s"


def test_a_reader_that_is_lost_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = configuration(tmp_path)
    monkeypatch.setattr(sumo_files, "PROGRAM", tmp_path / "none.py")
    assert "cannot be read within" in refused(path)


def test_it_needs_pythons_own_library_alone(tmp_path: Path) -> None:
    program = [sys.executable, "-I", "-S", sandbox.__file__, str(2**30), "60", "", str(sumo_files.PROGRAM)]
    ran = subprocess.run(
        [*program, "configuration", str(configuration(tmp_path))], capture_output=True, check=True
    )
    assert json.loads(ran.stdout)["found"]["used_types"] == ["car"]


def test_lanes_are_read_with_their_edges(tmp_path: Path) -> None:
    path = tmp_path / "road.net.xml"
    lane = '<lane id="a_b_0" length="10.5" shape="0,0 10.5,1,3"/>'
    path.write_text(f'<net version="1"><edge id="a_b">{lane}</edge></net>')
    assert read_lanes(path) == [("a_b", 10.5, [(0.0, 0.0), (10.5, 1.0)])]


@pytest.mark.parametrize("lane", ['<lane id="a_0"/>', '<lane id="a_0" length="1" shape="0"/>'])
def test_lanes_that_are_none_are_refused(lane: str, tmp_path: Path) -> None:
    path = tmp_path / "road.net.xml"
    path.write_text(f'<net version="1"><edge id="a">{lane}</edge></net>')
    with pytest.raises(InputError, match=r"road\.net\.xml: cannot be read: "):
        read_lanes(path)


def test_in_this_process_it_answers_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = configuration(tmp_path, routes=ROUTES)
    reader.main("configuration", str(path))
    assert json.loads(capsys.readouterr().out)["found"]["network"] == str(tmp_path / "road.net.xml")
    reader.main("lanes", str(tmp_path / "none"))
    assert "there is no such file" in json.loads(capsys.readouterr().out)["broken"]
