"""Published networks over real sequences: do measures of stability rank them as their published accuracy does?

    git clone https://github.com/sacmehta/EdgeNets && git -C EdgeNets checkout 2b232d3 && cp scripts/nets.py EdgeNets
    git clone https://github.com/isl-org/open3d_downloads
    python scripts/real_networks.py sequence open3d_downloads --data DATA
    python scripts/real_networks.py run --networks EdgeNets --data DATA --work WORK
    python scripts/real_networks.py show

It needs semstab, torch and, for the networks, an hour on two cores. `run` continues a run that was stopped, without
computing a finished condition again; `--only livingroom` runs the conditions whose names begin so. `show` computes
nothing: it prints the tables and draws docs/real-networks.png from results/.

Networks. EdgeNets (github.com/sacmehta/EdgeNets, MIT): ESPNetv2 and DiCENet in several widths, with weights and the
mIoU that their authors publish in model/segmentation/model_zoo/README.md. Ten are trained on PASCAL VOC (384x384), ten
on Cityscapes (512x256); the authors commented the mIoU of one of these out, which is therefore left empty.
scripts/nets.py wraps them: the whole image is resized to the network's input and normalised with ImageNet's mean and
standard deviation; logits are resized to the image, and the largest one is the label.

Sequences, each a posed folder DATA/NAME (docs/formats.md):
    livingroom  211 RGB-D frames of a rendered living room, test data of Open3D (github.com/isl-org/open3d_downloads at
                55705ea, MIT): tests/reconstruction_system/livingroom1_clean_micro. `sequence` writes the folder.
    hololens    sample-data/hololens-dataset/000 of github.com/ardaduz/deep-video-mvs (MIT), its frames 120 to 215, by
                `semstab-bench convert`: an office with tables, sofas and a kitchen, seen by a headset.
    brighton    18 photographs of a drone (github.com/pierotofy/drone_dataset_brighton_beach, BSD-2-Clause) with poses
                by COLMAP and depth from the dense cloud, `semstab-bench convert` of the project. The networks of
                Cityscapes were trained on streets from a car: views from above are outside their domain.
A sequence that is not in DATA is left out, with a note.

Conditions. Label maps are predicted once a sequence (`semstab-bench predict`) and fused in each condition
(`semstab-bench run`): a voxel size, every n-th frame, labels or scores (softmax, predicted within the run).

Numbers. results/real-networks.csv has a row for each network in each condition:

    published_miou         percent, by the authors, on photographs of the dataset that the network was trained on
    alpha, _low, _high     agreement of two views of the same spot beyond chance, with its 95 % interval; empty where
                           every sampled observation is of one class
    verdict, probability   the most probable level for the same scene flown again
    vss, _low, _high       mean VSS of the voxels with OP >= 3; vss_all of all voxels
    agree, _low, _high     probability that two frames agree on a voxel (PSA), OP >= 2
    within, between        the parts of 1 - agree within a frame (unsure scores, mixed voxels) and between frames
    flicker, compensated   percent of the pixels whose label differs in consecutive frames; after warping by depth
    effective_classes      1 / probability that two observations from anywhere agree (Hill number of order 2)
    largest_class, _share  the class with most observations
    voxels, mean_op, recurrent_share     of the map; recurrent: OP >= 3
    spots, views           what alpha rests on

results/real-networks.json has versions, commands, digests (SHA-256) of weights and sequences, and for each condition
Spearman's rank correlation of a measure with the published mIoU, and with the effective number of classes, over
`networks` networks. Its 95 % interval comes from 9,999 bootstrap samples of networks (scipy.stats.bootstrap, percentile
method). The digest of a folder is the digest of the lines that `sha256sum` prints for its files, sorted by name.
`wrapper` has the digest of the nets.py that was run. If the text of scripts/nets.py is different, `same_scores` has the
digest of scripts/nets.py: it gave the same scores and labels, bit for bit, in two frames of each sequence for each
network.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from outcome import StudyError, exit_code

import semstab
from semstab.core.files import atomic_path
from semstab.data.measures import VSS
from semstab.data.records import Record
from semstab.statistics.verdict import LIMITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROOT = Path(__file__).parents[1]
CSV, JSON, FIGURE = "real-networks.csv", "real-networks.json", ROOT / "docs" / "real-networks.png"
ZOO = Path("model/segmentation/model_zoo")
WEIGHTS = {"voc": "pascal_384x384", "city": "city_512x256"}
"""Ending of the names of files of weights, by the training data's short name in nets.py."""
PACKAGES = ("semstab", "numpy", "numba", "opencv-python-headless", "scipy", "torch")
RESAMPLES = 9999
USABLE = LIMITS.usable


