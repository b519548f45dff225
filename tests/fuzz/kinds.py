"""Every kind of file that is read: a tiny true one, how it is damaged, and the program's own way to read it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import image_files as images
import looking_down as down
import numpy as np
import scan_writers
import test_readers_odm as odm
import tiny_scene
import yaml
from dataset_writers import CLASSES, FORMATS, Format, save_depth_map, write_labels
from kept_kinds import of_kept
from kind import Kind, Read
from posed_config import configure
from rich.console import Console

import semstab
from semstab import AcceptanceThresholds, Events, Frame, Intrinsics, LabelSpace, VoxelTable
from semstab.comparison.differences import contrasts
from semstab.comparison.entries import shared_scenes
from semstab.comparison.opening import open_run, open_runs
from semstab.comparison.pairing import pair
from semstab.comparison.small_summary import save_summary
from semstab.configure import load_config, load_study
from semstab.convert import convert
from semstab.core.files import read_json
from semstab.core.json_form import from_json
from semstab.data.georeference import Georeference, wkt
from semstab.data.records import Record
from semstab.datasets import open_dataset
from semstab.datasets.files.depth import read_depth_map, read_dmap, read_mvei
from semstab.datasets.files.surfaces import Surface
from semstab.datasets.formats.decoders import reads_exr
from semstab.datasets.formats.images import color_size, read_color, read_depth, read_labels, read_mask, read_scores
from semstab.datasets.scannet import read_class_table
from semstab.engine import load_result
from semstab.exports import export
from semstab.gating.gate import gate_config
from semstab.gating.rules import parse
from semstab.models.sam import read_rules
from semstab.models.segearth_ov import read_prompts
from semstab.predict.folder import PredictionFolder
from semstab.report.figures.maps import Overview
from semstab.report.tables import tables
from semstab.report.terminal import print_summary
from semstab.statistics import SpotObservations
from semstab.statistics.cluster_sums import ClusterSums

SHAPE = (12, 16)
CAMERA = Intrinsics(12, 12, 7.5, 5.5)
SWEEPS = {"voxel_size": [0.1, 0.2], "depth_noise": {"values": [0, 0.1], "repeats": 2}}
RGB = np.random.default_rng(1).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)


def kinds(folder: Path) -> list[Kind]:
    """All of them, written into a folder."""
    return [*of_images(folder / "images"), *of_surfaces(folder / "surfaces"), *of_settings(folder / "settings"),
            *of_datasets(folder / "datasets"), *of_results(folder / "results"), *of_kept(folder / "kept")]  # fmt: skip


def of_images(folder: Path) -> Iterator[Kind]:
    """Depth, labels, scores, masks and colour; depth maps of dense reconstructions."""
    folder.mkdir()
    scores = images.SCORES.astype(np.float16)
    khw = functools.partial(read_scores, layout="KHW", size=images.SHAPE)
    contents: dict[str, tuple[bytes, Read]] = {
        "depth.png": (images.saved(images.MILLIMETRES), read_depth),
        "labels.png": (images.saved(images.IDS), functools.partial(read_labels, space=images.SPACE)),
        "palette.png": (images.palette_png(images.IDS), read_labels),
        "rgb.png": (images.saved(images.RGB), functools.partial(read_labels, space=images.SPACE)),
        "mask.png": (images.saved(images.IDS), read_mask),
        "color.png": (images.saved(RGB), read_color),
        "color.jpg": (images.saved(RGB, "JPEG"), read_color),
        "color.tif": (images.tiff_bytes(RGB), read_color),
        "size.jpg": (images.saved(RGB, "JPEG"), color_size),
        "depth.tiff": (images.tiff_bytes(images.METRES), read_depth),
        "depth.npy": (images.npy_bytes(images.METRES), read_depth),
        "depth.npz": (images.npz_bytes(depth=images.METRES), read_depth),
        "labels.npy": (images.npy_bytes(images.IDS), read_labels),
        "scores.npz": (images.npz_bytes(compress=True, scores=scores.transpose(2, 0, 1)), khw),
        "depth.mvei": (odm.mvei(images.METRES), read_mvei),
        "depth.dmap": (odm.dmap(images.METRES, "a.tif"), read_dmap),
        "halves.dmap": (odm.dmap(images.METRES, "a.tif", halves=True), read_dmap),
    }
    if reads_exr():
        contents["depth.exr"] = (cv2.imencode(".exr", images.METRES)[1].tobytes(), read_depth)
    for name, (content, read) in contents.items():
        yield Kind(name, (images.written(folder / name, content),), read)
    save_depth_map(folder / "colmap.bin", images.METRES)
    yield Kind("colmap depth map", (folder / "colmap.bin",), read_depth_map)


def of_surfaces(folder: Path) -> Iterator[Kind]:
    """Meshes, clouds and rasters at which depth is cast."""
    folder.mkdir()
    placed = Georeference(wkt(down.UTM, "crs"), down.OFFSET)
    las = small_las(folder / "points.las")
    files = {
        "mesh.ply": down.write_mesh(folder / "mesh.ply"), "mesh.obj": down.write_mesh(folder / "mesh.obj"),
        "mesh.stl": down.write_mesh(folder / "mesh.stl"), "points.ply": down.write_points(folder / "points.ply"),
        "points.las": las, "points.laz": small_las(folder / "points.laz"),
        "dsm.tif": down.write_raster(folder / "dsm.tif"),
    }  # fmt: skip
    for name, file in files.items():
        georeference = placed if file.suffix in (".las", ".laz", ".tif") else None
        yield Kind(f"surface {name}", (file,), functools.partial(read_surface, georeference=georeference))


def small_las(path: Path, shift: tuple[float, ...] = down.OFFSET) -> Path:
    import laspy

    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales, las.header.offsets = [0.001] * 3, shift
    las.x, las.y, las.z = (part.ravel() + at for part, at in zip(down.grid(3.0), shift, strict=True))
    las.write(path)
    return path


def read_surface(path: Path, georeference: Georeference | None) -> None:
    surface = Surface(path, cell=None, georeference=georeference)
    if len(surface.triangles.faces) < 10_000:
        surface.depth(odm_view())


def odm_view() -> Any:
    from semstab.datasets.files.surfaces import CameraView

    return CameraView(CAMERA, down.pose(0), SHAPE)


def of_settings(folder: Path) -> Iterator[Kind]:
    """Configurations, studies, taxonomies, rules and tables of one's own."""
    folder.mkdir()
    config = configure(tiny_scene.write(folder / "wall"), backends=["numpy"])
    contents: dict[str, tuple[Any, Read]] = {
        "config.yaml": (yaml.safe_load(config.to_yaml()), load_config),
        "study.yaml": ({"dataset": "city", "backends": ["numpy"], "sweeps": SWEEPS}, load_study),
        "taxonomy.yaml": (images.SPACE.to_dict(), LabelSpace.load),
        "rules.yaml": (read_rules(None).model_dump(mode="json"), read_rules),
        "prompts.yaml": (read_prompts(None).model_dump(mode="json"), read_prompts),
    }
    rules = ["alpha drop < 0.02", "class wall: recall > 0.6", "scene wall: class *: recall drop < 1 %"]
    contents["gate.yaml"] = ({"rules": rules, "level": 0.05, "undecided": "pass"}, read_gate)
    wall = {"by": "op", "at_least": 3, "precision": 0.97, "low": 0.95, "voxels": 200, "left": 0.7}
    commit = {"schema": 1, "precision": 0.95, "confidence": 0.95, "voxel_size": 0.25, "left": 0.6}
    contents["commit.yaml"] = (commit | {"classes": {"wall": wall, "door": {"never": True}}}, AcceptanceThresholds.load)
    for name, (content, read) in contents.items():
        (folder / name).write_text(yaml.safe_dump(content))
        yield Kind(name, (folder / name,), read)
    table = folder / "scannet.tsv"
    table.write_text("id\traw_category\tnyu40id\n1\twall\t1\n2\tchair\t5\n3\tfloor\t\n")
    yield Kind("scannet classes", (table,), functools.partial(read_class_table, column="nyu40id"))


