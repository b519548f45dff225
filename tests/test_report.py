"""The report: one page that needs nothing else, says what was found, and survives any name."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
from collections import Counter
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from records import record, study, voxels
from wall_study import CLASSES, drawn_walls, wall_study

from semstab.config import BASE, SHARED
from semstab.data.measures import dominant
from semstab.data.records import Failure, Variation
from semstab.data.results import Agreement, UnitName
from semstab.metrics import categories, vss
from semstab.report import write_report
from semstab.report.figures.topdown import EMPTY, FromAbove
from semstab.report.means import ENOUGH
from semstab.report.narrative import notes, warnings
from semstab.report.page import UNKNOWN
from semstab.report.tables import tables

SURE, SPLIT = [1, 0, 0], [3, 1, 0]
EVIL = '<script>alert("x")</script> & "quoted"'
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """The elements of a page, in order, with their attributes and text; it must be well nested."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.scripts = "", list[str]()
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open and self._open[-1] == "script":
            self.scripts.append(data)
        elif self._open and self._open[-1] not in ("style", "pre"):
            self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def page_of(result, folder):
    path = write_report(result, folder)
    assert path == folder / "report.html"
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    """The study with both walls, one model, its figures, and a failure."""
    calm, folder, _ = drawn_walls(tmp_path_factory.getbasetemp())
    failure = Failure(UnitName("often", "calm", "numpy"), Variation("voxel_size", 0.001), f"out of memory {EVIL}")
    result = dataclasses.replace(calm, failures=(failure,))
    return result, folder, page_of(result, folder)


def plain(text):
    return re.sub(r"\s+", " ", text.replace("<=", "≤").replace(">=", "≥"))


def test_the_page_needs_no_other_file_and_no_network_and_links_lead_somewhere(walls):
    page, text = walls[2], (walls[1] / "report.html").read_text()
    assert not page.all("iframe")
    assert all("src" not in attributes for attributes in page.all("script"))
    sources = [attributes["src"] for attributes in page.all("img")]
    assert sources
    assert all(source.startswith("data:image/") for source in sources)
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = {attributes["href"] for tag in ("a", "link") for attributes in page.all(tag)} - {"data:,"}
    assert links <= {f"#{name}" for name in ids}
    assert "url(" not in text
    assert "http" not in text.replace("http-equiv", "")
    assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)
    assert len(text) < 3_000_000


def test_the_page_can_be_heard_and_every_table_scrolls_in_a_region_of_its_own(walls):
    page = walls[2]
    assert page.all("html")[0]["lang"] == "en"
    assert all(attributes["alt"] for attributes in page.all("img"))
    assert all(attributes["aria-label"] for attributes in page.all("svg"))
    assert len(page.all("caption")) == len(tables(walls[0]))
    regions = [attributes for _, attributes in page.elements if "scroll" in (attributes.get("class") or "")]
    assert all(attributes["tabindex"] == "0" and attributes["aria-label"] for attributes in regions)
    assert [tag for tag, _ in page.elements if re.fullmatch(r"h\d", tag)][:2] == ["h1", "h2"]
    before = [page.elements[i - 1][1].get("class") for i, (tag, _) in enumerate(page.elements) if tag == "table"]
    assert set(before) == {"scroll"}


def test_the_answer_comes_first_and_the_map_before_the_rest(walls):
    """A card a model with its verdict, then where, when, which classes; tables and provenance are folded."""
    result, text = walls[0], (walls[1] / "report.html").read_text()
    order = [text.index(f">{words}<") for words in ("calm", "Where", "When", "How often it was seen", "All numbers")]
    assert order == sorted(order)
    (card,) = re.findall(r'<article class="card">.*?</article>', text, re.DOTALL)
    for unit_record in result.select():
        assert unit_record.statistics.verdict.level in card
        assert unit_record.unit.scene in card
    assert text.count("<details><summary>") == len(tables(result))


