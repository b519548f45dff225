"""Outputs that would overwrite what a run wrote, or what is read for them: refused before anything is written."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tiny_scene
from command_line import bench, error_of
from posed_config import configure

import semstab
from semstab import Belief, relabel
from semstab.comparison.opening import open_run
from semstab.comparison.small_summary import save_summary
from semstab.core.files import FolderLock, atomic_path, only_writer


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    root = tiny_scene.write(folder / "wall", models=("a",), frames=8)
    semstab.run(configure(root, models=["a"], backends=["numpy"], check=None), out=folder / "run", report=False)
    return folder / "run"


@pytest.fixture
def run(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "run")


def content(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize(
    "words",
    [
        ["export", "run", "--to", "run/voxels/wall__a__numpy.parquet"],
        ["export", "run", "--to", "other/../run/sums/new.csv"],
        ["export", "run", "--to", "m.csv", "--to", "linked/voxels/wall__a__numpy.parquet"],
        ["export", "run", "--to", "run/manifest.json", "--format", "coco"],
        ["gate", "run", "--save-baseline", "run/summary.json"],
        ["gate", "run", "--rule", "alpha > 0", "--out", "run/summary.json"],
        ["calibrate", "run", "--out", "run/config.yaml"],
        ["check", "--data", "wall", "--json", "run/summary.json"],
    ],
)
def test_a_file_of_a_run_is_no_output(run, tmp_path, words) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "linked").symlink_to(run)
    before = content(run)
    assert "is a file of the run in this folder; name another file" in error_of(*words, cwd=tmp_path)
    assert content(run) == before
    assert not (tmp_path / "m.csv").exists()


def test_a_map_may_lie_beside_the_files_of_a_run(run, tmp_path) -> None:
    bench("export", "run", "--to", "run/map.csv", cwd=tmp_path)
    bench("gate", "run", "--save-baseline", "run/base.summary", cwd=tmp_path)
    assert (run / "map.csv").stat().st_size > 100


def test_what_is_read_is_no_output(run, tmp_path) -> None:
    shutil.copy(run / "voxels/wall__a__numpy.parquet", tmp_path / "more.parquet")
    before = (tmp_path / "more.parquet").read_bytes()
    said = error_of("export", "run", "--join", "more.parquet", "--to", "./more.parquet", cwd=tmp_path)
    assert "more.parquet: is also read; name another file" in said
    assert (tmp_path / "more.parquet").read_bytes() == before


def test_a_baseline_may_replace_the_one_that_it_was_held_against(run, tmp_path) -> None:
    save_summary(open_run(run), tmp_path / "base.summary")
    words = ["--against", "base.summary", "--rule", "flicker rise < 100", "--save-baseline", "base.summary"]
    bench("gate", "run", *words, cwd=tmp_path)


@pytest.mark.parametrize("name", ["../../../X", "a/b", "..", "gt", "a\nb", "\x1b[31mred"])
def test_a_relabelled_source_stays_in_its_folder(run, tmp_path, name) -> None:
    assert "it names a folder" in error_of("relabel", "run", "--out", "o", "--name", name, cwd=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]


def test_what_a_killed_export_left_is_removed_and_what_is_being_written_is_not(run, tmp_path) -> None:
    (tmp_path / ".semstab-killed.ply").write_bytes(b"half")
    with atomic_path(tmp_path / "other.csv") as written:
        bench("export", "run", "--to", "m.csv", cwd=tmp_path)
        assert [path.name for path in tmp_path.glob(".semstab-*")] == [written.name]
        written.write_text("whole")
    assert (tmp_path / "other.csv").read_text() == "whole"


def test_two_exports_to_one_file_are_refused(run, tmp_path) -> None:
    (tmp_path / "linked").symlink_to(tmp_path)
    with only_writer(tmp_path / "m.csv"):
        said = error_of("export", "run", "--to", "a.ply", "--to", "linked/m.csv", cwd=tmp_path)
        assert "m.csv: another process writes it; wait for it, or name another file" in said
        bench("export", "run", "--to", "other.csv", cwd=tmp_path)
    bench("export", "run", "--to", "m.csv", "--to", "linked/m.csv", cwd=tmp_path)
    assert (tmp_path / "m.csv").read_bytes() == (tmp_path / "other.csv").read_bytes()
    assert not list(tmp_path.glob(".semstab-*"))
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_an_export_works_on_a_file_system_without_locks(tmp_path, monkeypatch, code) -> None:
    def no_lock(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", no_lock)
    with only_writer(tmp_path / "m.csv"):
        (tmp_path / "m.csv").write_text("whole")
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    assert (tmp_path / "m.csv").read_text() == "whole"


def test_the_lock_of_a_killed_export_holds_nobody_up(run, tmp_path) -> None:
    killed = (
        "import os; from semstab.core.files import only_writer\nwith only_writer('m.csv'):\n    os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", killed], cwd=tmp_path, check=False).returncode == -9
    assert len(list(tmp_path.glob(".semstab-*"))) == 1
    bench("export", "run", "--to", "m.csv", cwd=tmp_path)
    assert not list(tmp_path.glob(".semstab-*"))


def test_labels_and_their_report_are_the_same_however_often_it_was_started(run, tmp_path) -> None:
    words = ["relabel", "run", "--out", "twice", "--leave-one-out"]

    def stop(what, done, total):
        if done == 3:
            raise KeyboardInterrupt

    bench("relabel", "run", "--out", "once", "--leave-one-out", cwd=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        relabel(run, tmp_path / "twice", belief=Belief(leave_one_out=True), progress=stop)
    bench(*words, cwd=tmp_path)
    first = content(tmp_path / "twice")
    bench(*words, cwd=tmp_path)
    assert content(tmp_path / "twice") == first
    report = Path("labels/a-fused/relabelled.json")
    once, twice = (json.loads((tmp_path / name / report).read_text()) for name in ("once", "twice"))
    assert {**once, "folder": ""} == {**twice, "folder": ""}
    assert once["pixels"] == 8 * tiny_scene.WIDTH * tiny_scene.HEIGHT


def test_two_comparisons_into_one_folder_are_refused(run, tmp_path) -> None:
    shutil.copytree(run, tmp_path / "other")
    held = FolderLock(tmp_path / "out")
    said = error_of("compare", "run", "other", "--out", "out", cwd=tmp_path)
    held.release()
    assert "out: another process works on it; wait for it, or choose another folder" in said
    (tmp_path / "out" / ".semstab-killed.json").write_text("half")
    bench("compare", "run", "other", "--out", "out", cwd=tmp_path)
    assert not list((tmp_path / "out").glob(".semstab-*"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_an_export_in_one_line_that_promises_nothing(run, tmp_path, monkeypatch, number) -> None:
    monkeypatch.setattr("semstab.exports.load_result", lambda folder: (signal.raise_signal(number), time.sleep(5)))
    before = signal.getsignal(number)
    done = bench("export", "run", "--to", "m.csv", cwd=tmp_path, code=128 + number)
    assert done.stderr == "interrupted; no file is half-written; start the same command again\n"
    assert signal.getsignal(number) == before