@dataclass(frozen=True)
class NetworkCondition:
    """A sequence, the networks over it, and how their labels are fused."""

    scene: str
    trained_on: str
    stride: int
    voxel_size: float
    kind: str = "labels"

    @property
    def name(self) -> str:
        """The name for --only, and of its folder."""
        return f"{self.scene}-{self.kind}-{self.stride}-{self.voxel_size:g}"


CONDITIONS = (
    *(NetworkCondition("livingroom", "voc", stride, size) for stride in (20, 10, 5) for size in (0.02, 0.04)),
    NetworkCondition("livingroom", "voc", 10, 0.02, "scores"),
    NetworkCondition("hololens", "voc", 5, 0.02),
    NetworkCondition("brighton", "city", 1, 0.2),
)
MAIN = "livingroom-labels-5-0.02"
"""The condition of the figure."""
DENSEST = {scene: min(c.stride for c in CONDITIONS if c.scene == scene) for scene in {c.scene for c in CONDITIONS}}
"""Every n-th frame of a sequence is predicted; the strides of its conditions are multiples."""


@dataclass(frozen=True)
class Weights:
    """A file of weights, and the published mIoU in percent, or NaN without a published mIoU."""

    family: str
    scale: str
    trained_on: str
    weights: Path
    miou: float

    @property
    def name(self) -> str:
        """Family and width."""
        return f"{self.family}-{self.scale}"

    def model(self, folder: Path) -> str:
        """Return what --model and --predict call it."""
        return f"{folder / 'nets.py'}:{self.family}_{self.trained_on}"


@dataclass(frozen=True)
class NetworkRow:
    """One network in one condition; the module says what each number is."""

    condition: str
    scene: str
    kind: str
    stride: int
    voxel_size: float
    frames: int
    network: str
    trained_on: str
    published_miou: float
    alpha: float
    alpha_low: float
    alpha_high: float
    verdict: str
    probability: float
    vss: float
    vss_low: float
    vss_high: float
    vss_all: float
    agree: float
    agree_low: float
    agree_high: float
    within: float
    between: float
    flicker: float
    compensated: float
    effective_classes: float
    largest_class: str
    largest_share: float
    voxels: int
    mean_op: float
    recurrent_share: float
    spots: int
    views: int


MEASURES = ("alpha", "vss", "agree", "flicker")
PARTS = ("within", "between")
TITLES = {"alpha": "alpha", "vss": "VSS", "agree": "two frames agree", "flicker": "flicker"}


def networks(folder: Path, trained_on: str) -> list[Weights]:
    """Return the networks whose weights are in a clone of EdgeNets, the narrowest of each family first.

    Raises:
        StudyError: If there are none, or nets.py is not there.
    """
    if not (folder / "nets.py").is_file():
        raise StudyError(f"{folder / 'nets.py'} is not there: cp {ROOT / 'scripts' / 'nets.py'} {folder}")
    mious = published(folder)
    found = []
    for file in (folder / ZOO).glob(f"*/*_s_*_{WEIGHTS[trained_on]}.pth"):
        family, _, rest = file.stem.partition("_s_")
        scale = rest.partition("_")[0]
        found.append(Weights(family, scale, trained_on, file, mious.get(file.name, math.nan)))
    if not found:
        raise StudyError(f"{folder / ZOO}: no weights *_{WEIGHTS[trained_on]}.pth; clone github.com/sacmehta/EdgeNets")
    return sorted(found, key=lambda network: (network.family, float(network.scale)))


