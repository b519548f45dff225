"""What the statistics of a map are functions of: sums that add up over its parts, in two looks at each part.

The first look needs nothing but the part; what it leaves tells of the whole map how likely places with some votes are
stable, and into which cubes space is cut. With that the second one is taken.
"""

from semstab.statistics.sums.first import FirstSums, first_look
from semstab.statistics.sums.second import Overall, SecondSums, Whole, second_look

__all__ = ["FirstSums", "Overall", "SecondSums", "Whole", "first_look", "second_look"]
