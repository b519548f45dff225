"""Depth images are decoded once for check, fusion, ground truth and pictures."""

from __future__ import annotations

from collections import Counter
from threading import Barrier, Thread

import numpy as np
import pytest
import tiny_scene

import semstab
from semstab.configure import load_config
from semstab.core.arrays import RecentArrays
from semstab.datasets.files import scene


def test_an_array_is_made_again_once_others_took_its_room() -> None:
    made, recent = Counter(), RecentArrays(most_bytes=2 * 8 * 10)

    def ask(number: int) -> np.ndarray:
        def make() -> np.ndarray:
            made[number] += 1
            return np.full(10, float(number))

        return recent.get(number, make)

    for number in (1, 2, 1, 3, 1, 2):  # 3 takes the room of 2, which was asked for before 1
        assert ask(number)[0] == number
    assert made == {1: 1, 2: 2, 3: 1}


def test_an_array_that_is_larger_than_the_room_is_returned() -> None:
    recent = RecentArrays(most_bytes=8)
    assert len(recent.get(0, lambda: np.zeros(100))) == 100


def test_an_array_cannot_be_written_to() -> None:
    with pytest.raises(ValueError, match="read-only"):
        RecentArrays(100).get(0, lambda: np.zeros(3))[0] = 1


def test_threads_that_make_one_array_at_once_count_its_bytes_once() -> None:
    recent, both = RecentArrays(most_bytes=8 * 10), Barrier(2)

    def make() -> np.ndarray:
        both.wait(10)
        return np.zeros(10)

    threads = [Thread(target=lambda: recent.get(0, make)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    recent.get(0, lambda: pytest.fail("it has room"))


def test_a_run_decodes_each_depth_image_once(tmp_path, monkeypatch) -> None:
    decoded, decode = Counter(), scene.stored_depth

    def counted(source, *arguments):
        decoded[source.name] += 1
        return decode(source, *arguments)

    monkeypatch.setattr(scene, "stored_depth", counted)
    root = tiny_scene.write(tmp_path / "data" / "wall", models=("a",))
    config = load_config(overrides={"dataset": {"name": "posed_folder", "options": {"root": str(root)}}})
    semstab.run(config, out=tmp_path / "run", report=False)
    assert len(decoded) == tiny_scene.FRAMES
    assert set(decoded.values()) == {1}
