"""Write the hashes of a benchmark's data into its definition: `python scripts/benchmark_digests.py FILE.yaml [DATA]`.

They are those of the depth and the pose of each frame that the definition selects, in order, by scene. To be run once,
before a version is published, on data whose origin is sure: a published version is frozen (tests/test_leaderboard.py).
"""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path

from semstab.leaderboard.definition import load_benchmark

WIDTH = 118


def main() -> None:
    """Replace the part `digests` of the file, which stands at its end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("data", type=Path, nargs="?")
    given = parser.parse_args()
    found = load_benchmark(given.file).digests_of(given.data)
    text = given.file.read_text(encoding="utf-8").partition("\ndigests:")[0].rstrip("\n")
    lines = [text, "digests:  # of each frame: depth-pose"]
    for scene, hashes in found.items():
        lines.append(f"  {scene}: >-")
        lines += textwrap.wrap(hashes, WIDTH, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    given.file.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
