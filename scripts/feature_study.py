"""Do features agree where labels do? Ten networks in a room, and ten on eleven streets, with their features.

    python scripts/streets.py prepare mini_kitti_dataset --work WORK
    python scripts/feature_study.py run --edgenets EdgeNets --room ../shared/data/livingroom --work WORK
    python scripts/feature_study.py show

EdgeNets is the clone of scripts/streets.py, with scripts/nets.py in it; the room is any folder that `semstab-bench`
reads. `run` takes about an hour of one core, and goes on after a stop; `show` runs no network.

Each network gives its labels and the features before its classifier (scripts/feature_nets.py). Two vocabularies name
the features: the classifier's own classes, and groups of them. results/features.csv has a row for each network and
scene:

    data, street, network, family                street: the name of the scene
    spots, components       spots that two views saw or more; components of a feature
    feature_alpha, _low, _high, cosine, chance
    alpha, _low, _high      of the network's labels
    classes, meaning        of the classifier as a vocabulary; by the distances of its weights
    groups, _low, _high     of the vocabulary of groups
    named                   names of that vocabulary that have a label anywhere
    verdict                 of the network's labels
    level, kept, classes_seen, effective, merged
                            the finest groups on which views agree, of the classes with a label: stable, else usable
"""

from __future__ import annotations

import argparse
import math
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from outcome import StudyError, exit_code
from streets import write_rows
from streets_analysis import Array, StreetGrid, head, load, plain, row, signed, with_interval

import semstab
from semstab.data.records import Record

ROOT = Path(__file__).parents[1]

NETWORKS = {
    "livingroom": {
        "espnetv2_voc": (0.5, 1.0, 1.5, 2.0),
        "dicenet_voc": (0.2, 0.5, 0.75, 1.0, 1.25, 1.75),
    },
    "streets": {
        "espnetv2_city": (0.5, 1.0, 1.5, 2.0),
        "dicenet_city": (0.5, 0.75, 1.0, 1.25, 1.5, 1.75),
    },
}  # fmt: skip
"""Scales of each class of scripts/feature_nets.py, by data."""


def run(edgenets: Path, room: Path, work: Path, results: Path) -> None:
    """Run all networks on the room and on the streets, and write results/features.csv.

    Raises:
        StudyError: If a command fails.
    """
    data = {
        "livingroom": [str(room), "--frames", "::5", "--voxel-size", "0.02"],
        "streets": ["--dataset", "semantickitti_images", "--data", str(work / "data"), "--voxel-size", "0.2"],
    }
    rows = []
    for name, words in data.items():
        for network, scales in NETWORKS[name].items():
            for scale in scales:
                model = f"{network.partition('_')[0]}-{scale}"
                out = work / "features" / name / model
                vocabularies = [work / f"vocabularies/{name}/{model}/{of}.yaml" for of in ("classes", "groups")]
                for path in vocabularies:
                    _write_vocabulary(edgenets, network, scale, model, path)
                predictor = (
                    f"{ROOT / 'scripts/feature_nets.py'}:{network},scale={scale},networks={edgenets},name={model}"
                )
                command = [
                    "run", *words, "--predict", predictor, *(f"--vocabulary={path}" for path in vocabularies),
                    "--no-truth", "--rerun", "off", "--check", "none", "--out", str(out),
                ]  # fmt: skip
                done = subprocess.run([sys.executable, "-m", "semstab", *command, "--quiet"], check=False)
                if done.returncode not in (0, 1):
                    raise StudyError(f"exit code {done.returncode} of semstab-bench {shlex.join(command)}")
                records = {(r.unit.scene, r.unit.model): r for r in semstab.load_result(out).select()}
                rows += [_row(name, scene, model, records) for scene in sorted({scene for scene, _ in records})]
                print(model, name, flush=True)
    write_rows(results / "features.csv", rows)


