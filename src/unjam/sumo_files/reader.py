"""Read SUMO's XML files in one pass, to find vehicles and harmful elements, and to write a harmless copy.

The module imports only the standard library, because `reader_program.py` uses it in a separate process.
"""

import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

XML_CHUNK_BYTES, MAX_UNPACKED_BYTES = 1 << 18, 1 << 22  # bytes that are read, and decompressed, at a time
MAX_ELEMENT_BYTES = 1 << 22  # maximum size of an element with its attributes
MAX_INCLUDED_FILES = 1000  # maximum number of files that a file includes, as files can include each other endlessly
OUTPUT_ELEMENTS = {"edgeData", "laneData", "vTypeProbe", "timedEvent", "instantInductionLoop"}
"""elements that only write files"""
DETECTOR_SUFFIXES = ("Detector", "inductionLoop", "routeProbe", "detector")
"""suffixes of elements that are detectors of traffic lights and calibrators; in copies, they write no file"""
EXTERNAL_ELEMENTS = ("calibrator", "variableSpeedSign")  # elements that may name a file with their content: `file`
_ELEMENTS = """
routes route-alternatives additional add data meandata detectors tlLogics taz tazs types stops connections edges
include param vType vTypeDistribution type route routeDistribution vehicle trip flow stop interval edge lane
edgeRelation tazRelation person personFlow personTrip walk ride access container containerFlow transport tranship
tazSource tazSink source sink edgeData laneData timedEvent vTypeProbe inductionLoop e1Detector e2Detector e3Detector
laneAreaDetector entryExitDetector instantInductionLoop detEntry detExit detector detectorDefinition routeProbe
calibrator vaporizer variableSpeedSign step rerouter closingReroute closingLaneReroute destProbReroute
routeProbReroute parkingAreaReroute stationReroute overtakingReroute viaProbReroute rerouterValue parkingArea space
busStop trainStop containerStop chargingStation overheadWire overheadWireClamp overheadWireSegment tractionSubstation
poly poi tlLogic phase condition assignment function WAUT wautJunction wautSwitch railSignalConstraints predecessor
insertionPredecessor insertionOrder foeInsertion bidiPredecessor deadlock conflict ptLine ptLines preference
restriction stopOffset neigh connection multiLaneAreaDetector edgeFollowDetector additionals pois polys vss weights
edgedata
"""
SUMO_ELEMENTS = set(_ELEMENTS.split())
"""elements of SUMO's demand, additional files and weights of edges, including the outermost elements of such files"""
FOLLOWING_MODEL_PREFIX = "carFollowing-"  # prefix of elements with attributes of a car-following model
NETWORK_ELEMENT = "net"  # outermost element of a network; all elements of networks are allowed
NULL_FILE = "NUL"  # file name for which SUMO creates no file
FILE_ATTRIBUTES = ("file", "output", "dest", "href")  # attributes that name a file, besides those that end in `File`
FILE_PARAMETER_PARTS = ("file", "output", "log", "ssm", "tripinfo")
"""texts in the keys of harmful parameters, which read or write a file, or remove trips from SUMO's trip records"""
SUBSTITUTED_VARIABLES = ("HOME", "SUMO_HOME", "PWD", "TMPDIR", "LOCALTIME", "UTC", "PID")
"""variables that values of options may contain; SUMO defines the last three"""
ALLOWED_VARIABLES = ", ".join(f"${{{name}}}" for name in SUBSTITUTED_VARIABLES)
UNKNOWN_VARIABLE = re.compile(r"\$\{.*?\}")  # a variable that remains after the substitution
LANE_NAME = re.compile(r"_\d+$")  # end of the id of a lane, which is the key of a detector of a traffic light
CAV_TYPE_TEMPLATE = "cav_of_{}"  # id of the type of CAVs that replace vehicles of the type {}
CALIBRATED_TYPE_TEMPLATE = "{}_of_driver_{}"  # id of the type of vehicles of the type {} with the calibrated driver {}
TYPE_LIST, TYPE_LIST_DEFINITIONS = "vTypes", ("vTypeDistribution", "personTrip")
"""attribute or parameter by which rerouters, calibrators, detectors and signals select vehicles, and the elements in
which it defines vehicles"""
TYPE_ELEMENTS = "vType", "vTypeDistribution"
CHECKED_ELEMENTS = {*OUTPUT_ELEMENTS, *TYPE_ELEMENTS, "include", "param"}  # checked with any attributes
PLAIN_ENCODINGS = (None, "utf-8", "us-ascii", "ascii", "iso-8859-1")  # encodings that SUMO's parser reads like expat
XML_ERRORS = (expat.ExpatError, OSError, EOFError, zlib.error, LookupError, ValueError)  # errors of broken files

