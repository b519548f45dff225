"""Files, JSON, processes, compiled code and threads: the basis of all other modules."""
