"""Ways to damage a file: its bytes, its words, its values, or what lies behind a checksum or a compression."""

from __future__ import annotations

import copy
import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from image_files import png_chunk

from semstab.core.sealed_zip import DIGESTS, packed
from semstab.datasets.formats.decoders import PNG_SIGNATURE

Damage = Callable[[bytes, random.Random], bytes]

WHOLES = (
    b"", b"\0" * 64, b"\xff" * 300, b"[]", b"null", b"{}", b"[" * 100_000, b'{"a":' * 50_000, b"1" * 6000, b"x",
    b"- " * 20_000, b"\xef\xbb\xbf", b"{a: &a [1,1], b: *a, c: *d}", b"\n" * 999, b"!!python/object:os.system x",
)  # fmt: skip
WORDS = (
    "nan", "inf", "-inf", "1e308", "1e-320", "-1", "0", "9" * 25, "9" * 6000, "x", "", "%s{}", "../../x", "\0", "²",
    "0x1f", "1_0", "1e5", "-0.0", "4294967296", "[1, 2]", "{a: b}", "null", "true", "*a", "a" * 3000, "\r",
)  # fmt: skip
VALUES = (
    None, True, -1, 0, 1, 1e308, 1e-320, 2**31, 2**63, float("nan"), "x", "", "\ud800", [], {}, [[]], [1, 2],
    {"a": 1}, "../../x", 10**400, "a" * 5000, "a\nb", "\x1b[31m", "\0", "1", "=1", [None] * 50,
)  # fmt: skip
NUMBERS = tuple(
    struct.pack(form, value)
    for form in ("<i", ">i", "<q", ">q", "<f", "<d", "<h", ">h")
    for value in (-1, 0, 1, 32767, *((2**31 - 1, -(2**31)) if form[1] in "iqfd" else ()))
)


def of_bytes(content: bytes, rng: random.Random) -> bytes:
    """Bits turned, bytes replaced, a number replaced by an extreme, a piece cut out, doubled or zeroed, the end cut."""
    if rng.random() < 0.02:
        return rng.choice(WHOLES)
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        at = rng.randrange(len(data) + 1)
        if rng.random() < 0.4:
            at = min(at, rng.randrange(128))  # headers matter most
        length = rng.choice((1, 2, 4, 8, 64))
        match rng.randrange(7):
            case 0 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                data[at : at + length] = rng.randbytes(length)
            case 2 | 3:
                number = rng.choice(NUMBERS)
                data[at : at + len(number)] = number
            case 4:
                del data[at : at + length]
            case 5:
                data[at:at] = data[at : at + length]
            case 6 if rng.random() < 0.5:
                del data[at:]
    return bytes(data)


def of_words(content: bytes, rng: random.Random) -> bytes:
    """A word replaced, a line left out or doubled; or bytes."""
    if rng.random() < 0.25:
        return of_bytes(content, rng)
    text = content.decode("utf-8", "replace")
    for _ in range(rng.choice((1, 1, 2, 3))):
        if rng.random() < 0.3:
            lines = text.splitlines(keepends=True) or [""]
            k = rng.randrange(len(lines))
            lines[k] = rng.choice(("", lines[k] * 2, lines[k][::-1], rng.choice(lines)))
            text = "".join(lines)
        else:
            words = list(re.finditer(r"[\w.+-]+|[^\w\s]", text))
            if words:
                word = rng.choice(words)
                text = text[: word.start()] + rng.choice(WORDS) + text[word.end() :]
    return text.encode("utf-8", "surrogatepass")


def replace_somewhere(values: Any, rng: random.Random) -> None:
    """A value or a key of nested lists and dictionaries, in place."""
    keys = list(values) if isinstance(values, dict) else list(range(len(values)))
    if not keys:
        return
    key = rng.choice(keys)
    if isinstance(values[key], dict | list) and values[key] and rng.random() < 0.8:
        replace_somewhere(values[key], rng)
    elif isinstance(values, dict) and rng.random() < 0.2:
        del values[key]
    elif isinstance(values, dict) and rng.random() < 0.1:
        values[rng.choice(("x", "", "a\nb", "a" * 999))] = values.pop(key)
    elif rng.random() < 0.2:
        values[key] = [values[key], values[key]]
    else:
        values[key] = copy.deepcopy(rng.choice(VALUES))  # else a list might come to hold itself


