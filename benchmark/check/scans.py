"""The check of a scene of scans: whether they lie on each other by their poses, and how else they would.

A point of one scan is carried by the poses into the axes of another one; its distance from the surface there, divided
by the range of the point, is its error. Each other reading of the poses is assessed in the same way.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from semstab.check.hypotheses import OF_SCANS, SCANS
from semstab.check.scan_sample import ScanSample
from semstab.check.trials import Trial, ranked
from semstab.check.verdict import Verdict

BETTER = 0.67
"""Another reading of the poses is right where its error is at most this part of the configured one."""

ALIKE = 1.1
"""Readings whose errors differ by no more cannot be told apart."""

APART = 4.0
"""Least ratio of the distance between two scans to the distance between points of a scan: sparse scans err more."""

FAR = 20_000.0
"""Metres beyond which no scanner sees half of its points."""

HOPELESS = 0.05
"""The error from which on scans do not lie on each other, though no reading explains it."""

UPSIDE_DOWN = (
    "level surfaces lie above the sensors, and hardly any below, as if z of the points was mirrored, or pointed down"
    " while poses are of a body with z up: the map is upside down if so; negate z, or carry the points into such axes"
)


def assess_scans(sample: ScanSample) -> Verdict:
    """Return whether scans lie on each other, and the reading of the poses under which they would."""
    pairs, ranges, settings = sample.pairs, sample.ranges, sample.scene.settings
    if not pairs:
        return Verdict("unclear", "it takes two scans with points to tell whether poses are right")
    if (away := float(np.median(np.concatenate(ranges)))) > FAR and is_elsewhere(sample, away):
        other = {"sensor": "world", "world": "sensor"}.get(settings.get("coordinates", ""))
        mend = None if other is None else f"coordinates: {other}"
        advice = "carry them into its axes" if mend is None else f"set {mend} (--option coordinates={other})"
        text = f"points lie {away / 1000:,.0f} km from their sensor, as in the axes of the world; {advice}"
        return Verdict("unsound", text, () if mend is None else (mend,))
    now, trials, mistakes = sample.fit(), ranked(SCANS, sample), ranked(OF_SCANS, sample)
    frames, best = len({p for pair in pairs for p in pair}), likelier(trials[0], mistakes[0])
    listed = trials[:4] if best is trials[0] else [best, *trials[:3]]
    fits = (("as configured", now), *((trial.hypothesis.name, trial.fit) for trial in listed))
    about = Verdict("sound", "", (), now.error, now.share, frames, len(pairs), fits=fits)
    if best.is_right(sample, now, BETTER):
        reading = best.hypothesis
        mend = next((text for (key, value), text in reading.options.items() if settings.get(key) == value), None)
        advice = f"set {mend} (--option {mend.replace(': ', '=')})" if mend else reading.mend
        return about.refuted(
            f"scans do not lie on each other: points are typically {now.error:.1%} of their range from the"
            f" surfaces of another scan, and {best.fit.error:.2%} with {reading.name}; {advice}",
            () if mend is None else (mend,),
        )
    nearest = float(np.median(np.concatenate([met.error for met in sample.met.values()])))
    if nearest > HOPELESS and sample.between > APART * sample.spacing:
        return about.refuted(
            f"scans do not lie on each other: the nearest point of another scan is {nearest:.1%} of the range away, and"
            " no reading of the poses explains it; check the order of poses and scans"
        )
    remarks = (UPSIDE_DOWN,) if sample.is_upside_down else ()
    open_ = {trial.hypothesis.name for trial in trials if trial.fit.error <= ALIKE * now.error}
    return dataclasses.replace(
        about,
        text=f"scans lie on each other: points are typically {now.error:.2%} of their range from the surfaces of"
        " another scan",
        undetermined=tuple(hypothesis.name for hypothesis in SCANS if hypothesis.name in open_),
        reason="the sensor hardly moves or turns" if open_ else "",
        remarks=remarks,
    )


def is_elsewhere(sample: ScanSample, away: float) -> bool:
    """Return whether points lie around another place than their sensor, and not `away` from it to all sides."""
    middle, _ = sample.places
    return bool(np.median(np.linalg.norm(middle, axis=1)) > away / 2)


def likelier(reading: Trial[ScanSample], mistake: Trial[ScanSample]) -> Trial[ScanSample]:
    """Return another reading of the poses, or else a mistake under which scans lie clearly nearer to each other."""
    return mistake if mistake.fit.has_evidence and mistake.fit.error * ALIKE < reading.fit.error else reading
