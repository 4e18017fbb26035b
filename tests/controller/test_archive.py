import io
import stat
import struct
import tempfile
import warnings
import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.controller import file as files
from unjam.controller.file import ARCHIVE_PARTS, MANIFEST_PART, MAX_PART_BYTES, WEIGHTS_PART, pack_parts, unpack_parts
from unjam.errors import InputError
from unjam.files import sha256_of

WHOLE = {MANIFEST_PART: b"{}", WEIGHTS_PART: b"numbers"}


def written(folder: Path, content: bytes) -> Path:
    path = folder / "it.unjam"
    path.write_bytes(content)
    return path


def with_entry(entry: zipfile.ZipInfo, part: bytes = b"more") -> bytes:
    """An archive with one entry more."""
    content = io.BytesIO(pack_parts(WHOLE))
    with zipfile.ZipFile(content, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that is there already
        archive.writestr(entry, part)
    return content.getvalue()


def refusal_message(folder: Path, content: bytes) -> str:
    before = sorted(folder.iterdir())
    with pytest.raises(InputError) as caught:
        unpack_parts(written(folder, content))
    assert "\n" not in str(caught.value)
    assert sorted(folder.iterdir()) == sorted({*before, folder / "it.unjam"})
    return str(caught.value)


@given(st.dictionaries(st.sampled_from(ARCHIVE_PARTS[2:]), st.binary(max_size=50)))
def test_parts_come_back_as_they_were(more: dict[str, bytes]) -> None:
    parts = {**WHOLE, **more}
    with tempfile.TemporaryDirectory() as folder:
        assert unpack_parts(written(Path(folder), pack_parts(parts))) == parts
    assert pack_parts(parts) == pack_parts(dict(parts))


def test_the_same_parts_have_the_same_bytes_on_any_system() -> None:
    """Signatures of other machines and versions of Python are compared with these bytes."""
    wanted = "0c76ee6c3457b1cddf8e2d648525009b7da622c0d7567322a4be99b561c21548"
    assert sha256_of(pack_parts(WHOLE)) == wanted


@pytest.mark.parametrize(
    "name",
    [
        *("../escaped", "/etc/passwd", "C:\\escaped", "./manifest.json", "Manifest.json"),
        *("folder/", "data.pkl", "manifest.json\n", ".."),
    ],
)
def test_a_part_of_another_name_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "inner").mkdir()
    assert "is unknown; allowed: " in refusal_message(tmp_path / "inner", with_entry(zipfile.ZipInfo(name)))
    assert [path.name for path in tmp_path.iterdir()] == ["inner"]


@pytest.mark.parametrize("name", [MANIFEST_PART, WEIGHTS_PART])
def test_a_second_part_of_a_name_is_refused(tmp_path: Path, name: str) -> None:
    assert f"has {name} twice" in refusal_message(tmp_path, with_entry(zipfile.ZipInfo(name)))


def test_a_link_is_refused(tmp_path: Path) -> None:
    entry = zipfile.ZipInfo(ARCHIVE_PARTS[2])
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    assert "is a link" in refusal_message(tmp_path, with_entry(entry, b"/etc/passwd"))


@pytest.mark.parametrize("how", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, how: int, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = zipfile.ZipInfo(ARCHIVE_PARTS[2])
    entry.compress_type = how
    content = with_entry(entry, bytes(2**22))
    assert len(content) < 2**14
    monkeypatch.setattr(zipfile.ZipExtFile, "read1", None)  # what it would be unpacked with
    assert "is compressed or encrypted" in refusal_message(tmp_path, content)


def test_a_part_that_is_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_PART_BYTES", 1000)
    assert "has 1001 bytes; allowed: at most 1000" in refusal_message(
        tmp_path, with_entry(zipfile.ZipInfo(ARCHIVE_PARTS[2]), bytes(1001))
    )
    assert "bytes; allowed: at most 6000" in refusal_message(
        tmp_path, with_entry(zipfile.ZipInfo(ARCHIVE_PARTS[2]), bytes(6000))
    )


def test_a_part_that_says_it_is_larger_than_it_is_is_refused(tmp_path: Path) -> None:
    content = bytearray(pack_parts(WHOLE))
    struct.pack_into("<I", content, content.index(b"PK\x01\x02") + 24, MAX_PART_BYTES)
    assert "is compressed or encrypted" in refusal_message(tmp_path, bytes(content))


@pytest.mark.parametrize("name", [MANIFEST_PART, WEIGHTS_PART])
def test_without_what_every_controller_has_it_is_none(tmp_path: Path, name: str) -> None:
    parts = {key: part for key, part in WHOLE.items() if key != name}
    assert f"not a controller: it has no {name}" in refusal_message(tmp_path, pack_parts(parts))