def published(folder: Path) -> dict[str, float]:
    """Return the mIoU in percent by the name of the file of weights, from the tables of the model zoo's README."""
    text = re.sub(r"<!--.*?-->", "", (folder / ZOO / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    rows = re.findall(r"\|\s*([\d.]+)\s*\|\s*\[here\]\(\S*/(\S+\.pth)\)", text)
    return {name: float(miou) for miou, name in rows}


# --- Run --------------------------------------------------------------------------------------------------------------


def predict_command(network: Weights, scene: str, folders: StudyFolders) -> list[str]:
    """Return the command that stores a network's label maps of a sequence."""
    return [
        "predict", "--model", network.model(folders.networks), "--set", f"scale={network.scale}",
        "--name", network.name, "--data", str(folders.data / scene), "--frames", f"::{DENSEST[scene]}",
        "--out", str(folders.labels(scene)),
    ]  # fmt: skip


def run_command(condition: NetworkCondition, nets: Sequence[Weights], folders: StudyFolders) -> list[str]:
    """Return the command that fuses the labels, or predicts scores and fuses them."""
    words = ["run", "--data", str(folders.data / condition.scene)]
    if condition.kind == "labels":
        words += ["--option", f"labels_root={folders.labels(condition.scene)}"]
        words += ["--option", "labels=labels/{model}/{name}"]
        words += [word for network in nets for word in ("--model", network.name)]
    else:
        for network in nets:
            settings = f"scale={network.scale},soft=True,scores=True,name={network.name}"
            words += ["--predict", f"{network.model(folders.networks)},{settings}"]
    return [
        *words, "--frames", f"::{condition.stride}", "--voxel-size", f"{condition.voxel_size:g}", "--rerun", "off",
        "--out", str(folders.work / "runs" / condition.name),
    ]  # fmt: skip


@dataclass(frozen=True)
class StudyFolders:
    """Where networks, sequences, and what is computed from them lie."""

    networks: Path
    data: Path
    work: Path

    def labels(self, scene: str) -> Path:
        """Return the folder above labels/ of a sequence."""
        return self.work / "labels" / scene

    def without_paths(self, words: Iterable[str]) -> str:
        """Return a command with NETWORKS, DATA and WORK instead of this machine's folders."""
        line = shlex.join(["semstab-bench", *words])
        for name, path in (("NETWORKS", self.networks), ("DATA", self.data), ("WORK", self.work)):
            line = line.replace(str(path), name)
        return line


def run(folders: StudyFolders, results: Path, only: Sequence[str]) -> None:
    """Predict, fuse and measure each condition, and add it to the results as soon as it is there.

    Raises:
        StudyError: For names that no condition has, or a command that fails.
    """
    chosen = [
        condition for condition in CONDITIONS if not only or any(condition.name.startswith(name) for name in only)
    ]
    if not chosen:
        raise StudyError(f"--only {' '.join(only)}: there is {', '.join(condition.name for condition in CONDITIONS)}")
    predicted: set[str] = set()
    for condition in chosen:
        scene = condition.scene
        if not (folders.data / scene).is_dir():
            print(f"{condition.name}: left out, {folders.data / scene} is not there")
            continue
        nets = networks(folders.networks, condition.trained_on)
        predictions = [predict_command(network, scene, folders) for network in nets]
        if condition.kind == "labels" and scene not in predicted:
            for network, words in zip(nets, predictions, strict=True):
                predict_once(network, scene, words, folders)
            predicted.add(scene)
        command = run_command(condition, nets, folders)
        bench(command)
        rows = rows_of(condition, nets, folders.work / "runs" / condition.name)
        commands = [folders.without_paths(words) for words in (*predictions, command)]
        keep(condition, rows, nets, commands, folders, results)
        print(f"{condition.name}: {len(rows)} networks", flush=True)


def predict_once(network: Weights, scene: str, words: Sequence[str], folders: StudyFolders) -> None:
    """Store a network's label maps, unless the same command did so with the same network and images.

    semstab-bench would find out, too, but loads the network before.
    """
    digests = [digest(path) for path in (network.weights, folders.networks / "nets.py", folders.data / scene / "color")]
    content, note = json.dumps([*words, *digests]), folders.labels(scene) / f"{network.name}.json"
    if not note.exists() or note.read_text(encoding="utf-8") != content:
        bench(words)
        note.write_text(content, encoding="utf-8")


def bench(words: Sequence[str]) -> None:
    """Run semstab-bench in a process of its own.

    Raises:
        StudyError: If it fails, after what it printed.
    """
    done = subprocess.run([sys.executable, "-m", "semstab", *words, "--quiet"], check=False, env={**os.environ})
    if done.returncode:
        raise StudyError(f"exit code {done.returncode} of semstab-bench {shlex.join(words)}")


def rows_of(condition: NetworkCondition, nets: Sequence[Weights], folder: Path) -> list[NetworkRow]:
    """Return the rows of a finished run, in the order of the networks."""
    records = {record.unit.model.removesuffix("-scores"): record for record in semstab.load_result(folder).select()}
    return [_row(condition, network, records[network.name]) for network in nets]


def _row(condition: NetworkCondition, network: Weights, record: Record) -> NetworkRow:
    statistics, of_map = record.statistics, record.map_summary
    assert statistics is not None
    assert statistics.spots is not None
    headline, spots = statistics.headline, statistics.spots
    return NetworkRow(
        condition=condition.name, scene=condition.scene, kind=condition.kind, stride=condition.stride,
        voxel_size=condition.voxel_size, frames=record.frames,
        network=network.name, trained_on=network.trained_on, published_miou=network.miou,
        alpha=headline.alpha.value, alpha_low=headline.alpha.low, alpha_high=headline.alpha.high,
        verdict=statistics.verdict.level, probability=statistics.verdict.probability,
        vss=headline.vss_op3.value, vss_low=headline.vss_op3.low, vss_high=headline.vss_op3.high,
        vss_all=of_map[VSS],
        agree=headline.psa_op2.value, agree_low=headline.psa_op2.low, agree_high=headline.psa_op2.high,
        within=statistics.agreement.within.value, between=statistics.agreement.between.value,
        flicker=record.flicker_percent, compensated=record.image_space.compensated_flicker_percent,
        effective_classes=spots.effective_classes, largest_class=spots.largest_class,
        largest_share=spots.largest_share, voxels=of_map.voxels, mean_op=of_map.mean_op,
        recurrent_share=of_map.recurrent.share, spots=spots.spots, views=spots.views,
    )  # fmt: skip


# --- Results ----------------------------------------------------------------------------------------------------------


def keep(
    condition: NetworkCondition, rows: Sequence[NetworkRow], nets: Sequence[Weights], commands: Sequence[str],
    folders: StudyFolders, results: Path,
) -> None:  # fmt: skip
    """Put a condition into both files of results, instead of what they had of it."""
    *predictions, command = commands
    order = {condition.name: k for k, condition in enumerate(CONDITIONS)}
    there = [row for row in load(results) if row.condition != condition.name] if (results / CSV).exists() else []
    table = sorted([*there, *rows], key=lambda row: order[row.condition])
    with atomic_path(results / CSV) as path, path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(NetworkRow.__annotations__), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _text(value) for key, value in asdict(row).items()} for row in table)
    content: dict[str, Any] = json.loads((results / JSON).read_text()) if (results / JSON).exists() else {"schema": 1}
    for part in ("conditions", "predictions", "weights", "sequences"):
        content.setdefault(part, {})
    content["conditions"][condition.name] = {
        "versions": {"python": platform.python_version()} | {name: metadata.version(name) for name in PACKAGES},
        "command": command,
    }
    content["predictions"][condition.scene] = list(predictions)
    content["weights"] |= {condition.weights.name: digest(condition.weights) for condition in nets}
    content["wrapper"] = {"nets.py": digest(folders.networks / "nets.py")}
    content["sequences"][condition.scene] = {
        path.name: digest(path)
        for path in sorted((folders.data / condition.scene).iterdir())
        if path.name in ("color", "depth", "pose", "intrinsics.txt", "scene.yaml")
    }
    content["correlations"] = correlations(load(results))
    ordered = {condition.name: content["conditions"].get(condition.name) for condition in CONDITIONS}
    content["conditions"] = {name: condition for name, condition in ordered.items() if condition is not None}
    with atomic_path(results / JSON) as path:
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load(results: Path) -> list[NetworkRow]:
    """Return the rows of real-networks.csv; what is empty is NaN."""
    kinds: dict[str, Callable[[str], Any]] = {"int": int, "float": lambda text: float(text or "nan"), "str": str}
    with (results / CSV).open(newline="", encoding="utf-8") as file:
        return [
            NetworkRow(**{key: kinds[str(NetworkRow.__annotations__[key])](text) for key, text in line.items()})
            for line in csv.DictReader(file)
        ]


