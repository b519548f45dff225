"""Define the commands over finished runs: compare, gate, leaderboard, calibrate, export, maps, relabel; and conform."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semstab.cli.options import OwnCode, Quiet, ScopeOption, Verbose, print_lines, say
from semstab.errors import ConfigError

if TYPE_CHECKING:
    from semstab.comparison.entries import RunHandle


def compare(
    runs: Annotated[list[str], typer.Argument(
        metavar="RUN...", help="Folders of runs or studies, the base first; RUN:MODEL; or one run, for its models.")],
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Folder for report.html, tables, figures, JSON, Markdown.")] = None,
    scope: ScopeOption = None,
    markdown: Annotated[bool, typer.Option(
        "--markdown", metavar="", help="Print Markdown, for a pull request.")] = False,
    same_place: Annotated[bool, typer.Option(
        "--same-place", metavar="", help="Two visits: agreement within and across, and what changed.")] = False,
    align: Annotated[Path | None, typer.Option(
        "--align", metavar="FILE", help="With --same-place, points of both: rows x y z of one, x y z of two.")] = None,
    code: OwnCode = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Compare runs: report their differences with intervals, by class, location and frame."""
    if same_place:
        if scope is not None or markdown:
            raise ConfigError("--same-place: its intervals are for these frames; leave out --scope and --markdown")
        _compare_visits(runs, out, align, code or (), verbose=verbose, quiet=quiet)
        return
    if align is not None or code:
        raise ConfigError("--align and --code belong to two visits of one place: add --same-place")
    from semstab.compare_runs import compare_opened
    from semstab.compare_runs import markdown as as_markdown
    from semstab.comparison.opening import open_compared
    from semstab.core.console import Console
    from semstab.core.types import THIS_SCENE
    from semstab.report.comparison.screen import print_comparison

    with Console(stderr=True, quiet=quiet).status("opening") as status:
        handles = open_compared(runs)
        if all(handle.features_alone for handle in handles):
            status.stop()
            _compare_features(handles, out, scope, markdown=markdown, quiet=quiet)
            return
        comparison = compare_opened(
            handles, out=out, scope=scope or THIS_SCENE, progress=lambda scene: status.update(f"comparing {scene}")
        )
    if markdown:
        print_lines([as_markdown(comparison)], quiet=quiet)
        return
    if not quiet:
        print_comparison(comparison, Console(), verbose=verbose, out=out)
    if out is not None:
        print_lines([f"folder: {out}; report: {out / 'report.html'}"], quiet=quiet)


def _compare_features(
    handles: Sequence[RunHandle], out: Path | None, scope: str | None, *, markdown: bool, quiet: bool
) -> None:
    """Print the comparison of models that give features alone."""
    from semstab.report.comparison.features import compared_features
    from semstab.report.tables.table import to_markdown, to_terminal

    if out is not None or scope is not None:
        raise ConfigError(
            "compare: alpha of features has the scope of its run, and no pages of differences; leave out --out and"
            " --scope"
        )
    sentences, table = compared_features(handles)
    if markdown:
        print_lines(["\n".join([*(f"- {text}" for text in sentences), "", to_markdown(table)])], quiet=quiet)
    else:
        print_lines([*sentences, "", to_terminal(table)], quiet=quiet)


def _compare_visits(
    runs: list[str], out: Path | None, align: Path | None, code: Sequence[str], *, verbose: bool, quiet: bool
) -> None:
    from semstab.core.console import Console
    from semstab.engine.folder import require_output
    from semstab.two_visits import compare_visits
    from semstab.two_visits.tables import print_visits

    if len(runs) != 2:
        raise ConfigError(f"--same-place compares two visits; {len(runs)} runs are named")
    if out is not None:
        require_output(out / "visits.json", [align])
    with Console(stderr=True, quiet=quiet).status("opening") as status:
        comparison = compare_visits(
            *runs, align=align, out=out, code=code, progress=lambda scene: status.update(f"reading {scene} of both")
        )
    if not quiet:
        print_visits(comparison, Console(), verbose=verbose, out=out)
    if out is not None:
        print_lines([f"folder: {out}; report: {out / 'report.html'}"], quiet=quiet)


# The commands gate and calibrate: quality gates, and thresholds above which labels may be acted on.