def _write_vocabulary(edgenets: Path, network: str, scale: float, model: str, out: Path) -> None:
    """Write the classifier of a network as a vocabulary."""
    from feature_nets import write_vocabulary

    if not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        write_vocabulary(str(edgenets), network, scale, out, groups=out.stem == "groups", models=[model])


def _row(data: str, scene: str, network: str, of: Mapping[tuple[str, str], Record]) -> dict[str, Any]:
    statistics, classes, groups = (of[scene, f"{network}{end}"].statistics for end in ("", "@classes", "@groups"))
    assert statistics is not None
    assert statistics.features is not None
    assert classes is not None
    assert groups is not None
    features, groupings = (
        statistics.features,
        statistics.groupings and (statistics.groupings.stable or statistics.groupings.usable),
    )
    return {
        "data": data, "street": scene, "network": network, "family": network.partition("-")[0],
        "spots": features.spots, "components": features.components,
        **_interval("feature_alpha", features.alpha), "cosine": features.cosine, "chance": features.chance,
        **_interval("alpha", statistics.headline.alpha),
        "classes": classes.headline.alpha.value,
        "meaning": classes.spots.meaning.alpha.value if classes.spots and classes.spots.meaning else math.nan,
        **_interval("groups", groups.headline.alpha),
        "named": groups.groupings.classes if groups.groupings else 1,
        "verdict": statistics.verdict.level,
        "level": groupings.level if groupings else "", "kept": groupings.groups if groupings else math.nan,
        "classes_seen": statistics.groupings.classes if statistics.groupings else 1,
        "effective": groupings.effective if groupings else math.nan, "merged": groupings.text if groupings else "",
    }  # fmt: skip


def _interval(name: str, alpha: Any) -> dict[str, float]:
    return {name: alpha.value, f"{name}_low": alpha.low, f"{name}_high": alpha.high}


# --- Show -------------------------------------------------------------------------------------------------------------


def show(results: Path) -> None:
    """Print the tables of docs/open-vocabulary.md.

    Raises:
        StudyError: If there are no results.
    """
    if not (results / "features.csv").exists():
        raise StudyError(f"{results / 'features.csv'} is not there: python scripts/feature_study.py run ...")
    rows = load(results / "features.csv")
    accuracy = {(r["network"], r["street"]): r for r in load(results / "streets.csv") if r["condition"] == "main"}
    for title, lines in tables(rows, accuracy).items():
        print(f"{title}\n", *lines, "", sep="\n")


Rows = Sequence[Mapping[str, Any]]


