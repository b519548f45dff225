"""What a map's numbers would be elsewhere, or in the next flight: sums by frame and cube of space, and intervals."""

from semstab.statistics.sampling.collect import influence_sums, with_sample
from semstab.statistics.sampling.combined import mean_of, standard_error, unpaired
from semstab.statistics.sampling.influence import InfluenceSums, aligned, merged, of_places_alone, value
from semstab.statistics.sampling.intervals import (
    LEAST_FRAMES,
    Asked,
    answered,
    answers,
    asked_of,
    difference,
    estimate,
    identical,
    judged_by,
    none,
    question_of,
)
from semstab.statistics.sampling.paired import coverage, difference_over_frames, mean_over_frames, same_flight
from semstab.statistics.sampling.places import Mean, Places, PlaceSums

__all__ = [
    "LEAST_FRAMES",
    "Asked",
    "InfluenceSums",
    "Mean",
    "PlaceSums",
    "Places",
    "aligned",
    "answered",
    "answers",
    "asked_of",
    "coverage",
    "difference",
    "difference_over_frames",
    "estimate",
    "identical",
    "influence_sums",
    "judged_by",
    "mean_of",
    "mean_over_frames",
    "merged",
    "none",
    "of_places_alone",
    "question_of",
    "same_flight",
    "standard_error",
    "unpaired",
    "value",
    "with_sample",
]
