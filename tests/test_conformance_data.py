"""The conformance data: our own backends pass through the door that outside programs take, and wrong ones do not."""

from __future__ import annotations

import math
import runpy
import shlex
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from semstab.backends import create
from semstab.cli import app
from semstab.conformance import EXPECTED, LONG, case_folder, case_names, compared, expected_table, read_case
from semstab.conformance.formulas import FORMULAS
from semstab.conformance.fuse import fuse
from semstab.errors import ConfigError
from semstab.testing import assert_same_map

FUSE = f"{sys.executable} -m semstab.conformance.fuse"


@pytest.mark.parametrize("backend", ["numpy", "numba", "open3d", "torch"])
def test_a_backend_that_ships_passes_as_a_program(backend, tmp_path) -> None:
    for name in (
        "pinhole",
        "gaps",
        "labels_then_scores",
        "utm_faces",
        "pixels_65536",
        "random:0",
    ):  # all: BackendConformance
        fuse(backend, case_folder(name), tmp_path / f"{name}.csv")
        assert compared(case_folder(name), tmp_path / f"{name}.csv") == "", name


def test_the_cases_are_those_that_make_writes(tmp_path) -> None:
    make = runpy.run_path(str(Path(__file__).parents[1] / "scripts/make_conformance.py"))["make"]
    make(tmp_path, leaving_out=LONG)
    stored = case_folder("drift").parent
    files = {path.relative_to(tmp_path) for path in tmp_path.rglob("*.*")}
    files |= {Path(name, EXPECTED) for name in LONG}
    assert files == {path.relative_to(stored) for path in stored.rglob("*.*")}
    for file in files:
        if file.name != EXPECTED:
            assert (tmp_path / file).read_bytes() == (stored / file).read_bytes(), file
        elif file.parent.name not in LONG:
            assert compared(stored / file.parent, tmp_path / file) == "", file
    assert sum(path.stat().st_size for path in stored.rglob("*.*")) < 1_000_000


@pytest.mark.parametrize("name", FORMULAS)
def test_a_case_by_formula_is_what_the_reference_gives(name) -> None:
    voxel_size, num_classes, frames = read_case(case_folder(name))
    reference = create("numpy", voxel_size=voxel_size, num_classes=num_classes)
    for frame in frames:
        reference.integrate(frame)
    assert_same_map(reference.table(), expected_table(name), 1e-9)


def test_the_case_of_65538_frames_is_worked_out_by_hand() -> None:
    """Labels 0, 1, 0, 1, ...: p of class 0 is 1/2 after an even number t of frames, (t + 1) / 2t after an odd one."""

    def entropy(p):
        return sum(-x * math.log2(x) for x in (p, 1 - p) if x)

    def belief(t):
        return 0.5 if t % 2 == 0 else (t + 1) / (2 * t)

    steps = [(belief(t), belief(t + 1)) for t in range(1, 65538)]
    drift = math.fsum(entropy((p + q) / 2) - (entropy(p) + entropy(q)) / 2 for p, q in steps)
    table = expected_table("frames_65536")
    assert (table.op, table.pixels, table.first_frame, table.last_frame) == (65538, 65538, 0, 65537)
    assert table.evidence[:].tolist() == [[32769, 32769, 0]]
    assert table.drift_sum == pytest.approx(drift, abs=1e-9)


def test_frames_are_fused_in_rounds() -> None:
    _, _, frames = read_case(case_folder("frames_255"))
    assert [frame.index for frame in frames] == [*range(300)]
    assert [frame.shape for frame in frames[:4]] == [(1, 3), (1, 8)] * 2


def test_random_cases_run_by_seed() -> None:
    done = CliRunner().invoke(app, ["conform", f"{FUSE} numpy", "--only", "random:17", "--random", "1"])
    assert (done.exit_code, done.stdout) == (0, "random:17: the same\nrandom:0: the same\n")


def test_the_names_are_those_of_stored_cases_then_of_formulas() -> None:
    assert case_names()[0] == "one_pixel"
    assert case_names()[-len(FORMULAS) :] == tuple(FORMULAS)


def test_a_program_runs_through_the_command(tmp_path) -> None:
    (tmp_path / "program.py").write_text(
        f"import pathlib, shutil, sys\nshutil.copy(pathlib.Path(sys.argv[1], {EXPECTED!r}), sys.argv[2])\n"
    )
    command = shlex.join([sys.executable, "-S", str(tmp_path / "program.py")])
    done = CliRunner().invoke(app, ["conform", command, "--only", "drift"])
    assert (done.exit_code, done.stdout) == (0, "drift: the same\n")


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("rows[1:2] = []", "gaps: the voxel (0, 0, 0) is missing"),
        ("rows.append(rows[1].replace('0,0,0', '0,0,7', 1))", "gaps: the voxel (0, 0, 7) should not be there"),
        ("rows[1] = rows[1].replace('0,0,0,2', '0,0,0,3', 1)", "gaps: op of the voxel (0, 0, 0) is 3.0, expected 2.0"),
        ("rows.append(rows[1])", "the voxel (0, 0, 0) is there twice"),
        ("rows[0] = rows[0].replace('op', 'OP')", "gaps: table.csv: the column op is missing"),
        ("rows[0] = rows[0].replace('evidence_1', 'e')", "gaps: the column evidence_1 is missing"),
        ("rows[1] += ',1'", "gaps: table.csv, line 2: 18 fields, not 17"),
        ("rows[1] = rows[1].replace('2', 'x', 1)", "gaps: table.csv: cannot be read (could not convert"),
        ("sys.exit('no such device')", "gaps: the program ended with code 1 (no such device)"),
        ("sys.exit(0)", "gaps: the program wrote no table"),
    ],
)
def test_a_wrong_table_is_said_with_its_voxel(tmp_path, program, said) -> None:
    path = tmp_path / "program.py"
    path.write_text(
        "import pathlib, sys\n"
        f"rows = pathlib.Path(sys.argv[1], {EXPECTED!r}).read_text().splitlines()\n"
        f"{program}\n"
        "pathlib.Path(sys.argv[2]).write_text(chr(10).join(rows))\n"
    )
    command = shlex.join([sys.executable, "-S", str(path)])
    done = CliRunner().invoke(app, ["conform", command, "--only", "gaps"])
    assert done.exit_code == 3
    (line,) = done.stderr.splitlines()
    assert said in line


def test_what_cannot_be_run_is_one_line() -> None:
    for words in (["nowhere/program"], [""], ["'half a quotation"], [f"{FUSE} numpy", "--only", "drfit"]):
        done = CliRunner().invoke(app, ["conform", *words])
        assert done.exit_code == 2
        assert done.stderr.startswith("error: ")
    with pytest.raises(ConfigError, match="did you mean 'drift'"):
        case_folder("drfit")
    assert Path(case_folder("drift"), EXPECTED).is_file()
