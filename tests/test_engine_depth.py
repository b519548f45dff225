"""How far it is from `semstab.run` to `integrate`, and how long the pass over frames is: what a reader has to hold."""

from __future__ import annotations

import inspect
import sys

import tiny_scene
from posed_config import configure

import semstab
from semstab.backends.numpy_reference import NumpyReference
from semstab.engine import Observer, frame_loop


def test_integrate_is_nine_calls_below_run_in_seven_files(tmp_path, monkeypatch) -> None:
    config = configure(tiny_scene.write(tmp_path / "wall", models=("a",)))
    integrate, stacks = NumpyReference.integrate, []

    def watched(self, frame):
        calls, frame_of_call = [], sys._getframe(1)
        while frame_of_call is not None:
            calls.append((frame_of_call.f_code.co_filename, frame_of_call.f_code.co_name))
            frame_of_call = frame_of_call.f_back
        stacks.append(calls)
        return integrate(self, frame)

    monkeypatch.setattr(NumpyReference, "integrate", watched)
    semstab.run(config, report=False)
    deepest = max(stacks, key=len)
    first = inspect.getsourcefile(semstab.run), "run"
    last = max(k for k, call in enumerate(deepest) if call == first)
    calls = [("numpy_reference.py", "integrate"), *deepest[: last + 1]]
    assert len(calls) <= 9, calls
    assert len({file for file, _ in calls}) <= 7, calls


def test_the_pass_over_frames_is_one_short_function_with_eight_hooks() -> None:
    """Its verbs are those of the paper, in that order."""
    source = inspect.getsource(frame_loop.fuse_sequence)
    assert len(source.splitlines()) <= 40
    verbs = ("prepare", "integrate", "sample", "measure", "notify")
    positions = [source.index(f".{verb}(") for verb in verbs]
    assert positions == sorted(positions)
    hooks = [name for name, value in vars(Observer).items() if inspect.isfunction(value)]
    assert hooks == [
        "run_started", "geometry_checked", "group_started", "frame_fused", "advanced", "unit_finished", "run_finished",
        "close",
    ]  # fmt: skip
