"""Write docs/leaderboard.md from the results in results/: `python scripts/leaderboard_page.py`.

Its tables have the rows of `semstab-bench leaderboard results`; tests/test_leaderboard.py compares them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from semstab.core.files import write_text
from semstab.leaderboard.board import Board, boards, headline
from semstab.report.tables.table import to_markdown

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/leaderboard.md"

HEAD = """# Leaderboard

Which models are more stable on the [benchmarks](benchmarks.md)? Each number follows from sums that are
[checked](benchmarks.md#what-is-checked). A page with scenes, hardware and cards, of the results in `results/`:

```bash
semstab-bench leaderboard results --out site
```

- **alpha** counts an answer that a model leaves out as one that disagrees; means over scenes, intervals at 95 %.
- **rank** is 1 plus the number of models that are shown to be more stable; '1 to 7' shares ranks.
- A model may be stable and wrong: read alpha beside accuracy.

Made by:

```bash
semstab-bench benchmark city@1 -m sim-steady -m sim-flicker -m sim-soft -m trick-two-class \\
  -m trick-world-locked -m trick-constant --submit results
semstab-bench benchmark city@1 --predict colour-clusters \\
  --taxonomy results/colour_clusters_uavid7.yaml --out runs/colours --submit results
semstab-bench benchmark apc_shelf@1 --data DATA/apc_shelf --submit results
semstab-bench benchmark livingroom@1 --data DATA/livingroom \\
  --predict EdgeNets/nets.py:espnetv2_voc,scale=0.5,name=espnetv2-0.5 ... --submit results
python scripts/streets.py predict --edgenets EdgeNets --espnet ESPNet --coral coral --work WORK
semstab-bench benchmark semantickitti-images@1 --data WORK/data --labels WORK/labels -m deeplab \\
  -m espnet-8 -m dicenet-0.75 -m espnetv2-2.0 --submit results
```
"""

MODELS = {
    "apc_shelf@1": "The labels and the scores that were published with the data.",
    "city@1": "Simulated models of known quality, tricks that buy stability without knowledge, and clusters of colour.",
    "livingroom@1": "Ten networks of two families, trained on PASCAL VOC.",
    "semantickitti-images@1": "One network of each of four families, trained on Cityscapes; the study of real"
    " networks has fourteen.",
}
"""Models of each benchmark."""


def caption(board: Board) -> str:
    """Return a description of the data, of the models, and why some are not ranked."""
    benchmark = board.benchmark
    said = [f"{benchmark.description}; definition {benchmark.digest}", *board.reasons]
    return " ".join([*(f"{text[0].upper()}{text[1:]}." for text in said), MODELS.get(benchmark.id, "")]).strip()


def page() -> str:
    """Return the text of the page."""
    parts = [HEAD]
    for board in boards(ROOT / "results"):
        parts.append(to_markdown(dataclasses.replace(headline(board), caption=caption(board))))
    return "\n".join(parts)


if __name__ == "__main__":
    write_text(PAGE, page())