def of_json(content: bytes, rng: random.Random) -> bytes:
    """A value replaced; or words or bytes."""
    if rng.random() < 0.3:
        return of_words(content, rng)
    values = json.loads(content)
    for _ in range(rng.choice((1, 1, 2))):
        if isinstance(values, dict | list):
            replace_somewhere(values, rng)
    return json.dumps(values).encode("utf-8", "surrogatepass")


def of_yaml(content: bytes, rng: random.Random) -> bytes:
    """A value replaced; or words or bytes."""
    if rng.random() < 0.4:
        return of_words(content, rng)
    values = yaml.safe_load(content)
    if isinstance(values, dict | list):
        replace_somewhere(values, rng)
    return yaml.safe_dump(values, allow_unicode=True).encode("utf-8", "surrogatepass")


def of_png(content: bytes, rng: random.Random) -> bytes:
    """A chunk or what is compressed in it, with right checksums; or bytes."""
    if rng.random() < 0.3:
        return of_bytes(content, rng)
    chunks, at = [], len(PNG_SIGNATURE)
    while at < len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    k = rng.randrange(len(chunks))
    kind, body = chunks[k]
    if kind == b"IDAT" and rng.random() < 0.7:
        body = zlib.compress(of_bytes(zlib.decompress(body), rng), 1)
    elif rng.random() < 0.2:
        kind = rng.choice((b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND", b"iCCP", b"zTXt"))
    else:
        body = of_bytes(body, rng)
    chunks[k : k + 1] = [(kind, body)] * rng.choice((0, 1, 1, 1, 1, 2))
    return PNG_SIGNATURE + b"".join(png_chunk(*chunk) for chunk in chunks)


def of_npz(content: bytes, rng: random.Random) -> bytes:
    """A member of the archive, with a right checksum; or bytes."""
    if rng.random() < 0.3:
        return of_bytes(content, rng)
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        chosen, members = rng.choice(old.namelist()), dict[str, bytes]()
        for name in old.namelist():
            body = old.read(name)
            called = rng.choice((name, name, name, "x", "../x.npy")) if name == chosen else name
            damage = {".json": of_json, ".parquet": of_parquet}.get(name[name.rfind(".") :], of_bytes)
            members[called] = damage(body, rng) if name == chosen else body
            info = zipfile.ZipInfo(called)  # without the time of day: the same for the same seed
            new.writestr(info, members[called], zipfile.ZIP_DEFLATED)
    if members.pop(DIGESTS, None) is not None and rng.random() < 0.8:
        return packed(members)  # with right digests, so that the damage itself is met
    return out.getvalue()


def of_parquet(content: bytes, rng: random.Random) -> bytes:
    """A column left out, of another type, with other values or too few rows; what the schema says; or bytes."""
    if rng.random() < 0.4:
        return of_bytes(content, rng)
    table = pq.read_table(io.BytesIO(content))
    k = rng.randrange(table.num_columns)
    field, column = table.schema.field(k), table.column(k)
    about = dict(table.schema.metadata or {})
    match rng.randrange(7):
        case 0:
            table = table.remove_column(k)
        case 1:
            values = pa.array([rng.choice(("x", None, "9" * 99)) for _ in range(len(column))], pa.string())
            table = table.set_column(k, field.name, values)
        case 2:
            extremes = pa.array([rng.choice((-1, 0, 2**31, 2**62, -(2**62))) for _ in range(len(column))], pa.int64())
            table = table.set_column(k, field.name, extremes)
        case 3:
            floats = pa.array([rng.choice((float("nan"), 1e300, -1.0, float("inf"))) for _ in range(len(column))])
            table = table.set_column(k, field.name, floats)
        case 4:
            table = table.slice(0, rng.choice((0, 1, len(table) // 2)))
        case 5:
            table = table.append_column(field.name, column)
        case 6 if b"semstab" in about:
            about[b"semstab"] = of_json(about[b"semstab"], rng)
            table = table.replace_schema_metadata(about)
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()
