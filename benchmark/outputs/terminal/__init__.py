"""What the terminal shows: progress, the summary of a run or a study, statistics, remedies."""
