"""Files for a later start or a later command: tiles, casts, predictions, comparisons, recordings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import predicted_scene
import rerun as rr
import tiny_scene
import yaml
from kind import Kind
from posed_config import configure

import semstab
from semstab import Intrinsics, LabelSpace, VoxelTable
from semstab.compare_runs import compare, load_comparison
from semstab.configure import load_config, resolve
from semstab.conformance import case_folder, compared
from semstab.datasets import open_dataset
from semstab.datasets.files.surfaces import CameraView, Casts
from semstab.engine.series import NUMBERS
from semstab.engine.tiles import TileResult
from semstab.engine.units import make_plan
from semstab.errors import DataError
from semstab.models import Model, Prediction
from semstab.models.names import class_names
from semstab.predict.filters import parse
from semstab.predict.producer import Producer
from semstab.recording import Recording
from semstab.recording.target import is_whole
from semstab.recording.timeline import Clock, log_file


def of_kept(folder: Path) -> Iterator[Kind]:
    """All of them; each is read again, or made again where it is damaged."""
    folder.mkdir()
    wall = tiny_scene.write(folder / "wall")
    config = configure(wall, check=None, tile_size=8)
    tiled = folder / "tiled"
    semstab.run(config, out=tiled, observers=[Recording(tiled / "recording.rrd")], report=False)
    tile = min(tiled.glob("voxels/*/*.parquet"))
    yield Kind("tile of a map", (tile,), lambda file: VoxelTable.load(file.parent))
    task = make_plan(config).tasks[0]
    result = folder / "8_frames.npz"
    TileResult({"a.csv": "0"}, series=np.zeros((3, len(NUMBERS))), sums={"strata": np.zeros(4)}).save(result)
    yield Kind("result of a tile", (result,), TileResult.load)
    view = CameraView(Intrinsics(12, 12, 7.5, 5.5), np.eye(4), (12, 16))
    casts = Casts(folder / "casts", b"surface")
    casts.put(view, np.ones((12, 16), np.float32))
    yield Kind("cast depth", (next((folder / "casts").rglob("*.cast")),), lambda _: casts.get(view))
    flight = predicted_scene.write(folder / "predicted_on", frames=1)
    maps = folder / "predictions"
    produced(flight, maps)
    files = (maps / "labels/halves/000.png", maps / "scores/halves/000.npz", maps / "labels/halves/predictions.json")
    for file in files:
        yield Kind(f"predicted {file.name}", (file,), lambda _: produced(flight, maps))
    compare(f"{tiled}:a", f"{tiled}:b", out=folder / "compared")
    yield Kind("comparison.json", (folder / "compared/comparison.json",), lambda file: load_comparison(file.parent))
    yield Kind("recording.rrd", (tiled / "recording.rrd",), is_whole)
    series = min(tiled.glob("frames/*.csv"))
    stream = rr.RecordingStream("fuzz")
    yield Kind("series of a recording", (series,), lambda file: log_file(stream, task.units[0], task, file, Clock()))
    yield from of_text(folder)


def produced(flight: Path, maps: Path) -> Prediction:
    """The labels and scores of its first frame."""
    scene = open_dataset("posed_folder", {"root": flight}).scene(flight.name)
    return Producer(scene, Halves(), maps, "halves", scores=True).read(0, scores=True)


class Halves(Model):
    """A model that is as sure of each of two classes."""

    label_space = LabelSpace("two", ("a", "b"))
    gives_scores = True

    def predict(self, images, *, scores=False):
        """See `Model`."""
        half = np.full((*images[0].shape[:2], 2), 0.5, np.float32)
        return [Prediction(image[..., 0] % 2, half if scores else None) for image in images]

    def identity(self):
        """See `Model`."""
        return {"halves": 1}


def of_text(folder: Path) -> Iterator[Kind]:
    """Names of classes, filters, tables of outside programs, predictions over filters."""
    names = folder / "names.txt"
    names.write_text("wall\ndoor\nwindow\n")
    yield Kind("names of classes", (names,), lambda file: class_names(str(file)))
    chains = folder / "filters.txt"
    chains.write_text("ema:0.6\nvote:5\nguided:4\nema-warped:0.5\n")
    yield Kind("filters", (chains,), read_filters)
    flight = predicted_scene.write(folder / "flight", frames=2)
    model = {"model": "colour-clusters", "filters": ["ema:0.6", "guided:4"]}
    inner = {"name": "posed_folder", "options": {"root": str(flight)}}
    content = {"dataset": {"name": "predicted", "options": {"dataset": inner, "models": [model]}}, "top_k": 2}
    (folder / "predicted.yaml").write_text(yaml.safe_dump(content))
    yield Kind("predicted.yaml", (folder / "predicted.yaml",), open_predicted)
    case = case_folder("drift")
    table = folder / "table.csv"
    table.write_bytes((case / "expected.csv").read_bytes())
    yield Kind("table of a program", (table,), lambda file: read_table(case, file))


def read_filters(file: Path) -> None:
    """A filter a line."""
    for line in file.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
        parse(line)


def open_predicted(file: Path) -> None:
    """The scene and its labels' names."""
    dataset = resolve(load_config(file)).dataset
    opened = open_dataset(dataset.name, dataset.options)
    opened.scene(opened.scenes[0]).models  # noqa: B018


def read_table(case: Path, file: Path) -> None:
    """What is wrong with it is told, not raised."""
    if problem := compared(case, file):
        raise DataError(problem)
