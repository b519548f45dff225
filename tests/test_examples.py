"""The examples for pipelines and clusters work: docs/examples, and docs/continuous-integration.md about them."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import predicted_scene
import pytest
import tiny_scene
import yaml
from command_line import bench
from fresh import setup
from onnx import TensorProto, helper, numpy_helper

SOURCE = Path(__file__).parents[1]
EXAMPLES = SOURCE / "docs/examples"
PAGE = (SOURCE / "docs/continuous-integration.md").read_text(encoding="utf-8")
WORKFLOW = yaml.safe_load((EXAMPLES / "gate.yml").read_text(encoding="utf-8"))
STEPS = {step["name"]: step["run"] for step in WORKFLOW["jobs"]["gate"]["steps"] if "run" in step}
PREPARE = [line.strip() for line in PAGE.splitlines() if line.startswith("    semstab-bench ") and "ci/" in line]
CLASSES = ("building", "road", "tree", "car")


def bash(script: str, cwd: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a script as GitHub does, with the installed command; SLURM_* of the machine are hidden."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    environment |= {"PATH": f"{Path(sys.executable).parent}:{environment['PATH']}", "COLUMNS": "160"} | more
    words = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", script]
    return subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def network(file: Path, *, of_the_image: float) -> None:
    """Write a network that tells classes by colour, and to some degree by the place in the image, which moves."""
    rng = np.random.default_rng(0)
    weight = numpy_helper.from_array(rng.normal(size=(4, 3, 1, 1)).astype("float32"), "weight")
    stripes = np.eye(4)[np.arange(40) // 3 % 4].T[None, :, None] * np.ones((1, 4, 24, 1))
    bias = numpy_helper.from_array((of_the_image * stripes).astype("float32"), "bias")
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 48, 80])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 4, 24, 40])
    conv = helper.make_node("Conv", ["image", "weight"], ["colours"], strides=[2, 2])
    add = helper.make_node("Add", ["colours", "bias"], ["logits"])
    graph = helper.make_graph([conv, add], "net", [image], [logits], [weight, bias])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), file)


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository as the workflow finds it; its baseline is made by the commands of the page."""
    folder = tmp_path_factory.mktemp("repository")
    predicted_scene.write(folder / "ci/scene", frames=8)
    (folder / "ci/gate.yaml").write_text("rules:\n  - alpha drop < 0.02\n")
    (folder / "models").mkdir()
    network(folder / "models/segmenter.onnx", of_the_image=0.0)
    for command in PREPARE:
        typed(command, folder)
    return folder


def typed(command: str, cwd: Path, code: int = 0) -> None:
    """Type a command of semstab-bench: in this process, as a test of what commands do may."""
    program, *words = shlex.split(command)
    assert program == "semstab-bench"
    bench(*words, cwd=cwd, code=code, report=True)


@pytest.mark.parametrize(("of_the_image", "code", "outcome"), [(0.0, 0, "passes"), (100.0, 4, "fails")])
def test_the_workflow_judges_the_model_of_a_pull_request(repository, of_the_image, code, outcome) -> None:
    network(repository / "models/segmenter.onnx", of_the_image=of_the_image)
    steps = dict(STEPS)
    summary = {"GITHUB_STEP_SUMMARY": str(repository / "summary.md")}
    (repository / "summary.md").unlink(missing_ok=True)
    assert steps.pop("Install").startswith("pip install ")
    judge, show = steps.pop("Judge it"), steps.pop("Show the outcome on the page of the job")
    for command in steps.values():
        typed(command, repository)
    done = bash(judge, repository)
    assert done.returncode == code, done.stdout + done.stderr
    assert bash(show, repository, **summary).returncode == 0
    assert f"the gate {outcome}" in (repository / "summary.md").read_text()
    paths = next(
        step["with"]["path"] for step in WORKFLOW["jobs"]["gate"]["steps"] if step.get("name") == "Keep the report"
    )
    assert [path for path in paths.split() if not [*repository.glob(path)]] == []