def read_gate(file: Path) -> None:
    for rule in gate_config(file).rules:
        parse(rule)


def of_datasets(folder: Path) -> Iterator[Kind]:
    """The text, JSON, YAML and binary files of every dataset, read with the scene that they describe."""
    for name, form in FORMATS.items():
        root = folder / name.replace(", ", "_")
        (root / "seq").mkdir(parents=True)
        frames = [stored(down.frame(k, CAMERA, SHAPE), form.scale) for k in range(2)]
        write_labels(root / "seq", form.write(root / "seq", frames), frames)
        (root / "seq/labels/net/label_space.yaml").write_text(yaml.safe_dump({"classes": CLASSES}))
        yield Kind(name, described(root), functools.partial(read_scene, form=form, root=root))
    for name, of_scans in scan_writers.SCANS.items():
        root = folder / f"scans {name}"
        scan_writers.write_predicted(of_scans, root)
        yield Kind(f"scans {name}", every_file(root), lambda _, f=of_scans, r=root: read_scans(f, r))
    project = odm.write_project(folder / "project", depth="mve")
    odm.write_georeference(project)
    options = {"root": project, "classes": odm.CLASSES, "casts": False}
    yield Kind("odm project", described(project), lambda _: read_frames("odm", options))


def stored(frame: Frame, scale: float | None) -> Frame:
    """With depth that a 16-bit image holds."""
    depth = frame.depth / 10
    return dataclasses.replace(frame, depth=depth if scale is None else np.rint(depth * scale) / np.float32(scale))


