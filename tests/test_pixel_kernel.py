"""The compiled passes over the pixels say what numpy's expressions say, for both types of label maps."""

from __future__ import annotations

import numpy as np
import pytest

from semstab.data.kernels import count_changed, has_other, mark_valid
from semstab.data.labels import flat

DEPTHS = np.array([0.0, -0.0, -1.0, np.nan, np.inf, -np.inf, 1e-45, 3.4e38, 1.0], dtype=np.float32)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_passes_equal_numpy(dtype) -> None:
    rng = np.random.default_rng(5)
    ignore = int(np.iinfo(dtype).max)
    depth = rng.choice(DEPTHS, 5000)
    labels, other = (rng.choice([0, 1, 254, ignore], 5000).astype(dtype) for _ in range(2))
    valid, other_valid = np.empty(5000, dtype=bool), rng.random(5000) < 0.5
    mark_valid(flat(depth), flat(labels), ignore, valid)
    np.testing.assert_array_equal(valid, (depth > 0) & (depth < np.inf) & (labels != ignore))
    both = valid & other_valid
    expected = both.sum(), (both & (labels != other)).sum()
    assert count_changed(flat(valid), flat(labels), flat(other_valid), flat(other)) == expected


@pytest.mark.parametrize(("ids", "other"), [([0, 1, 2, 255], False), ([0, 3], True), ([254], True), ([], False)])
def test_ids_outside_the_classes_are_seen(ids, other) -> None:
    assert has_other(flat(np.array(ids, dtype=np.uint8)), 3, 255) == other


def test_flat_leaves_the_image_as_it_is() -> None:
    image = np.arange(6)
    values = flat(image)
    assert not values.flags.writeable
    assert image.flags.writeable
    np.testing.assert_array_equal(flat(np.arange(12).reshape(3, 4)[:, ::2]), [0, 2, 4, 6, 8, 10])
