"""Small files that claim to be large, and what reading one takes: peak memory and time of a process of its own."""

from __future__ import annotations

import io
import json
import resource
import subprocess
import sys
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

MOST_MB, MOST_SECONDS = 500, 2.0
"""What docs/reliability.md promises of one file."""

MEASURED = """
import json, resource, sys, time
sys.path.insert(0, {tests!r})
import bombs
from semstab.errors import SemstabError
{setup}
def peak():
    for line in open("/proc/self/status"):
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
for action in json.loads({actions!r}):
    open("/proc/self/clear_refs", "w").write("5")  # the peak restarts at the memory in use
    before, began, message = peak(), time.process_time(), None
    try:
        eval(action)
    except SemstabError as error:
        message = str(error)
    print(json.dumps([message, peak() - before, time.process_time() - began]))
"""


@dataclass(frozen=True)
class Taken:
    """The message that refuses a file, None where it was read; megabytes beyond the imports; seconds of computing."""

    message: str | None
    megabytes: float
    seconds: float


def read(setup: str, *actions: str, limit_gb: float = 6) -> list[Taken]:
    """Evaluate expressions one after the other in a process that has at most `limit_gb` of memory."""
    code = MEASURED.format(tests=str(Path(__file__).parent), setup=setup, actions=json.dumps(actions))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (int(limit_gb * 2**30),) * 2),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [Taken(*json.loads(line)) for line in done.stdout.splitlines()[-len(actions) :]]


def png(path: Path, width: int, height: int, bits: int = 16, colors: int = 0) -> Path:
    """Write a PNG of zeros, row after row."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colors]
    packer, row = zlib.compressobj(1), bytes(1 + width * channels * bits // 8)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()

    def chunk(kind: bytes, content: bytes) -> bytes:
        return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([bits, colors, 0, 0, 0])
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b""))
    return path


def npz(path: Path, key: str, shape: tuple[int, ...], dtype: str = "|u1") -> Path:
    """Write an .npz of zeros, piece by piece."""
    import numpy as np

    left = np.dtype(dtype).itemsize
    for side in shape:
        left *= side
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    zipped = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with zipped as archive, archive.open(f"{key}.npy", "w", force_zip64=True) as file:
        file.write(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text)
        while left:
            piece = min(left, 2**24)
            file.write(bytes(piece))
            left -= piece
    return path


def semstab(path: Path, whole: Path, rows: int) -> Path:
    """Write a small summary whose sums are those of a whole one, so often that they are that many rows."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    with zipfile.ZipFile(whole) as archive:
        content, sums = archive.read("summary.json"), archive.read("0.parquet")
    table, packed = pq.read_table(io.BytesIO(sums)), io.BytesIO()
    chunk = table.take(pa.array(np.zeros(2**16, np.int64)))
    with pq.ParquetWriter(packed, table.schema, compression="zstd") as writer:
        for _ in range(rows // 2**16):
            writer.write_table(chunk)
    return _archived(path, content, packed.getvalue())


def semstab_of_text(path: Path, whole: Path, size: int) -> Path:
    """Write a small summary with as many bytes of text, a list of empty lists."""
    with zipfile.ZipFile(whole) as archive:
        content, sums = json.loads(archive.read("summary.json")), archive.read("0.parquet")
    content["about"] = {"more": 0}
    text = json.dumps(content).replace('"more": 0', '"more": [[]' + ",[]" * (size // 3) + "]")
    return _archived(path, text.encode(), sums)


def _archived(path: Path, content: bytes, sums: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr("summary.json", content)
        archive.writestr("0.parquet", sums)
    return path