FileStamp = tuple[int, int]  # time of the last change [ns] and size [bytes]
XmlAttributes = dict[str, str]  # values of the attributes of an element, by name
XmlHandlers = dict[str, Callable[[XmlAttributes], None]]
"""functions that receive the attributes of an element, by name of the element; `/name` is for its end"""


class BrokenFileError(Exception):
    """A file is broken or not allowed; the message is one line."""


def check_file_exists(file: Path) -> None:
    """Raise `BrokenFileError` unless the file exists."""
    if not os.path.isfile(file):  # false, too, for names that no file can have
        raise BrokenFileError(f"{str(file)!r}: there is no such file")


def file_stamp(file: Path) -> FileStamp:
    """Return the stamp of a file; it differs if the content of the file has changed."""
    status = file.stat()
    return status.st_mtime_ns, status.st_size


class XmlReader:
    """Reader of an XML file of SUMO and the files that it includes; it writes the harmless elements to `out`.

    Vehicle types get the attributes that `type_changes` has for their ids. Lists of vehicle types also name the types
    of CAVs and of `driver_count` calibrated drivers.
    """

    def __init__(
        self,
        handlers: XmlHandlers,
        out: IO[str] | None = None,
        type_changes: dict[str, XmlAttributes] | None = None,
        driver_count: int = 0,
    ) -> None:
        self._handlers, self._type_changes, self._driver_count = handlers, type_changes or {}, driver_count
        self._write = out.write if out else None
        self._dropped_depth = 0  # number of open elements from the dropped element on; zero: none is dropped
        self._open_type = ""  # tag of the outermost open type or distribution of types; empty: none
        self._changed_attributes: XmlAttributes = {}  # attributes that `type_changes` has for the last type
        self._renamed_tags: dict[str, str] = {}  # tags under which elements are written, if they differ
        self._harmless_names: set[str] = set()  # names of attributes that were found to be harmless
        self._parsers: list[Any] = []  # parsers of the open files
        self._open_files: list[Path] = []  # the file that is being read, after the files that include it
        self.root = self.version = ""  # tag of the first element, and its attribute `version`
        self.sources: dict[Path, FileStamp] = {}  # files that were read, with their stamps before reading
        self._include_count = 0
        self.dropped_items: set[str] = set()  # descriptions of the parts that were left out
        self.needs_copy = False  # whether SUMO must read a harmless copy instead of the file

    def read(self, path: Path) -> None:
        """Read a file to its end; raise `BrokenFileError` if it is not XML or not allowed."""
        check_file_exists(path)
        if path.resolve() in [file.resolve() for file in self._open_files]:
            raise BrokenFileError(f"{path.name}: it includes itself")
        if self._include_count > MAX_INCLUDED_FILES:
            raise BrokenFileError(f"{self._open_files[0].name}: it includes more than {MAX_INCLUDED_FILES} files")
        self.sources.setdefault(path, file_stamp(path))
        self._open_files.append(path)
        parser = expat.ParserCreate()
        self._parsers.append(parser)
        parser.buffer_text = True
        parser.XmlDeclHandler = self._on_declaration
        parser.StartElementHandler = self._on_outermost
        if self._write is not None:
            parser.EndElementHandler, parser.CharacterDataHandler = self._on_end, self._on_text
        self.needs_copy |= any(character in str(path) for character in ",; \t$%")
        parse_xml(path, parser, self._chunks(path))
        self._open_files.pop()
        self._parsers.pop()

    def _chunks(self, path: Path) -> Iterator[bytes]:
        """Yield the decompressed bytes of a file; the first bytes show SUMO whether a file is compressed."""
        with path.open("rb") as file:
            head = file.peek(4)[:4]
            is_compressed = head[:2] == b"\x1f\x8b" or head[:2] in (b"\x78\x01", b"\x78\x9c", b"\x78\xda")
            self.needs_copy |= is_compressed or b"\0" in head or head[:2] in (b"\xff\xfe", b"\xfe\xff")
            decompressor = None
            while chunk := file.read(XML_CHUNK_BYTES):
                while is_compressed and chunk:
                    if decompressor is None or decompressor.eof:  # a file may have several compressed parts
                        decompressor = zlib.decompressobj(zlib.MAX_WBITS | 32)
                    yield decompressor.decompress(chunk, MAX_UNPACKED_BYTES)
                    chunk = decompressor.unused_data or decompressor.unconsumed_tail
                yield chunk
        if decompressor is not None:
            yield decompressor.flush()
            if not decompressor.eof:
                raise EOFError("the compressed data are incomplete")

    def _on_declaration(self, version: str, encoding: str | None, standalone: int) -> None:
        self.needs_copy |= version != "1.0" or (encoding and encoding.lower()) not in PLAIN_ENCODINGS

    def _on_start(self, tag: str, attributes: XmlAttributes) -> None:
        if self._dropped_depth:
            self._dropped_depth += 1
            return
        if not self.root:
            self.root, self.version = tag, attributes.get("version", "")
        if (handler := self._handlers.get(tag)) is not None:
            handler(attributes)
        is_changed = bool(self._changed_attributes) and tag.startswith(FOLLOWING_MODEL_PREFIX)
        if is_changed or tag in CHECKED_ELEMENTS or not self._harmless_names.issuperset(attributes):
            self._process_element(tag, attributes)
        elif self._write is not None:
            self._write_start(tag, attributes)

    def _on_outermost(self, tag: str, attributes: XmlAttributes) -> None:
        """Refuse other files than SUMO's: a configuration can name any file, and users may pass copies on to others."""
        is_network = tag == NETWORK_ELEMENT and len(self._open_files) == 1
        if not is_network and not is_sumo_element(tag):
            allowed = "an element of SUMO, such as <additional> or <routes>"
            raise BrokenFileError(f"{self._open_files[-1].name}: it begins with <{tag[:60]}>; allowed: {allowed}")
        self._parsers[-1].StartElementHandler = self._on_start if is_network else self._on_inner
        self._on_start(tag, attributes)

    def _on_inner(self, tag: str, attributes: XmlAttributes) -> None:
        if self._dropped_depth or is_sumo_element(tag):
            self._on_start(tag, attributes)
        else:
            self._record_dropped(f"element {tag[:60]}")
            self._drop_content()

    def _process_element(self, tag: str, attributes: XmlAttributes) -> None:
        if tag == "include":
            self._include(attributes.get("href", ""))
        harmless = None if tag == "include" else self._filter_attributes(tag, attributes)
        if harmless is None:
            self._drop_content()
            return
        if tag in TYPE_ELEMENTS:
            self._open_type = self._open_type or tag
            self._parsers[-1].EndElementHandler = self._on_end
        if tag == "vType":
            self._changed_attributes = self._type_changes.get(harmless.get("id", ""), {})
            harmless |= self._changed_attributes
        elif tag.startswith(FOLLOWING_MODEL_PREFIX):  # its attributes would replace those of the type that contains it
            harmless = {name: value for name, value in harmless.items() if name not in self._changed_attributes}
        self._write_start(tag, harmless)
        if tag in EXTERNAL_ELEMENTS and attributes.get("file"):
            self._renamed_tags = dict.fromkeys(EXTERNAL_ELEMENTS, "content")  # SUMO crashes on an element within itself
            self._include(attributes["file"])
            self._renamed_tags = {}
            self._write_end(tag)
            self._drop_content()  # SUMO ignores it, too

    def _drop_content(self) -> None:
        """Leave out the content and the end of the element that has just started."""
        self._dropped_depth = 1
        self._parsers[-1].EndElementHandler = self._on_end

    def _on_end(self, tag: str) -> None:
        if self._dropped_depth:
            self._dropped_depth -= 1
        else:
            self._write_end(tag)
            if tag == self._open_type:
                self._open_type = ""
            if (handler := self._handlers.get(f"/{tag}")) is not None:
                handler({})
        # Without output, a call at the end of each element would only take time.
        if self._write is None and not self._dropped_depth and not self._open_type:
            self._parsers[-1].EndElementHandler = None

    def _on_text(self, text: str) -> None:
        if self._write is not None and text.isspace():  # SUMO reads no text
            self._write(text)

    def _write_start(self, tag: str, attributes: XmlAttributes) -> None:
        if self._write is not None:
            attributes_text = "".join(f" {name}={quoteattr(value)}" for name, value in attributes.items())
            self._write(f"<{self._renamed_tags.get(tag, tag)}{attributes_text}>")

    def _write_end(self, tag: str) -> None:
        if self._write is not None:
            self._write(f"</{self._renamed_tags.get(tag, tag)}>")

    def _include(self, name: str) -> None:
        """Read another file at this position; its name is relative to the file that includes it, as in SUMO."""
        self.needs_copy = True
        self._include_count += 1
        self.read(self._open_files[-1].parent / name)

    def _filter_attributes(self, tag: str, attributes: XmlAttributes) -> XmlAttributes | None:
        """Return the harmless attributes of an element; None if the element itself is harmful."""
        if tag in OUTPUT_ELEMENTS or (tag == "param" and not is_harmless_parameter(attributes.get("key", ""))):
            self._record_dropped(tag if tag != "param" else f"parameter {attributes['key']}")
            return None
        if ".." in (emission_class := attributes.get("emissionClass", "")):  # SUMO reads a file of this name
            allowed = "an emission class of SUMO, such as HBEFA4/PC_petrol_Euro-6ab"
            file = self._open_files[-1].name
            raise BrokenFileError(f"{file}: emissionClass: {emission_class!r} is not allowed; allowed: {allowed}")
        harmless = dict(attributes)
        if tag == "param" and attributes.get("key") == TYPE_LIST:
            harmless["value"] = self._extend_types(attributes.get("value", ""))
        for name in attributes:
            if name == TYPE_LIST:
                if tag not in TYPE_LIST_DEFINITIONS:
                    harmless[name] = self._extend_types(attributes[name])
            elif is_harmless_attribute(name):
                self._harmless_names.add(name)
            elif name == "file" and tag.endswith(DETECTOR_SUFFIXES):
                if harmless[name] != NULL_FILE:
                    harmless[name] = NULL_FILE
                    self._record_dropped(f"{name} of {tag}")
            else:
                del harmless[name]
                if name != "file" or tag not in EXTERNAL_ELEMENTS:
                    self._record_dropped(f"{name} of {tag}")
        return harmless

    def _extend_types(self, text: str) -> str:
        """Return a list of vehicle types with their derived types, so that CAVs are selected like other vehicles."""
        self.needs_copy, types = True, text.split()
        indices = range(self._driver_count)
        types += [CALIBRATED_TYPE_TEMPLATE.format(name, index) for name in types for index in indices]
        return " ".join([*types, *map(CAV_TYPE_TEMPLATE.format, types)])

    def _record_dropped(self, description: str) -> None:
        self.dropped_items.add(description)
        self.needs_copy = True


