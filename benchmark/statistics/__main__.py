"""`python -m semstab.statistics RUN`: the statistics of a run folder's maps, from the files in it."""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from semstab.config import read_yaml
from semstab.datasets import GROUND_TRUTH
from semstab.errors import SemstabError
from semstab.metrics.summary import STRATA
from semstab.model.results import Unit
from semstab.model.voxels import Events, VoxelTable
from semstab.runtime.files import read_json, write_json
from semstab.runtime.json_form import to_json
from semstab.statistics.backbones import compare_backbones
from semstab.statistics.description import analyse
from semstab.statistics.text import comparison_lines, lines


def main() -> int:
    """Print the statistics of each map, the ground truth's among them, and of the backbones beside each other."""
    parser = argparse.ArgumentParser(prog="python -m semstab.statistics", description=__doc__)
    parser.add_argument("run", type=Path, help="run folder; made with --events it has drift tests and fusion rules too")
    parser.add_argument("--json", type=Path, help="also write the statistics there")
    parser.add_argument("--maps", type=Path, help="also write each map with its statistics as columns into this folder")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    try:
        content = _statistics(arguments.run, arguments.maps, arguments.seed)
        if arguments.json:
            write_json(arguments.json, content)
    except SemstabError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    return 0


def _statistics(run: Path, maps: Path | None, seed: int) -> dict[str, Any]:
    edges = read_yaml(run / "config.yaml").get("strata", STRATA)
    groups: dict[tuple[str, str], list[Unit]] = defaultdict(list)
    for row in read_json(run / "summary.json")["runs"]:
        groups[row["scene"], row["backend"]].append(Unit(row["scene"], row["backbone"], row["backend"]))
    content: dict[str, Any] = {"maps": [], "comparisons": []}
    for (scene, backend), units in groups.items():
        tables = {unit.backbone: VoxelTable.load(run / "voxels" / f"{unit.slug}.parquet") for unit in units}
        logs = {unit.backbone: run / "events" / f"{unit.slug}.parquet" for unit in units}
        events = {name: Events.load(path) for name, path in logs.items() if path.exists()}
        truth = tables.get(GROUND_TRUTH)
        for unit in units:
            name, reference = unit.backbone, None if unit.backbone == GROUND_TRUTH else truth
            found = analyse(
                tables[name], events.get(name), reference, limit=reference, name=name, seed=seed, edges=edges
            )
            content["maps"].append({"scene": scene, "backbone": name, "backend": backend, **to_json(found.summary)})
            _say(f"{scene}, {name}, {backend}", lines(found.summary))
            if maps is not None:
                tables[name].save(maps / f"{unit.slug}.parquet", found.maps)
        backbones = {name: table for name, table in tables.items() if name != GROUND_TRUTH}
        if len(backbones) > 1:
            logged = events if set(backbones) <= set(events) else None
            compared = compare_backbones(backbones, logged, truth, scene=scene, seed=seed)
            content["comparisons"].append({"backend": backend, **to_json(compared)})
            _say(f"{scene}, {backend}: {', '.join(backbones)}", comparison_lines(compared))
    return content


def _say(title: str, text: list[str]) -> None:
    sys.stdout.write("\n".join([title, "-" * len(title), *text, "", ""]))


if __name__ == "__main__":
    sys.exit(main())