def test_the_map_of_the_page_has_the_numbers_of_the_voxels(walls):
    """Two images without loss: class and category, then VSS, OP and SBD of the topmost voxel of each cell."""
    result, text = walls[0], (walls[1] / "report.html").read_text()
    maps = json.loads(re.search(r'id="maps">(.*?)</script>', text, re.DOTALL)[1])
    assert [(m["scene"], m["model"]) for m in maps] == [(r.unit.scene, r.unit.model) for r in result.select()]
    for map_of_page, unit_record in zip(maps, result.select(), strict=True):
        above = FromAbove.from_table(unit_record.table(), result.up[unit_record.unit.scene])
        first, second = (np.asarray(pixels(source)) for source in map_of_page["numbers"])
        occupied = above.rows != EMPTY
        assert first.shape[:2] == tuple(reversed(map_of_page["size"])) == above.rows.shape
        assert ((first[..., 2] == UNKNOWN) == ~occupied).all()
        at = above.rows[occupied]
        assert (first[occupied][:, 0] == dominant(above.table)[at]).all()
        assert (first[occupied][:, 2] == categories(above.table)[at]).all()
        assert (second[occupied][:, 1] == above.table.op[at]).all()
        np.testing.assert_allclose(second[occupied][:, 0] / 255, vss(above.table)[at], atol=1 / 255)
        assert map_of_page["names"] == list(above.table.classes)


def pixels(source):
    return Image.open(io.BytesIO(base64.b64decode(source.partition(";base64,")[2])))


def test_the_page_says_maps_failures_and_where_the_numbers_come_from(walls, tmp_path_factory):
    result, text = walls[0], plain(walls[2].text)
    _, folder = wall_study(tmp_path_factory.getbasetemp())
    units = json.loads((folder / "manifest.json").read_text())["units"]["units"]
    assert f"{units // 2} maps" in text  # those of one of the two models
    for line in ("1 failed", 'out of memory <script>alert("x")</script>', "voxel size 0.001, repeat 0"):
        assert line in text
    assert result.manifest["python"] in text
    assert not re.search(r"\bnan\b|\bNone\b|\binf\b", walls[2].text)
    assert "\N{EN DASH}" in text


def test_every_table_stands_on_the_page_with_all_cells(walls):
    result, _, page = walls
    text = plain(page.text)
    ids = {attributes.get("id") for _, attributes in page.elements}
    for table in tables(result):
        assert f"table-{table.name}" in ids
        assert plain(table.title) in text
        for _, row in table.rows():
            if row[-1] == "absent":
                assert re.search(rf"Absent: [^.]*{re.escape(plain(row[0]))}", text)
                continue
            for column, cell in zip(table.columns, row, strict=True):
                printed = plain(column.text(cell)).replace("--", "\N{EN DASH}")
                assert printed in text.replace("\N{MINUS SIGN}", "-")
    for caption, times in Counter(plain(item.caption) for item in tables(result)).items():
        assert text.count(caption) >= times
    text = (walls[1] / "report.html").read_text()
    for table in re.findall(r"<table class=\"sortable\">.*?</table>", text, re.DOTALL):
        rows = re.findall(r"<tr.*?</tr>", table, re.DOTALL)
        widths = [
            sum(
                int(n or 1)
                for n in re.findall(r"<t[hd](?:\s+colspan=\"(\d+)\")?", row.replace('scope="rowgroup" ', ""))
            )
            for row in rows
        ]
        assert len(set(widths)) == 1, table[:300]


def test_the_page_is_the_same_again(walls):
    result, folder, _ = walls
    before = (folder / "report.html").read_bytes()
    write_report(result, folder)
    assert (folder / "report.html").read_bytes() == before