NEXT_STEP = {
    "undecided": "take more frames (--plan says how many), or accept undecided rules with --undecided pass",
    "fails": "improve the model, or save it regardless with --save-baseline alone, without rules",
}
"""The next step by the outcome, so that a baseline is saved."""


def gate(
    new: Annotated[str, typer.Argument(metavar="NEW", help="Folder of a finished run, or FOLDER:MODEL.")],
    against: Annotated[str | None, typer.Option(
        metavar="BASE", help="The baseline: a folder likewise, or a small summary.")] = None,
    model: Annotated[str | None, typer.Option("--model", "-m", help="The label source of NEW: NEW:MODEL.")] = None,
    rule: Annotated[list[str] | None, typer.Option(
        "--rule", "-r", metavar="RULE", help="E.g. 'alpha drop < 0.02', 'class car: recall > 0.6'.")] = None,
    config: Annotated[Path | None, typer.Option(
        "--config", "-c", help="YAML file: rules, level, undecided, scope.")] = None,
    level: Annotated[float | None, typer.Option(
        help="Probability that a rule errs, on each side.", show_default="0.05")] = None,
    undecided: Annotated[str | None, typer.Option(
        metavar="report|pass|fail", help="Undecided rules: exit code 5, or 0, or 4.", show_default="report")] = None,
    scope: ScopeOption = None,
    out: Annotated[list[Path] | None, typer.Option(
        "--out", "-o", metavar="FILE", help=".xml (JUnit), .md (pull request), .json; repeatable.")] = None,
    save_baseline: Annotated[Path | None, typer.Option(
        metavar="FILE", help="Save NEW as a small summary if the gate passes.")] = None,
    plan: Annotated[bool, typer.Option("--plan", metavar="", help="Print how many frames each rule needs.")] = False,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Fail if a new model is significantly worse: exit code 4 if a rule fails, 5 if one is undecided."""
    from semstab.comparison.opening import open_run
    from semstab.comparison.small_summary import save_summary
    from semstab.core.console import Console
    from semstab.engine.folder import require_output
    from semstab.gating import report as gate_report
    from semstab.gating.gate import gate as assess
    from semstab.gating.gate import gate_config

    new = new if model is None else f"{new}:{model}"
    gate_report.require_formats(out or ())
    for file in (*(out or ()), *([] if save_baseline is None else [save_baseline])):
        require_output(file, [config])
    if save_baseline is None or rule or config:
        result = assess(new, against, gate_config(config, rule or (), level, undecided, scope))
        for file in out or ():
            gate_report.write(result, file)
        print_lines(gate_report.plan(result) if plan else gate_report.lines(result, Console().width), quiet=quiet)
        if save_baseline is not None and not result.passed:
            say(
                f"{save_baseline}: no baseline is saved, as the gate {gate_report.OUTCOMES[result.outcome]};"
                f" {NEXT_STEP[result.outcome]}"
            )
        if not (result.passed or plan):
            raise typer.Exit(result.exit_code)
        if not result.passed:
            return
    if save_baseline is not None:
        save_summary(open_run(new), save_baseline)
        print_lines([f"{save_baseline}: a baseline of {save_baseline.stat().st_size:,} bytes"], quiet=quiet)


def leaderboard(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with results, files of --submit.")],
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Folder for index.html, one plain page.")] = None,
    definition: Annotated[list[Path] | None, typer.Option(
        "--benchmark", metavar="FILE", help="Definition of a benchmark that does not ship; repeatable.")] = None,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Check results of benchmarks that were handed in, and rank them with intervals."""
    from semstab.leaderboard.board import boards, lines, write_page
    from semstab.leaderboard.definition import load_benchmark

    definitions = {benchmark.id: benchmark for benchmark in map(load_benchmark, definition or ())}
    made = boards(folder, definitions)
    print_lines(lines(made), quiet=quiet)
    if out is not None:
        print_lines([f"  page  {write_page(made, out)}"], quiet=quiet)


def calibrate(
    run: Annotated[str, typer.Argument(metavar="RUN", help="Folder of a run with ground truth, or FOLDER:MODEL.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="YAML file to write.")],
    precision: Annotated[float, typer.Option(help="Least share of right labels among those that are acted on.")] = 0.95,
    confidence: Annotated[float, typer.Option(help="Confidence that this holds, class by class.")] = 0.95,
    quiet: Quiet = False,
) -> None:
    """Find for each class the least evidence at which its labels are right often enough to be acted on."""
    from semstab.engine.folder import require_output
    from semstab.gating.calibration import calibrate_run, lines

    require_output(out)
    thresholds = calibrate_run(run, precision=precision, confidence=confidence)
    thresholds.save(out)
    print_lines(lines(thresholds), quiet=quiet)


# The command conform.

DIFFERS, RANDOM_CASES = 3, 4


def conform(
    command: Annotated[
        str, typer.Argument(metavar="CMD", help="Program and its options, quoted; CASE and OUT are appended.")
    ],
    only: Annotated[list[str] | None, typer.Option(metavar="CASE", help="This case alone; repeatable.")] = None,
    tolerance: Annotated[float, typer.Option(min=0, help="Largest difference of a sum or a measure.")] = 1e-9,
    random: Annotated[
        int | None,
        typer.Option(
            min=0, metavar="N", help="Also N random cases, random:0 and so on; 4 by default, none with --only."
        ),
    ] = None,
    scans: Annotated[bool, typer.Option("--scans/--no-scans", help="The cases that have scans of points, too.")] = True,
    scores: Annotated[bool, typer.Option("--scores/--no-scores", help="The cases that have soft scores, too.")] = True,
    quiet: Quiet = False,
) -> None:
    """Test an external fusion program with the conformance data. Exit code 3 if its tables differ."""
    from semstab.conformance import conform

    wrong = 0
    more = random if random is not None else 0 if only else RANDOM_CASES
    for verdict in conform(command, only or (), tolerance, more, scans=scans, scores=scores):
        wrong += bool(verdict.problem)
        if verdict.problem:
            say(f"{verdict.case}: {verdict.problem}")
        elif not quiet:
            covered = f"not covered, it has {verdict.left_out}" if verdict.left_out else "the same"
            typer.echo(f"{verdict.case}: {covered}")
    if wrong:
        raise typer.Exit(DIFFERS)


# The commands export and relabel: files for other programs.

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run, or FOLDER:MODEL.")]
Scene = Annotated[str | None, typer.Option("--scene", "-s", help="Scene; needed if the run has several.")]
Model = Annotated[str | None, typer.Option("--model", "-m", help="Label source; needed if the run has several.")]
Thresholds = Annotated[Path | None, typer.Option(
    "--thresholds", metavar="FILE", help="Only labels above the thresholds of `semstab-bench calibrate`.")]  # fmt: skip
Backend = Annotated[
    str | None, typer.Option("--backend", "-b", help="Backend of the map; by default the first of the run.")
]


def export(
    run: Run,
    to: Annotated[list[Path], typer.Option(
        "--to", metavar="FILE",
        help=".ply .las .laz .tif .glb .parquet .csv; places.csv, .geojson; classes: .yaml; masks: moving/;"
             " tasks: --format.")],
    scene: Scene = None,
    model: Model = None,
    backend: Backend = None,
    measure: Annotated[list[str] | None, typer.Option(
        help="Column to write: vss, sbd, entropy, margin, op, ...; repeatable.")] = None,
    min_op: Annotated[int, typer.Option(min=1, help="Only voxels that at least this many frames saw.")] = 1,
    classes: Annotated[list[str] | None, typer.Option("--class", help="Only voxels of this class; repeatable.")] = None,
    thresholds: Thresholds = None,
    cell: Annotated[int, typer.Option(min=1, help="Edge of a cell of .tif, in voxels.")] = 1,
    asprs: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML 'CLASS: CODE' for .las and .laz.")] = None,
    classify: Annotated[Path | None, typer.Option(
        metavar="CLOUD", help="Classify this .las, .laz or .ply cloud, and write it.")] = None,
    radius: Annotated[float | None, typer.Option(
        min=0, help="Metres from a point to the voxel that it may take; a voxel's edge.")] = None,
    join: Annotated[Path | None, typer.Option(
        metavar="FILE", help="Parquet with more columns of the voxels: OUT/columns of compare.")] = None,
    task_format: Annotated[str | None, typer.Option(
        "--format", metavar="coco",
        help="Annotation tasks instead of the map: locations where frames disagree.")] = None,
    most: Annotated[int, typer.Option("--most", "-n", min=1, help="Largest number of tasks or places.")] = 50,
    code: OwnCode = None,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Write the fused map as a point cloud, raster, mesh or table, or the places where frames disagree most."""
    from semstab.exports import export as write

    for file in write(
        run, to, scene=scene, model=model, backend=backend, measures=measure, min_op=min_op,
        classes=classes or (), thresholds=thresholds, cell=cell, asprs=asprs, radius=radius, classify=classify,
        join=join, task_format=task_format, most=most, code=code or (),
    ):  # fmt: skip
        print_lines([f"{file.path}: {file.content}", *(f"  {note}" for note in file.notes)], quiet=quiet)


def maps(
    run: Run,
    others: Annotated[list[Path], typer.Argument(
        metavar="OTHER...", help="Labelled clouds, meshes or voxel maps: .ply, .las, .laz, .npz, .parquet.")],
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Folder for tables, places (CSV, GeoJSON), pictures and a recording.")] = None,
    scene: Scene = None,
    model: Model = None,
    backend: Backend = None,
    field: Annotated[str | None, typer.Option(
        metavar="NAME", help="The field that holds the class; 'colour' for colours.")] = None,
    classes: Annotated[str | None, typer.Option(
        metavar="FILE", help="Names of ids: YAML with ID: NAME, a taxonomy file, or the name of one.")] = None,
    colours: Annotated[Path | None, typer.Option(
        metavar="FILE", help="Colours of classes: YAML with NAME: [r, g, b], a taxonomy file, or CSV.")] = None,
    unit: Annotated[str, typer.Option(metavar="m|cm|mm", help="Unit of the coordinates.")] = "m",
    axes: Annotated[str | None, typer.Option(
        metavar="X,Y,Z", help="The file's axes that become x, y, z, as x,-z,y.")] = None,
    shift: Annotated[str | None, typer.Option(
        metavar="X,Y,Z", help="Metres that are added after that, as 0.05,0.05,0.05.")] = None,
    frame: Annotated[str | None, typer.Option(
        metavar="scene|projection", help="The system of the coordinates, if the file does not say it.")] = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Compare the maps of other programs with the fused map: coverage, equal labels, accuracy, where they differ."""
    from semstab.core.console import Console
    from semstab.other_maps import compare_maps
    from semstab.other_maps.tables import print_maps

    with Console(stderr=True, quiet=quiet).status("comparing"):
        comparison = compare_maps(
            run, *others, scene=scene, model=model, backend=backend, field=field, classes=classes, colours=colours,
            unit=unit, axes=axes, shift=shift, frame=frame, out=out,
        )  # fmt: skip
    if not quiet:
        print_maps(comparison.agreements, comparison.run.name, Console(), verbose=verbose)
    if out is not None:
        print_lines([f"folder: {out}; viewer: semstab-bench view {out / 'recording.rrd'}"], quiet=quiet)


def relabel(
    run: Run,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder above labels/; the scene's own, to run it at once.")],
    scene: Scene = None,
    model: Model = None,
    backend: Backend = None,
    name: Annotated[str | None, typer.Option(help="Name of the new maps; MODEL-fused by default.")] = None,
    min_op: Annotated[int, typer.Option(min=1, help="Ignore pixels of voxels that fewer frames saw.")] = 1,
    min_psa: Annotated[float, typer.Option(help="Ignore pixels of voxels on which fewer pairs of frames agree.")] = 0.0,
    category: Annotated[list[str] | None, typer.Option(
        help="Label only pixels of voxels of this category; repeatable.")] = None,
    thresholds: Thresholds = None,
    leave_one_out: Annotated[bool, typer.Option(
        "--leave-one-out", help="Label each frame by the other frames, without its own vote.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace maps of other settings.")] = False,
    code: OwnCode = None,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Write the fused classes back into every frame, as label maps of a new source."""
    from semstab.convert import frame_bar
    from semstab.core.console import Console
    from semstab.exports.fused_labels import Belief
    from semstab.exports.relabel import relabel as write
    from semstab.statistics.acceptance import AcceptanceThresholds

    loaded = None if thresholds is None else AcceptanceThresholds.load(thresholds)
    belief = Belief(min_op, min_psa, tuple(category or ()), leave_one_out, loaded)
    with frame_bar(Console(stderr=True, quiet=quiet)) as bar:
        report = write(
            run, out, belief=belief, scene=scene, model=model, backend=backend, name=name, overwrite=overwrite,
            code=code or (), progress=bar,
        )  # fmt: skip
    print_lines(report.lines(), quiet=quiet)
