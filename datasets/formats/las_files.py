"""LAS and LAZ, opened only where what their headers claim can be: laspy takes the memory that a header asks for."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO

from semstab.errors import DataError, SemstabError, one_line

SHORT, OF_1_4 = 227, 375
"""Bytes of a header, and of one that has the fields of LAS 1.4."""

RECORD, EXTENDED = (54, "<H", 20), (60, "<Q", 20)
"""Of a variable length record and an extended one: bytes of its head, how and where its length stands in it."""

BYTES_AT_ONCE = 2**26
"""Of points as stored, and of those of one chunk of LAZ: what is compressed together is decoded together."""

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Of LAZ's items that are compressed in layers (LAS 1.4): how many each has. Item 14, extra bytes, has one a byte."""

EXTRA_BYTES = 14

DAMAGE = (OSError, ValueError, LookupError, RuntimeError, OverflowError, AttributeError, AssertionError, struct.error)
"""What laspy and lazrs raise on damaged files beside laspy's own."""

PANIC = "pyo3_runtime"
"""Where the error is from by which lazrs gives up: it is no Exception, and has no public name."""


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A laspy.LasReader. Whatever is wrong with the file is a DataError of one line, also while it is read."""
    import laspy

    try:
        with path.open("rb") as file:
            _require_whole(file, path.stat().st_size)
        with laspy.open(path) as reader:
            if reader.header.are_points_compressed:
                with path.open("rb") as file:
                    _require_decodable(file, reader.header)
            yield reader
    except (SemstabError, ImportError):
        raise
    except (laspy.errors.LaspyException, *DAMAGE) as error:
        raise DataError(f"{path}: cannot be read ({one_line(error)})") from error
    except BaseException as error:
        if type(error).__module__ != PANIC:
            raise
        raise DataError(f"{path}: cannot be read ({one_line(error)})") from error


def points_at_once(header: Any) -> int:
    """How many points of a file to read at a time."""
    return int(max(1, BYTES_AT_ONCE // header.point_format.size))


def _require_whole(file: BinaryIO, size: int) -> None:
    """Raise ValueError where the file is too small for what its header says is in it."""
    head = file.read(OF_1_4)
    if len(head) < SHORT or head[:4] != b"LASF":
        raise ValueError("it is no LAS file")
    length, start, records, kind, record, points = struct.unpack_from("<HIIBHI", head, 94)
    if not SHORT <= length <= start <= size:
        raise ValueError(f"its points would begin at byte {start}, of {size}; it is cut short")
    _require_records(file, length, start, records, RECORD)
    if head[25] >= 4 and len(head) == OF_1_4:
        first, extended = struct.unpack_from("<QI", head, 235)
        _require_records(file, first, size, extended, EXTENDED)
        (points,) = struct.unpack_from("<Q", head, 247)
    if not kind & 0x80 and points * record > size - start:
        raise ValueError(f"ends after {(size - start) // record:,} of {points:,} points; it is cut short")
    if kind & 0x80:
        _require_chunks(file, start, size)


def _require_records(file: BinaryIO, at: int, end: int, count: int, form: tuple[int, str, int]) -> None:
    """Raise ValueError where so many records do not fit between two places in a file."""
    head, number, place = form
    for _ in range(count):
        if at + head > end:
            raise ValueError(f"it has no room for the {count} records that its header names")
        file.seek(at)
        (length,) = struct.unpack_from(number, file.read(head), place)
        at += head + length
    if count and at > end:
        raise ValueError(f"its last record ends at byte {at}, after {end}")


def _require_chunks(file: BinaryIO, start: int, size: int) -> None:
    """Raise ValueError where the table of LAZ's chunks does not stand in the file, or names more of them than fit."""
    file.seek(start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table == -1:  # written where one could not go back: it stands at the end
        file.seek(max(start, size - 8))
        table = int.from_bytes(file.read(8), "little", signed=True)
    if not start + 8 <= table <= size - 8:
        raise ValueError("its table of chunks is not in the file; it is cut short")
    file.seek(table + 4)
    chunks = int.from_bytes(file.read(4), "little")
    if chunks > table - start:
        raise ValueError(f"it names {chunks} chunks in {table - start} bytes")


def _require_decodable(file: BinaryIO, header: Any) -> None:
    """Raise ValueError where LAZ's chunks are not what the table says, or larger than is decoded at once.

    lazrs takes the memory that sizes in record, table and chunks name before it sees that the file is shorter.
    """
    import lazrs

    record = header.vlrs[header.vlrs.index("LasZipVlr")].record_data
    said = lazrs.LazVlr(record)
    if said.item_size() != header.point_format.size:
        raise ValueError(f"its points have {header.point_format.size} bytes, and {said.item_size()} where compressed")
    file.seek(header.offset_to_point_data)
    chunks = lazrs.read_chunk_table(file, said)
    most, at = max((points for points, _ in chunks), default=0), file.tell()
    if most * said.item_size() > BYTES_AT_ONCE:
        raise ValueError(f"it has chunks of {most:,} points; compress it anew (laszip writes 50,000)")
    if sum(points for points, _ in chunks) < header.point_count:
        raise ValueError(f"its chunks hold fewer points than the {header.point_count:,} that its header names")
    layers = _layers(record)
    for _, length in chunks:
        if layers:
            _require_layers(file, at, length, said.item_size(), layers)
        at += length
    if at > file.seek(0, SEEK_END):
        raise ValueError("its chunks are longer than it; it is cut short")


def _layers(record: bytes) -> int:
    """How many layers a chunk has, by the items of the LASzip record; 0 where it is compressed point by point."""
    (items,) = struct.unpack_from("<H", record, 32)
    kinds = [struct.unpack_from("<HH", record, 34 + 6 * item) for item in range(items)]
    return sum(length if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, length in kinds)


def _require_layers(file: BinaryIO, at: int, length: int, first: int, layers: int) -> None:
    """Raise ValueError where the layers of a chunk are not as long as it. Before them: a point, a count, lengths."""
    file.seek(at + first + 4)
    lengths = struct.unpack(f"<{layers}I", file.read(4 * layers))
    if first + 4 + 4 * layers + sum(lengths) != length:
        raise ValueError(f"a chunk at byte {at} has layers that do not fit into it")
