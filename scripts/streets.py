"""Does stability tell which network is right, and where? Networks of Cityscapes on eleven streets with ground truth.

    git clone https://github.com/rancheng/mini_kitti_dataset && git -C mini_kitti_dataset checkout 2a36153
    git clone https://github.com/sacmehta/EdgeNets && git -C EdgeNets checkout 2b232d3 && cp scripts/nets.py EdgeNets
    git clone https://github.com/sacmehta/ESPNet && git -C ESPNet checkout afe71c3
    git clone https://github.com/google-coral/test_data coral && git -C coral checkout 104342d
    pip install torch ai-edge-litert scikit-learn
    python scripts/streets.py prepare mini_kitti_dataset --work WORK
    python scripts/streets.py predict --edgenets EdgeNets --espnet ESPNet --coral coral --work WORK
    python scripts/streets.py run --work WORK
    python scripts/streets.py show

`predict` and `run` take half an hour each on two cores; both go on where they were stopped. `show` runs no network: it
prints the tables of docs/real-networks.md and draws its figures from results/streets.csv and streets-classes.csv.

Streets: the first ten images of SemanticKITTI 00 to 10 (CC BY-NC-SA 4.0), with depth and the true class at the pixels
of the LiDAR's points, read by `semantickitti_images`; things that move are masked. calib.txt of this copy lacks Tr, so
`prepare` adds the values of KITTI's odometry. Labels are compared in the taxonomy `cityscapes`: a network's
'background' is wrong everywhere.
Networks: scripts/street_nets.py; fourteen of four families, and eight variants that are worse by construction.

results/streets.csv has a row for each network on each street, in each condition; others than `main` have alpha and VSS:

    accuracy, miou          of the labels of single frames at the LiDAR's pixels; mIoU over the classes of the truth
    alpha, _low, _high      agreement of two views of a spot beyond chance, with its 95 % interval
    meaning                 alpha by the distance between Cityscapes' categories
    verdict, probability    the most probable level
    vss, sbd, entropy       means over voxels with OP >= 3; vss2 of OP >= 2
    agree                   probability that two frames agree on a voxel, OP >= 2
    flicker, compensated    percent of the pixels whose label differs in consecutive frames; after warping by depth
    vc, tc                  video consistency over 8 frames, of all pixels (no ground truth), and temporal consistency
    softmax, flip           mean largest softmax of single frames; share of pixels that keep their label if the image is
                            mirrored
    auroc_*                 of a sign for wrong labels at the LiDAR's pixels, see SIGNS
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from outcome import StudyError, exit_code

import semstab
from semstab.backends import create
from semstab.backends.shared.association import back_project, voxel_index
from semstab.core.files import atomic_path
from semstab.data.measures import entropy, sbd, vss
from semstab.data.records import Record
from semstab.data.voxels import VoxelTable
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.agreement import psa
from semstab.statistics.cluster_sums import value
from semstab.statistics.observations import SpotObservations
from semstab.statistics.sampler import Sampler
from semstab.task import open_scenes, read, tasks_of, truth_task

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "simulations"))  # signs of wrong labels
STREETS = tuple(f"{k:02d}" for k in range(11))
FRAMES = 10

TR = {
    ("00", "01", "02"):
        "4.276802385584e-04 -9.999672484946e-01 -8.084491683471e-03 -1.198459927713e-02 -7.210626507497e-03 "
        "8.081198471645e-03 -9.999413164504e-01 -5.403984729748e-02 9.999738645903e-01 4.859485810390e-04 "
        "-7.206933692422e-03 -2.921968648686e-01",
    ("03",):
        "2.347736981471e-04 -9.999441545438e-01 -1.056347781105e-02 -2.796816941295e-03 1.044940741659e-02 "
        "1.056535364138e-02 -9.998895741176e-01 -7.510879138296e-02 9.999453885620e-01 1.243653783865e-04 "
        "1.045130299567e-02 -2.721327964059e-01",
    ("04", "05", "06", "07", "08", "09", "10"):
        "-1.857739385241e-03 -9.999659513510e-01 -8.039975204516e-03 -4.784029760483e-03 -6.481465826011e-03 "
        "8.051860151134e-03 -9.999466081774e-01 -7.337429464231e-02 9.999773098287e-01 -1.805528627661e-03 "
        "-6.496203536139e-03 -3.339968064433e-01",
}  # fmt: skip
"""Tr of KITTI's odometry, from the LiDAR to camera 0, by sequence."""