def tables(rows: Rows, accuracy: Mapping[tuple[str, str], Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return the lines of each table, by its title."""
    room = [numbers for numbers in rows if numbers["data"] == "livingroom"]
    of_streets = [
        {**numbers, **{name: accuracy[numbers["network"], numbers["street"]][name] for name in ("accuracy", "miou")}}
        for numbers in rows
        if numbers["data"] == "streets"
    ]
    grid = StreetGrid(of_streets)
    return {
        "room": room_table(room),
        "streets, means": streets_table(grid),
        "differences on streets": differences_table(grid),
        "correlations on streets": correlations_table(grid),
        "distinctions that hold in the room": kept_table(room),
        "distinctions that hold on streets": kept_on_streets(of_streets),
    }


COLUMNS = {"feature_alpha": "features", "alpha": "labels", "meaning": "by meaning", "groups": "groups"}


def room_table(rows: Rows) -> list[str]:
    """Return the networks of the room, with intervals."""
    lines = head(["network", *COLUMNS.values()])
    for numbers in rows:
        cells = [_with_ends(numbers, name) if name.endswith("alpha") else plain(numbers[name]) for name in COLUMNS]
        lines.append(row([numbers["network"], *cells]))
    return lines


def _with_ends(numbers: Mapping[str, Any], name: str) -> str:
    return f"{plain(numbers[name])} ({plain(numbers[f'{name}_low'])} to {plain(numbers[f'{name}_high'])})"


def streets_table(grid: StreetGrid) -> list[str]:
    """Return the networks by accuracy, with means over streets."""
    lines = head(["network", "accuracy", *COLUMNS.values()])
    means = {name: np.nanmean(grid.column(name), axis=1) for name in ("accuracy", *COLUMNS)}
    for k in np.argsort(-means["accuracy"]):
        lines.append(row([grid.networks[k], *(plain(mean[k]) for mean in means.values())]))
    return lines


def differences_table(grid: StreetGrid) -> list[str]:
    """Return by how much alpha of features, by meaning and of groups exceeds alpha of labels."""
    lines, labels = head(["minus alpha of labels", "mean", "share of networks and streets"]), grid.column("alpha")
    for name, title in COLUMNS.items():
        if name != "alpha":
            share = float((grid.column(name) > labels).mean())
            mean = with_interval(grid, grid.column(name), lambda x, y: float(np.nanmean(x - y)), labels)
            lines.append(row([title, _text(mean), f"{100 * share:.0f} %"]))
    return lines


Statistic = Callable[[Array, Array], float]


def correlations_table(grid: StreetGrid) -> list[str]:
    """Return what each number tells of networks and of streets."""
    from streets_analysis import between_networks, streets, streets_of_a_network

    asked: dict[str, Statistic] = {
        "which network": between_networks, "which street, for one network": streets_of_a_network,
        "which street, mean of networks": streets,
    }  # fmt: skip
    lines = head(["number", "against", *asked])
    pairs = [(name, against) for against in ("accuracy", "miou") for name in COLUMNS] + [("feature_alpha", "alpha")]
    for name, against in pairs:
        found = [with_interval(grid, grid.column(name), of, grid.column(against)) for of in asked.values()]
        lines.append(row([COLUMNS[name], COLUMNS.get(against, against), *map(_text, found)]))
    return lines


def _text(found: tuple[float, float, float]) -> str:
    value, low, high = map(signed, found)
    return f"{value} ({low} to {high})"


def kept_table(rows: Rows) -> list[str]:
    """Return the finest groups of classes on which views agree, by network of the room."""
    lines = head(["network", "labels", "verdict", "groups that hold", "merged"])
    for numbers in rows:
        holds = (
            f"{numbers['level']}: {numbers['kept']:.0f} of {numbers['classes_seen']:.0f}" if numbers["level"] else "-"
        )
        lines.append(
            row([numbers["network"], plain(numbers["alpha"]), numbers["verdict"], holds, numbers["merged"] or "-"])
        )
    return lines


def kept_on_streets(rows: Rows) -> list[str]:
    """Return on how many streets all classes hold, or groups of them, and which classes are merged most often."""
    lines = head(["network", "labels", "all classes", "stable groups", "usable groups", "neither", "merged most often"])
    for network in dict.fromkeys(numbers["network"] for numbers in rows):
        of_network = [numbers for numbers in rows if numbers["network"] == network]
        levels = ["all" if numbers["verdict"] == "stable" else numbers["level"] for numbers in of_network]
        merged = Counter(group for numbers in of_network for group in filter(None, numbers["merged"].split(", ")))
        often = ", ".join(
            f"{group} ({n})" for group, n in sorted(merged.items(), key=lambda item: (-item[1], item))[:1]
        )
        alpha = float(np.nanmean([numbers["alpha"] for numbers in of_network]))
        counts = (str(levels.count(level)) for level in ("all", "stable", "usable", ""))
        lines.append(row([network, plain(alpha), *counts, often or "-"]))
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    words = commands.add_parser("run", help="predict, fuse, measure and write results; a second start resumes")
    for name in ("edgenets", "room", "work"):
        words.add_argument(f"--{name}", type=Path, required=True)
    words.add_argument("--results", type=Path, default=ROOT / "results")
    words = commands.add_parser("show", help="print the tables")
    words.add_argument("--results", type=Path, default=ROOT / "results")
    asked = parser.parse_args(arguments)

    def work() -> None:
        if asked.command == "run":
            run(asked.edgenets.absolute(), asked.room.absolute(), asked.work.absolute(), asked.results)
        else:
            show(asked.results)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
