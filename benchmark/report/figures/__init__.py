"""Draw figures for a paper, PNG or SVG, as wide as its column or page: `semstab-bench show RUN --figures png`."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from semstab.core.files import keep_only
from semstab.data.measures import measures
from semstab.data.records import OVERVIEW, Record, Result
from semstab.data.results import slug
from semstab.report.figures.distributions import (
    Histograms,
    draw_ecdf,
    draw_persistence,
    draw_sweep,
    informative,
    together,
)
from semstab.report.figures.maps import Overview, TopViews, draw_overview, draw_stability
from semstab.report.figures.style import Figure
from semstab.report.filter_study import of_interest
from semstab.report.means import ENOUGH, by_model, complete_scenes, levels, swept

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


__all__ = ["Figure", "TopViews", "figures", "write_figures"]


def write_figures(result: Result, folder: str | Path, out: Path | None = None, *, svg: bool = False) -> list[Path]:
    """Write OUT/NAME.png, and .svg on request, for every figure that the result has records for; return the paths.

    Without `out` they are written into FOLDER/figures, where earlier figures are removed.
    """
    target = out or Path(folder) / "figures"
    ordered = sorted(figures(result, folder), key=lambda figure: figure.unit)  # a unit's figures read its voxels once
    written = [path for figure in ordered for path in figure.save(target, svg=svg)]
    if out is None:
        keep_only(written, target)
    return written


def figures(result: Result, folder: str | Path) -> list[Figure]:
    """Return every figure in the paper's order, drawn only when it is saved.

    Saved frames are taken from the study folder.
    """
    views, result = TopViews(), of_interest(result)
    with_voxels = [record for record in result.select() if record.voxels_file is not None]
    return [
        *_overviews(result, with_voxels, views, Path(folder) / OVERVIEW),
        *_distributions(with_voxels, views),
        *_maps(result, with_voxels, views),
        *_sweeps(result),
    ]


def _overviews(result: Result, with_voxels: list[Record], views: TopViews, folder: Path) -> Iterator[Figure]:
    """Yield one figure for each model, of the first scene that has a saved frame."""
    for model, records in by_model(with_voxels).items():
        for record in records:
            path = folder / f"{slug(record.unit.scene, model)}.npz"
            if record.unit.scene in result.up and path.exists():
                yield _overview(record, result, views, path)
                break


def _overview(record: Record, result: Result, views: TopViews, path: Path) -> Figure:
    scene, model = record.unit.scene, record.unit.model
    up, georeference = result.up[scene], result.georeference.get(scene)
    return Figure(
        slug("overview", scene, model),
        f"Overview: {scene}, {model}",
        "A frame, its prediction, and the map of all sampled frames. The map is seen from above, below a ceiling if"
        " the scene has one, or from the side if that shows more. It shows the dominant class of the topmost voxels, in"
        " the colours of the prediction.",
        f"A camera image of {scene}, the classes that {model} predicts for it, and the fused map from above in the"
        " same colours.",
        lambda: draw_overview(views.above(record, up), Overview.load(path), georeference),
        unit=record.unit.slug,
    )


def _distributions(with_voxels: list[Record], views: TopViews) -> Iterator[Figure]:
    if not with_voxels:
        return

    @functools.cache
    def of_all() -> dict[str, dict[str, Histograms]]:
        """Return the histograms of each model and scene."""
        return {
            model: {record.unit.scene: views.sums(record) for record in records}
            for model, records in by_model(with_voxels).items()
        }

    def ecdf(model: str) -> Canvas:
        ends = informative(histograms for scenes in of_all().values() for histograms in scenes.values())
        return draw_ecdf(of_all()[model], ends)

    for model in by_model(with_voxels):
        yield Figure(
            slug("ecdf", model),
            f"The measures by scene: {model}",
            "Empirical distributions over the voxels of each scene. A measure that is better when high is shown by its"
            " distance from the best value: 1 - VSS is disagreement. SBD is that of the voxels seen twice or more."
            " Dashed: the recurrent voxels of all scenes. The x axes are the same for each model and end where every"
            " curve has reached 99% of the voxels.",
            f"A panel for each measure, with a cumulative curve for each scene, for {model}.",
            partial(ecdf, model),
        )
    yield Figure(
        "persistence",
        "The measures against observation persistence",
        "The mean and interquartile range over the voxels of all scenes with that OP (above 8 in bins that widen by a"
        " quarter), and the number of these voxels. Where more than three quarters of the voxels agree fully, the range"
        " is a line.",
        "For each model, a curve of every measure against OP on a logarithmic axis, and the number of voxels.",
        lambda: draw_persistence({name: together(scenes.values()) for name, scenes in of_all().items()}),
    )


def _maps(result: Result, with_voxels: list[Record], views: TopViews) -> Iterator[Figure]:
    panels = " and ".join(measure.title for measure in measures() if measure.panel)
    for record in with_voxels:
        scene, model = record.unit.scene, record.unit.model
        if scene in result.up:
            yield Figure(
                slug("stability_map", scene, model),
                f"Stability from above: {scene}, {model}",
                "The topmost voxel of each column along the up axis, below a ceiling if the scene has one; of a wall,"
                f" the foremost voxel. (a) shows its stability category, the other panels show {panels}. A grey voxel"
                " was seen once and has no category. An arrow on a scale marks values beyond its end.",
                f"Maps of {scene} from above with the stability category, {panels} of {model}'s voxels.",
                partial(_draw_map, record, result, views),
                unit=record.unit.slug,
            )


def _draw_map(record: Record, result: Result, views: TopViews) -> Canvas:
    scene = record.unit.scene
    return draw_stability(views.above(record, result.up[scene]), result.georeference.get(scene))


def _sweeps(result: Result) -> Iterator[Figure]:
    for sweep in swept(result):
        models = [name for name in result.models if complete_scenes(result, sweep.name, name)]
        if models:
            yield Figure(
                f"sensitivity_{sweep.name}",
                f"Sensitivity to {sweep.title}",
                "The share of recurrent voxels, and every measure over all voxels (solid) and over the recurrent ones"
                f" (dashed; not drawn for fewer than {ENOUGH:,}), pooled over scenes. Bars are the standard deviation"
                " over repeats. The axes of VSS and margin span 0.1 or more, the others begin at 0. Read every panel"
                " together with (a): the set of averaged voxels changes along the sweep.",
                f"Panels against {sweep.title}: the recurrent share and each measure, for all voxels and for the"
                " recurrent ones.",
                partial(draw_sweep, sweep, {name: levels(result, sweep.name, name) for name in models}),
            )
