"""Runs side by side: what differs between them, how surely, and where."""
