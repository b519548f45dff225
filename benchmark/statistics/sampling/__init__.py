"""What a map's numbers would be elsewhere, or in the next flight: sums by frame and cube of space, and intervals."""

from semstab.statistics.sampling.collect import influence_sums
from semstab.statistics.sampling.influence import InfluenceSums, aligned, merged, value

__all__ = ["InfluenceSums", "aligned", "influence_sums", "merged", "value"]