def described(root: Path) -> tuple[Path, ...]:
    suffixes = (".txt", ".json", ".yaml", ".bin", ".hdf5", ".db3", ".mcap", ".xml", ".csv", ".pincam", ".traj")
    return tuple(sorted(p for p in root.rglob("*") if p.suffix in suffixes and "depth_maps" not in p.parts))


def every_file(root: Path) -> tuple[Path, ...]:
    return tuple(sorted(path for path in root.rglob("*") if path.is_file()))


def read_scans(form: scan_writers.ScanFormat, root: Path) -> None:
    scene = scan_writers.opened(form, root)
    for index in range(len(scene)):
        scene.frame(index, "net")


def read_scene(_: Path, form: Format, root: Path) -> None:
    camera = [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]
    options = {key: camera if key == "intrinsics" else value for key, value in form.options.items()}
    read_frames(form.dataset, {"root": root, "classes": CLASSES} | options)


def read_frames(dataset: str, options: dict[str, Any]) -> None:
    opened = open_dataset(dataset, options)
    for name in opened.scenes[:2]:
        scene = opened.scene(name)
        for index in range(min(len(scene), 1)):
            scene.frame(index, scene.models[0] if scene.models else None)


def of_results(folder: Path) -> Iterator[Kind]:
    """What a run, a prediction and a conversion leave, and clouds that are classified."""
    folder.mkdir()
    config = configure(tiny_scene.write(folder / "wall"), check=None, events=True, statistics=True)
    run = folder / "run"
    semstab.run(config, out=run, report=False)
    list(convert(config, folder / "converted"))
    predict(folder)
    first: dict[str, Read] = {
        "voxels/*.parquet": VoxelTable.load,
        "events/*.parquet": Events.load,
        "observations/*.parquet": SpotObservations.load,
        "sums/*.parquet": ClusterSums.load,
        "overview/*.npz": Overview.load,
        "units/*.json": lambda file: from_json(Record, read_json(file), file),
        "summary.json": lambda _: read_result(run),
        "manifest.json": lambda _: read_result(run),
        "frames/*.csv": lambda _: semstab.load(run).series(model="a"),
    }
    for pattern, read in first.items():
        if found := sorted(run.glob(pattern)):
            yield Kind(f"run {pattern}", (found[0],), read)
    small = folder / "small.semstab"
    save_summary(open_run(f"{run}:a"), small)
    yield Kind("small summary", (small,), lambda file: compared(file, f"{run}:b"))
    conversion = folder / "converted/wall/conversion.json"
    yield Kind("conversion.json", (conversion,), lambda _: list(convert(config, folder / "converted")))
    yield Kind("predictions.json", (folder / "labels/net/predictions.json",), lambda _: predict(folder))
    onto = functools.partial(export, run, model="a", radius=0.3)
    table = VoxelTable.load(min(run.glob("voxels/a*.parquet"), default=min(run.glob("voxels/*.parquet"))))
    for cloud in (small_cloud(folder / "cloud.ply", table.centers), las_at(folder / "cloud.laz", table.centers),
                  las_at(folder / "cloud.las", table.centers)):  # fmt: skip
        out = folder / f"out{cloud.suffix}"
        yield Kind(f"onto {cloud.name}", (cloud,), lambda file, out=out: onto(out, classify=file))
    codes = folder / "codes.yaml"
    codes.write_text("wall: 6\ndoor: 20\n")
    yield Kind("asprs.yaml", (codes,), lambda file: onto(folder / "coded.las", asprs=file))


def read_result(folder: Path) -> None:
    result = load_result(folder)
    tables(result)
    if result.select():
        print_summary(result, Console(file=StringIO()))


def compared(*paths: Path | str) -> None:
    runs = open_runs(paths)
    for scene in shared_scenes(runs):
        entries = [run.scenes[scene] for run in runs]
        contrasts(pair(entries, [run.name for run in runs]), *entries, 1)


def predict(folder: Path) -> None:
    predicted = PredictionFolder(folder / "labels" / "net", "labels", {}, {}, None)
    try:
        if not predicted.has("0", "digest"):
            predicted.write("0", "digest", np.zeros((3, 3), np.uint8), 0.1)
    finally:
        predicted.close()


def small_cloud(path: Path, points: Any) -> Path:
    head = f"ply\nformat binary_little_endian 1.0\ncomment mine\nelement vertex {len(points)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(head.encode() + points.astype("<f8").tobytes())
    return path


def las_at(path: Path, points: Any) -> Path:
    import laspy

    las = laspy.LasData(laspy.LasHeader(point_format=7, version="1.4"))
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = points.T
    las.write(path)
    return path
