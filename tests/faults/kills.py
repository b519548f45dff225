"""Kill runs, studies, predictions, exports and conversions at random moments, half of them at their folder's birth.

    python tests/faults/kills.py [COUNT [SEED [KIND...]]]       make faults: 315, 35 of each of 9 kinds

The kind `wide` is a run of 12 scenes and two models in two processes.

Each is then started again as it was, and has to leave what one without a kill leaves. Where several are at work on the
machine, a kill may come after the end: those are counted apart. Beside these, a fifth as many are started twice at
once: one of the two is refused in one line, or both end well.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import predicted_scene
import tiny_scene
import tiny_study
import video_scene
import yaml

from semstab.cli import app
from semstab.core.files import read_sealed
from semstab.recording.target import is_whole

Words = list[str]
KINDS = ("csv", "parquet", "ply", "laz", "tif", "glb")
"""The formats that are exported at once."""

ROOMS = 12
"""Scenes of the kind `wide`."""

TIMES = ("fuse_ms_per_frame", "stages_ms")


def in_a_child(words: Words, log: Path) -> int:
    """Start the command line in a process of its own, which has loaded everything already; its id."""
    child = os.fork()
    if child:
        return child
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1), os.dup2(out, 2)
    code = 1
    with contextlib.suppress(BaseException):
        try:
            app(words, standalone_mode=True)
        except SystemExit as ended:
            code = int(ended.code or 0)
    os._exit(code)


def finished(words: Words, log: Path) -> None:
    """Let it come to its end, which must be a good one."""
    _, status = os.waitpid(in_a_child(words, log), 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{' '.join(words)}: {log.read_text()[-2000:]}")


def killed(words: Words, log: Path, wait: Callable[[], None]) -> bool:
    """Kill it after a while; whether it was still at work."""
    child = in_a_child(words, log)
    wait()
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == -signal.SIGKILL


def beside(words: Words, logs: tuple[Path, Path], seconds: float) -> str | None:
    """Start it twice, the second a while after the first; what is wrong with their ends."""
    children = [in_a_child(words, logs[0])]
    time.sleep(seconds)
    children.append(in_a_child(words, logs[1]))
    ends = [
        (os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), log.read_text())
        for child, log in zip(children, logs, strict=True)
    ]
    refused = [said for code, said in ends if code == 2 and "another process" in said]
    if any(code for code, _ in ends) and (len(refused) != 1 or len(refused[0].splitlines()) != 1):
        return str(ends)
    return None


def of_run(out: Path) -> Any:
    """What a run or a study leaves: the summary without times, its files, and whether the recording is whole."""
    found = read_sealed(out / "summary.json")
    runs = [{key: value for key, value in run.items() if key not in TIMES} for run in found["runs"]]
    recording = out / "recording.rrd"
    names = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    return {**found, "runs": runs}, names, not recording.exists() or is_whole(recording)


def of_files(out: Path) -> Any:
    """What a conversion or a prediction leaves, file by file; manifests without times and places."""
    manifests = ("conversion.json", "predictions.json", "relabelled.json")
    files = sorted(path for path in out.rglob("*") if path.is_file())
    content = {str(path.relative_to(out)): path.read_bytes() for path in files if path.name not in manifests}
    told = [json.loads(path.read_text()) for path in files if path.name in manifests]
    frames = [list(line["frames"]) for line in told if isinstance(line.get("frames"), dict)]
    return content, frames, [{**line, "folder": None} for line in told if "confirmed" in line]


def kinds(base: Path) -> dict[str, tuple[Callable[[Path], Words], Callable[[Path], Any]]]:
    """What is killed: its words for a folder, and what is compared of that."""
    wall = tiny_scene.write(base / "wall", models=("a", "b"), frames=20)
    for k in range(ROOMS):
        tiny_scene.write(base / f"rooms/room{k:02d}", models=("a", "b"), frames=2)
    flight = predicted_scene.write(base / "flight")
    for name, wrong in (("one", (5, 12)), ("two", (3,)), ("three", ())):
        video_scene.write(base / "clips" / name, wrong)
    study = base / "tiny.yaml"
    study.write_text(yaml.safe_dump(tiny_study.content(tiny_study.write(base / "walls"), backends=["numpy"])))
    wide = ["--data", str(base / "rooms"), "--backend", "numpy", "--quiet", "--report", "off", "--voxel-size", "0.1"]
    common = ["--data", str(wall), "--backend", "numpy", "--quiet", "--report", "off", "--voxel-size", "0.1"]
    one = ["--data", str(wall), "--model", "a", "--backend", "numpy", "--quiet", "--report", "off", "--rerun", "off"]

    videos = ["--dataset", "video", "--data", str(base / "clips"), "--quiet", "--rerun", "off"]
    videos += ["--option", f"classes=[{','.join(video_scene.CLASSES)}]"]

    @functools.cache
    def fused() -> str:
        words = [sys.executable, "-m", "semstab", *one, "--voxel-size", "0.1", "--out", str(base / "fused")]
        subprocess.run(words, check=True)
        return str(base / "fused")

    return {
        "run": (lambda out: [*common, "--out", str(out)], of_run),
        "tiles": (
            lambda out: [*common, "--tile-size", "8", "--jobs", "2", "--rerun", "off", "--out", str(out)],
            of_run,
        ),
        "wide": (lambda out: [*wide, "--jobs", "2", "--rerun", "off", "--out", str(out)], of_run),
        "videos": (lambda out: [*videos, "--out", str(out)], of_run),
        "study": (lambda out: ["study", str(study), "--report", "off", "--quiet", "--out", str(out)], of_run),
        "predict": (
            lambda out: ["predict", "-m", "colour-clusters", "--data", str(flight), "--out", str(out), "--quiet"],
            of_files,
        ),
        "export": (
            lambda out: ["export", fused(), *(word for k in KINDS for word in ("--to", f"{out}/m.{k}")), "--quiet"],
            of_files,
        ),
        "relabel": (lambda out: ["relabel", fused(), "--out", str(out), "--quiet"], of_files),
        "convert": (lambda out: ["convert", "--data", str(wall), "--out", str(out), "--quiet"], of_files),
    }


def until_birth(out: Path, seconds: float) -> None:
    """Wait for the folder, or what lies in it, and a moment longer."""
    deadline = time.monotonic() + 30
    while not out.exists() and time.monotonic() < deadline:
        time.sleep(0.0002)
    time.sleep(seconds)


def main(count: int, seed: int, *only: str) -> None:
    """Kill so many, say how many ended as they should, and fail where one did not."""
    rng, told, wrong = random.Random(seed), collections.Counter[str](), []
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary)
        made, whole, seconds = kinds(base), {}, {}
        made = {kind: kill for kind, kill in made.items() if kind in (only or made)}
        for kind, (words, left) in made.items():
            started = time.monotonic()
            finished(words(base / kind), base / "log")
            seconds[kind] = time.monotonic() - started
            whole[kind] = left(base / kind)
        with contextlib.suppress(KeyboardInterrupt):  # says what it has come to
            for k in range(count):
                kind, birth = list(made)[k % len(made)], (k // len(made)) % 2 == 0
                (words, left), out = made[kind], base / f"{kind}{k}"
                moment = rng.random() * (0.03 if birth else seconds[kind])
                wait = functools.partial(until_birth, out, moment) if birth else functools.partial(time.sleep, moment)
                at_work = killed(words(out), base / "log", wait)
                finished(words(out), base / "log")
                told[f"{kind}, {'birth' if birth else 'later'}{'' if at_work else ', had ended'}"] += 1
                if left(out) != whole[kind]:
                    wrong.append(f"{kind} {k}: differs, killed at {moment:.3f} s{' of its birth' if birth else ''}")
            for k in range(count // 5):
                kind = list(made)[k % len(made)]
                (words, left), out = made[kind], base / f"twice {kind}{k}"
                fault = beside(words(out), (base / "log", base / "log2"), rng.random() * seconds[kind])
                finished(words(out), base / "log")
                told[f"{kind}, twice at once"] += 1
                if fault or left(out) != whole[kind]:
                    wrong.append(f"{kind} {k}, twice at once: {fault or 'differs'}")
    for what, times in sorted(told.items()):
        print(f"{times:3} {what}")
    print(f"{told.total() - len(wrong)} of {told.total()} left what one without a kill leaves")
    for line in wrong:
        print(line)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    count, seed, *only = (*sys.argv[1:], *("315", "0")[len(sys.argv) - 1 :])
    main(int(count), int(seed), *only)
