"""Reads SUMO's XML files in one pass: what vehicles and harmful elements they have, and a harmless copy.

It uses Python's own library alone: `reader_program.py` runs it in a process of its own.
"""

import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

XML_CHUNK_BYTES = 1 << 18
"""bytes read at once"""
MAX_UNPACKED_BYTES = 1 << 22
"""bytes that are unpacked at once"""
MAX_INCLUDED_FILES = 1000
"""files that one file may include: without a limit a few of them could include each other endlessly"""
OUTPUT_ELEMENTS = {"edgeData", "laneData", "vTypeProbe", "timedEvent", "instantInductionLoop"}
"""elements that do nothing but write files"""
DETECTOR_SUFFIXES = ("Detector", "inductionLoop", "routeProbe", "detector")
"""how elements end that signals and calibrators ask too: they stay, and write to nowhere"""
EXTERNAL_ELEMENTS = ("calibrator", "variableSpeedSign")
"""elements whose attribute `file` names the file that defines their content"""
NULL_FILE = "NUL"
"""the file that SUMO never makes"""
FILE_ATTRIBUTES = ("file", "output", "dest", "href")
"""attributes that name files, beside those that end in `File`"""
FILE_PARAMETER_PARTS = ("file", "output", "log", "ssm", "tripinfo")
"""what is in the names of parameters of vehicles and signals that name files, write one by themselves, or
keep trips out of the records that delays are read from"""
TYPE_ELEMENTS = "vType", "vTypeDistribution"
CHECKED_ELEMENTS = {*OUTPUT_ELEMENTS, "include", "param", "vType", "vTypeDistribution"}
"""elements that are looked at whatever attributes they have"""
PLAIN_ENCODINGS = (None, "utf-8", "us-ascii", "ascii", "iso-8859-1")
"""in which SUMO's parser cannot see another element than the one here"""
XML_ERRORS = (expat.ExpatError, OSError, EOFError, zlib.error, LookupError, ValueError)
"""what reading can raise where a file is broken"""

FileStamp = tuple[int, int]
XmlAttributes = dict[str, str]
XmlHandlers = dict[str, Callable[[XmlAttributes], None]]
"""what to call with the attributes of an element, by its name; of an end by `/name`"""


class BrokenFileError(Exception):
    """What is wrong with a file, in one line."""


def check_file_exists(file: Path) -> None:
    """Raise `BrokenFileError` unless there is such a file."""
    if not os.path.isfile(file):  # also of names that no file can have
        raise BrokenFileError(f"{str(file)!r}: there is no such file")


def file_stamp(file: Path) -> FileStamp:
    """Return time of change and size of a file: another content has another stamp."""
    found = file.stat()
    return found.st_mtime_ns, found.st_size