def _text(value: object) -> str:
    return str(value) if not isinstance(value, float) else "" if math.isnan(value) else f"{value:.6g}"


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of the lines that sha256sum prints for a folder's files, by name."""
    if path.is_dir():
        lines = [f"{digest(file)}  {file.name}\n" for file in sorted(path.iterdir())]
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    return hashlib.sha256(path.read_bytes()).hexdigest()


def correlations(rows: Sequence[NetworkRow]) -> list[dict[str, Any]]:
    """Return Spearman's correlation of each measure with published mIoU and with effective classes, in each condition.

    `of` is 'all' networks for which both numbers are defined, or the 'informative' ones among them, whose verdict is
    another than 'uninformative'.
    """
    found = []
    for name in dict.fromkeys(row.condition for row in rows):
        everything = [row for row in rows if row.condition == name]
        informative = [row for row in everything if row.verdict != "uninformative"]
        for of, chosen in (("all", everything), ("informative", informative)):
            for against in ("published_miou", "effective_classes"):
                measures = (*MEASURES, *PARTS) if (of, against) == ("all", "published_miou") else MEASURES
                for measure in measures:
                    key = {"condition": name, "measure": measure, "against": against, "of": of}
                    found.append(key | spearman(*_pairs(chosen, measure, against)))
    return found


