"""Write docs/leaderboard.md from the results in results/: `python scripts/leaderboard_page.py`.

Its tables are those of `semstab-bench leaderboard results`; tests/test_leaderboard.py compares them.
"""

from __future__ import annotations

from pathlib import Path

from semstab.core.files import write_text
from semstab.leaderboard.board import boards, tables_of
from semstab.report.tables.table import to_markdown

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/leaderboard.md"

HEAD = """# Leaderboard

Results of the [benchmarks](benchmarks.md) that can be run here. `semstab-bench leaderboard results --out site` makes
a page of them; `python scripts/leaderboard_page.py` writes these tables.

- `city@1`: simulated models of known quality, tricks that buy stability without knowledge (a map painted in the world,
  two classes, one class), and clusters of colour named by eye. A model may be stable and wrong: read alpha beside
  accuracy.
- `apc_shelf@1`: the labels and the scores that were published with the data.
- `livingroom@1`: ten networks of two families, trained on PASCAL VOC ([how](real-networks.md)).

Each number but those "as stated" is computed from the sums of a result, which are checked against the definition
([how](benchmarks.md#what-is-checked)). These models were timed on two cores that did other work, too: their
milliseconds are no measure of speed.

```bash
semstab-bench benchmark city@1 -m sim-steady -m sim-flicker -m sim-soft -m trick-two-class \\
  -m trick-world-locked -m trick-constant --submit results
semstab-bench benchmark city@1 --predict colour-clusters \\
  --taxonomy results/colour_clusters_uavid7.yaml --submit results
semstab-bench benchmark apc_shelf@1 --data DATA/apc_shelf --submit results
semstab-bench benchmark livingroom@1 --data DATA/livingroom \\
  --predict EdgeNets/nets.py:espnetv2_voc,scale=0.5,name=espnetv2-0.5 ... --submit results
```
"""


def page() -> str:
    """Return the text of the page."""
    parts = [HEAD]
    for board in boards(ROOT / "results"):
        parts += map(to_markdown, tables_of(board))
    return "\n".join(parts)


if __name__ == "__main__":
    write_text(PAGE, page())
