"""The gate: rules that a run must satisfy, their judgement, and thresholds from a run with ground truth."""