class XmlReader:
    """Follows an XML file of SUMO's and what it includes, and writes what is harmless of it to `out`.

    Names are those in the file, with their prefixes, as SUMO takes them. Vehicle types get the attributes
    that `types` has for their ids. A large file is read in one pass that keeps nothing of it.
    """

    def __init__(
        self, handlers: XmlHandlers, out: IO[str] | None = None, type_changes: dict[str, XmlAttributes] | None = None
    ) -> None:
        self._handlers, self._type_changes = handlers, type_changes or {}
        self._write = out.write if out else None
        self._dropped_depth = 0
        """open elements within one that was dropped, itself included"""
        self._open_type = ""
        """the outermost type or distribution of types that is open; empty where none is"""
        self._renamed_tags: dict[str, str] = {}
        """other names by which elements are written"""
        self._harmless_names: set[str] = set()
        """names of attributes that are known to name no file"""
        self._parsers: list[Any] = []
        self._open_files: list[Path] = []
        """the file that is being read, behind those that include it"""
        self.root = self.version = ""
        self.sources: dict[Path, FileStamp] = {}
        """the files that were read, with their stamps before they were"""
        self._include_count = 0
        self.dropped_items: set[str] = set()
        self.needs_copy = False

    def read(self, path: Path) -> None:
        """Follow a file to its end; raise `BrokenFileError` where it has a document type, or is no XML."""
        check_file_exists(path)
        if path.resolve() in [file.resolve() for file in self._open_files]:
            raise BrokenFileError(f"{path.name}: includes itself")
        if self._include_count > MAX_INCLUDED_FILES:
            raise BrokenFileError(f"{self._open_files[0].name}: includes more than {MAX_INCLUDED_FILES} files")
        self.sources.setdefault(path, file_stamp(path))
        self._open_files.append(path)
        parser = expat.ParserCreate()
        self._parsers.append(parser)
        parser.buffer_text = True
        parser.XmlDeclHandler = self._on_declaration
        parser.StartElementHandler = self._on_start
        if self._write is not None:
            parser.EndElementHandler, parser.CharacterDataHandler = self._on_end, self._on_text
        self.needs_copy |= any(sign in str(path) for sign in ",; \t$%")
        parse_xml(path, parser, self._chunks(path))
        self._open_files.pop()
        self._parsers.pop()

    def _chunks(self, path: Path) -> Iterator[bytes]:
        """Yield the bytes of a file; SUMO knows compressed ones by how they begin."""
        with path.open("rb") as file:
            head = file.peek(4)[:4]
            packed = head[:2] == b"\x1f\x8b" or head[:2] in (b"\x78\x01", b"\x78\x9c", b"\x78\xda")
            self.needs_copy |= packed or b"\0" in head or head[:2] in (b"\xff\xfe", b"\xfe\xff")
            unpacker = None
            while chunk := file.read(XML_CHUNK_BYTES):
                while packed and chunk:
                    if unpacker is None or unpacker.eof:  # one of several parts that follow each other
                        unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)
                    yield unpacker.decompress(chunk, MAX_UNPACKED_BYTES)
                    chunk = unpacker.unused_data or unpacker.unconsumed_tail
                yield chunk
        if unpacker is not None:
            yield unpacker.flush()
            if not unpacker.eof:
                raise EOFError("it ends before the end of what was compressed")

    def _on_declaration(self, version: str, encoding: str | None, standalone: int) -> None:
        self.needs_copy |= version != "1.0" or (encoding and encoding.lower()) not in PLAIN_ENCODINGS

    def _on_start(self, tag: str, attributes: XmlAttributes) -> None:
        if self._dropped_depth:
            self._dropped_depth += 1
            return
        if not self.root:
            self.root, self.version = tag, attributes.get("version", "")
        if (note := self._handlers.get(tag)) is not None:
            note(attributes)
        if tag in CHECKED_ELEMENTS or not self._harmless_names.issuperset(attributes):
            self._process_element(tag, attributes)
        elif self._write is not None:
            self._write_start(tag, attributes)

    def _process_element(self, tag: str, attributes: XmlAttributes) -> None:
        """Take what is harmless of an element that may name a file; read what it includes."""
        if tag == "include":
            self._include(attributes.get("href", ""))
            self._drop_content()
            return
        kept = self._filter_attributes(tag, attributes)
        if kept is None:
            self._drop_content()
            return
        if tag in TYPE_ELEMENTS:
            self._open_type = self._open_type or tag
            self._parsers[-1].EndElementHandler = self._on_end
        if tag == "vType":
            kept |= self._type_changes.get(kept.get("id", ""), {})
        self._write_start(tag, kept)
        if tag in EXTERNAL_ELEMENTS and attributes.get("file"):
            self._renamed_tags = dict.fromkeys(EXTERNAL_ELEMENTS, "content")  # within itself it would crash SUMO
            self._include(attributes["file"])
            self._renamed_tags = {}
            self._write_end(tag)
            self._drop_content()  # as SUMO does

    def _drop_content(self) -> None:
        """Take nothing of the element that has just begun, nor its end."""
        self._dropped_depth = 1
        self._parsers[-1].EndElementHandler = self._on_end

    def _on_end(self, tag: str) -> None:
        if self._dropped_depth:
            self._dropped_depth -= 1
        else:
            self._write_end(tag)
            if tag == self._open_type:
                self._open_type = ""
            if (note := self._handlers.get(f"/{tag}")) is not None:
                note({})
        # Where nothing is written a call for each element would only take time.
        if self._write is None and not self._dropped_depth and not self._open_type:
            self._parsers[-1].EndElementHandler = None

    def _on_text(self, text: str) -> None:
        if self._write is not None and not self._dropped_depth:
            self._write(escape(text))

    def _write_start(self, tag: str, attributes: XmlAttributes) -> None:
        if self._write is not None:
            inside = "".join(f" {name}={quoteattr(value)}" for name, value in attributes.items())
            self._write(f"<{self._renamed_tags.get(tag, tag)}{inside}>")

    def _write_end(self, tag: str) -> None:
        if self._write is not None:
            self._write(f"</{self._renamed_tags.get(tag, tag)}>")

    def _include(self, name: str) -> None:
        """Read another file in this place, as SUMO does: its name is relative to the one that names it."""
        self.needs_copy = True
        self._include_count += 1
        self.read(self._open_files[-1].parent / name)

    def _filter_attributes(self, tag: str, attributes: XmlAttributes) -> XmlAttributes | None:
        """Return which attributes of an element are harmless; None where the element is not."""
        key = attributes.get("key", "").lower().replace("profile", "")
        if tag in OUTPUT_ELEMENTS or (tag == "param" and any(word in key for word in FILE_PARAMETER_PARTS)):
            self._record_dropped(tag if tag != "param" else f"parameter {attributes['key']}")
            return None
        kept = dict(attributes)
        for name in attributes:
            if name not in FILE_ATTRIBUTES and not name.endswith("File"):
                self._harmless_names.add(name)
            elif name == "file" and tag.endswith(DETECTOR_SUFFIXES):
                if kept[name] != NULL_FILE:
                    kept[name] = NULL_FILE
                    self._record_dropped(f"{name} of {tag}")
            else:
                del kept[name]
                if name != "file" or tag not in EXTERNAL_ELEMENTS:
                    self._record_dropped(f"{name} of {tag}")
        return kept

    def _record_dropped(self, name: str) -> None:
        self.dropped_items.add(name)
        self.needs_copy = True


def parse_xml(path: Path, parser: Any, chunks: Iterable[bytes]) -> None:
    """Parse a file; raise `BrokenFileError` where it is no XML, or has a document type.

    That can name other files, or grow without end. SUMO's own files have none, and SUMO itself would follow
    what it names.
    """

    def refuse_doctype(*definition: object) -> None:
        raise BrokenFileError(f"{path.name}: a document type (<!DOCTYPE ...>) is not allowed")

    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        for chunk in chunks:
            parser.Parse(chunk, False)
        parser.Parse(b"", True)
    except XML_ERRORS as error:
        raise BrokenFileError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
