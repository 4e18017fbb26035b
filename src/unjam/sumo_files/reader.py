"""Reads SUMO's XML files in one pass: what vehicles and harmful elements they have, and a harmless copy.

It uses Python's own library alone: `program.py` runs it in a process of its own.
"""

import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

CHUNK = 1 << 18
"""bytes read at once"""
LARGEST_BLOCK = 1 << 22
"""bytes that are unpacked at once"""
MOST_FILES = 1000
"""files that one file may include: without a limit a few of them could include each other endlessly"""
ONLY_WRITERS = {"edgeData", "laneData", "vTypeProbe", "timedEvent", "instantInductionLoop"}
"""elements that do nothing but write files"""
DETECTORS = ("Detector", "inductionLoop", "routeProbe", "detector")
"""how elements end that signals and calibrators ask too: they stay, and write to nowhere"""
DEFINED_ELSEWHERE = ("calibrator", "variableSpeedSign")
"""elements whose attribute `file` names the file that defines their content"""
NOWHERE = "NUL"
"""the file that SUMO never makes"""
TO_FILES = ("file", "output", "dest", "href")
"""attributes that name files, beside those that end in `File`"""
IN_PARAMETERS = ("file", "output", "log", "ssm", "tripinfo")
"""what is in the names of parameters of vehicles and signals that name files, write one by themselves, or
keep trips out of the records that delays are read from"""
TYPES = "vType", "vTypeDistribution"
CHECKED = {*ONLY_WRITERS, "include", "param", "vType", "vTypeDistribution"}
"""elements that are looked at whatever attributes they have"""
PLAIN_ENCODINGS = (None, "utf-8", "us-ascii", "ascii", "iso-8859-1")
"""in which SUMO's parser cannot see another element than the one here"""
UNREADABLE = (expat.ExpatError, OSError, EOFError, zlib.error, LookupError, ValueError)
"""what reading can raise where a file is broken"""

Stamp = tuple[int, int]
Attributes = dict[str, str]
Notes = dict[str, Callable[[Attributes], None]]
"""what to call with the attributes of an element, by its name; of an end by `/name`"""


class Broken(Exception):
    """What is wrong with a file, in one line."""


def check_exists(file: Path) -> None:
    """Raise `Broken` unless there is such a file."""
    if not os.path.isfile(file):  # also of names that no file can have
        raise Broken(f"{str(file)!r}: there is no such file")


def stamp_of(file: Path) -> Stamp:
    """Return time of change and size of a file: another content has another stamp."""
    found = file.stat()
    return found.st_mtime_ns, found.st_size