def _pairs(rows: Sequence[NetworkRow], measure: str, against: str) -> tuple[list[float], list[float]]:
    pairs = [(getattr(row, against), getattr(row, measure)) for row in rows]
    pairs = [pair for pair in pairs if not any(map(math.isnan, pair))]
    return [x for x, _ in pairs], [y for _, y in pairs]


def with_miou(rows: Sequence[NetworkRow]) -> dict[str, dict[str, Any]]:
    """Return the correlation of each measure with published mIoU, over all networks of one condition."""
    return {measure: spearman(*_pairs(rows, measure, "published_miou")) for measure in MEASURES}


def spearman(x: Sequence[float], y: Sequence[float]) -> dict[str, Any]:
    """Return Spearman's rank correlation, its bootstrap interval over pairs, and the number of pairs.

    The correlation is None if it is not defined: with fewer than three pairs, or if all values are the same. Samples
    of the bootstrap in which that happens are left out.
    """
    from scipy.stats import DegenerateDataWarning, bootstrap

    found: dict[str, Any] = {"networks": len(x), "rho": None, "low": None, "high": None}
    if len(x) < 3 or len(set(x)) == 1 or len(set(y)) == 1:
        return found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateDataWarning)  # of samples in which it is not defined
        samples = bootstrap(
            (x, y), _rank_correlation, n_resamples=RESAMPLES, paired=True, vectorized=True, method="percentile", rng=0
        ).bootstrap_distribution
    low, high = np.nanquantile(samples, [0.025, 0.975])
    rho = _rank_correlation(np.array(x), np.array(y))
    return found | {"rho": round(float(rho), 4), "low": round(float(low), 4), "high": round(float(high), 4)}


def _rank_correlation(x: Any, y: Any, axis: int = -1) -> Any:
    """Return Pearson's correlation of ranks, with the mean rank for ties, or NaN if all values are tied."""
    from scipy.stats import rankdata

    x, y = (rankdata(values, axis=axis) for values in (x, y))
    x, y = (values - values.mean(axis=axis, keepdims=True) for values in (x, y))
    scale = np.sqrt((x**2).sum(axis=axis) * (y**2).sum(axis=axis))
    return np.divide((x * y).sum(axis=axis), scale, out=np.full(np.shape(scale), np.nan), where=scale > 0)


# --- Show -------------------------------------------------------------------------------------------------------------


def signed(number: float | None) -> str:
    """Return a correlation as '+.61'."""
    return "-" if number is None else f"{number:+.2f}".replace("0.", ".", 1)


