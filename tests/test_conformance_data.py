"""The conformance data: our own backends pass through the door that outside programs take, and wrong ones do not."""

from __future__ import annotations

import runpy
import shlex
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from semstab.cli import app
from semstab.conformance import EXPECTED, case_folder, case_names, compared
from semstab.conformance.fuse import fuse
from semstab.errors import ConfigError

FUSE = f"{sys.executable} -m semstab.conformance.fuse"


@pytest.mark.parametrize("backend", ["numpy", "numba", "open3d", "torch"])
def test_a_backend_that_ships_gives_every_table(backend, tmp_path) -> None:
    for name in case_names():
        fuse(backend, case_folder(name), tmp_path / f"{name}.csv")
        assert compared(case_folder(name), tmp_path / f"{name}.csv") == "", name


def test_the_cases_are_those_that_make_writes(tmp_path) -> None:
    runpy.run_path(str(Path(__file__).parents[1] / "scripts/make_conformance.py"))["make"](tmp_path)
    stored = case_folder("drift").parent
    files = {path.relative_to(tmp_path) for path in tmp_path.rglob("*.*")}
    assert files == {path.relative_to(stored) for path in stored.rglob("*.*")}
    for file in files:
        if file.suffix in (".labels", ".scores", ".depth"):
            assert (tmp_path / file).read_bytes() == (stored / file).read_bytes(), file
    assert sum(path.stat().st_size for path in stored.rglob("*.*")) < 1_000_000


def test_a_program_runs_through_the_command() -> None:
    done = CliRunner().invoke(app, ["conform", f"{FUSE} numpy", "--only", "drift"])
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
