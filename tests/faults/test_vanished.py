"""Files that vanish after they were written, while the command is still at work: one line and exit code 2."""

from __future__ import annotations

import shutil

import predicted_scene
import tiny_scene
from command_line import bench, error_of

from semstab.engine.folder import Folder
from semstab.predict.folder import PredictionFolder


def test_a_folder_that_vanishes_after_its_unit_was_stored_is_told_and_computed_again(tmp_path, monkeypatch) -> None:
    root, out = tiny_scene.write(tmp_path / "wall", models=("a",)), tmp_path / "out"
    words = ["--data", root, "--backend", "numpy", "--check", "none", "--quiet", "--out", "out"]
    with monkeypatch.context() as patch:
        whole = Folder.save_result
        patch.setattr(Folder, "save_result", lambda *given: (shutil.rmtree(out / "voxels"), whole(*given))[1])
        said = error_of(*words, cwd=tmp_path)
    assert "out/voxels/wall__a__numpy.parquet: was written, and is gone; run the same command again" in said
    assert not (out / "summary.json").exists()
    bench(*words, cwd=tmp_path)
    assert (out / "voxels/wall__a__numpy.parquet").is_file()


def test_a_predicted_map_that_vanishes_is_told_and_predicted_again(tmp_path, monkeypatch) -> None:
    predicted_scene.write(tmp_path / "flight")
    words = ["predict", "-m", "colour-clusters", "--data", "flight", "--out", "out", "--quiet"]
    with monkeypatch.context() as patch:
        whole = PredictionFolder.close
        patch.setattr(
            PredictionFolder,
            "close",
            lambda predicted: (whole(predicted), min(predicted.path.glob("*.png")).unlink(missing_ok=True))[0],
        )
        said = error_of(*words, cwd=tmp_path)
    assert ".png: was written, and is gone; run the same command again" in said
    bench(*words, cwd=tmp_path)
    maps = len(list((tmp_path / "out/labels/colour-clusters").glob("*.png")))
    assert maps == len(list((tmp_path / "flight/color").iterdir()))
