"""Check that each extra of setup.cfg, alone with the base install, does its work; without it, a line names it.

    python scripts/extras.py [EXTRA ...] [--constraint torch==2.13.0]

prints a Markdown table. Models are tiny and of random weights (`tests/tiny_models.py`); none is downloaded.
For PyTorch's CPU build, let pip find its wheel (PIP_FIND_LINKS, PIP_INDEX_URL) and say its version as above.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import fresh

SCENE = ("--data", "scene", "--frames", "::8", "--backend", "numpy", "--check", "none")
"""Options of a run on the built-in city as a folder of files."""

TINY = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import tiny_models
tiny_models.{model}(Path({model!r}))
"""

SMP = """
import torch, segmentation_models_pytorch
net = segmentation_models_pytorch.create_model("unet", encoder_name="resnet18", encoder_weights=None, classes=4)
torch.save(net.state_dict(), "smp.pth")
"""

TFLITE = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import tiny_tflite
tiny_tflite.write(Path("net.tflite"))
"""

NETWORK = """
import numpy as np, onnx
from onnx import TensorProto, helper, numpy_helper
rng = np.random.default_rng(0)
weight = numpy_helper.from_array(rng.normal(size=(4, 3, 3, 3)).astype("float32"), "weight")
conv = helper.make_node("Conv", ["image", "weight"], ["logits"], strides=[2, 2], pads=[1, 1, 1, 1])
image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])
graph = helper.make_graph([conv], "net", [image], [helper.make_empty_tensor_value_info("logits")], [weight])
onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), "net.onnx")
"""

GEO = """
import laspy, rasterio
cloud, raster = laspy.read("map.laz"), rasterio.open("map.tif")
assert len(cloud.points) > 1000, len(cloud.points)
assert cloud.header.parse_crs().to_epsg() == raster.crs.to_epsg() == 32615
"""

FLIGHT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import bag_writer, dataset_writers
bag_writer.write_bag(Path("flight"), "ROS 1", lambda ros: bag_writer.records(ros, dataset_writers.source(1000)))
"""

RECORDS = """
import h5py, numpy as np
with h5py.File("sensor_records.hdf5", "w") as records:
    truth = records.create_group("trajectory_0000/groundtruth")
    truth["position"], truth["attitude"] = np.zeros((8, 3)), np.eye(4)[[0] * 8]
"""

MIDAIR = """from pathlib import Path
    from semstab.datasets.midair import read_flight
    print(len(read_flight(Path("sensor_records.hdf5").absolute(), "trajectory_0000")[0]), "poses")"""

CLUSTER = """
import subprocess, sys
if __name__ == "__main__":
    address = "tcp://127.0.0.1:9"
    if sys.argv[1] == "there":
        from distributed import LocalCluster
        cluster = LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None)
        address = cluster.scheduler_address
    sys.exit(subprocess.run([sys.executable, "-m", "semstab", *sys.argv[2:], "--scheduler", address]).returncode)
"""

CALL = """
import sys, semstab
try:
    {call}
except semstab.SemstabError as error:
    print("error:", error, file=sys.stderr)
    sys.exit(error.exit_code)
"""

TRAINING = """from semstab.online.torch_metric import TemporalStability
    import torchmetrics
    assert issubclass(semstab.TemporalStability, torchmetrics.Metric) and semstab.TemporalStability is TemporalStability
    print(semstab.TemporalStability(num_classes=7, voxel_size=0.2))"""

TESTING = """import semstab.testing
    import pytest
    sys.exit(pytest.main(["-q", "-p", "no:cacheprovider", "test_mine.py"]))"""

MINE = """
from semstab import backends
from semstab.testing import BackendConformance

class TestMine(BackendConformance):
    def create(self, voxel_size, num_classes):
        return backends.create("numpy", voxel_size=voxel_size, num_classes=num_classes)
"""


@dataclass(frozen=True)
class Use:
    """The use of an extra, and its proof.

    Attributes:
        shown: The use in the table.
        commands: Without the extra, each prints one line that names the extra; with the extra, each has the exit code
            0. 'OUT' is a new folder.
        said: Text that the last command prints.
        prepare: Code that makes what the commands need, run with the extra.
        proof: Code that looks at what they wrote.
        files: Files that the commands need.
        over: Another extra without which nothing would ask for this one.
    """

    shown: str
    commands: tuple[tuple[str, ...], ...]
    said: str = ""
    prepare: str = ""
    proof: str = ""
    files: tuple[tuple[str, str], ...] = ()
    over: str = ""