def prepare(clone: Path, work: Path) -> None:
    """Write WORK/data/NN: ten frames of each sequence in SemanticKITTI's layout.

    Raises:
        StudyError: If the clone has no such files.
    """
    source = clone / "dataset/sequences"
    if not (source / "00/image_2/000000.png").is_file():
        raise StudyError(f"{source}/00/image_2 is not there: git clone https://github.com/rancheng/mini_kitti_dataset")
    for street in STREETS:
        target = work / "data" / street
        for folder, suffix in (("image_2", "png"), ("velodyne", "bin"), ("labels", "label")):
            (target / folder).mkdir(parents=True, exist_ok=True)
            for k in range(FRAMES):
                name = f"{k:06d}.{suffix}"
                (target / folder / name).write_bytes((source / street / folder / name).read_bytes())
        calibration = (source / street / "calib.txt").read_text()
        if not any(line.startswith("Tr") for line in calibration.splitlines()):
            calibration = calibration.rstrip("\n") + f"\nTr: {next(v for k, v in TR.items() if street in k)}\n"
        (target / "calib.txt").write_text(calibration)
        poses = (source / street / "poses.txt").read_text().splitlines()[:FRAMES]
        (target / "poses.txt").write_text("\n".join(poses) + "\n")
    print(f"{work / 'data'}: {len(STREETS)} streets of {FRAMES} frames")


# --- Predict ----------------------------------------------------------------------------------------------------------


def predict(edgenets: Path, espnet: Path, coral: Path, work: Path) -> None:
    """Write the label maps, the largest scores and what a mirrored image changes, of all networks on all streets."""
    import street_nets
    import torch

    torch.set_num_threads(1)
    for network in street_nets.networks(edgenets, espnet, coral):
        paths = {street: work / "single" / street / f"{file_name(network.name)}.json" for street in STREETS}
        if all(path.exists() for path in paths.values()):
            continue
        labeller = network.load()
        for street, path in paths.items():
            images = sorted((work / "data" / street / "image_2").glob("*.png"))
            labels, top = (work / kind / street / file_name(network.name) for kind in ("labels", "top"))
            frames = [_predicted(labeller, network.spoil, image, labels, top) for image in images]
            (labels / "label_space.yaml").write_text((ROOT / "configs/taxonomies/cityscapes.yaml").read_text())
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps({"family": network.family, "of": network.of, "frames": frames}))
        print(network.name, flush=True)


def _predicted(
    labeller: Callable[[Any], Any], spoil: Callable[[Any], Any] | None, image: Path, labels: Path, top: Path
) -> dict[str, float | None]:
    """Write a frame's labels, and its largest scores times 255; return their mean and the share that a mirror keeps."""
    rgb = cv2.cvtColor(cv2.imread(str(image)), cv2.COLOR_BGR2RGB)
    rgb = rgb if spoil is None else spoil(rgb)
    out, mirrored = labeller(rgb), labeller(np.ascontiguousarray(rgb[:, ::-1]))[:, ::-1]
    scored = out.ndim == 3
    label, other = (output.argmax(axis=2) if scored else output for output in (out, mirrored))
    labels.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(labels / image.name), label.astype(np.uint8))
    softmax = None
    if scored:
        largest = out.max(axis=2)
        softmax = float(largest.mean())
        top.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(top / image.name), np.rint(255 * largest).astype(np.uint8))
    return {"softmax": softmax, "flip": float((label == other).mean())}


