"""The conformance suite for fusion backends: subclass it, define how a backend is made, and pytest does the rest.

    from semstab.testing import BackendConformance

    class TestMine(BackendConformance):
        def create(self, voxel_size, num_classes):
            return MyBackend(voxel_size, num_classes)

`properties` and `contract` hold scenes so small that the answer is worked out by hand in their docstrings; they are
also the shortest way to learn the definitions. Further tests check random sequences, and agreement with the reference.
`cases` runs the data that `semstab-bench conform` gives to programs. `builders` make the frames and compare the maps: a
failure names column, voxel, what it is and what was expected.
"""

from semstab.errors import MissingDependencyError

try:
    import hypothesis  # noqa: F401
    import pytest
except ImportError as missing:
    raise MissingDependencyError(
        f"semstab.testing cannot be used ({missing}); pip install 'semstab[testing]'"
    ) from missing

for _part in ("builders", "cases", "contract", "properties", "scans"):
    pytest.register_assert_rewrite(f"semstab.testing.{_part}")  # a failure shows the values that were compared

from semstab.testing.builders import (  # noqa: E402
    EXACT,
    HITS,
    JS_HALF,
    SEQUENCES,
    SUMS,
    as_frames,
    assert_same_map,
    checks,
    random_frames,
    sight_line,
    voxels,
)
from semstab.testing.cases import CaseTests  # noqa: E402
from semstab.testing.contract import ContractTests  # noqa: E402
from semstab.testing.properties import EvidenceTests, GeometryTests, PropertyTests  # noqa: E402
from semstab.testing.scans import ScanTests  # noqa: E402

__all__ = [
    "EXACT",
    "HITS",
    "JS_HALF",
    "SEQUENCES",
    "SUMS",
    "BackendConformance",
    "as_frames",
    "assert_same_map",
    "checks",
    "random_frames",
    "sight_line",
    "voxels",
]


class BackendConformance(EvidenceTests, GeometryTests, ContractTests, PropertyTests, ScanTests, CaseTests):
    """The contract of every fusion backend. A subclass defines `create`; the rest is inherited.

    Attributes:
        tolerance: Largest difference of a sum (evidence, drift, ...) from its exact value; 1e-9 for float64.
        voxel_share: Part of the voxels that may differ from the reference on random frames, because other arithmetic
            puts a point on the other side of a voxel's face; 0 for float64.
        reach: Voxels that a map holds to either side of its first camera, 2^31 unless the backend reaches less far;
            points beyond are refused.
        long_cases: Whether the cases of very many frames (65,538) are run too.
        scans: Whether the backend fuses scans of points too; False for a backend of images alone.
        scores: Whether it fuses soft scores too; False for a backend of labels alone. Tests of scans or scores are
            skipped if the backend does not fuse them.
    """
