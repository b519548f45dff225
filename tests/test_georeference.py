"""Where a scene lies on Earth: what the options say of it, and that a finished run and a conversion know it."""

import sys

import pytest
import tiny_scene
from posed_config import configure, dataset_of
from posed_scene import fails

import semstab
from semstab.convert import convert
from semstab.data.georeference import Georeference, wkt
from semstab.datasets import open_dataset
from semstab.errors import ConfigError, MissingDependencyError

pyproj = pytest.importorskip("pyproj")

OFFSET = (576714.0, 5188162.0, 0.0)
UTM = "+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs +type=crs"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tiny_scene.write(tmp_path_factory.mktemp("data") / "wall", frames=3)


def test_words_for_one_reference_system_are_one_wkt_with_its_number() -> None:
    assert wkt(UTM, "proj.txt") == wkt("EPSG:32615", "crs") == wkt(wkt(UTM, "proj.txt"), "again")
    assert 'ID["EPSG",32615]' in wkt(UTM, "proj.txt")
    assert pyproj.CRS.from_wkt(wkt("+proj=tmerc +lon_0=9 +x_0=1 +ellps=GRS80", "x")).is_projected


def test_a_finished_run_knows_where_its_scenes_lie(root, tmp_path) -> None:
    dataset = dataset_of(root, crs=UTM, offset=OFFSET)
    semstab.run(configure(root, dataset=dataset), out=tmp_path / "run", report=False)
    found = semstab.load_result(tmp_path / "run").georeference
    assert found == {"wall": Georeference(wkt("EPSG:32615", "x"), OFFSET)}
    semstab.run(configure(root), out=tmp_path / "run", report=False)
    assert semstab.load_result(tmp_path / "run").georeference == {}


def test_a_conversion_keeps_it(root, tmp_path) -> None:
    config = configure(root, dataset=dataset_of(root, crs="EPSG:32615", offset=OFFSET))
    assert [done.scene for done in convert(config, tmp_path / "out")] == ["wall"]
    converted = open_dataset("posed_folder", {"root": tmp_path / "out" / "wall"})
    assert converted.scene("wall").georeference == Georeference(wkt(UTM, "x"), OFFSET)
    assert open_dataset("posed_folder", {"root": root}).scene("wall").georeference is None


@pytest.mark.parametrize(
    ("crs", "match"),
    [
        ("somewhere 15N", "wall: crs: 'somewhere 15N' is no reference system .*write it as EPSG:32615"),
        ("EPSG:4326", "WGS 84 has axes in degree; project it, to UTM for example"),
        ("EPSG:2263", "axes in US survey foot; project it"),
    ],
)
def test_a_reference_system_that_cannot_be_used_is_said(root, crs, match) -> None:
    fails(ConfigError, match, open_dataset("posed_folder", {"root": root, "crs": crs}).scene, "wall")


def test_an_offset_needs_its_reference_system(root) -> None:
    fails(ConfigError, "give crs with offset", configure, root, dataset=dataset_of(root, offset=OFFSET))


def test_without_pyproj_it_is_said_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    fails(MissingDependencyError, r"proj.txt: .*pip install 'semstab\[geo\]'", wkt, UTM, "proj.txt")