def test_a_study_of_sweeps_has_charts_and_one_in_which_all_failed_has_a_report(tmp_path):
    result = study(*(record(voxels((5, 4, SURE)), "frame_count", n) for n in (5, 9)), record(voxels((5, 2, SURE))))
    page = page_of(result, tmp_path)
    assert "VSS (OP>=3) by temporal sampling, frames" in {attributes["aria-label"] for attributes in page.all("svg")}
    failure = Failure(UnitName("s", "m", "numpy"), Variation(BASE), "no depth")
    page = page_of(study(failures=(failure,)), tmp_path)
    assert "there are no results yet" in page.text
    assert "no depth" in page.text


def test_names_are_shown_as_they_are_whatever_they_are(tmp_path):
    found = study(*(record(voxels((5, 2, SURE)), scene=EVIL, model=name) for name in (EVIL, "b")), failures=())
    renamed = dataclasses.replace(found, name=EVIL, manifest={"command": [EVIL], EVIL: EVIL})
    page = page_of(renamed, tmp_path)
    assert not any("alert" in content for content in page.scripts)
    assert page.text.count(EVIL) >= 4
    assert CLASSES[2] == "window & <sill>"


def read(result):
    return list(notes(result))


def model(name, once, recurrent, sweep=BASE):
    return record(voxels((ENOUGH, 1, once), (ENOUGH, 4, recurrent)), sweep, model=name)


def test_models_may_change_order_where_voxels_recur_and_the_shared_taxonomy_decides():
    found = study(model("x", [1, 0, 0], [6, 4, 0]), model("y", [6, 4, 0], [8, 2, 0]))
    line = "VSS of all voxels misleads: in one taxonomy (abc) its order is x > y, and y > x for OP>=3."
    assert line in read(found)
    same = [model("x", SURE, SURE), model("y", SURE, SPLIT)]
    assert not any("VSS of all voxels" in sentence for sentence in read(study(*same)))
    shared = [model("x", [5, 5, 0], [9, 1, 0], SHARED), model("y", SURE, [8, 2, 0], SHARED)]
    (found,) = (sentence for sentence in read(study(*same, *shared)) if "VSS of all voxels" in sentence)
    assert "its order is y > x, and x > y for OP>=3" in found


def test_the_scene_that_seems_most_stable_may_be_the_one_seen_least():
    scenes = [record(voxels((10, 4, SPLIT)), scene="looked at"), record(voxels((10, 1, SURE)), scene="passed by")]
    expected = (
        "The mean VSS of all voxels of m is highest in passed by (1.000 at any OP), which is the scene seen least"
        " often, 1.00 frames per voxel: voxels seen once look stable for that reason."
    )
    assert expected in read(study(*scenes))
    assert expected not in read(study(record(voxels((10, 4, SURE)), scene="looked at"), scenes[1]))


def agreement(name, agrees):
    return Agreement("s", "m", ("numpy", name), (1, 1), (0, 0), {}, agrees)


def test_the_notes_say_which_implementations_agree():
    rows = (agreement("numba", True), agreement("open3d", True), agreement("mine", True), agreement("mine", False))
    sentences = read(study(record(voxels((5, 1, SURE)))))
    assert not any("same maps" in sentence for sentence in sentences)
    found = dataclasses.replace(study(record(voxels((5, 1, SURE)))), agreement=rows)
    sentences = read(found)
    assert "numba and open3d make the same maps as numpy." in sentences
    assert "mine and numpy disagree in 1 of 2 comparisons." in sentences
    drawn = dataclasses.replace(found, agreement=tuple(dataclasses.replace(row, one_in=16) for row in rows[:1]))
    assert "numba makes the same maps as numpy (1 in 16 voxels were compared)." in read(drawn)


@pytest.mark.parametrize(("other", "advice"), [(70, "leave it out: --set"), (5, "take another model")])
def test_a_class_that_leaves_nothing_else_is_not_to_be_left_out(other, advice) -> None:
    found = study(record(voxels((1000 - other, 4, SURE), (other, 4, [0, 1, 0]))))
    (line,) = (text for text in warnings(found) if "covers" in text)
    assert advice in line