def predicting(model: str, predictor: str, *more: str, over: str = "") -> Use:
    """Return a run with labels of a tiny model."""
    command = ("-m", "semstab", *SCENE, "--predict", predictor, *more, "--out", "OUT")
    title = f"`--predict {predictor.partition(',points')[0]}`, a tiny model"
    prepare = {"onnx": NETWORK, "smp": SMP, "tflite": TFLITE}.get(model, TINY)
    prepare = prepare.format(tests=str(fresh.SOURCE / "tests"), model=model) if prepare in (TINY, TFLITE) else prepare
    return Use(title, (command,), "verdict", prepare=prepare, over=over)


SAM = "points_per_side=4,pred_iou=0.5,stability=0.3,stability_offset=0.01,nms_iou=0.95,min_area=20"

USES = {
    "torch": Use(
        "`--backend torch --frames ::8`, against numpy",
        (("-m", "semstab", "--backend", "torch", "--frames", "::8", "--check", "numpy", "--out", "OUT"),),
        "checked torch against numpy on ",
    ),
    "segformer": predicting("segformer", "segformer,checkpoint=segformer"),
    "sam": predicting("sam", f"sam-heuristic,checkpoint=sam,{SAM}"),
    "segearth": predicting("clip", "segearth-ov,checkpoint=clip"),
    "torchvision": predicting("segformer", "segformer,checkpoint=segformer,processor=torchvision", over="segformer"),
    "onnx": predicting("onnx", "net.onnx", "--classes", "building,road,tree,car"),
    "tflite": predicting("tflite", "net.tflite", "--classes", "building,road,tree,car"),
    "smp": predicting("smp", "smp,encoder=resnet18,checkpoint=smp.pth", "--classes", "building,road,tree,car"),
    "geo": Use(
        "a run with `crs`, `export` to .laz and .tif",
        (
            ("-m", "semstab", *SCENE, "--option", "crs=EPSG:32615", "--out", "OUT"),
            ("-m", "semstab", "export", "with-geo", "--to", "map.laz"),
            ("-m", "semstab", "export", "with-geo", "--to", "map.tif"),
        ),
        "map.tif",
        proof=GEO,
    ),
    "bags": Use(
        "`check flight.bag`, four frames",
        (("-m", "semstab", "check", "flight.bag"),),
        "/camera/aligned_depth_to_color/image_raw",
        prepare=FLIGHT.format(tests=str(fresh.SOURCE / "tests")),
    ),
    "midair": Use(
        "the poses of a `sensor_records.hdf5`",
        (("-c", CALL.format(call=MIDAIR)),),
        "8 poses",
        prepare=RECORDS,
    ),
    "pandas": Use(
        "`semstab.load(RUN).summary`",
        (("-c", CALL.format(call="print(semstab.load('base').summary)")),),
        "flicker_percent",
    ),
    "cluster": Use(
        "`--scheduler` with two workers",
        (("cluster.py", "PRESENCE", *SCENE, "--out", "OUT"),),
        "verdict",
        files=(("cluster.py", CLUSTER),),
    ),
    "training": Use(
        "`semstab.TemporalStability` is a torchmetrics.Metric",
        (("-c", CALL.format(call=TRAINING)),),
        "TemporalStability",
    ),
    "testing": Use(
        "`semstab.testing.BackendConformance` by pytest",
        (("-c", CALL.format(call=TESTING)),),
        " passed",
        files=(("test_mine.py", MINE),),
    ),
}


