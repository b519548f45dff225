"""Writes the golden files: `python tests/golden/regenerate.py`. Look at the diff before you commit."""

import dataclasses
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from semstab import backends
from semstab.core.files import write_json, write_text
from semstab.core.json_form import to_json
from semstab.data.frames import Frame, Intrinsics
from semstab.data.measures import measures
from semstab.metrics import summarise
from semstab.report.tables import tables, to_csv, to_latex, to_markdown

FILE = Path(__file__).parent / "small_map.json"
K = 4


def frames():
    """Five frames of 5x6 pixels by simple arithmetic; the camera turns by 3-4-5 triangles, frame 3 has soft scores."""
    v, u = np.mgrid[:5, :6]
    for t in range(5):
        c, s = ((1, 0), (0.8, 0.6), (0.6, 0.8), (0.8, -0.6), (1, 0))[t]
        T_wc = np.array([[c, 0, s, 0.3 * t], [0, 1, 0, -0.2], [-s, 0, c, 0.1 * t], [0, 0, 0, 1]])
        labels = ((u + t) // 3 + v // 2).astype(np.uint8) % K
        labels[(u + v + t) % 11 == 0] = 255
        soft = t == 3
        scores = 1.0 + ((u * 3 + v * 5)[..., None] * np.arange(1, K + 1)) % 7
        yield Frame(
            index=2 * t,
            depth=2 + ((u * 5 + v * 3 + t) % 7 - (u == t) * 9) / 4,
            intrinsics=Intrinsics(fx=5, fy=5, cx=2.5, cy=2.0),
            T_wc=T_wc,
            labels=None if soft else labels,
            scores=scores if soft else None,
        )


def golden(backend="numpy"):
    """The map of these frames: its columns and measures, its summary, and the reports of the frames."""
    fusion = backends.create(backend, voxel_size=2.0, num_classes=K)
    reports = [dataclasses.asdict(fusion.integrate(frame)) for frame in frames()]
    for report in reports:
        for name in ("seconds", "association_seconds", "update_seconds"):
            del report[name]
    table = fusion.table()
    columns = {name: value for name, value in vars(table).items() if hasattr(value, "tolist")}
    columns |= {measure.key: measure.of(table) for measure in measures()}
    return {
        "voxels": {name: column.tolist() for name, column in columns.items()},
        "summary": to_json(summarise(table)),
        "reports": reports,
    }


def golden_city():
    """The built-in city, which its version in `datasets/city` stands for: what stands still, traffic, and labels."""
    from semstab.datasets import open_dataset
    from semstab.datasets.city import GENERATOR_VERSION

    dataset = open_dataset("city", {"width": 96, "height": 54, "frames": 5})
    content = {"version": GENERATOR_VERSION}
    for name in dataset.scenes:
        scene = dataset.scene(name)
        frame = scene.frame(2, "gt")
        labels = {model: scene.frame(2, model).labels for model in ("gt", "sim-steady", "sim-flicker")}
        content[name] = {
            "still": surface_content(scene.town.still),
            "traffic": surface_content(scene.town.moving(3.0, frame.T_wc[:3, 3])),
            "pose": frame.T_wc.tolist(),
            "depth": float(frame.depth.mean()),
            "color": frame.color.mean(axis=(0, 1)).tolist(),
            "labels": {
                model: np.bincount(label_map.ravel(), minlength=8).tolist() for model, label_map in labels.items()
            },
        }
    return content


def surface_content(surface):
    """Of each class the triangles, their area, centre and mean colour, each weighted by area."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    content = {}
    for k in np.unique(surface.classes).tolist():
        of_class = surface.classes == k
        weight = area[of_class, None] / area[of_class].sum()
        content[str(k)] = {
            "triangles": int(of_class.sum()),
            "area": float(area[of_class].sum()),
            "centre": (weight * (a + b + c)[of_class] / 3).sum(axis=0).tolist(),
            "color": (weight * surface.colors[of_class]).sum(axis=0).tolist(),
        }
    return content


def write_benchmark_digests():
    """The digest of each benchmark that ships, benchmarks.json: new versions are added, published ones stay."""
    from semstab.configure import shipped_benchmarks
    from semstab.leaderboard.definition import load_benchmark

    path = FILE.with_name("benchmarks.json")
    stored = json.loads(path.read_text()) if path.exists() else {}
    write_json(path, {name: load_benchmark(name).digest for name in shipped_benchmarks()} | stored)


def write_table_files():
    """The tables of the study of two walls, tables.{csv,md,tex}."""
    sys.path.insert(0, str(FILE.parents[1]))
    from wall_study import wall_study

    with tempfile.TemporaryDirectory() as base:
        result, _ = wall_study(Path(base))
        for suffix, write in {"csv": to_csv, "md": to_markdown, "tex": to_latex}.items():
            write_text(FILE.with_name(f"tables.{suffix}"), "\n".join(write(table) for table in tables(result)))


def write_stable_surface():
    """What docs/stability.md promises, stable.json: names of commands, settings, files and Python."""
    sys.path[:0] = [str(FILE.parents[1]), str(FILE.parents[2] / "scripts")]
    from stable_surface import stable_surface

    lines = (f"{json.dumps(surface)}: {json.dumps(names)}" for surface, names in stable_surface().items())
    write_text(FILE.with_name("stable.json"), "{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    write_json(FILE, golden())
    write_json(FILE.with_name("city.json"), golden_city())
    write_benchmark_digests()
    write_table_files()
    write_stable_surface()
