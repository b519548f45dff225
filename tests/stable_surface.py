"""The names that docs/stability.md promises, by surface, as the code and a small run have them."""

from __future__ import annotations

import csv
import hashlib
import inspect
import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import reference
import tiny_scene

import semstab
from semstab import GateConfig, backends, conformance, datasets, gate, models
from semstab.cli.execution import DISAGREE
from semstab.config import Config
from semstab.engine import Observer
from semstab.gating.report import as_json
from semstab.gating.result import EXIT_CODES
from semstab.predict.filters import Filter

Surface = dict[str, list[str]]

PROTOCOLS = (backends.FusionBackend, datasets.Dataset, datasets.Scene, models.Model, Filter, Observer)
CASES = Path(conformance.__file__).parent / "cases"
REMEDY = "say it in CHANGELOG.md, then run: python tests/golden/regenerate.py"


def stable_surface() -> Surface:
    """Return the sorted names of each surface."""
    found = {name: sorted(set(names)) for name, names in (*_python(), *_commands(), *_settings(), *_files())}
    found["exit codes"] = [str(code) for code in sorted({0, semstab.SemstabError.exit_code, DISAGREE, 130} | _gates())]
    found["conformance cases"] = [f"{case.name} {_digest(case)}" for case in sorted(CASES.iterdir()) if case.is_dir()]
    return dict(sorted(found.items()))


def complaints(stored: Mapping[str, Iterable[str]], found: Mapping[str, Iterable[str]]) -> list[str]:
    """Return a sentence for each surface that lost or gained names."""
    lines = []
    for surface in sorted({*stored, *found}):
        before, now = set(stored.get(surface, ())), set(found.get(surface, ()))
        if gone := sorted(before - now):
            lines.append(
                f"{surface}: {', '.join(gone)} is gone; keep the old name for a minor version with a warning that names"
                f" the new one (docs/stability.md); if a major version drops it, {REMEDY}"
            )
        if new := sorted(now - before):
            lines.append(f"{surface}: {', '.join(new)} is new, and will stay; {REMEDY}")
    return lines


def _python() -> Iterator[tuple[str, Iterable[str]]]:
    """Yield the arguments and members of each public name, and the members of each protocol."""
    yield "semstab", semstab.__all__
    for name in semstab.__all__:
        value = getattr(semstab, name)
        if inspect.ismodule(value):
            yield f"semstab.{name}", (row.split("`")[1].split("(")[0] for row in reference._module(name, value)
                                      if row.startswith("| `"))  # fmt: skip
            continue
        if names := [argument.lstrip("*") for argument, _, _ in reference.arguments(value)]:
            yield f"semstab.{name}: arguments", names
        if isinstance(value, type):
            yield f"semstab.{name}: members", _members(value)
    for protocol in PROTOCOLS:
        yield f"protocol {protocol.__name__}", _members(protocol)


def _members(value: type) -> Iterator[str]:
    """Yield the public members that classes of semstab define."""
    for cls in value.__mro__:
        if cls.__module__.startswith("semstab"):
            names = {*vars(cls), *inspect.get_annotations(cls)} - {"model_config", "model_post_init"}
            yield from (name for name in names if not name.startswith("_"))


def _commands() -> Iterator[tuple[str, Iterable[str]]]:
    import typer

    from semstab.cli import app

    group: Any = typer.main.get_command(app)
    visible = {name: command for name, command in group.commands.items() if not command.hidden}
    yield "commands", visible
    for name, command in visible.items():
        options = (
            reference._option(parameter) for parameter in command.params if not getattr(parameter, "hidden", False)
        )
        yield f"command {name}", (word.strip("`") for words in options for word in words.split(", "))


def _settings() -> Iterator[tuple[str, Iterable[str]]]:
    for model in (Config, GateConfig):
        schema = model.model_json_schema()
        parts = {model.__name__: schema, **schema.get("$defs", {})}
        for name, part in parts.items():
            if "properties" in part:
                yield f"settings {name.partition('_')[0]}", part["properties"]  # pydantic names Values[...] by its type


def _files() -> Iterator[tuple[str, Iterable[str]]]:
    """Yield the names in the files of a run of two models on a tiny scene, and of a gate."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = tiny_scene.write(folder / "wall", frames=9)
        data = {"dataset": {"name": "posed_folder", "options": {"root": str(scene)}}}
        settings = data | {"voxel_size": 0.25, "statistics": True, "events": True, "backends": ["numpy"]}
        semstab.run(semstab.load_config(settings), out=folder / "run")
        summary, manifest = (json.loads((folder / f"run/{file}.json").read_text()) for file in ("summary", "manifest"))
        yield "summary.json", [*summary, f"schema {summary['schema']}"]
        entries = [entry for entry in summary["runs"] if entry["statistics"]]
        yield "summary.json: runs", entries[0]
        yield "summary.json: runs.statistics", entries[0]["statistics"]
        yield "manifest.json", [*manifest, f"schema {manifest['schema']}"]
        for kind in ("voxels", "events"):
            file = next((folder / "run" / kind).glob("*.parquet"))
            columns = pq.read_schema(file)
            about = json.loads(columns.metadata[b"semstab"])
            yield f"{kind}/*.parquet", [*columns.names, f"schema {about['schema']}"]
        with next((folder / "run/frames").glob("*.csv")).open(newline="", encoding="utf-8") as file:
            yield "frames/*.csv", next(csv.reader(file))
        rules = GateConfig(rules=("alpha drop < 0.5",))
        told = json.loads(as_json(gate(f"{folder / 'run'}:a", f"{folder / 'run'}:b", rules)))
        yield "gate.json", [*told, f"schema {told['schema']}"]
        yield "gate.json: rules", told["rules"][0]


def _gates() -> set[int]:
    return set(EXIT_CODES.values())


def _digest(case: Path) -> str:
    """Return a hash of a conformance case: of its files, by name."""
    files = (file for file in sorted(case.rglob("*")) if file.is_file())
    parts = (f"{file.relative_to(case)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n" for file in files)
    return hashlib.sha256("".join(parts).encode()).hexdigest()[:12]
