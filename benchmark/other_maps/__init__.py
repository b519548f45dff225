"""Compare the labelled clouds and voxel maps of other programs with the map of a run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semstab.core.files import only_writer
from semstab.core.types import Float64, Int64
from semstab.data.georeference import INSTALL, Georeference
from semstab.engine.folder import load_result, model_of
from semstab.errors import ConfigError, DataError, MissingDependencyError
from semstab.exports.voxels import ExportedUnit, ExportedVoxels
from semstab.other_maps.agreement import (
    ClassMatch,
    DifferingPlace,
    MapAgreement,
    RunMap,
    StratumAgreement,
    Voxelwise,
    agreement,
)
from semstab.other_maps.classes import NONE, RunClasses, labels_of
from semstab.other_maps.clouds import Cloud, System, read_cloud
from semstab.other_maps.placing import UNITS, MapPlacement, better_placement, fused, index_of, on_surface

__all__ = ["ClassMatch", "DifferingPlace", "MapAgreement", "MapComparison", "StratumAgreement", "compare_maps"]

SYSTEMS: tuple[System, ...] = ("scene", "projection")

STEP = 0.5
"""The distance of points that stand for the surface of a mesh, in voxels."""


@dataclass(frozen=True, eq=False)
class MapComparison:
    """Maps of other programs, each compared with the map of a run.

    Attributes:
        run: The map of the run.
        first: Some of its voxels, with the colours of its classes and where they lie.
        maps: The comparisons.
        scene: Name of the scene.
    """

    run: RunMap
    first: ExportedVoxels
    maps: tuple[Voxelwise, ...]
    scene: str

    @property
    def agreements(self) -> tuple[MapAgreement, ...]:
        """The numbers of each map."""
        return tuple(voxelwise.agreement for voxelwise in self.maps)

    def __repr__(self) -> str:
        lines = [f"<MapComparison with {self.run.name} on {self.scene}>"]
        lines += [
            f"  {row.name}: {row.same:.1%} of {row.compared:,} labels agree; it holds {row.covers:.1%} of the voxels"
            for row in self.agreements
        ]
        return "\n".join(lines)


def compare_maps(
    run: str | Path,
    *others: str | Path,
    scene: str | None = None,
    model: str | None = None,
    backend: str | None = None,
    field: str | None = None,
    classes: str | Path | None = None,
    colours: str | Path | None = None,
    unit: str = "m",
    axes: str | None = None,
    shift: str | None = None,
    frame: str | None = None,
    out: str | Path | None = None,
) -> MapComparison:
    """Compare labelled clouds, meshes or voxel maps of other programs with the map of a run.

    The points of a file are counted into voxels of the run: a voxel has the class of most of its points. A file is
    never moved unless an option says so; if it fits much better otherwise, `MapAgreement.better` says how.

    Args:
        run: Folder of the run, or FOLDER:MODEL.
        others: PLY, LAS, LAZ, NPZ or Parquet files.
        scene: Scene of the unit; may be left out if there is one.
        model: Model of the unit; may be left out if there is one.
        backend: Backend of the unit, the base backend if it is not given.
        field: The field that holds the class; 'colour' for colours.
        classes: Names of ids: a YAML file ID: NAME, a taxonomy file, or a taxonomy that ships.
        colours: Colours of classes: a YAML file NAME: [r, g, b], a taxonomy file, or CSV with name, red, green, blue.
        unit: Unit of the files' coordinates: m, cm, mm.
        axes: The files' axes that become x, y, z, as 'x,-z,y'.
        shift: Metres that are added to x, y, z, as '0.05,0.05,0.05'.
        frame: 'scene' or 'projection', if a file does not say it; the projection if the run has a georeference.
        out: A folder for tables, places (CSV, GeoJSON), pictures and a recording.

    Raises:
        ConfigError, DataError, MissingDependencyError: For files that cannot be compared, in one line.

    Examples:
        >>> [file] = semstab.export("run:sim-steady", "map.ply")
        >>> comparison = semstab.compare_maps("run:sim-steady", file.path)
        >>> comparison.agreements[0].same
        1.0
    """
    if not others:
        raise ConfigError("name a map of another program: PLY, LAS, LAZ, NPZ or Parquet")
    if frame not in (None, *SYSTEMS):
        raise ConfigError(f"--frame {frame}: not known; it is scene or projection")
    MapPlacement.parse(unit, axes, shift, "scene")
    folder, model = model_of(run, model)
    result = load_result(folder)
    record = result.record(scene=scene, model=model, backend=backend)
    first = ExportedUnit(result, record, columns=("op",)).first
    target = RunClasses.from_taxonomy(first.classes, first.colors, first.taxonomy)
    ours, compared = RunMap.from_record(record, first.classes), []
    for path, name in zip(map(Path, others), _names(others), strict=True):
        cloud = read_cloud(path, field)
        system = _system(cloud, frame, first.georeference)
        placement = MapPlacement.parse(unit, axes, shift, system)
        labels = labels_of(
            cloud, target, None if classes is None else str(classes), None if colours is None else Path(colours)
        )
        voxelwise = _compared(cloud, labels.row, ours, placement, first.georeference, name)
        compared.append(
            replace(voxelwise, agreement=replace(voxelwise.agreement, notes=(*_frame_notes(cloud), *labels.notes)))
        )
    comparison = MapComparison(ours, first, tuple(compared), record.unit.scene)
    if out is not None:
        from semstab.other_maps.written import write

        with only_writer(Path(out) / "maps"):
            write(comparison, Path(out))
    return comparison


def _names(paths: Sequence[str | Path]) -> list[str]:
    """Return a short name for each file: without its folder, if no two are called so."""
    names = [Path(other).name for other in paths]
    return names if len(set(names)) == len(names) else [str(other) for other in paths]


def _system(cloud: Cloud, frame: str | None, georeference: Georeference | None) -> System:
    """Return the system of a cloud's coordinates: as the option says, else the file, else that of the run's exports.

    Raises:
        DataError: If the file states another reference system than the run's.
    """
    if frame is not None:
        return "projection" if frame == "projection" else "scene"
    if cloud.stated.crs:
        if georeference is None:
            raise DataError(
                f"{cloud.path}: is in {_short(cloud.stated.crs)}, and the run has no georeference; give its dataset one"
                " (crs, offset), or say --frame scene if the coordinates are the scene's"
            )
        there, here = _epsg(cloud.stated.crs), _epsg(georeference.crs)
        if there is not None and here is not None and there != here:
            raise DataError(f"{cloud.path}: the map is in EPSG:{there}, the run in EPSG:{here}; reproject the map")
    if cloud.stated.system is not None:
        return cloud.stated.system
    return "scene" if georeference is None else "projection"


def _short(crs: str) -> str:
    match = re.search(r'"([^"]*)"', crs)
    return match[1] if match else crs[:60]


def _epsg(crs: str) -> int | None:
    """Return the EPSG number of a reference system in WKT or by its name; None if it has none."""
    if match := re.search(r"\(EPSG:(\d+)\)$", crs):
        return int(match[1])
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ImportError as error:
        raise MissingDependencyError(f"reference systems need pyproj; {INSTALL}") from error
    try:
        number: int | None = CRS.from_user_input(crs).to_epsg()
    except CRSError:
        return None
    return number


def _frame_notes(cloud: Cloud) -> tuple[str, ...]:
    return () if cloud.faces is None else ("a mesh: points on its triangles, half a voxel apart, stand for it",)


def _compared(
    cloud: Cloud, row: Int64, run: RunMap, placement: MapPlacement, georeference: Georeference | None, name: str
) -> Voxelwise:
    points, size = cloud.points, run.grid.size
    if cloud.faces is not None:
        points, row = on_surface(points, row, cloud.faces, STEP * size / UNITS[placement.unit])
    placed = placement(points, georeference)
    better = better_placement(points, row, run.grid, placement, georeference)
    inside = run.grid.rows(index_of(placed, size)) != NONE
    if not inside.any():
        raise _outside(cloud, placed, run, better.line() if better else "")
    theirs = fused(placed, row, size, len(run.classes))
    numbers = len(points), float(np.mean(~inside)), float(np.mean(row == NONE))
    voxelwise = agreement(run, theirs, name, *numbers, placement)
    return replace(voxelwise, agreement=replace(voxelwise.agreement, better=better.line() if better else ""))


def _outside(cloud: Cloud, placed: Float64, run: RunMap, better: str) -> DataError:
    """Return the error of a cloud without a point in a voxel of the run."""
    size, index = run.grid.size, run.grid.index
    there, here = (
        " to ".join("(" + ", ".join(f"{value:.1f}" for value in corner) + ")" for corner in box)
        for box in (
            (placed.min(axis=0), placed.max(axis=0)),
            (index.min(axis=0) * size, (index.max(axis=0) + 1) * size),
        )
    )
    mend = f"it {better}" if better else "bring it into the run's coordinates (--frame, --unit, --axes, --shift)"
    return DataError(f"{cloud.path}: no point lies in a voxel of the run: it spans {there} m, the map {here}; {mend}")
