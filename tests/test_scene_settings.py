"""scene.yaml and the options over it: what they do, and every way in which they can be wrong."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from posed_scene import H, K, W, fails, first_frame, opened, save_image, say, write_scene
from pydantic import ValidationError

from semstab.datasets import options_model
from semstab.datasets.posed_folder import PosedFolder
from semstab.errors import ConfigError, DataError, SemstabError


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_scene(tmp_path / "scene0")


def classes(folder: Path, said: str):
    """Of the scene whose scene.yaml says that."""
    (folder / "scene.yaml").write_text(said)
    return opened(folder).label_space("net").classes


@pytest.mark.parametrize(
    ("said", "match"),
    [
        ("depth_scal: 5\n", "unknown setting 'depth_scal'; did you mean 'depth_scale'"),
        ("depth_scale: 0\n", "depth_scale: "), ("depth_scale: .nan\n", "depth_scale: "),
        ("camera_axes: blender\n", "camera_axes: "), ("up_axis: w\n", "up_axis: "),
        ("classes: [a, no]\n", "classes.1: "), ("intrinsics_size: [640]\n", "intrinsics_size"),
        ("intrinsics_size: [640, 0]\n", "intrinsics_size"),
        ("classes: [a, b]\ntaxonomy: uavid7\n", "give classes or taxonomy, not both"),
        ("up_axis: z\nclasses: [a\n", r"not valid YAML .*line \d"), ("- a\n", "expected settings"),
        ("classes: !!python/object/apply:os.getcwd []\n", "not valid YAML"),
        ("depth_scale: 2020-13-45\n", "not valid YAML"), ("!!int ''", "not valid YAML"), ("!!bool x", "not valid YAML"),
        ("!!timestamp x", "not valid YAML"), ("? [a]: b\n: c", "not valid YAML"),
        pytest.param("[" * 1500, "not valid YAML", id="deep"), ("\0", "not valid YAML"),
        ("'\ud800'", "not a text file"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_used_are_named(folder, said, match):
    (folder / "scene.yaml").write_bytes(said.encode("utf-8", errors="surrogatepass"))
    fails(ConfigError, rf"scene\.yaml: .*{match}", opened, folder)


YAMLISH = st.text(alphabet="abcdepth_sl: []{}-!&*#|>'\"\n\t0123456789<=?%@", max_size=120)


@given(content=st.one_of(st.binary(max_size=120), YAMLISH.map(str.encode)))
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_yaml_is_settings_or_an_error(folder, content):
    (folder / "scene.yaml").write_bytes(content)
    message = "scene0"
    try:
        opened(folder).label_space("net")
    except SemstabError as error:
        message = str(error)
    assert "scene0" in message
    assert "\n" not in message


def test_options_override_scene_yaml(folder):
    say(folder, depth_scale=500, camera_axes="opengl")
    scene = opened(folder, depth_scale=2000, up_axis="-y", taxonomy="uavid7")
    raw = np.asarray(Image.open(folder / "depth/frame1.png"))
    np.testing.assert_array_equal(scene.depth(0), (raw / 2000).astype(np.float32))
    assert scene.up.tolist() == [0, -1, 0]
    assert scene.options.camera_axes == "opengl"
    assert scene.label_space("net").name == "uavid7"
    assert opened(folder, classes=["x", "y"]).label_space("net").classes == ("x", "y")


def test_options_are_closed_and_frozen(folder):
    model = options_model("posed_folder")
    assert model is PosedFolder.Options
    with pytest.raises(ValidationError, match="Extra inputs"):
        model(root=folder, rot=1)
    with pytest.raises(ValidationError, match="frozen"):
        model(root=folder).root = folder


def test_the_classes_may_be_a_taxonomy(folder):
    assert len(classes(folder, "taxonomy: uavid7\n")) == 7
    (folder / "mine.yaml").write_text("name: mine\nclasses: [p, q]\n")
    assert classes(folder, "taxonomy: mine.yaml\n") == ("p", "q")
    message = "scene0: taxonomy 'uavid' is not known; did you mean"
    fails(ConfigError, message, classes, folder, "taxonomy: uavid\n")
    fails(ConfigError, "scene0: .*needs at least 2", classes, folder, "classes: [alone]\n")


def test_unknown_classes_matter_only_when_asked_for(folder):
    (folder / "scene.yaml").unlink()
    scene = opened(folder)
    assert scene.up is None
    assert scene.frame(0, "net").labels is not None
    fails(DataError, r"the classes of 'net' are not known; write scene\.yaml with classes", scene.label_space, "net")


def test_labels_by_colour_go_through_the_taxonomy(folder):
    (folder / "scene.yaml").write_text("taxonomy: uavid7\n")
    road = np.full((H, W, 3), (128, 64, 128), np.uint8)
    save_image(folder / "labels/net/frame1.png", road)
    assert (first_frame(folder).labels == 1).all()
    road[2, 3] = 0
    save_image(folder / "labels/net/frame1.png", road)
    fails(DataError, r"net/frame1\.png: colour \(0, 0, 0\) at pixel \(3, 2\)", first_frame, folder)


def test_scores_may_be_stored_hwk(folder):
    scores = np.random.default_rng(0).dirichlet(np.ones(K), (H, W)).astype(np.float32)
    np.savez(folder / "scores/net/frame1.npz", scores=scores)
    fails(DataError, r"net/frame1\.npz: .*set scores_layout: HWK", first_frame, folder, "net-scores")
    say(folder, scores_layout="HWK")
    np.testing.assert_array_equal(first_frame(folder, "net-scores").scores, scores)


def test_intrinsics_of_another_resolution_are_resized(folder):
    (folder / "intrinsics.txt").write_text("20 0 7.5 0\n0 22 5.5 0\n0 0 1 0\n0 0 0 1\n")
    say(folder, intrinsics_size=[2 * W, 2 * H])
    camera = first_frame(folder).intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10, 11, 3.5, 2.5)
