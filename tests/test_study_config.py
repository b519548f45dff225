"""Study files: short forms, the layers below them, unknown settings, the studies that ship, parts of a study."""

from __future__ import annotations

import pytest
import tiny_study
import yaml

from semstab.config import Config
from semstab.configure import load_config, load_study, resolve, shipped_studies
from semstab.engine.units import NOT_IN_KEYS, make_plan
from semstab.errors import ConfigError


def write(tmp_path, **content):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_short_forms_mean_the_long_ones(tmp_path) -> None:
    short = load_study(write(tmp_path, sweeps={"voxel_size": [0.1]}, backends=["numpy", "open3d"]))
    long = {"sweeps": {"voxel_size": {"values": [0.1]}}, "backends": [{"name": "numpy"}, {"name": "open3d"}]}
    assert short == load_study(write(tmp_path, **long))
    assert [name for name, _ in short.sweeps.given()] == ["voxel_size"]


def test_the_name_is_the_file_s_and_the_dataset_s_defaults_lie_below(tmp_path) -> None:
    study = load_study(write(tmp_path, voxel_size=0.5))
    assert (study.name, study.dataset.name, study.taxonomy) == ("mine", "city", "uavid7")
    assert study.scenes == ["scene0", "scene3"]  # of configs/datasets/city.yaml
    assert load_study(write(tmp_path, taxonomy=None, scenes=None)).scenes is None
    assert load_study(write(tmp_path), {"dataset": {"name": "posed_folder"}}).taxonomy is None
    assert load_study(write(tmp_path), {"voxel_size": 0.3, "sweeps": {"pixel_stride": [2]}}).voxel_size == 0.3


def test_a_resolved_study_is_read_back(tmp_path) -> None:
    study = resolve(load_study("paper"))
    (tmp_path / "study.yaml").write_text(study.to_yaml())
    assert load_study(tmp_path / "study.yaml") == study
    assert study.dataset.options["seed"] == 0  # defaults are filled in


def test_a_run_is_a_study_without_sweeps(tmp_path) -> None:
    """The same settings by the same names; only what nobody asked for differs: its name, and the check."""
    run, study = load_config(write(tmp_path, voxel_size=0.5)), load_study(write(tmp_path, voxel_size=0.5))
    assert (run.check, study.check) == ("sample", None)
    assert run.model_copy(update={"name": "mine", "check": None}) == study


def test_units_have_the_base_settings_as_a_run_of_their_own() -> None:
    settings = {"strata": [1, 3], "seed": 4, "perturbation": {"depth_noise": 0.01}, "models": ["sim-soft"]}
    plan = make_plan(resolve(load_study("paper", {**settings, "scene_frames": {"scene0": {"stop": 3}}})).only([]))
    base, other, *_ = (unit.config for unit in plan.units)
    assert (base.strata, base.scenes, base.check, base.models) == ([1, 3], ["scene0"], None, ["sim-soft"])
    assert (base.frames.stop, other.frames.stop) == (3, None)
    assert base.perturbation is not None
    assert base.perturbation.seed == 4


CHANGED = {
    "voxel_size": 0.5, "pixel_stride": 2, "top_k": 2, "exclude": {"classes": ["road"]}, "statistics": True,
    "perturbation": {"depth_noise": 0.1}, "strata": [1, 2], "truth": False,
    "frame_quality": True, "video_measures": "depth", "moving": "keep",
    "critical_classes": ["road"], "scope": "other scenes", "verdict": {"stable": 0.9},
}  # fmt: skip
"""Another value of each setting that numbers follow from."""