def condition_table(rows: Sequence[NetworkRow]) -> list[str]:
    """Return the table of correlations, a Markdown row for each condition."""
    lines = [
        "| sequence | voxels, m | frames | networks | " + " | ".join(TITLES[measure] for measure in MEASURES) + " |",
        "|---|---|---|---|" + "---|" * len(MEASURES),
    ]
    for name in dict.fromkeys(row.condition for row in rows):
        of_condition = [row for row in rows if row.condition == name]
        one, found = of_condition[0], with_miou(of_condition)
        title = one.scene + (", scores" if one.kind == "scores" else "")
        cells = []
        for measure in MEASURES:
            correlation = found[measure]
            ends = (
                ""
                if correlation["rho"] is None
                else f" ({signed(correlation['low'])} to {signed(correlation['high'])})"
            )
            cells.append(signed(correlation["rho"]) + ends)
        of = [found[measure]["networks"] for measure in MEASURES]
        count = f"{of[1]}" if of[0] == of[1] else f"{of[1]}, alpha {of[0]}"
        lines.append(f"| {title} | {one.voxel_size:g} | {one.frames} | {count} | " + " | ".join(cells) + " |")
    return lines


def network_table(rows: Sequence[NetworkRow], condition: str) -> list[str]:
    """Return the networks of a condition, by published mIoU."""
    lines = [
        f"{condition}",
        f"{'network':16}{'mIoU':>6}  {'alpha (95 % CI)':22}{'verdict':15}{'VSS':>6}{'agree':>7}{'flicker':>9}"
        f"{'classes':>9}",
    ]
    for row in sorted((row for row in rows if row.condition == condition), key=lambda row: row.published_miou):
        ends = f"{row.alpha:.2f} ({row.alpha_low:.2f} to {row.alpha_high:.2f})"
        lines.append(
            f"{row.network:16}{row.published_miou:6.2f}  {ends:22}{row.verdict:15}{row.vss:6.3f}{row.agree:7.3f}"
            f"{row.flicker:9.2f}{row.effective_classes:9.2f}"
        )
    return lines


FAMILIES = {"espnetv2": ("#0072B2", "o", -0.3, "ESPNetv2"), "dicenet": ("#D55E00", "s", 0.3, "DiCENet")}
"""Colours of Okabe and Ito, told apart by any colour vision, markers, and a shift so that equal mIoUs stay apart."""


def draw(rows: Sequence[NetworkRow], file: Path, condition: str = MAIN) -> None:
    """Draw VSS and alpha against published mIoU, with their intervals; hollow where the verdict is 'uninformative'."""
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    selected = [row for row in rows if row.condition == condition]
    grey: dict[str, Any] = {"color": "#555555", "linestyle": "none"}
    marks = [
        Line2D([], [], color=color, marker=marker, linestyle="none", label=title)
        for color, marker, _, title in FAMILIES.values()
    ]
    marks.append(Line2D([], [], marker="o", markerfacecolor="white", label="uninformative", **grey))
    if any(math.isnan(row.alpha) for row in selected):
        marks.append(Line2D([], [], marker="x", label="no alpha: one class", **grey))
    with mpl.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(7, 3.3), layout="constrained")
        left, right = figure.subplots(1, 2)
        _panel(left, selected, "vss")
        left.set_ylabel("mean VSS, OP >= 3")
        _panel(right, selected, "alpha")
        right.set_ylabel("alpha")
        right.set_ylim(top=1.02)
        right.axhline(USABLE, color="#555555", linewidth=0.8, linestyle="--")
        right.annotate("usable", (0.16, USABLE), xycoords=("axes fraction", "data"), xytext=(0, 2),
                       textcoords="offset points", fontsize=9)  # fmt: skip
        figure.legend(handles=marks, loc="outside lower center", ncols=len(marks), frameon=False)
        with atomic_path(file) as path:
            figure.savefig(path, format="png", dpi=150, metadata={"Software": None})


def _panel(axes: Axes, rows: Sequence[NetworkRow], measure: str) -> None:
    """Draw a measure with its intervals; a network without it is a cross on the axis."""
    for row in rows:
        color, marker, shift, _ = FAMILIES.get(row.network.rpartition("-")[0], ("#000000", "^", 0, ""))
        x = row.published_miou + shift
        value, low, high = (getattr(row, measure + end) for end in ("", "_low", "_high"))
        if math.isnan(value):
            axes.plot(x, 0.015, "x", color=color, transform=axes.get_xaxis_transform(), clip_on=False)
            continue
        face = "white" if row.verdict == "uninformative" else color
        bars = None if math.isnan(low) else [[max(value - low, 0)], [max(high - value, 0)]]
        axes.errorbar(x, value, bars, fmt=marker, color=color, markerfacecolor=face, elinewidth=1, capsize=2)
    correlation = with_miou(rows)[measure]
    ends = f"95 % {signed(correlation['low'])} to {signed(correlation['high'])}, {correlation['networks']} networks"
    axes.set_title(f"{TITLES[measure]}: rank correlation {signed(correlation['rho'])}\n({ends})", fontsize=10)
    axes.set_xlabel("published mIoU on PASCAL VOC, %")
    axes.grid(color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)