def file_name(network: str) -> str:
    """Return a network's name as the name of a folder and of a model."""
    return network.replace("/", "-")


# --- Run and measure --------------------------------------------------------------------------------------------------

CONDITIONS: dict[str, tuple[float, str, str]] = {
    "voxels of 0.1 m": (0.1, "mask", "::1"),
    "voxels of 0.4 m": (0.4, "mask", "::1"),
    "every second frame": (0.2, "mask", "::2"),
    "things that move kept": (0.2, "keep", "::1"),
}
"""Other choices: voxel size in metres, whether things that move are masked, and frames."""

SIGNS = ("disagreement", "entropy", "border", "softmax")
"""Signs that the label of a pixel is wrong: 1 - PSA and the entropy of its voxel, how near the next border of its own
label map is, and 1 minus its largest score; `all` is a logistic regression of the four, fitted on the other streets."""


def run(work: Path, results: Path) -> None:
    """Fuse and measure each condition, and write the results.

    Raises:
        StudyError: If a command fails.
    """
    about, out = _about(work), work / "runs/main"
    command = [
        "run", "--dataset", "semantickitti_images", "--data", str(work / "data"), "--taxonomy", "cityscapes",
        "--option", f"labels_root={work / 'labels'}", "--voxel-size", "0.2", "--video-measures", "depth", "--no-truth",
        "--rerun", "off", "--out", str(out), *(word for model in about for word in ("--model", model)),
    ]  # fmt: skip
    done = subprocess.run([sys.executable, "-m", "semstab", *command, "--quiet"], check=False)
    if done.returncode not in (0, 1):
        raise StudyError(f"exit code {done.returncode} of semstab-bench {shlex.join(command)}")
    records = semstab.load_result(out).select()
    numbers, classes = _against_truth(out, records, work)
    rows = [
        {"condition": "main", **_row(r, about[r.unit.model]), **numbers[r.unit.scene, r.unit.model]} for r in records
    ]
    rows += _halves(records, about)
    rows += _under_other_choices(out, about)
    accuracy = {(row["street"], row["network"]): row["accuracy"] for row in rows if row["condition"] == "main"}
    for row in rows:
        row["accuracy"] = accuracy[row["street"], row["network"]]
    write_rows(results / "streets.csv", rows)
    write_rows(results / "streets-classes.csv", classes)
    _describe(results / "streets.json", shlex.join(["semstab-bench", *command]).replace(str(work), "WORK"), about, work)