def test_the_workflow_asks_for_what_it_needs_and_no_more() -> None:
    assert WORKFLOW[True] == {"pull_request": {"paths": ["models/**", "ci/**"]}}  # YAML 1.1 reads 'on' as true
    assert WORKFLOW["permissions"] == {"contents": "read"}
    workflow = yaml.safe_load((SOURCE / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    actions = {step["uses"] for job in workflow["jobs"].values() for step in job["steps"] if "uses" in step}
    assert {step["uses"] for step in WORKFLOW["jobs"]["gate"]["steps"] if "uses" in step} <= actions
    assert requirement(STEPS["Install"]) <= extras()


def test_the_page_leads_to_the_workflow() -> None:
    assert "](examples/gate.yml)" in PAGE
    assert len(PREPARE) == 2


def extras() -> set[str]:
    return set(setup()["options.extras_require"])


def requirement(command: str) -> set[str]:
    """Return the extras of semstab that a pip command names; it takes the versions of 1.0.0 on."""
    (word,) = (word for word in shlex.split(command) if word.startswith("semstab"))
    found = re.fullmatch(r"semstab\[([\w,]+)\]==1\.\*", word)
    assert found, word
    return set(found[1].split(","))


SLURM = str(EXAMPLES / "slurm_array.sh")


def test_each_task_of_the_array_runs_its_scene(tmp_path: Path) -> None:
    for name in ("a", "b c"):
        tiny_scene.write(tmp_path / "scenes" / name, frames=5)
    options = "--model a --voxel-size 0.25 --report off"
    for task in ("0", "1"):
        done = bash(f"{SLURM} scenes out {options}", tmp_path, SLURM_ARRAY_TASK_ID=task)
        assert done.returncode == 0, done.stderr
    assert sorted(path.parent.name for path in tmp_path.glob("out/*/summary.json")) == ["a", "b c"]
    bench("show", *sorted(tmp_path.glob("out/*")), "--out", "all", cwd=tmp_path)
    assert [*tmp_path.glob("all/*")] != []


def test_a_task_without_a_scene_says_so(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / "scenes" / name).mkdir(parents=True)
    done = bash(f"{SLURM} scenes out", tmp_path, SLURM_ARRAY_TASK_ID="2")
    assert (done.returncode, done.stderr) == (2, "error: task 2 has no scene; there are 2: sbatch --array=0-1\n")


def test_the_script_is_one_that_slurm_takes() -> None:
    text = Path(SLURM).read_text(encoding="utf-8")
    assert bash(f"bash -n {SLURM}", SOURCE).returncode == 0
    directives = re.findall(r"(?m)^#SBATCH (--[\w-]+)(?:=.+)?$", text)
    assert len(directives) == text.count("#SBATCH") >= 5
    assert text.index("#SBATCH") < text.index("\nset ")  # Slurm reads directives before the first command only


def instructions(text: str) -> Mapping[str, list[str]]:
    """Return the arguments of each instruction of a Dockerfile, by its name."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    found: dict[str, list[str]] = {}
    for line in "\n".join(lines).replace("\\\n", "").splitlines():
        name, arguments = line.split(maxsplit=1)
        found.setdefault(name, []).append(arguments)
    return found


def test_the_container_has_what_the_command_needs() -> None:
    text = (EXAMPLES / "Dockerfile").read_text(encoding="utf-8")
    found = instructions(text)
    assert set(found) == {"FROM", "RUN", "ENV", "WORKDIR", "ENTRYPOINT", "CMD"}
    version = re.fullmatch(r"python:(3\.\d+)-slim", found["FROM"][0])
    assert version
    assert f"Python :: {version[1]}" in setup()["metadata"]["classifiers"]
    apt, pip = found["RUN"]
    libraries = re.findall(r"\]=(\S+)", (SOURCE / "scripts/setup.sh").read_text(encoding="utf-8").partition("\n)")[0])
    assert set(libraries) <= set(apt.split())
    assert requirement(pip) <= extras()
    assert yaml.safe_load(found["ENTRYPOINT"][0])[0] in setup()["options.entry_points"]["console_scripts"]
