"""What a map's numbers would be elsewhere, or in the next flight: sums by frame and cube of space, and intervals."""

from semstab.statistics.sampling.collect import influence_sums
from semstab.statistics.sampling.influence import InfluenceSums, aligned, merged, value
from semstab.statistics.sampling.intervals import difference, estimate

__all__ = ["InfluenceSums", "aligned", "difference", "estimate", "influence_sums", "merged", "value"]
