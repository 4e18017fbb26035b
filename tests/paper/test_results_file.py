from pathlib import Path

import pytest

from unjam.files import to_json
from unjam_paper.results_file import collect_results, read_part, read_parts, write_results

TABLE = [{"driver": "pi", "speed": 3.000001, "seed": [1, 0]}, {"driver": "human", "speed": 1e-7, "seed": [2, 0]}]
PARTS = {
    "manifest": {"commit": "abc"},
    "table": TABLE,
    "same": [{"a": 1.0, "b": None, "c": [1]}, {"a": 1.0, "b": None, "c": [1]}],
    "mixed": [{"a": 1.0, "b": True}, {"a": 1, "b": 1}],
    "all the same": [{"a": 1}, {"a": 1}],
    "uneven": [{"a": 1}, {"b": 2}],
    "nested": {"10 %": {"rows": TABLE, "one": TABLE[:1], "none": []}, "text": "Größe", "empty": [{}, {}]},
}


def test_a_results_file_gives_back_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "study.json"
    write_results(path, PARTS)
    assert read_parts(path) == PARTS
    assert to_json(read_parts(path)) == to_json(PARTS), "keys have the same order"
    assert read_part(path, "table") == TABLE
    assert len(path.read_text().splitlines()) == len(PARTS) + 2, "a line for each part"
    assert path.read_text().count("speed") == 3, "stored by columns"
    assert '"same": {"columns":{"a":1.0,"b":null,"c":[[1],[1]]}}' in path.read_text()


def test_repeated_texts_are_stored_once(tmp_path: Path) -> None:
    rows = [
        {"driver": f"driver {number // 8}", "drive": f"drive {number}", "speed": {"mean": number}}
        for number in range(32)
    ]
    path = tmp_path / "study.json"
    write_results(path, {"part": rows, "texts": [{"texts": "a", "rows": 1}]})
    assert read_part(path, "part") == rows
    assert read_part(path, "texts") == [{"texts": "a", "rows": 1}]
    assert [path.read_text().count(text) for text in ("driver 3", 'drive 3"')] == [1, 1]


def test_numbers_have_seven_digits(tmp_path: Path) -> None:
    write_results(
        tmp_path / "study.json", {"part": [1.0 / 3.0, 2.0e-9 / 3.0, 12345678901, 123456789.5, None, "0.123456789"]}
    )
    part = read_part(tmp_path / "study.json", "part")
    assert part == [0.3333333, 6.666667e-10, 12345678901, 123456800.0, None, "0.123456789"]


def test_a_part_is_read_from_the_working_folder_or_from_the_file(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    (folder / "controllers").mkdir(parents=True)
    for name, part in PARTS.items():
        (folder / f"{name}.json").write_text(to_json(part))
    for name in ("curves.png", "study.png", "controllers/pi-0.unjam"):
        (folder / name).write_bytes(name.encode())
    path = collect_results(folder)
    assert {each.name for each in tmp_path.iterdir()} == {
        *("study", "study.json", "study.png", "study-curves.png", "study-controllers.zip")
    }
    assert next(iter(read_parts(path))) == "manifest"
    assert read_parts(path) == read_parts(folder) == PARTS
    assert read_part(path, "nested") == read_part(folder, "nested") == PARTS["nested"]
    archive = tmp_path / "study-controllers.zip"
    content = archive.read_bytes()
    collect_results(folder)
    assert archive.read_bytes() == content, "the same controllers give the same archive"
    for source in (path, folder):
        with pytest.raises((KeyError, FileNotFoundError)):
            read_part(source, "other")


def test_numbers_that_are_not_finite_become_null(tmp_path: Path) -> None:
    write_results(tmp_path / "study.json", {"rows": [{"a": float("nan")}, {"a": float("inf")}]})
    assert read_part(tmp_path / "study.json", "rows") == [{"a": None}, {"a": None}]
