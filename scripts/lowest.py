"""The lowest versions that setup.cfg declares, as constraints for pip; and the main job with exactly these versions.

python scripts/lowest.py             # writes constraints/lowest.txt
python scripts/lowest.py --run       # and installs a wheel with them, and runs the commands below with it
python scripts/lowest.py --newest    # the same commands with the newest versions that pip finds for this Python
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


def run(*options: str, versions: str) -> None:
    """Install the wheel with options of pip into a new environment, and run each command from an empty folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = fresh.make_venv(folder / "venv")
        fresh.pip(python, "install", *options, str(fresh.build_wheel(folder)))
        fresh.run([str(python), "-m", "pip", "check"])
        sizes = fresh.sizes(python)
        print(f"{sum(sizes.values()) / 1e6:.0f} MB in {len(sizes) - 1} packages, without byte code")  # pip is no part
        empty = folder / "empty"
        empty.mkdir()
        for words in COMMANDS:
            start = time.monotonic()
            fresh.run([str(python), "-m", "semstab", *words.split()], empty)
            print(f"{time.monotonic() - start:6.1f} s  semstab-bench {words}", flush=True)
    print(f"all end with exit code 0, with Python {platform.python_version()} and {versions}, {time.strftime('%F')}")


if __name__ == "__main__":
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(constraints())
    if sys.argv[1:] == ["--run"]:
        run("-c", str(FILE), versions=FILE.name)
    elif sys.argv[1:] == ["--newest"]:
        run(versions="the newest versions")
