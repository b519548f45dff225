"""Write the hashes of a benchmark's data into its definition: `python scripts/benchmark_digests.py FILE.yaml [DATA]`.

They are those of the depth and the pose of each frame that the definition selects, in order, by scene. Beside it,
NAME@VERSION.geometry.json gets the spots that these frames see. To be run once, before a version is published, on data
whose origin is sure: a published version is frozen (tests/test_leaderboard.py). `--geometry` writes the spots alone,
and requires that the data is that of the hashes.
"""

from __future__ import annotations

import argparse
import json
import textwrap
from pathlib import Path

import yaml

from semstab.leaderboard.definition import load_benchmark
from semstab.leaderboard.geometry import geometry_file, save_geometry

WIDTH = 118


def main() -> None:
    """Write both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--geometry", action="store_true", help="leave the hashes as they are")
    given = parser.parse_args()
    if not given.geometry:
        write_hashes(given.file, given.data)
    write_geometry(given.file, given.data)


def write_hashes(file: Path, data: Path | None) -> None:
    """Replace the part `digests` of the file, which stands at its end."""
    found = load_benchmark(file).digests_of(data)
    text = file.read_text(encoding="utf-8").partition("\ndigests:")[0].rstrip("\n")
    lines = [text, "digests:  # of each frame: depth-pose"]
    for scene, hashes in found.items():
        lines.append(f"  {scene if yaml.safe_load(scene) == scene else json.dumps(scene)}: >-")
        lines += textwrap.wrap(hashes, WIDTH, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_geometry(file: Path, data: Path | None) -> None:
    """Write the spots of the scenes next to a definition."""
    benchmark = load_benchmark(file)
    benchmark.require_data(data)
    save_geometry(geometry_file(file), benchmark.geometry_of(data), benchmark.data_digest)


if __name__ == "__main__":
    main()
