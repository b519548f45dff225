"""The compiled loops behind the statistics."""