class Reader:
    """Follows an XML file of SUMO's and what it includes, and writes what is harmless of it to `out`.

    Names are those in the file, with their prefixes, as SUMO takes them. Vehicle types get the attributes
    that `types` has for their ids. A large file is read in one pass that keeps nothing of it.
    """

    def __init__(
        self, notes: Notes, out: IO[str] | None = None, types: dict[str, Attributes] | None = None
    ) -> None:
        self._notes, self._types = notes, types or {}
        self._write = out.write if out else None
        self._within = 0
        """open elements within one that was dropped, itself included"""
        self._open_type = ""
        """the outermost type or distribution of types that is open; empty where none is"""
        self._names: dict[str, str] = {}
        """other names by which elements are written"""
        self._plain: set[str] = set()
        """names of attributes that are known to name no file"""
        self._parsers: list[Any] = []
        self._files: list[Path] = []
        """the file that is being read, behind those that include it"""
        self.root = self.version = ""
        self.sources: dict[Path, Stamp] = {}
        """the files that were read, with their stamps before they were"""
        self._included = 0
        self.dropped: set[str] = set()
        self.to_copy = False

    def read(self, path: Path) -> None:
        """Follow a file to its end; raise `Broken` where it has a document type, or is no XML."""
        check_exists(path)
        if path.resolve() in [file.resolve() for file in self._files]:
            raise Broken(f"{path.name}: includes itself")
        if self._included > MOST_FILES:
            raise Broken(f"{self._files[0].name}: includes more than {MOST_FILES} files")
        self.sources.setdefault(path, stamp_of(path))
        self._files.append(path)
        parser = expat.ParserCreate()
        self._parsers.append(parser)
        parser.buffer_text = True
        parser.XmlDeclHandler = self._declared
        parser.StartElementHandler = self._started
        if self._write is not None:
            parser.EndElementHandler, parser.CharacterDataHandler = self._ended, self._text
        self.to_copy |= any(sign in str(path) for sign in ",; \t$%")
        parse(path, parser, self._chunks(path))
        self._files.pop()
        self._parsers.pop()

    def _chunks(self, path: Path) -> Iterator[bytes]:
        """Yield the bytes of a file; SUMO knows compressed ones by how they begin."""
        with path.open("rb") as file:
            head = file.peek(4)[:4]
            packed = head[:2] == b"\x1f\x8b" or head[:2] in (b"\x78\x01", b"\x78\x9c", b"\x78\xda")
            self.to_copy |= packed or b"\0" in head or head[:2] in (b"\xff\xfe", b"\xfe\xff")
            unpacker = None
            while chunk := file.read(CHUNK):
                while packed and chunk:
                    if unpacker is None or unpacker.eof:  # one of several parts that follow each other
                        unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)
                    yield unpacker.decompress(chunk, LARGEST_BLOCK)
                    chunk = unpacker.unused_data or unpacker.unconsumed_tail
                yield chunk
        if unpacker is not None:
            yield unpacker.flush()
            if not unpacker.eof:
                raise EOFError("it ends before the end of what was compressed")

    def _declared(self, version: str, encoding: str | None, standalone: int) -> None:
        self.to_copy |= version != "1.0" or (encoding and encoding.lower()) not in PLAIN_ENCODINGS

    def _started(self, tag: str, attributes: Attributes) -> None:
        if self._within:
            self._within += 1
            return
        if not self.root:
            self.root, self.version = tag, attributes.get("version", "")
        if (note := self._notes.get(tag)) is not None:
            note(attributes)
        if tag in CHECKED or not self._plain.issuperset(attributes):
            self._check(tag, attributes)
        elif self._write is not None:
            self._write_start(tag, attributes)

    def _check(self, tag: str, attributes: Attributes) -> None:
        """Take what is harmless of an element that may name a file; read what it includes."""
        if tag == "include":
            self._include(attributes.get("href", ""))
            self._drop_content()
            return
        kept = self._harmless(tag, attributes)
        if kept is None:
            self._drop_content()
            return
        if tag in TYPES:
            self._open_type = self._open_type or tag
            self._parsers[-1].EndElementHandler = self._ended
        if tag == "vType":
            kept |= self._types.get(kept.get("id", ""), {})
        self._write_start(tag, kept)
        if tag in DEFINED_ELSEWHERE and attributes.get("file"):
            self._names = dict.fromkeys(DEFINED_ELSEWHERE, "content")  # within itself it would crash SUMO
            self._include(attributes["file"])
            self._names = {}
            self._write_end(tag)
            self._drop_content()  # as SUMO does

    def _drop_content(self) -> None:
        """Take nothing of the element that has just begun, nor its end."""
        self._within = 1
        self._parsers[-1].EndElementHandler = self._ended

    def _ended(self, tag: str) -> None:
        if self._within:
            self._within -= 1
        else:
            self._write_end(tag)
            if tag == self._open_type:
                self._open_type = ""
            if (note := self._notes.get(f"/{tag}")) is not None:
                note({})
        # Where nothing is written a call for each element would only take time.
        if self._write is None and not self._within and not self._open_type:
            self._parsers[-1].EndElementHandler = None

    def _text(self, text: str) -> None:
        if self._write is not None and not self._within:
            self._write(escape(text))

    def _write_start(self, tag: str, attributes: Attributes) -> None:
        if self._write is not None:
            inside = "".join(f" {name}={quoteattr(value)}" for name, value in attributes.items())
            self._write(f"<{self._names.get(tag, tag)}{inside}>")

    def _write_end(self, tag: str) -> None:
        if self._write is not None:
            self._write(f"</{self._names.get(tag, tag)}>")

    def _include(self, name: str) -> None:
        """Read another file in this place, as SUMO does: its name is relative to the one that names it."""
        self.to_copy = True
        self._included += 1
        self.read(self._files[-1].parent / name)

    def _harmless(self, tag: str, attributes: Attributes) -> Attributes | None:
        """Return which attributes of an element are harmless; None where the element is not."""
        key = attributes.get("key", "").lower().replace("profile", "")
        if tag in ONLY_WRITERS or (tag == "param" and any(word in key for word in IN_PARAMETERS)):
            self._drop(tag if tag != "param" else f"parameter {attributes['key']}")
            return None
        kept = dict(attributes)
        for name in attributes:
            if name not in TO_FILES and not name.endswith("File"):
                self._plain.add(name)
            elif name == "file" and tag.endswith(DETECTORS):
                if kept[name] != NOWHERE:
                    kept[name] = NOWHERE
                    self._drop(f"{name} of {tag}")
            else:
                del kept[name]
                if name != "file" or tag not in DEFINED_ELSEWHERE:
                    self._drop(f"{name} of {tag}")
        return kept

    def _drop(self, name: str) -> None:
        self.dropped.add(name)
        self.to_copy = True


def parse(path: Path, parser: Any, chunks: Iterable[bytes]) -> None:
    """Parse a file; raise `Broken` where it is no XML, or has a document type.

    That can name other files, or grow without end. SUMO's own files have none, and SUMO itself would follow
    what it names.
    """

    def refuse(*definition: object) -> None:
        raise Broken(f"{path.name}: a document type (<!DOCTYPE ...>) is not allowed")

    parser.StartDoctypeDeclHandler = refuse
    try:
        for chunk in chunks:
            parser.Parse(chunk, False)
        parser.Parse(b"", True)
    except UNREADABLE as error:
        raise Broken(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
