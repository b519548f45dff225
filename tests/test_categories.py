"""Categories of voxels: hand-worked votes on either side of each threshold."""

import math

import numpy as np
import pytest
from hypothesis import given

from semstab import backends
from semstab.data.information import entropy_bits, normalise
from semstab.errors import ConfigError
from semstab.metrics import CATEGORIES, CATEGORY_COLORS, CategoryThresholds, categories, category_shares, sbd
from semstab.testing import SEQUENCES, as_frames, checks, sight_line


def fuse(frames):
    backend = backends.create("numpy", voxel_size=1.0, num_classes=3)
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


def vote(*labels):
    """The map of one voxel that one frame after the other gives these labels."""
    return fuse([sight_line(t, [(0.5, label)]) for t, label in enumerate(labels)])


def names_of(table, thresholds=None):
    return [CATEGORIES[c] for c in categories(table, thresholds)]


@pytest.mark.parametrize(
    ("labels", "category"),
    [
        ([0], "low persistence"),
        ([0, 0], "low persistence"),
        ([0, 1], "low persistence"),
        ([0, 0, 0], "stable"),
        ([0, 0, 1], "drifting"),  # SBD (0 + 0.191) / 2 = 0.095 bits
        ([0, 1, 0], "drifting"),
        ([0, 0, 0, 1], "uncertain"),  # SBD 0.139 / 3 = 0.046, entropy 0.811
        ([0, 1, 0, 0], "drifting"),  # SBD (0.311 + 0.021 + 0.007) / 3 = 0.113
        ([0, 0, 0, 0, 1], "stable"),  # 4 to 1: entropy 0.722; SBD 0.108 / 4 = 0.027
        ([0, 1, 2] * 2, "drifting"),
        ([0, 1] * 8, "uncertain"),  # SBD 0.026, entropy 1
        ([0] * 9 + [1], "stable"),
    ],
)
def test_a_vote_has_its_category(labels, category):
    assert names_of(vote(*labels)) == [category]


def test_the_numbers_of_the_thresholds_docstring():
    assert sbd(vote(0, 0, 1))[0] == pytest.approx(0.0954, abs=1e-4)
    assert sbd(vote(0, 1, 1))[0] == pytest.approx(0.166, abs=1e-3)
    assert sbd(vote(0, 0, 0, 1))[0] == pytest.approx(0.046, abs=5e-4)
    assert sbd(vote(0, 1, 0, 0))[0] == pytest.approx(0.113, abs=5e-4)
    assert entropy_bits([0.75, 0.25]) == pytest.approx(0.811, abs=5e-4)
    assert entropy_bits([0.8, 0.2]) == pytest.approx(0.722, abs=5e-4)


def test_thresholds_count_as_reached():
    table = vote(0, 0, 0, 1)
    drift, entropy = float(sbd(table)[0]), float(entropy_bits(normalise(table.evidence))[0])
    assert names_of(table, CategoryThresholds(min_op=5)) == ["low persistence"]
    assert names_of(table, CategoryThresholds(min_op=4, drifting_bits=drift)) == ["drifting"]
    assert names_of(table, CategoryThresholds(drifting_bits=drift + 1e-9, uncertain_bits=entropy)) == ["uncertain"]
    assert names_of(table, CategoryThresholds(drifting_bits=drift + 1e-9, uncertain_bits=entropy + 1e-9)) == ["stable"]


@pytest.mark.parametrize(
    ("settings", "name"),
    [({"min_op": 0}, "min_op = 0"), ({"drifting_bits": 0}, "drifting_bits = 0"), ({"uncertain_bits": math.nan}, "nan")],
)
def test_thresholds_out_of_range_are_refused(settings, name):
    with pytest.raises(ConfigError, match=name):
        CategoryThresholds(**settings)


@checks
@given(SEQUENCES)
def test_each_voxel_is_what_its_numbers_say(sequence):
    table = fuse(as_frames(sequence))
    entropy, drift = entropy_bits(normalise(table.evidence)), sbd(table)
    for row, name in enumerate(names_of(table)):
        seen_enough, moves, ambiguous = table.op[row] >= 3, drift[row] >= 0.05, entropy[row] >= 0.8
        assert (name == "low persistence") == (not seen_enough)
        assert (name == "drifting") == bool(seen_enough and moves)
        assert (name == "uncertain") == bool(seen_enough and not moves and ambiguous)


def test_shares_are_of_all_voxels():
    rows = [[0], [0, 0, 0], [0, 0, 0], [0, 0, 1]]
    longest = max(map(len, rows))
    frames = [sight_line(t, [(z + 0.5, row[t]) for z, row in enumerate(rows) if t < len(row)]) for t in range(longest)]
    shares = category_shares(fuse(frames))
    assert shares == {"low persistence": 0.25, "drifting": 0.25, "uncertain": 0.0, "stable": 0.5}
    empty = category_shares(backends.create("numpy", voxel_size=1.0, num_classes=3).table())
    assert all(math.isnan(share) for share in empty.values())


# Okabe and Ito's colours as normal and colour-blind eyes see them: matrices of Machado et al. 2009 (severity 1).
SIGHT = {
    "normal": np.eye(3),
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


@pytest.mark.parametrize("sight", SIGHT)
def test_colors_differ_to_all_eyes(sight):
    colors = np.array(CATEGORY_COLORS) / 255
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    perceived = np.clip(linear @ np.array(SIGHT[sight]).T, 0, 1)
    xyz = perceived @ np.array([[0.4124, 0.2126, 0.0193], [0.3576, 0.7152, 0.1192], [0.1805, 0.0722, 0.9505]])
    x, y, z = np.cbrt(xyz / [0.9505, 1, 1.089]).T  # all above the linear part of CIE Lab
    lab = np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)
    distances = [np.linalg.norm(a - b) for i, a in enumerate(lab) for b in lab[:i]]
    assert min(distances) > 25
