"""Measures are those of other libraries: a few cases of scripts/equality.py, whose table stands in docs/metrics.md."""

from __future__ import annotations

import importlib.metadata
import re
from pathlib import Path

import equality
import numpy as np
import pytest

PAGE = (Path(__file__).parents[1] / "docs/metrics.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("name", "package", "function", "measure"), equality.MEASURES)
def test_a_measure_is_that_of_another_library(name, package, function, measure) -> None:
    rng = np.random.default_rng(7)
    pairs = np.array([measure(rng) for _ in range(25)])
    single = 1e-6 if package == "torchmetrics" else 1e-12  # torchmetrics counts in 32 bits
    np.testing.assert_allclose(pairs[:, 0], pairs[:, 1], rtol=0, atol=single)
    assert np.ptp(pairs[:, 0]) > 0.05
    (row,) = re.findall(rf"^\| {re.escape(name)} \|.*$", PAGE, re.MULTILINE)
    assert f"{package} " in row
    assert function in row
    assert importlib.metadata.version(package)