def test_every_setting_is_in_the_key_of_a_unit_or_named_as_none_that_is() -> None:
    """A new setting is in the key by itself; the test asks for another value of it, or for a line in NOT_IN_KEYS."""
    elsewhere = {"check_geometry", "threads", "memory_gb", "tile_size"}  # not stored with a run
    assert set(Config.model_fields) == NOT_IN_KEYS | elsewhere | set(CHANGED)
    city = {"name": "city", "options": {"width": 64, "height": 36, "frames": 4}}
    base = {"dataset": city, "scenes": ["scene0"], "models": ["sim-soft"], "taxonomy": "uavid8", "check": None}

    def key(**changes: object) -> str:
        (unit,) = make_plan(resolve(load_config(base | changes))).units
        return unit.identity

    keys = {name: key(**{name: value}) for name, value in CHANGED.items()}
    assert len({key(), *keys.values()}) == 1 + len(CHANGED)
    assert key(name="another", tolerance=1e-3, seed=3, events=True) == key()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"voxelsize": 1}, "unknown setting 'voxelsize'; did you mean 'voxel_size'"),
        ({"sweeps": {"voxel": [1]}}, r"unknown setting 'sweeps\.voxel'; did you mean 'voxel_size'"),
        ({"sweeps": {"depth_noise": {"values": [1], "repeat": 2}}}, "depth_noise.repeat'; did you mean 'repeats'"),
        ({"sweeps": {"voxel_size": [0]}}, r"sweeps\.voxel_size\.values\.0: input should be greater than"),
        ({"sweeps": {"voxel_size": []}}, r"sweeps\.voxel_size\.values: list should have at least 1 item"),
        ({"sweeps": {"depth_noise": [-0.1]}}, r"sweeps\.depth_noise\.values\.0: input should be greater than or equal"),
        ({"sweeps": {"frame_count": [0]}}, r"sweeps\.frame_count\.values\.0: input should be greater than"),
        ({"sweeps": {"pixel_stride": [0]}}, r"sweeps\.pixel_stride\.values\.0: input should be greater than"),
        ({"sweeps": {"frame_count": [2.5]}}, r"sweeps\.frame_count\.values\.0: input should be a valid integer"),
        ({"sweeps": {"pixel_stride": {"values": [2], "repeats": 3}}}, "unknown setting 'sweeps.pixel_stride.repeats'"),
        ({"sweeps": {"voxel_size": [1, 0.5, 1.0]}}, "name each value once"),
        ({"backends": ["numpy", "numpy"]}, "backends: each backend can be named once"),
        ({"backends": [{"name": "numpy", "scenes": ["s"]}]}, "backends: the first backend fuses every unit"),
        ({"perturbation": {"seed": 3}}, "perturbation: leave its seed out; 'seed' counts"),
        ({"region_maps": ["x"], "models": ["x"]}, "region_maps: 'x' is named among the models too"),
        ({"strata": [2, 1]}, "strata: edges must be ascending"),
        ({"frames": {"spacing": "even"}}, "spacing: even needs count"),
    ],
)  # fmt: skip
def test_bad_settings_are_one_line_that_names_the_setting(tmp_path, content, message) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_study(write(tmp_path, **content))
    assert str(caught.value).startswith(str(tmp_path / "mine.yaml"))
    assert "\n" not in str(caught.value)


def test_the_shipped_studies_fit_together() -> None:
    assert shipped_studies() == ("filters", "ladder", "paper", "rules", "uavid3d")
    assert all(load_study(name).description for name in shipped_studies())
    grid = make_plan(resolve(load_study("paper")))
    assert {cell.variation.sweep for cell in grid.units} == {
        "base", "shared_taxonomy", "backends", "voxel_size", "depth_noise", "translation_noise", "rotation_noise",
        "translation_drift", "rotation_drift", "frame_count", "pixel_stride",
    }  # fmt: skip
    assert len(grid.distinct()) < 300  # they take minutes
    paper = load_study("uavid3d")
    assert paper.scene_frames["scene1"].indices(200) == [*range(0, 80, 4)]
    assert len(paper.frames.indices(200)) == 20
    assert load_study("uavid3d", {"scene_frames": {}}).scene_frames == {}
    some = load_study("uavid3d", {"scene_frames": {"scene1": {"stop": 40}}}).scene_frames
    assert (some["scene0"].stop, some["scene1"].stop) == (80, 40)
    assert (paper.taxonomy, paper.shared_taxonomy, paper.voxel_size) == ("uavid6", "uavid3", 0.2)


def test_a_part_of_a_study(tmp_path) -> None:
    study = load_study("paper")
    part = study.only(["depth_noise"])
    assert [name for name, _ in part.sweeps.given()] == ["depth_noise"]
    assert (part.shared_taxonomy, [backend.name for backend in part.backends]) == (None, ["numba"])
    assert study.only(["backends", "shared_taxonomy"]).backends == study.backends
    assert study.only(["base"]).sweeps == Config().sweeps


def test_perturbed_base_units_are_varied_on_top(tmp_path) -> None:
    root = tiny_study.write(tmp_path / "wall", models=("a",))
    study = tiny_study.configure(
        root, seed=2, perturbation={"translation_noise": 0.01}, sweeps={"depth_noise": [0, 0.1]}, backends=["numpy"]
    )
    noises = [cell.config.perturbation for cell in make_plan(study).units]
    assert [(noise.translation_noise, noise.depth_noise, noise.seed) for noise in noises] == [
        (0.01, 0, 2), (0.01, 0, 2), (0.01, 0.1, 2)
    ]  # fmt: skip
    assert len(make_plan(study).distinct()) == 2
