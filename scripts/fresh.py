"""New environments with a wheel of this source: what users have, without what a developer has also installed."""

from __future__ import annotations

import configparser
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path

SOURCE = Path(__file__).parents[1]

Done = subprocess.CompletedProcess[str]

SIZES = """
import json
from importlib import metadata
files = lambda d: (f.locate() for f in d.files or () if f.suffix != ".pyc")
size = lambda d: sum(f.stat().st_size for f in files(d) if f.is_file())
print(json.dumps({d.metadata["Name"].lower(): size(d) for d in metadata.distributions()}))
"""


def setup() -> configparser.ConfigParser:
    """Return what setup.cfg says."""
    found = configparser.ConfigParser()
    found.read(SOURCE / "setup.cfg")
    return found


def build_wheel(folder: Path) -> Path:
    """Build the wheel of the committed and changed files into a folder; without network."""
    copy = folder / "source"
    files = run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], SOURCE).stdout.split("\0")
    for name in filter(None, files):
        if (SOURCE / name).exists():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(SOURCE / name, copy / name, follow_symlinks=False)  # src/semstab is a link
    pip(Path(sys.executable), "wheel", "--no-deps", "--wheel-dir", str(folder), str(copy))
    (wheel,) = folder.glob("semstab-*.whl")
    return wheel


def make_venv(folder: Path, base: str = sys.executable) -> Path:
    """Make an environment without any package, and return its Python."""
    run([base, "-m", "venv", str(folder)])
    return folder / "bin" / "python"


def pip(python: Path, *words: str) -> None:
    """Run pip of an environment. Raises SystemExit with its last lines if it fails."""
    done = run([str(python), "-m", "pip", *words, "--quiet", "--disable-pip-version-check"], code=None)
    if done.returncode:
        raise SystemExit(f"pip {' '.join(words)}: {done.stderr[-2000:]}")


def sizes(python: Path) -> dict[str, int]:
    """Return the bytes of the installed files of each distribution in an environment, without byte code."""
    return {str(name): int(size) for name, size in json.loads(run([str(python), "-c", SIZES]).stdout).items()}


def key(distribution: str) -> str:
    """Return the name of a distribution as all its spellings are compared.

    >>> key("PyYAML"), key("pydantic_core")
    ('pyyaml', 'pydantic-core')
    """
    return re.sub(r"[-_.]+", "-", distribution).lower()


def needed(names: Iterable[str]) -> set[str]:
    """Return these distributions and all that they need, as far as installed; extras that they ask for, too."""
    from packaging.requirements import Requirement

    found: set[tuple[str, str]] = set()
    waiting = [(key(name), "") for name in names]
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in found:
            continue
        try:
            requirements = map(Requirement, metadata.requires(name) or ())
        except metadata.PackageNotFoundError:
            continue
        found.add((name, extra))
        for requirement in requirements:
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                waiting += [(key(requirement.name), extra_name) for extra_name in ("", *requirement.extras)]
    return {name for name, _ in found}


def lowest_versions(requirements: Iterable[str]) -> list[str]:
    """Return `name==version` of each requirement's lower bound.

    >>> lowest_versions(["rerun-sdk>=0.41,<0.42", "laspy[lazrs]>=2.5"])
    ['rerun-sdk==0.41', 'laspy==2.5']
    """
    found = [re.match(r"([\w.-]+)(?:\[[\w,]+\])?[>=]=([\w.]+)", line) for line in requirements]
    return [f"{match[1]}=={match[2]}" for match in found if match]


def run(words: Sequence[str], cwd: Path | None = None, code: int | None = 0) -> Done:
    """Run a program that sees its environment's packages only. Raises SystemExit if it ends with another code."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    environment = {key: value for key, value in os.environ.items() if key not in hidden} | {"COLUMNS": "120"}
    done = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    if code is not None and done.returncode != code:
        raise SystemExit(f"{' '.join(words)}: exit code {done.returncode}\n{done.stdout[-1000:]}{done.stderr[-2000:]}")
    return done