def show(results: Path, file: Path) -> None:
    """Print both tables and draw the figure.

    Raises:
        StudyError: If there are no results.
    """
    if not (results / CSV).exists():
        raise StudyError(f"{results / CSV} is not there: python scripts/real_networks.py run ...")
    rows = load(results)
    for name in dict.fromkeys(row.condition for row in rows):
        print(*network_table(rows, name), "", sep="\n")
    print(*condition_table(rows), "", sep="\n")
    for correlation in correlations(rows):
        if correlation["measure"] in PARTS or (correlation["of"], correlation["against"]) != ("all", "published_miou"):
            ends = f"({signed(correlation['low'])} to {signed(correlation['high'])})"
            pair = f"{correlation['measure']} with {correlation['against']}"
            count = f"{correlation['networks']} {correlation['of']}"
            print(f"{correlation['condition']:27}{pair:34}{signed(correlation['rho']):6}{ends:18}{count}")
    if any(row.condition == MAIN for row in rows):
        draw(rows, file)


# --- The sequence -----------------------------------------------------------------------------------------------------


def sequence(clone: Path, data: Path) -> None:
    """Write DATA/livingroom, a posed folder, from a clone of open3d_downloads.

    Raises:
        StudyError: If it is not in the clone, or DATA/livingroom is there already.
    """
    source, target = clone / "tests/reconstruction_system/livingroom1_clean_micro", data / "livingroom"
    log = source / "test_scene/trajectory.log"
    if not log.is_file():
        raise StudyError(f"{log} is not there: git clone https://github.com/isl-org/open3d_downloads")
    if target.exists():
        raise StudyError(f"{target} is there already")
    for name in ("color", "depth", "pose"):
        (target / name).mkdir(parents=True)
    lines = log.read_text().split("\n")
    for k in range(0, len(lines) // 5 * 5, 5):  # 'i i i+1', then camera to world
        name = f"{int(lines[k].split()[0]):05d}"
        np.savetxt(target / f"pose/{name}.txt", [[float(x) for x in line.split()] for line in lines[k + 1 : k + 5]])
        for kind, folder, suffix in (("color", "image", "jpg"), ("depth", "depth", "png")):
            (target / kind / f"{name}.{suffix}").write_bytes((source / folder / f"{name}.{suffix}").read_bytes())
    (target / "intrinsics.txt").write_text("525 0 319.5\n0 525 239.5\n0 0 1\n")  # Open3D's PrimeSense default
    (target / "scene.yaml").write_text("depth_scale: 1000\npose_convention: camera_to_world\ncamera_axes: opencv\n")
    print(f"{target}: {len(lines) // 5} frames")


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    words = commands.add_parser("sequence", help="write DATA/livingroom from a clone of open3d_downloads")
    words.add_argument("clone", type=Path)
    words.add_argument("--data", type=Path, required=True)
    words = commands.add_parser("run", help="predict, fuse and measure; a second start resumes")
    words.add_argument("--networks", type=Path, required=True, help="clone of EdgeNets with nets.py in it")
    words.add_argument("--data", type=Path, required=True, help="folder of livingroom/, hololens/, brighton/")
    words.add_argument("--work", type=Path, required=True, help="folder of label maps and runs")
    words.add_argument("--only", action="append", default=[], metavar="NAME", help="conditions that begin so")
    words.add_argument("--results", type=Path, default=ROOT / "results")
    words = commands.add_parser("show", help="print the tables and draw the figure, without computing")
    words.add_argument("--results", type=Path, default=ROOT / "results")
    words.add_argument("--figure", type=Path, default=FIGURE)
    asked = parser.parse_args(arguments)

    def work() -> None:
        if asked.command == "sequence":
            sequence(asked.clone, asked.data)
        elif asked.command == "run":
            folders = StudyFolders(*(path.absolute() for path in (asked.networks, asked.data, asked.work)))
            run(folders, asked.results, asked.only)
        else:
            show(asked.results, asked.figure)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
