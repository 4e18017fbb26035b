"""Read tables of recorded traffic from CSV with any separator, Parquet, and SUMO's FCD output as XML."""

import csv
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
import pandas as pd

from unjam.errors import InputError
from unjam.sandbox import limit_memory_growth
from unjam.sumo_files.reader import BrokenFileError, XmlAttributes, parse_xml

HEAD_BYTES, HEAD_LINES = 1 << 16, 20
"""number of bytes at the beginning of a file from which its format is detected, which is also the maximum length of a
line, and number of lines in which the header is searched"""
MAX_TEXT_BYTES, MAX_CELLS, MAX_FCD_VEHICLES = 1 << 30, 1 << 27, 1 << 23
"""maximum size of a table, which takes about five times as much memory: bytes of uncompressed text (in Parquet, of all
cells), cells, and `vehicle` elements of FCD output as XML"""
MAX_BINARY_LENGTH = 16
"""maximum length of binary values of equal length in Parquet that are read, such as decimal numbers [bytes]"""
MAX_PARQUET_MEMORY = 8 << 30
"""maximum memory for reading a Parquet file [bytes]"""
RECONSTRUCTED_COLUMN_ORDER = (
    *("vehicleid", "frameid", "laneid", "localy", "meanspeed"),
    *("meanaccel", "vehiclelength", "vehicleclassid", "followerid", "leaderid"),
)
"""columns of the reconstructed NGSIM files, in order; these files have no header"""
NGSIM_COLUMN_ORDER = (
    *("vehicle_id", "frame_id", "total_frames", "global_time", "local_x", "local_y", "global_x", "global_y"),
    *("v_length", "v_width", "v_class", "v_vel", "v_acc", "lane_id", "preceding", "following"),
    *("space_headway", "time_headway"),
)
"""columns of NGSIM's text files, in order; these files have no header"""
HEADERLESS_COLUMNS = {len(names): list(names) for names in (RECONSTRUCTED_COLUMN_ORDER, NGSIM_COLUMN_ORDER)}
"""columns of files without a header, by their number"""
FCD_ATTRIBUTES = ("id", "speed", "leaderID", "leaderSpeed", "leaderGap")
"""attributes of a vehicle that are read of SUMO's FCD output as XML; as CSV, their names begin with `vehicle_`"""
FCD_PART_ROWS = 1 << 16
"""number of `vehicle` elements that are converted at a time"""
ALLOWED_FILES = "CSV with a line for each row, Parquet, or SUMO's FCD output"