def _under_other_choices(out: Path, about: Mapping[str, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield rows with alpha and VSS in each of CONDITIONS, of the networks without the variants."""
    config = semstab.load_config(out / "config.yaml")
    for condition, (voxel_size, moving, frames) in CONDITIONS.items():
        options = {**config.dataset.options, "moving": moving}
        changed = config.model_copy(update={"dataset": config.dataset.model_copy(update={"options": options})})
        stride = int(frames.rpartition(":")[2])
        for street, scene in open_scenes(changed, out).items():
            for task in tasks_of(scene, changed):
                if about[task.model]["of"]:
                    continue
                K = len(task.mapping.target.classes)
                backend, sampler = create("numba", voxel_size=voxel_size, num_classes=K), Sampler(K)
                for index in task.indices[::stride]:
                    frame = read(task, index)
                    backend.integrate(frame)
                    sampler.add(frame)
                of = {"street": street, "network": task.model, "family": about[task.model]["family"], "of": ""}
                alpha = value(sums_of_spots(sampler.sample(task.mapping.target.classes)), "alpha")
                yield {"condition": condition, **of, "alpha": alpha, "vss": _means(backend.table(), 3)["vss"]}
        print(condition, flush=True)


def _about(work: Path) -> dict[str, dict[str, Any]]:
    """Return of each network its family, what it is a variant of, and its softmax and flip by street."""
    about: dict[str, dict[str, Any]] = {}
    for street in STREETS:
        for path in sorted((work / "single" / street).glob("*.json")):
            content = json.loads(path.read_text())
            one = about.setdefault(path.stem, {"family": content["family"], "of": file_name(content["of"])})
            softmax = [frame["softmax"] for frame in content["frames"]]
            one[street] = {
                "softmax": math.nan if None in softmax else float(np.mean(softmax)),
                "flip": float(np.mean([frame["flip"] for frame in content["frames"]])),
            }
    if not about:
        raise StudyError(f"{work}: no predictions; python scripts/streets.py predict ...")
    return about


def _row(record: Record, about: dict[str, Any]) -> dict[str, Any]:
    statistics, image = record.statistics, record.image_space
    assert statistics is not None
    assert statistics.spots is not None
    alpha, video = statistics.headline.alpha, record.video_measures
    op2, op3 = (_means(record.table(), op) for op in (2, 3))
    return {
        "street": record.unit.scene, "network": record.unit.model, "family": about["family"], "of": about["of"],
        "alpha": alpha.value, "alpha_low": alpha.low, "alpha_high": alpha.high,
        "meaning": statistics.spots.meaning.alpha.value if statistics.spots.meaning else math.nan,
        "verdict": statistics.verdict.level, "probability": statistics.verdict.probability,
        "vss": op3["vss"], "sbd": op3["sbd"], "entropy": op3["entropy"], "vss2": op2["vss"],
        "agree": statistics.headline.psa_op2.value,
        "flicker": record.flicker_percent, "compensated": image.compensated_flicker_percent,
        "vc": video.self_vc8.value if video else math.nan, "tc": video.tc.etc if video else math.nan,
        **about[record.unit.scene],
    }  # fmt: skip


def _means(table: VoxelTable, op: int) -> dict[str, float]:
    """Return means over the voxels that at least `op` frames saw."""
    often = table.rows(np.flatnonzero(table.op >= op))
    return {name: float(np.mean(of(often))) for name, of in (("vss", vss), ("sbd", sbd), ("entropy", entropy))}


def _halves(records: Sequence[Record], about: Mapping[str, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield rows with alpha of one half of the spots, and of the other."""
    for record in records:
        one, file = about[record.unit.model], record.observations_file
        if one["of"] or file is None:
            continue
        spots = SpotObservations.load(file)
        first = (spots.drawn < np.median(spots.drawn))[spots.spot]
        for condition, rows in (("half of the spots", first), ("the other half", ~first)):
            alpha = value(sums_of_spots(spots.only(rows)), "alpha")
            of = {"street": record.unit.scene, "network": record.unit.model, "family": one["family"], "of": ""}
            yield {"condition": condition, **of, "alpha": alpha}


Measured = tuple[dict[tuple[str, str], dict[str, float]], list[dict[str, Any]]]


def _against_truth(out: Path, records: Sequence[Record], work: Path) -> Measured:
    """Return accuracy, mIoU and the AUROC of signs by street and network, and rows of classes."""
    from signs import auroc

    config, table = semstab.load_config(out / "config.yaml"), {(r.unit.scene, r.unit.model): r for r in records}
    numbers: dict[tuple[str, str], dict[str, float]] = {}
    pixels: dict[tuple[str, str], tuple[Any, Any]] = {}
    classes = []
    for street, scene in open_scenes(config, out).items():
        for task in tasks_of(scene, config):
            record = table[street, task.model]
            confusion, signs, wrong = _pixels(task, record.table(), work)
            present = confusion.sum(axis=1) > 0
            iou = np.diag(confusion) / np.maximum(confusion.sum(axis=0) + confusion.sum(axis=1) - np.diag(confusion), 1)
            numbers[street, task.model] = {
                "accuracy": float(np.trace(confusion) / confusion.sum()),
                "miou": float(iou[present].mean()),
                "pixels": float(len(wrong)),
                **{f"auroc_{name}": auroc(sign, wrong) for name, sign in zip(SIGNS, signs, strict=True)},
            }
            pixels[street, task.model] = signs, wrong
            alphas = {counted.name: counted.alpha.value for counted in record.statistics.spots.classes}
            for k, name in enumerate(task.mapping.target.classes):
                if present[k] or confusion[:, k].any():
                    of_class = {
                        "true": int(confusion[k].sum()), "said": int(confusion[:, k].sum()),
                        "right": int(confusion[k, k]),
                    }  # fmt: skip
                    row = {"street": street, "network": task.model, "class": name, "alpha": alphas.get(name, math.nan)}
                    classes.append(row | of_class)
    for network in {network for _, network in pixels}:
        for street, area in _together({s: pixels[s, n] for s, n in pixels if n == network}).items():
            numbers[street, network]["auroc_all"] = area
    return numbers, classes


def _pixels(task: Any, table: VoxelTable, work: Path) -> tuple[Any, Any, Any]:
    """Return the confusion (K, K) of single frames, true classes first, signs (4, n) and whether n pixels are wrong."""
    from signs import VoxelRows, to_border

    K = len(task.mapping.target.classes)
    rows, of_voxel = VoxelRows(table), np.stack([1 - np.nan_to_num(psa(table), nan=1.0), entropy(table)])
    of_truth = truth_task(task)
    confusion, signs, wrongs = np.zeros((K, K), np.int64), [], []
    for index in task.indices:
        frame, truth = read(task, index), read(of_truth, index)
        label, true = frame.labels, truth.labels
        both = frame.valid & (true < K)
        confusion += np.bincount(true[both].astype(int) * K + label[both], minlength=K * K).reshape(K, K)
        voxel = rows.find(voxel_index(back_project(frame), table.voxel_size, frame).T)
        again, here = table.op[voxel] >= 2, np.full(frame.shape, -1)
        here[frame.valid] = np.where(again, voxel, -1)
        both &= here >= 0
        top = work / "top" / task.scene.name / task.model / f"{index:06d}.png"
        softmax = cv2.imread(str(top), cv2.IMREAD_UNCHANGED) if top.exists() else None
        whole = cv2.imread(str(work / "labels" / task.scene.name / task.model / top.name), cv2.IMREAD_UNCHANGED)
        unsure = np.full(frame.shape, math.nan) if softmax is None else 1 - softmax / 255
        signs.append(np.stack([*of_voxel[:, here[both]], -to_border(whole)[both], unsure[both]]))
        wrongs.append(label[both] != true[both])
    return confusion, np.concatenate(signs, axis=1), np.concatenate(wrongs)


def _together(pixels: Mapping[str, tuple[Any, Any]]) -> dict[str, float]:
    """Return by street the AUROC of a logistic regression of all signs, fitted on the other streets."""
    from signs import auroc
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    areas = {}
    for street, (signs, wrong) in pixels.items():
        if np.isnan(signs).any():
            return dict.fromkeys(pixels, math.nan)
        others = [pixels[other] for other in pixels if other != street]
        x, y = np.concatenate([s for s, _ in others], axis=1).T, np.concatenate([w for _, w in others])
        some = slice(None, None, max(1, len(y) // 50_000))
        fitted = make_pipeline(StandardScaler(), LogisticRegression()).fit(x[some], y[some])
        areas[street] = auroc(fitted.decision_function(signs.T), wrong)
    return areas


# --- Results ----------------------------------------------------------------------------------------------------------


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of numbers and texts as CSV; NaN is empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _text(row.get(name, math.nan)) for name in names} for row in rows)


def _text(value: object) -> str:
    return str(value) if not isinstance(value, float) else "" if math.isnan(value) else f"{value:.6g}"


def _describe(path: Path, command: str, about: Mapping[str, Any], work: Path) -> None:
    """Write versions, commands and digests of what was read."""
    packages = ("semstab", "numpy", "numba", "opencv-python-headless", "scipy", "torch", "ai-edge-litert")
    folders = {
        f"{kind}/{street}{name and '/' + name}": digest(work / kind / street / name)
        for street in STREETS
        for kind, names in (("data", ("image_2", "velodyne", "labels")), ("labels", sorted(about)))
        for name in names
    }
    content = {
        "schema": 1,
        "versions": {"python": platform.python_version()} | {name: metadata.version(name) for name in packages},
        "command": command,
        "sha256": folders,
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def digest(folder: Path) -> str:
    """Return the SHA-256 of the lines that sha256sum prints for a folder's files, by name."""
    lines = [
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n"
        for file in sorted(folder.iterdir())
        if file.is_file()
    ]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


# --- Show -------------------------------------------------------------------------------------------------------------


def show(results: Path, figures: Path) -> None:
    """Print all tables and draw the figures.

    Raises:
        StudyError: If there are no results.
    """
    import streets_analysis as analysis
    import streets_figures

    if not (results / "streets.csv").exists():
        raise StudyError(f"{results / 'streets.csv'} is not there: python scripts/streets.py run --work WORK")
    rows, classes = (analysis.load(results / name) for name in ("streets.csv", "streets-classes.csv"))
    for title, lines in tables(rows, classes).items():
        print(f"{title}\n", *lines, "", sep="\n")
    main_rows = [row for row in rows if row["condition"] == "main" and not row["of"]]
    streets_figures.draw(analysis.StreetGrid(main_rows), figures)


def tables(rows: Sequence[dict[str, Any]], classes: Sequence[dict[str, Any]]) -> dict[str, list[str]]:
    """Return the lines of each table, by its title."""
    import streets_analysis as analysis

    main_rows = [row for row in rows if row["condition"] == "main"]
    networks = [row for row in main_rows if not row["of"]]
    grid = analysis.StreetGrid(networks)
    by_class, correlation = analysis.classes_table(classes, grid.networks)
    return {
        "networks": analysis.networks_table(grid),
        "questions, by accuracy": analysis.questions_table(grid),
        "questions, by mIoU": analysis.questions_table(grid, "miou"),
        "variants that are worse by construction": analysis.variants_table(main_rows),
        "verdicts": analysis.verdicts_table(networks),
        "places": analysis.places_table(grid),
        f"classes; in a network alpha ranks classes as IoU does: {analysis.signed(correlation)}": by_class,
        "beyond the softmax": analysis.beyond_softmax(grid),
        "choices": analysis.choices_table(rows),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    words = commands.add_parser("prepare", help="write WORK/data from a clone of mini_kitti_dataset")
    words.add_argument("clone", type=Path)
    words.add_argument("--work", type=Path, required=True, help="folder of data, predictions and runs")
    words = commands.add_parser("predict", help="write label maps; a second start resumes")
    for name in ("edgenets", "espnet", "coral", "work"):
        words.add_argument(f"--{name}", type=Path, required=True)
    words = commands.add_parser("run", help="fuse, measure and write results; a second start resumes")
    words.add_argument("--work", type=Path, required=True)
    words.add_argument("--results", type=Path, default=ROOT / "results")
    words = commands.add_parser("show", help="print the tables and draw the figures")
    words.add_argument("--results", type=Path, default=ROOT / "results")
    words.add_argument("--figures", type=Path, default=ROOT / "docs")
    asked = parser.parse_args(arguments)

    def work() -> None:
        if asked.command == "prepare":
            prepare(asked.clone, asked.work)
        elif asked.command == "predict":
            predict(asked.edgenets, asked.espnet, asked.coral, asked.work)
        elif asked.command == "run":
            run(asked.work.absolute(), asked.results)
        else:
            show(asked.results, asked.figures)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
