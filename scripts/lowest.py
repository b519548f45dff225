"""The lowest versions that setup.cfg declares, as constraints for pip; and the main job with exactly these versions.

python scripts/lowest.py          # writes constraints/lowest.txt
python scripts/lowest.py --run    # and installs a wheel with them, and runs the commands below with it
"""

from __future__ import annotations

import platform
import sys
import tempfile
import time
from pathlib import Path

import fresh

FILE = fresh.SOURCE / "constraints" / "lowest.txt"

COMMANDS = (
    "run --backend open3d --out run",
    "check",
    "compare run:sim-steady run:sim-flicker --out compared",
    "gate run:sim-steady --against run:sim-flicker --rule alpha>0",
    "show run --figures png",
    "export run --scene scene0 --model sim-flicker --to map.ply --to map.csv --to map.parquet",
)

HEAD = """# The lowest versions that setup.cfg declares for the base install: pip install -c constraints/lowest.txt .
# Written by python scripts/lowest.py
"""


def constraints() -> str:
    """Return the content of the file."""
    declared = fresh.setup()["options"]["install_requires"].split("\n")
    return HEAD + "".join(f"{line}\n" for line in fresh.lowest_versions(filter(None, declared)))


def run() -> None:
    """Install the wheel with these versions into a new environment, and run each command from an empty folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = fresh.make_venv(folder / "venv")
        fresh.pip(python, "install", "-c", str(FILE), str(fresh.build_wheel(folder)))
        fresh.run([str(python), "-m", "pip", "check"])
        empty = folder / "empty"
        empty.mkdir()
        for words in COMMANDS:
            start = time.monotonic()
            fresh.run([str(python), "-m", "semstab", *words.split()], empty)
            print(f"{time.monotonic() - start:6.1f} s  semstab-bench {words}", flush=True)
    print(f"all end with exit code 0, with Python {platform.python_version()} and {FILE.name} of {time.strftime('%F')}")


if __name__ == "__main__":
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(constraints())
    if sys.argv[1:] == ["--run"]:
        run()