@dataclass(frozen=True)
class Fresh:
    """A base install, and copies of it with an extra each; extras with the same requirements share one.

    Attributes:
        folder: Where all of it lies, and where the commands run.
        wheel: Of this source.
        constraints: A file for pip.
    """

    folder: Path
    wheel: Path
    constraints: Path

    @property
    def base(self) -> Path:
        """The base install's Python."""
        return self.folder / "venv-base" / "bin" / "python"

    def with_extra(self, name: str) -> Path:
        """Return the Python of the base install with one extra, made by hard links, which pip never writes through."""
        extras = fresh.setup()["options.extras_require"]
        first = next(extra for extra in extras if extras[extra] == extras[name])
        venv = self.folder / f"venv-{first}"
        if not venv.exists():
            shutil.copytree(self.folder / "venv-base", venv, symlinks=True, copy_function=os.link)
            self.install(venv / "bin" / "python", f"{self.wheel}[{name}]")
        return venv / "bin" / "python"

    def install(self, python: Path, what: str) -> None:
        """Install without byte code: most of it is never run here."""
        fresh.pip(python, "install", "--no-compile", "-c", str(self.constraints), what)


def words_of(command: Sequence[str], out: str, presence: str) -> list[str]:
    """Return a command with its own folder, for the time with or without the extra."""
    return [{"OUT": out, "PRESENCE": presence}.get(word, word) for word in command]


def try_extra(name: str, there: Fresh) -> str:
    """Return the extra's row of the table.

    Raises:
        SystemExit: If it does not do what it is for.
    """
    use, folder = USES[name], there.folder
    python, without = there.with_extra(name), there.with_extra(use.over) if use.over else there.base
    before, after = fresh.sizes(there.base), fresh.sizes(python)
    if changed := {package for package in before if after.get(package) != before[package]}:
        print(f"note: {name} changes {', '.join(sorted(changed))}", file=sys.stderr)
    for file, text in use.files:
        (folder / file).write_text(text)
    if use.prepare:
        fresh.run([str(python), "-c", use.prepare], folder)
    start = time.monotonic()
    for command in use.commands:
        done = fresh.run([str(python), *words_of(command, f"with-{name}", "there")], folder)
    seconds = time.monotonic() - start
    if use.said not in done.stdout:
        raise SystemExit(f"{name}: {use.said!r} is not in\n{done.stdout}")
    if use.proof:
        fresh.run([str(python), "-c", use.proof], folder)
    for command in use.commands:
        done = fresh.run([str(without), *words_of(command, f"without-{name}", "missing")], folder, code=2)
        errors = [line for line in done.stderr.splitlines() if line.startswith("error:") or "Traceback" in line]
        if len(errors) != 1 or f"pip install 'semstab[{name}]'" not in errors[0]:
            raise SystemExit(f"{name}: without it, {' '.join(command)} says\n{done.stderr}")
    added = set(after) - set(before)
    cost = f"{len(added)}, {sum(after[package] for package in added) / 1e6:,.0f} MB"
    return f"| `{name}` | {use.shown} | works | {cost} | {seconds:.0f} |"


def main() -> None:
    """Print the table, a row as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("extras", nargs="*", metavar="EXTRA", help="all of setup.cfg by default, but dev")
    parser.add_argument("--constraint", action="append", default=[], help="for pip, such as torch==2.13.0; repeatable")
    options = parser.parse_args()
    names = options.extras or [extra for extra in fresh.setup()["options.extras_require"] if extra != "dev"]
    if unknown := [name for name in names if name not in USES]:
        raise SystemExit(f"not known what it is for: {', '.join(unknown)}; say it in USES")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        there = Fresh(folder, fresh.build_wheel(folder), folder / "constraints.txt")
        there.constraints.write_text("\n".join(options.constraint))
        there.install(fresh.make_venv(folder / "venv-base"), str(there.wheel))
        semstab = (str(there.base), "-m", "semstab")
        fresh.run([*semstab, "convert", "--scene", "scene0", "--model", "sim-flicker", "--out", "scene"], folder)
        fresh.run([*semstab, *SCENE, "--out", "base"], folder)
        print("| extra | what was run | result | packages, MB added | seconds |\n|---|---|---|---|---|", flush=True)
        failed = False
        for name in names:
            try:
                print(try_extra(name, there), flush=True)
            except SystemExit as error:  # the next ones are tried all the same
                failed = True
                print(f"| `{name}` | {USES[name].shown} | fails | | |", flush=True)
                print(error, file=sys.stderr)
    sys.exit(failed)


if __name__ == "__main__":
    main()
