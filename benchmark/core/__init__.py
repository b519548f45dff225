"""Files, JSON, processes, compiled code and threads: what all else rests on."""
