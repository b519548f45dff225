"""Simulations: how often what semstab says is right, where the truth is known."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "scripts"))

import cases

CASES = {
    "exact": "exact",
    "exact-coverage": "exact_coverage",
    "alpha": "alpha",
    "intervals": "intervals",
    "simpler": "simpler",
    "frames": "frames",
    "gate": "gate",
    "power": "power",
    "planted": "planted",
    "acceptance": "acceptance",
    "risk": "risk",
    "ranges": "ranges",
    "labellers": "labellers",
    "doctor": "doctor",
    "doctor-scans": "doctor_scans",
    "moving": "moving",
    "visits": "visits",
}

if __name__ == "__main__":
    cases.run(__doc__, CASES, sys.argv[1:])
