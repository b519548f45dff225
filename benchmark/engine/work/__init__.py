"""The work of a plan: jobs, the passes over a sequence that do them, and where they run."""
