"""The verdict on scans: their poses, the motion in a sweep, their order, and the labels of their points."""

from __future__ import annotations

from collections.abc import Sequence

from semstab.check.labels import LabelFindings
from semstab.check.scan_labels import wrong_order
from semstab.check.scan_order import in_order, with_order
from semstab.check.scan_sample import ScanSample
from semstab.check.scans import assess_scans
from semstab.check.sweep import with_sweep
from semstab.check.verdict import Verdict


def verdict_of_scans(
    sample: ScanSample, indices: Sequence[int], models: Sequence[str]
) -> tuple[Verdict, tuple[LabelFindings, ...]]:
    """Return the verdict on scans, and what labels of models show to be wrong with them if the scans are sound."""
    verdict = with_sweep(assess_scans(sample), sample)
    if verdict.state != "sound":
        return verdict, ()
    ordered = {model: in_order(sample.scene, indices, model) for model in models}
    first = next(iter(ordered.values()), None) or in_order(sample.scene, indices, None)
    verdict = with_order(verdict, sample.scene, indices, first)
    if verdict.state != "sound":
        return verdict, ()
    lines = {model: wrong_order(of_model) for model, of_model in ordered.items()}
    return verdict, tuple(
        LabelFindings(model, (f"labels of {model} {line}",)) for model, line in lines.items() if line is not None
    )
