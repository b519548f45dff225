"""The study's figures: what they are drawn from, against plain recomputation, and the files that come out."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from records import record, study, voxels
from wall_study import MODELS, drawn_walls, wall_study

from semstab import VoxelTable, backends
from semstab.data.kernels import put_topmost
from semstab.data.labels import palette
from semstab.data.measures import SBD, SBD_MAX, VSS, measures
from semstab.data.topdown import EMPTY, level_axes, top_down
from semstab.errors import DataError
from semstab.metrics import CATEGORY_COLORS, categories, dominant, op, sbd
from semstab.report.figures import figures
from semstab.report.figures.distributions import (
    BINS,
    OP_BOUNDS,
    by_op,
    distance,
    draw_ecdf,
    draw_persistence,
    draw_sweep,
    ecdf,
    histograms,
    informative,
    op_position,
    together,
    upper_ends,
)
from semstab.report.figures.maps import Overview, draw_overview, draw_stability, scale_length
from semstab.report.figures.style import COLUMN, DPI, PAGE, legend_columns
from semstab.report.figures.topdown import FromAbove
from semstab.report.means import ENOUGH, describe, levels
from semstab.testing import SEQUENCES, as_frames, checks

SURE, SPLIT = [1, 0, 0], [3, 1, 0]
PALETTE = np.array([[200, 0, 0], [0, 200, 0], [0, 0, 200]], dtype=np.uint8)


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return wall_study(tmp_path_factory.getbasetemp())[0]


def of_table(table, up):
    return top_down(table.centers, table.voxel_size, up)[:2]


def at(index, r=1.0, **columns):
    """A map with voxels at these indices (n, 3), in any order, and these columns."""
    index = np.asarray(index)
    order = np.lexsort(index.T[::-1])
    n, zeros = len(index), np.zeros(len(index))
    given = {"op": np.ones(n), "evidence": np.tile(SURE, (n, 1)), "drift_sum": zeros} | columns
    given = {name: np.asarray(value)[order] for name, value in given.items()}
    rest = dict.fromkeys(("pixels", "first_frame", "last_frame", "self_sum", "frame_entropy_sum"), zeros)
    return VoxelTable(*index[order].T, **given, **rest, voxel_size=r, classes=("a", "b", "c"))


def test_the_bins_of_op_widen_and_a_long_legend_takes_more_lines():
    assert OP_BOUNDS[:9].tolist() == list(range(1, 10))
    steps = np.diff(OP_BOUNDS[8:].astype(float))
    assert (steps >= 1).all()
    assert (steps <= 0.25 * OP_BOUNDS[8:-1] + 0.5).all()
    assert OP_BOUNDS[-1] >= 2**31
    assert op_position()[:8] == pytest.approx(range(1, 9))
    names = [f"a model with a long name {k}" for k in range(8)]
    assert legend_columns(names, PAGE) < legend_columns(["a", "b", "c", "d", "e", "f", "g", "h"], PAGE) == 8


@checks
@given(SEQUENCES)
def test_histograms_say_what_the_voxels_say(sequence):
    table = fused(sequence)
    for measure, counts in histograms(table).items():
        values, bin_width = measure.of(table), measure.largest / BINS + 1e-9
        defined, far = ~np.isnan(values), distance(measure, values)
        mean, low, _ = by_op(measure, counts)
        for k, times in enumerate(range(1, 9)):
            here = defined & (op(table) == times)
            assert counts[k].sum() == here.sum()
            if here.any():
                assert mean[k] == pytest.approx(values[here].mean(), abs=bin_width / 2)
                nearest = distance(measure, np.quantile(far[here], 0.25, method="inverted_cdf"))
                assert low[k] == pytest.approx(nearest, abs=bin_width)
        grid = np.arange(0, BINS + 1, 50)
        ends = upper_ends(measure)[grid]
        expected = [np.mean(far[defined] <= end + 1e-9) if defined.any() else 0 for end in ends]
        assert ecdf(counts)[grid] == pytest.approx(expected)


def fused(sequence):
    backend = backends.create("numpy", voxel_size=1.0, num_classes=3)
    for frame in as_frames(sequence):
        backend.integrate(frame)
    return backend.table()


@checks
@given(SEQUENCES)
def test_no_voxel_drifts_further_than_two_contradicting_frames(sequence):
    drift = sbd(fused(sequence))
    assert (drift[~np.isnan(drift)] <= SBD_MAX + 1e-12).all()
    assert pytest.approx(-(0.75 * math.log2(0.75) + 0.25 * math.log2(0.25)) - 0.5) == SBD_MAX


def test_histograms_add_up():
    groups = (5, 1, SURE), (3, 9, SPLIT, 0.1), (2, 4, SPLIT, 0.2), (7, 2, SURE)
    added = together(map(histograms, (voxels(*groups[:2]), voxels(*groups[2:]))))
    direct = histograms(voxels(*groups))
    assert set(added) == set(measures())
    assert all(np.array_equal(counts, direct[measure]) for measure, counts in added.items())


def test_ecdfs_leave_the_others_out_and_end_where_nearly_all_voxels_are():
    counts = histograms(voxels((6, 1, SURE), (3, 3, SURE), (1, 3, SPLIT)))[VSS]
    assert (ecdf(counts)[0], ecdf(counts, 3)[0], ecdf(counts, 3)[BINS // 4]) == (0.9, 0.75, 1.0)
    ends = informative([histograms(voxels((99, 2, SURE, 0.1), (1, 2, [1, 1, 0], 0.3)))])
    assert ends[VSS] == 0.06
    assert ends[SBD] == pytest.approx(0.1, abs=SBD_MAX / BINS)


@checks
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda up: np.linalg.norm(up) > 0.1))
def test_level_axes_are_right_handed_unit_vectors(up):
    right, ahead, above = level_axes(up)
    R = np.stack([right, ahead, above])
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    assert above @ np.array(up) == pytest.approx(np.linalg.norm(up))


AXES = {
    (0.0, 0.0, 1.0): lambda i: (i[1], i[0], i[2]),  # ahead, right, up of an index
    (0.0, 0.0, -1.0): lambda i: (-i[1], i[0], -i[2]),
    (0.0, -1.0, 0.0): lambda i: (i[2], i[0], -i[1]),
    (0.0, 2.0, 0.0): lambda i: (-i[2], i[0], i[1]),
    (1.0, 0.0, 0.0): lambda i: (i[2], i[1], i[0]),
}


@pytest.mark.parametrize("up", AXES)
@checks
@given(st.sets(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=40))
def test_the_topmost_voxel_of_each_column(up, index):
    table = at(list(index))
    image, cell = of_table(table, up)
    tops = {}
    for row, i in enumerate(table.index):
        ahead, right, height = (int(x) for x in AXES[up](i))
        tops[ahead, right] = max(tops.get((ahead, right), (-99, -1)), (height, row))
    farthest, leftmost = max(a for a, _ in tops), min(r for _, r in tops)
    expected = np.full(image.shape, EMPTY)
    for (ahead, right), (_, row) in tops.items():
        expected[farthest - ahead, right - leftmost] = row
    assert cell == 1.0
    assert np.array_equal(image, expected)


@pytest.mark.parametrize("up", [(0.05, 0.02, 1.0), (0.3, -0.2, 1.0)])
def test_a_tilted_floor_has_no_holes(up):
    """A floor at right angles to up, in voxels of a grid that is not."""
    right, ahead, above = level_axes(up)
    a, b = np.meshgrid(np.arange(-6, 6, 0.05), np.arange(-4, 4, 0.05))
    points = a[..., None] * right + b[..., None] * ahead + 0.5 * above
    image, _ = of_table(at(np.unique(np.floor(points.reshape(-1, 3) / 0.2).astype(int), axis=0), r=0.2), up)
    inside = image[3:-3, 3:-3]
    assert inside.shape[0] > 30
    assert (inside != EMPTY).all()


def test_large_maps_have_large_cells_and_lone_voxels_far_away_are_cut_off():
    table = at([(x, 0, x % 7) for x in range(40)])
    image, cell, corner = top_down(table.centers, 1.0, (0, 0, 1), largest=10)
    assert corner == (0.0, 0.0)
    assert cell == 4.0
    assert image.shape == (1, 10)
    assert [table.iz[row] for row in image[0][:3]] == [3, 6, 4]
    plate = [(x, y, 0) for x in range(40) for y in range(40)]
    image, _ = of_table(at([*plate, (10_000, 0, 0), (0, -10_000, 0)]), (0, 0, 1))
    assert image.shape == (40, 40)


@pytest.mark.parametrize(("width", "length"), [(100, 20), (8, 2), (4.1, 1), (0.6, 0.1), (1999, 200)])
def test_a_scale_bar_has_a_round_length(width, length):
    assert scale_length(width) == pytest.approx(length)


def pixels(axes):
    (image,) = axes.get_images()
    return image.get_array()


def test_a_map_has_the_colours_of_its_categories_and_nothing_is_white():
    columns = {"op": [1, 4, 4], "evidence": [SURE, [2, 2, 0], [4, 0, 0]], "drift_sum": [0, 0.6, 0]}
    table = at([(0, 0, 0), (1, 0, 0), (2, 0, 0)], **columns)
    kind, drift, doubt, *_ = draw_stability(FromAbove.from_table(table, (0, 0, 1))).axes
    assert pixels(kind)[0].tolist() == [list(CATEGORY_COLORS[k]) for k in categories(table)]
    assert pixels(drift)[0, 0, :3].tolist() == pixels(doubt)[0, 0, :3].tolist() == [204, 204, 204]
    assert pixels(drift)[0, 2, :3].tolist() != pixels(drift)[0, 1, :3].tolist() != [204, 204, 204]
    apart = at([(0, 0, 0), (2, 0, 0)], op=[3, 3])
    for axes in draw_stability(FromAbove.from_table(apart, (0, 0, 1))).axes[
        : 1 + sum(measure.panel for measure in measures())
    ]:
        assert pixels(axes)[0, 1, :3].tolist() == [255, 255, 255]


def test_the_overview_is_in_one_palette():
    above = FromAbove.from_table(at([(0, 0, 0), (1, 0, 0)], evidence=[[0, 1, 0], [0, 0, 1]]), (0, 0, 1))
    overview = Overview(7, np.array([[0, 1], [2, 255]]), np.zeros((2, 2, 3), np.uint8), PALETTE)
    image, prediction, fused_map = draw_overview(above, overview).axes
    assert [axes.get_title(loc="left")[:3] for axes in (image, prediction, fused_map)] == ["(a)", "(b)", "(c)"]
    assert pixels(prediction).tolist() == [[[200, 0, 0], [0, 200, 0]], [[0, 0, 200], [255, 255, 255]]]
    assert pixels(fused_map)[0].tolist() == [PALETTE[k].tolist() for k in dominant(above.table)]
    assert len(draw_overview(above, dataclasses.replace(overview, color=None)).axes) == 2


def test_a_sweep_shows_all_voxels_and_recurrent_ones(walls):
    found = {name: levels(walls, "depth_noise", name) for name in MODELS}
    share, stability, *_ = draw_sweep(describe("depth_noise"), found).axes
    lines = [container.lines[0].get_ydata() for container in stability.containers]
    expected = [
        [level.mean(lambda p, group=group: getattr(p, group)[VSS]) for level in levels_]
        for levels_ in found.values()
        for group in ("every", "recurrent")
    ]
    assert np.array(lines) == pytest.approx(np.array(expected))
    assert [label.get_text() for label in share.get_xticklabels()] == ["0", "1"]
    shares = share.containers[0].lines[0].get_ydata()
    assert shares == pytest.approx([100 * level.mean(lambda p: p.recurrent.share) for level in found["calm"]])


def test_curves_have_the_means_of_the_voxels_and_none_of_few_recurrent_ones():
    few = record(voxels((ENOUGH - 1, 3, SPLIT)), "frame_count", 5)
    many = record(voxels((ENOUGH, 3, SPLIT)), "frame_count", 10)
    found = {"m": levels(study(few, many), "frame_count", "m")}
    every, recurrent = draw_sweep(describe("frame_count"), found).axes[1].containers
    assert (list(every.lines[0].get_xdata()), list(recurrent.lines[0].get_xdata())) == ([0, 1], [1])
    found = histograms(voxels((ENOUGH, 1, SURE), (ENOUGH, 2, SPLIT, 0.2), (5, 4, [1, 1, 0], 0.1)))
    stability, drift, *_, counts = draw_persistence({"m": found}).axes
    mean, few = stability.get_lines()
    assert mean.get_xdata().tolist() == pytest.approx([1, 2, 4])
    assert mean.get_ydata().tolist() == pytest.approx([1, 0.75, 0.5], abs=1 / BINS)
    assert few.get_xdata().tolist() == pytest.approx([4])
    assert drift.get_lines()[0].get_ydata().tolist() == pytest.approx([math.nan, 0.2, 0.1], nan_ok=True, abs=1 / BINS)
    assert [tick for tick in counts.get_xticks() if tick <= 4] == [1, 2, 3, 4]
    scenes = {name: histograms(voxels((n, 3, SPLIT, 0.1), (5, 1, SURE))) for name, n in (("x", 5), ("y", 15))}
    disagreement, *_ = draw_ecdf(scenes, informative(scenes.values())).axes
    at_zero = [line.get_ydata()[0] for line in disagreement.get_lines()]
    assert at_zero == pytest.approx([0.5, 0.25, 0.0])


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return drawn_walls(tmp_path_factory.getbasetemp())


def test_every_figure_is_written_in_the_same_bytes(drawn, tmp_path):
    result, folder, paths = drawn
    names = [figure.name for figure in figures(result, folder)]
    assert names == [
        "overview__often__calm", "ecdf__calm", "persistence", "stability_map__often__calm",
        "stability_map__rarely__calm", "sensitivity_voxel_size", "sensitivity_depth_noise", "sensitivity_frame_count",
    ]  # fmt: skip
    assert set(paths) == {folder / "figures" / f"{name}.{suffix}" for name in names for suffix in ("png", "svg")}
    result, folder, _ = drawn
    (figure,) = (f for f in figures(result, folder) if f.name == "stability_map__often__calm")
    for path in figure.save(tmp_path):
        assert path.read_bytes() == (folder / "figures" / path.name).read_bytes()


def test_figures_have_texts_and_the_width_of_a_column_or_page_and_svg_no_date(drawn):
    for path in drawn[2]:
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert image.width in (round(COLUMN * DPI), round(PAGE * DPI))
                assert image.height <= 8 * DPI
        else:
            assert ET.parse(path).getroot().tag.endswith("svg")
            assert "date" not in path.read_text(encoding="utf-8")
    for figure in figures(*drawn[:2]):
        assert figure.title
        assert figure.caption.endswith(".")
        assert len(figure.alt) > 40


def test_without_an_up_axis_there_is_no_map_and_of_nothing_no_figure(drawn):
    result, folder, _ = drawn
    names = [figure.name for figure in figures(dataclasses.replace(result, up={"often": (0.0, -1.0, 0.0)}), folder)]
    assert "stability_map__often__calm" in names
    assert "stability_map__rarely__calm" not in names
    assert figures(study(), folder) == []


def test_a_damaged_frame_file_is_one_line(tmp_path):
    np.savez(tmp_path / "a.npz", frame=0, labels=np.zeros((2, 2)))
    np.savez(tmp_path / "b.npz", frame=0, labels=np.array([{}], dtype=object), palette=PALETTE)
    for k, content in enumerate((b"", b"not an archive", b"PK\x03\x04broken")):
        (tmp_path / f"{k}.npz").write_bytes(content)
    later = bytearray((tmp_path / "a.npz").read_bytes())
    later[later.index(b"PK\x01\x02") + 6] = 109  # the version of ZIP that is needed to extract: 10.9
    (tmp_path / "later.npz").write_bytes(later)
    for path in tmp_path.iterdir():
        with pytest.raises(DataError, match=rf"{path.name}: not a saved frame") as caught:
            Overview.load(path)
        assert "\n" not in str(caught.value)


def test_matplotlib_is_imported_only_when_something_is_drawn():
    heavy = "{'matplotlib', 'jinja2', 'PIL'}"
    code = f"import sys, semstab.report.figures, semstab.report; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_colours_are_as_many_as_classes_and_each_is_unlike_the_others() -> None:
    colors = np.array(palette(60))
    assert len(np.unique(colors, axis=0)) == 60
    apart = np.linalg.norm((colors[:, None] - colors[None]).astype(float), axis=2) + 1e9 * np.eye(60)
    assert apart.min() > 20
    assert palette(60)[:8] == palette(8)


def test_a_room_is_cut_open_beneath_its_ceiling_and_a_wall_is_seen_from_the_side() -> None:
    x, y = (index.ravel() for index in np.meshgrid(range(20), range(20)))
    floor, ceiling = np.stack([x, y, 0 * x], axis=1), np.stack([x, y, 0 * x + 15], axis=1)
    room = FromAbove.from_table(at(np.concatenate([floor, ceiling]), r=0.1), (0, 0, 1))
    assert room.view.startswith("cut open at")
    assert (room.table.iz == 0).all()
    assert FromAbove.from_table(at(floor, r=0.1), (0, 0, 1)).view == "from above"
    assert FromAbove.from_table(at(np.stack([x, 0 * x, y], axis=1), r=0.1), (0, 0, 1)).view == "from the side"


@given(st.integers(0, 2**31), st.booleans())
def test_the_highest_row_of_a_cell_is_seen_and_of_equal_ones_the_last(seed, some_unknown) -> None:
    rng = np.random.default_rng(seed)
    rows, height = np.tile(np.arange(60), 2), rng.integers(0, 5, 60).astype(np.float64)
    height[rng.random(60) < 0.1 * some_unknown] = np.nan
    cells = rng.integers(0, 6, (120, 2))
    expected, image = (np.full((6, 6), EMPTY, np.int64) for _ in range(2))
    order = np.argsort(height[rows], kind="stable")
    expected[tuple(cells[order].T)] = rows[order]
    put_topmost(cells, rows, height, image)
    np.testing.assert_array_equal(image, expected)
