"""Settings: defaults, unknown keys, YAML, the layers below a configuration file."""

from __future__ import annotations

import pytest

import semstab
from semstab.config import BackendConfig, Config, FrameSelection, merge, read_yaml
from semstab.configure import load_config, load_study, resolve
from semstab.errors import ConfigError


def test_defaults_are_the_papers() -> None:
    config = Config()
    assert (config.voxel_size, config.strata, config.dataset.name) == (0.2, [1, 2, 5], "city")
    assert [backend.name for backend in config.fused_by()] == ["numba"]
    assert [backend.name for backend in load_config().fused_by()] == ["numba"]
    assert load_config().check == "sample"


def test_the_checking_backend_is_not_fused_twice() -> None:
    config = Config(backends=[BackendConfig(name="numpy")])
    assert [backend.name for backend in config.fused_by()] == ["numpy"]


def test_short_forms_mean_one_thing(tmp_path) -> None:
    assert Config(frames="2:9:3").frames == FrameSelection(start=2, stop=9, stride=3)
    assert Config(frames=[3, 5]).frames == FrameSelection(list=[3, 5])
    short = {"dataset": "posed_folder", "scenes": "s", "backends": "numpy", "frames": "::20"}
    config = load_config(short, {"frames": {"stop": 40}})
    assert config.frames == FrameSelection(stop=40, stride=20)
    assert (config.dataset.name, config.scenes, config.fused_by()[0].name) == ("posed_folder", ["s"], "numpy")
    (tmp_path / "c.yaml").write_text("frames: '::20'\n")
    assert load_config(tmp_path / "c.yaml", {"frames": "5:"}).frames == FrameSelection(start=5, stride=20)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frames": "all"}, "frames: write START:STOP:STRIDE"),
        ({"frames": 20}, "frames: write 20:21 for one frame, :20 for the first 20"),
        ({"frame": 2}, "unknown setting 'frame'; did you mean 'frames'"),
    ],
)
def test_a_configuration_made_in_python_is_refused_in_one_line(settings, message) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        Config(**settings)
    assert "\n" not in str(caught.value)


def test_a_run_takes_a_dict() -> None:
    with pytest.raises(ConfigError, match="no scene 'scne0'; did you mean 'scene0'"):
        semstab.run({"dataset": "city", "scenes": ["scne0"]})
    assert {"run", "Frame", "load_config"} <= set(dir(semstab))


def test_yaml_round_trip(tmp_path) -> None:
    config = Config(voxel_size=0.05, scenes=["s"], frames=FrameSelection(stride=4), check=None)
    (tmp_path / "c.yaml").write_text(config.to_yaml())
    assert Config.build(read_yaml(tmp_path / "c.yaml")) == config


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"frames": {"strid": 2}}, r"unknown setting 'frames\.strid'; did you mean 'stride'"),
        ({"backends": [{"name": "numpy", "option": {}}]}, "did you mean 'options'"),
        ({"voxel_size": 0}, "voxel_size: input should be greater than"),
        ({"voxel_size": -0.2}, "voxel_size: input should be greater than"),
        ({"voxel_size": float("nan")}, "voxel_size: "),
        ({"backends": []}, "backends: "),
        ({"pixel_stride": 0}, "pixel_stride: "),
        ({"colour": 1}, "unknown setting 'colour'; known: "),
    ],
)
def test_bad_settings_are_one_line_that_names_the_setting(content, message) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        Config.build(content, "my.yaml")
    assert str(caught.value).startswith("my.yaml: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [("a: [1", "not valid YAML"), ("- 1\n- 2\n", "found a list"), ("!!python/object:os.system {}", "not valid YAML")],
)
def test_bad_yaml_is_one_line_that_names_the_file(tmp_path, text, message) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_merge_goes_group_by_group() -> None:
    assert merge({"a": {"x": 1, "y": 2}, "b": 3}, {"a": {"y": 4}}) == {"a": {"x": 1, "y": 4}, "b": 3}


def test_city_is_fused_in_the_papers_taxonomy_unless_told_otherwise(tmp_path) -> None:
    assert load_config().taxonomy == "uavid7"
    assert load_config(overrides={"taxonomy": "uavid3"}).taxonomy == "uavid3"
    assert load_config(overrides={"dataset": {"name": "posed_folder"}}).taxonomy is None
    (tmp_path / "c.yaml").write_text("taxonomy: null\n")
    assert load_config(tmp_path / "c.yaml").taxonomy is None


def test_another_dataset_has_no_options_of_the_files_dataset(tmp_path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text("dataset: {name: city, options: {frames: 40}}\nscenes: [scene0]\n")
    other = load_study(file, {"dataset": {"name": "posed_folder", "options": {"root": "flight"}}})
    assert other.dataset.options == {"root": "flight"}
    assert load_study(file, {"dataset": {"options": {"width": 160}}}).dataset.options == {"frames": 40, "width": 160}


def test_resolving_fills_in_the_datasets_own_defaults_and_absolute_paths(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = resolve(load_config(overrides={"dataset": {"name": "posed_folder", "options": {"root": "x"}}}))
    assert config.dataset.options["root"] == str(tmp_path / "x")
    assert resolve(config) == config


def test_an_unknown_option_of_the_dataset_is_named() -> None:
    options = {"root": ".", "depthscale": 10}
    with pytest.raises(ConfigError, match="'depthscale'; did you mean 'depth_scale'"):
        resolve(load_config(overrides={"dataset": {"name": "posed_folder", "options": options}}))


@pytest.mark.parametrize(("options", "message"), [
    ({"name": "tum", "options": {"x": 1}}, "dataset 'tum', options: root: field required"),
    ({"name": "posed_folder", "options": {"root": ".", "labels": {"a": 3}}}, "input should be a valid string"),
    ({"name": "city", "options": {"frames": "abc"}}, "unable to parse string as an integer (got 'abc')"),
])  # fmt: skip
def test_an_error_prints_a_plain_value_and_no_options_as_python_has_them(options, message) -> None:
    with pytest.raises(ConfigError) as caught:
        resolve(load_config({"dataset": options}))
    assert str(caught.value).endswith(message)


def test_a_folder_in_place_of_a_datasets_name_says_what_to_write() -> None:
    with pytest.raises(ConfigError, match=r"write \{name: posed_folder, options: \{root: /data/flight\}\}"):
        load_config(overrides={"dataset": "/data/flight"})