def is_sumo_element(tag: str) -> bool:
    """Return whether an element occurs in SUMO's demand, additional files or weights of edges."""
    return tag in SUMO_ELEMENTS or tag.startswith(FOLLOWING_MODEL_PREFIX)


def is_harmless_attribute(name: str) -> bool:
    """Return whether an attribute is harmless, as it names no file."""
    return name not in FILE_ATTRIBUTES and not name.endswith("File")


def is_harmless_parameter(key: str) -> bool:
    """Return whether a `<param>` is harmless: it reads or writes no file, and removes no trip from SUMO's records."""
    name = key.lower().replace("profile", "")
    return bool(LANE_NAME.search(key)) or not any(text in name for text in FILE_PARAMETER_PARTS)


def parse_xml(path: Path, parser: Any, chunks: Iterable[bytes]) -> None:
    """Parse a file; raise `BrokenFileError` if it is not XML, or has a huge element or a document type.

    The entities of a document type can expand to endless text.
    """

    def refuse_doctype(*definition: object) -> None:
        raise BrokenFileError(f"{path.name}: a document type (<!DOCTYPE ...>) is not allowed")

    parser.StartDoctypeDeclHandler = refuse_doctype
    size = 0
    try:
        for chunk in chunks:
            parser.Parse(chunk, False)
            size += len(chunk)
            # The parser reads an incomplete element from its beginning again with each chunk.
            if size - parser.CurrentByteIndex > MAX_ELEMENT_BYTES:
                limit = f"an element has at most {MAX_ELEMENT_BYTES:,} bytes"
                raise BrokenFileError(f"{path.name}: line {parser.CurrentLineNumber} is too long; allowed: {limit}")
        parser.Parse(b"", True)
    except XML_ERRORS as error:
        raise BrokenFileError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