def read_table(path: Path) -> pd.DataFrame:
    """Return the table of a file, which may be compressed.

    The column `line` has the line of each row in the file; its `attrs` have the lines above the header, by first word.
    Raise `InputError` if the file is missing, cannot be read, or is not a table.
    """
    if not path.is_file():
        raise InputError(f"data: {str(path)!r} does not exist")
    try:
        with path.open("rb") as compressed_file:
            is_compressed = compressed_file.read(2) == b"\x1f\x8b"
        with gzip.open(path) if is_compressed else path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            if head.startswith(b"PAR1"):
                return _read_parquet(path)
            _check_text_size(path, file, head)
            file.seek(0)
            if head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<"):
                return _read_fcd_xml(path, file, head)
            return _read_csv(path, file, head)
    except (ValueError, NotImplementedError, OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
    except MemoryError:
        raise _unreadable_file_error(path, f"it takes more than {MAX_PARQUET_MEMORY / 2**30:g} GiB of memory") from None
    except BrokenFileError as error:
        raise InputError(str(error)) from None


def _check_text_size(path: Path, file: Any, head: bytes) -> None:
    """Raise `InputError` if a text is too large; a small compressed file can contain a very long text."""
    size, cells, chunk = 0, 0, head
    while chunk and size <= MAX_TEXT_BYTES and cells <= MAX_CELLS:
        size += len(chunk)
        cells += max(len(chunk.split()), sum(map(chunk.count, (b"\n", b",", b";", b"\t"))))
        chunk = file.read(HEAD_BYTES)
    _check_table_limits(path, size, cells)


def _read_parquet(path: Path) -> pd.DataFrame:
    """Return the columns of a Parquet file that are numbers or text.

    The length of all text is limited: a file of some kilobytes can refer to one long text a million times.
    """
    import pyarrow as pa
    from pyarrow.compute import call_function
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        metadata, schema = file.metadata, file.schema
        check_unique_columns(path, file.schema_arrow.names)
    columns = [schema.column(index) for index in range(len(schema))]
    columns = [column for column in columns if column.path == column.name and column.max_repetition_level == 0]
    columns = [column for column in columns if column.length <= MAX_BINARY_LENGTH]
    names = {column.name for column in columns}
    texts = {column.name for column in columns if column.physical_type == "BYTE_ARRAY"}
    groups = [metadata.row_group(index) for index in range(metadata.num_row_groups)]
    chunks = [(group, group.column(index)) for group in groups for index in range(metadata.num_columns)]
    chunks = [(group, chunk) for group, chunk in chunks if chunk.path_in_schema in names]
    has_same_rows = all(chunk.num_values == group.num_rows for group, chunk in chunks)
    if not has_same_rows or sum(group.num_rows for group in groups) != metadata.num_rows:
        raise _unreadable_file_error(path, "its numbers of rows contradict each other")
    _check_table_limits(path, cells=metadata.num_rows * metadata.num_columns)
    text_bytes = sum(chunk.total_uncompressed_size for _, chunk in chunks if chunk.path_in_schema in texts)
    total_bytes = sum(chunk.total_uncompressed_size for _, chunk in chunks)
    _check_table_limits(path, text_bytes, (total_bytes - text_bytes) // MAX_BINARY_LENGTH)
    # The decompressed data can be larger than the sizes in the footer of the file.
    with ParquetFile(path, read_dictionary=sorted(texts)) as file, limit_memory_growth(MAX_PARQUET_MEMORY):
        table = file.read([column.name for column in columns], use_threads=False)
        dictionaries = [index for index, kind in enumerate(table.schema.types) if pa.types.is_dictionary(kind)]
        arrays = [array for index in dictionaries for array in table.column(index).chunks]
        lengths = (call_function("binary_length", [array.dictionary]).take(array.indices) for array in arrays)
        _check_table_limits(path, sum(array_lengths.sum().as_py() or 0 for array_lengths in lengths))
        for index in dictionaries:
            value_type = table.schema.field(index).type.value_type
            table = table.set_column(index, table.column_names[index], table.column(index).cast(value_type))
        frame = table.to_pandas(ignore_metadata=True, use_threads=False)
    return frame.assign(line=np.arange(len(frame)) + 2)


def _check_table_limits(path: Path, text_bytes: int = 0, cells: int = 0) -> None:
    if text_bytes > MAX_TEXT_BYTES:
        raise _unreadable_file_error(path, f"it has more than {MAX_TEXT_BYTES:,} bytes of text")
    if cells > MAX_CELLS:
        raise _unreadable_file_error(path, f"it has more than {MAX_CELLS:,} cells")


def _unreadable_file_error(path: Path, reason: str) -> InputError:
    return InputError(f"{path.name}: cannot be read: {reason}; allowed: {ALLOWED_FILES}")


def check_unique_columns(path: Path, columns: Iterable[str]) -> None:
    """Raise `InputError` if two columns have the same name, as one of them would be ignored."""
    counts = Counter(name.strip() for name in columns)
    for name in [name for name, count in counts.items() if name and count > 1]:
        raise InputError(f"{path.name}: {counts[name]} columns have the name {name!r}; allowed: one")


def _read_fcd_xml(path: Path, file: Any, head: bytes) -> pd.DataFrame:
    if b"<fcd-export" not in head:
        raise _unreadable_file_error(path, "it is XML, but not SUMO's FCD output")
    parser, time = expat.ParserCreate(), ""
    names = ["timestep_time", *(f"vehicle_{name}" for name in FCD_ATTRIBUTES)]
    rows, frames = list[tuple[Any, ...]](), list[pd.DataFrame]()

    def store_rows() -> None:  # columns of a frame take a tenth of the memory of the rows
        frames.append(pd.DataFrame(rows, columns=[*names, "line"]))
        rows.clear()

    def on_start(tag: str, attributes: XmlAttributes) -> None:
        nonlocal time
        if tag == "timestep":
            time = attributes.get("time", "")
        elif tag == "vehicle":
            if len(frames) * FCD_PART_ROWS + len(rows) == MAX_FCD_VEHICLES:
                raise _unreadable_file_error(path, f"it has more than {MAX_FCD_VEHICLES:,} elements 'vehicle'")
            rows.append((time, *map(attributes.get, FCD_ATTRIBUTES), parser.CurrentLineNumber))
            if len(rows) == FCD_PART_ROWS:
                store_rows()

    parser.StartElementHandler = on_start
    parse_xml(path, parser, iter(lambda: file.read(HEAD_BYTES), b""))
    store_rows()
    return pd.concat(frames, ignore_index=True).dropna(axis="columns", how="all")


def _read_csv(path: Path, file: Any, head: bytes) -> pd.DataFrame:
    lines = head.decode("utf-8-sig", errors="ignore").splitlines()[:HEAD_LINES] or [""]
    if b"\0" in head:
        raise _unreadable_file_error(path, "it is not text in UTF-8")
    if lines[0].lstrip().startswith(("{", "[")):
        raise _unreadable_file_error(path, "it is JSON")
    header, attributes = _find_header(lines)
    if len(lines) <= header + 2 and len(head) == HEAD_BYTES:
        raise _unreadable_file_error(path, f"line {len(lines)} is longer than {HEAD_BYTES:,} bytes")
    separator = max(",;\t", key=lines[header].count)
    separator = separator if separator in lines[header] else r"\s+"
    cells, options = re.split(separator, lines[header].strip()), dict[str, Any](skiprows=header)
    if all(re.fullmatch(r"\s*-?[\d.eE+-]+\s*", cell) for cell in cells):
        if len(cells) not in HEADERLESS_COLUMNS:
            raise _unreadable_file_error(path, "its first line is not the names of its columns")
        names = HEADERLESS_COLUMNS[len(cells)]
        header, options = -1, {"names": names, "header": None}
    else:
        names = cells if separator == r"\s+" else next(csv.reader([lines[header]], delimiter=separator))
        check_unique_columns(path, names)
    rows = "\n".join(lines[header + 1 :])
    if separator != "," and re.search(r"\d,\d", rows) and not re.search(r"\d\.\d", rows):
        options["decimal"] = ","
    width = 0 if separator == r"\s+" else max(map(len, csv.reader(lines[header + 1 :], delimiter=separator)), default=0)
    surplus = [f"surplus {index}" for index in range(width - len(cells))]
    if surplus:  # pandas would use the first columns as an index, and shift the names of the others
        options = {"header": 0, **options, "names": [*names, *surplus]}
    frame = pd.read_csv(file, sep=separator, encoding="utf-8-sig", skipinitialspace=True, **options)
    if (is_filled := frame[surplus].notna().any(axis=1)).any():
        raise _unreadable_file_error(
            path, f"line {header + 2 + int(is_filled.argmax())} has more cells than columns have names"
        )
    frame = frame.drop(columns=surplus)
    frame = pd.concat([frame, pd.Series(np.arange(len(frame)) + header + 2, frame.index, name="line")], axis=1)
    frame.attrs = attributes
    return frame


def _find_header(lines: list[str]) -> tuple[int, dict[Hashable, str]]:
    """Return the number of lines above the header of a CSV file, and their content; only files of OpenACC have some."""
    for count, line in enumerate(lines):
        if re.match(r"time\s*[,;\t]\s*speed1\b", line.strip(), re.IGNORECASE):
            above = [line.strip().partition(",") for line in lines[:count]]
            return count, {key.strip(" :").lower(): value.strip(",\" '") for key, _, value in above}
    return 0, {}
