import json

import coverage
import pytest
import quick
import recorded

FILE = recorded.ROOT / "benchmark" / "metrics" / "summary.py"

SOURCE = '''
class Scene:
    """A scene."""

    @property
    def frames(self):
        """Number of frames."""
        return 3

    def voxels(self):
        def half(n):
            return n // 2

        return half(8)

total = 4
'''


@pytest.mark.parametrize(
    ("lines", "names"), [
        ([6], {"Scene.frames"}), ([5], {"Scene.frames"}), ([12], {"Scene.voxels.half"}), ([14], {"Scene.voxels"}),
        ([2, 3], set()), ([16], set()), ([8, 14, 16], {"Scene.frames", "Scene.voxels"}),
    ],
)  # fmt: skip
def test_the_innermost_function_of_a_line_is_named(lines, names):
    assert recorded.functions_at(SOURCE, lines) == names


def lines_of(name):
    (body,) = [body for other, _, body in recorded.functions(FILE.read_text("utf-8")) if other == name]
    return set(body)


@pytest.fixture
def record(tmp_path, monkeypatch):
    """A record in which a test of these summaries calls two functions, and a whole run, in two variants, calls one."""
    data = coverage.CoverageData(no_disk=True)
    for test, names in (
        ("tests/test_pipeline.py::test_whole[numba]", ("summarise", "TableSums.summary")),
        ("tests/test_pipeline.py::test_whole[numpy]", ("summarise", "TableSums.summary")),
        ("tests/test_metrics.py::test_strata_follow_their_edges", ("summarise",)),
    ):
        data.set_context(f"{test}|run")
        data.add_lines({str(FILE): set().union(*map(lines_of, names))})
    data.set_context("")
    data.add_lines({str(FILE): {1, 2, 3, *lines_of("pool")}, "/elsewhere/other.py": {1}})
    monkeypatch.setattr(recorded, "RECORD", tmp_path / "record.json")
    recorded.RECORD.write_text(json.dumps(recorded.condensed(data)))


def test_tests_that_call_fewer_functions_come_first(record, monkeypatch):
    monkeypatch.setattr(recorded, "_is_there", lambda test: True)
    file = FILE.relative_to(recorded.ROOT)
    whole, focused = "tests/test_pipeline.py::test_whole", "tests/test_metrics.py::test_strata_follow_their_edges"
    assert recorded.tests_of(file, ["summarise"]) == [focused, whole]
    assert recorded.tests_of(file, ["TableSums.summary"]) == [whole]
    assert recorded.tests_of(file, ["pool"]) == []  # called while modules are imported, by no test


def test_a_recorded_test_that_has_gone_is_left_out(record):
    file = FILE.relative_to(recorded.ROOT)
    assert recorded.tests_of(file, ["summarise"]) == ["tests/test_metrics.py::test_strata_follow_their_edges"]


def test_without_a_record_no_test_is_chosen_by_function(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded, "RECORD", tmp_path / "record.json")
    assert recorded.tests_of(FILE.relative_to(recorded.ROOT), ["summarise"]) == []


def test_lines_that_changed_are_those_of_the_hunks(tmp_path, monkeypatch):
    monkeypatch.setattr(quick, "ROOT", tmp_path)
    for command in (
        ["init", "-q"],
        ["add", "."],
        ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first"],
    ):
        if command == ["add", "."]:
            (tmp_path / "scene.py").write_text(SOURCE)
        quick.subprocess.run(["git", *command], cwd=tmp_path, check=True)
    text = SOURCE.replace("return 3", "return 5").replace("        return half(8)\n", "")
    (tmp_path / "scene.py").write_text(text)
    (tmp_path / "new.py").write_text("a = 1\nb = 2\n")
    assert quick.changed_lines("scene.py", "HEAD") == [8, 13]  # one line changed, and one went after another
    assert quick.changed_lines("new.py", "HEAD") == [1, 2]
