"""The report: one page that needs nothing else, says what was found, and survives any name."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
from collections import Counter
from html.parser import HTMLParser

import pytest
from PIL import Image
from records import record, study, voxels
from wall_study import BACKBONES, CLASSES, STEPS, drawn_walls, wall_study

from semstab.config import BASE, SHARED
from semstab.model.records import Failure, ImageSpace, Variation
from semstab.model.results import Agreement, Unit
from semstab.report import write_report
from semstab.report.averages import ENOUGH, pooled
from semstab.report.figures import figures
from semstab.report.findings import findings
from semstab.report.narrative import reading, verdicts
from semstab.report.tables import tables

SURE, SPLIT = [1, 0, 0], [3, 1, 0]
EVIL = '<script>alert("x")</script> & "quoted"'
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """The elements of a page, in order, with their attributes and text; it must be well nested."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
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
        if self._open and self._open[-1] not in ("style", "pre"):
            self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def page_of(result, folder):
    (path,) = write_report(result, folder)
    assert path == folder / "report.html"
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    """The study with both walls, one backbone, its figures, and a failure."""
    calm, folder, _ = drawn_walls(tmp_path_factory.getbasetemp())
    failure = Failure(Unit("often", "calm", "numpy"), Variation("voxel_size", 0.001), f"out of memory {EVIL}")
    result = dataclasses.replace(calm, failures=(failure,))
    return result, folder, page_of(result, folder)


def plain(text):
    return re.sub(r"\s+", " ", text.replace("<=", "≤").replace(">=", "≥"))


def test_the_page_needs_no_other_file_no_script_and_no_network_and_links_lead_somewhere(walls):
    page = walls[2]
    assert not page.all("script") + page.all("iframe")
    sources = [attributes["src"] for attributes in page.all("img")]
    assert sources
    assert all(source.startswith("data:image/") for source in sources)
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = {attributes["href"] for tag in ("a", "link") for attributes in page.all(tag)} - {"data:,"}
    assert links <= {f"#{name}" for name in ids}
    assert "url(" not in (walls[1] / "report.html").read_text()
    assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)


def test_the_page_can_be_heard_and_every_table_scrolls_in_a_region_of_its_own(walls):
    page = walls[2]
    assert page.all("html")[0]["lang"] == "en"
    assert all(len(attributes["alt"]) > 40 for attributes in page.all("img"))
    assert len(page.all("caption")) == len(tables(walls[0]))
    regions = [attributes for _, attributes in page.elements if "scroll" in (attributes.get("class") or "")]
    assert all(attributes["tabindex"] == "0" and attributes["aria-label"] for attributes in regions)
    assert [tag for tag, _ in page.elements if re.fullmatch(r"h\d", tag)][:2] == ["h1", "h2"]
    before = [page.elements[i - 1][1].get("class") for i, (tag, _) in enumerate(page.elements) if tag == "table"]
    assert set(before) == {"scroll"}


def test_the_page_says_units_findings_failures_and_where_the_numbers_come_from(walls, tmp_path_factory):
    result, text = walls[0], plain(walls[2].text)
    _, folder = wall_study(tmp_path_factory.getbasetemp())
    units = json.loads((folder / "manifest.json").read_text())["units"]["units"]
    assert f"{units // 2} units" in text  # those of one of the two backbones
    for finding in findings(result):
        said = [plain(line) for row in finding.evidence for line in (row.outcome.numbers, row.outcome.why)]
        assert all(line in text for line in (finding.claim, *said))
    for line in ("1 failed", 'out of memory <script>alert("x")</script>', "voxel size 0.001, repeat 0"):
        assert line in text
    assert result.manifest["python"] in text
    assert not re.search(r"\bnan\b|\bNone\b|\binf\b", walls[2].text)
    assert "\N{EN DASH}" in text


def test_every_table_and_figure_stands_on_the_page_with_all_cells(walls):
    result, folder, page = walls
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
    drawn = figures(result, folder)
    assert {f"figure-{figure.name}" for figure in drawn} <= ids
    for caption, times in Counter(plain(item.caption) for item in (*tables(result), *drawn)).items():
        assert text.count(caption) >= times
    text = (walls[1] / "report.html").read_text()
    for table in re.findall(r"<table>.*?</table>", text, re.DOTALL):
        rows = re.findall(r"<tr.*?</tr>", table, re.DOTALL)
        widths = [
            sum(
                int(n or 1)
                for n in re.findall(r"<t[hd](?:\s+colspan=\"(\d+)\")?", row.replace('scope="rowgroup" ', ""))
            )
            for row in rows
        ]
        assert len(set(widths)) == 1, table[:300]


def test_figures_are_made_small_maps_closed_and_the_page_is_the_same_again(walls, tmp_path):
    result, folder, page = walls
    by_alt = {attributes["alt"]: attributes for attributes in page.all("img")}
    for figure in figures(result, folder):
        kind, _, data = by_alt[figure.alt]["src"].partition(";base64,")
        content = base64.b64decode(data)
        assert kind == "data:image/png"
        with Image.open(io.BytesIO(content)) as image, Image.open(folder / "figures" / f"{figure.name}.png") as full:
            assert image.width == round(full.width * 2 / 3)
    text = (walls[1] / "report.html").read_text()
    maps = text[text.index('<section id="maps"') :]
    assert maps.index("figure-stability_map__often__calm") < maps.index("<details>")
    assert maps.index("<details>") < maps.index("figure-stability_map__rarely__calm")
    result, folder, _ = walls
    before = (folder / "report.html").read_bytes()
    write_report(result, folder)
    assert (folder / "report.html").read_bytes() == before


def test_missing_figures_are_drawn_and_a_study_in_which_everything_failed_has_a_report(tmp_path):
    result = study(record(voxels((5, 2, SURE))), record(voxels((5, 2, SURE)), "frame_count", 5))
    page = page_of(result, tmp_path)
    assert len(page.all("img")) == 1
    assert (tmp_path / "figures" / "sensitivity_frame_count.png").exists()
    failure = Failure(Unit("s", "m", "numpy"), Variation(BASE), "no depth")
    page = page_of(study(failures=(failure,)), tmp_path)
    assert "there is nothing to say yet" in page.text
    assert "no depth" in page.text


def test_names_are_shown_as_they_are_whatever_they_are(tmp_path):
    found = study(*(record(voxels((5, 2, SURE)), scene=EVIL, backbone=name) for name in (EVIL, "b")), failures=())
    named = dataclasses.replace(found, name=EVIL, manifest={"command": [EVIL], EVIL: EVIL})
    page = page_of(named, tmp_path)
    assert not page.all("script")
    assert page.text.count(EVIL) >= 6
    assert CLASSES[2] == "window & <sill>"


def read(result):
    return reading(result, findings(result))


def test_the_reading_says_what_was_seen_once_and_what_recurs():
    sentences = read(study(record(voxels((3 * ENOUGH, 1, SURE), (ENOUGH, 4, SPLIT)), backbone="net")))
    assert sentences[0].startswith("75% of the voxels were seen once and look stable for that reason")
    assert sentences[-1] == (
        "Where net had three looks or more (25% of its voxels), 25.0% of the evidence goes against the voxel's own"
        " class; over all voxels it seems to be 6.2%."
    )


def test_few_voxels_have_no_sentence_and_flicker_has_one_with_its_compensated_share():
    sentences = read(study(record(voxels((90, 1, SURE), (10, 4, SPLIT)))))
    assert "m has 10 voxels with three looks or more: too few to judge it by." in sentences
    few = study(record(voxels((5, 1, SURE), (3 * ENOUGH, 4, SPLIT)), backbone="net"))
    assert not any("seen once" in sentence for sentence in read(few))
    sentences = read(study(record(voxels((5, 1, SURE)), backbone="net", image_space=ImageSpace(65.2, 12.4))))
    assert any(sentence.endswith("(in brackets pixel flicker, with it): net 12% (65%).") for sentence in sentences)


def backbone(name, once, recurrent, sweep=BASE):
    return record(voxels((ENOUGH, 1, once), (ENOUGH, 4, recurrent)), sweep, backbone=name)


def test_the_order_of_the_backbones_may_change_where_voxels_recur_and_the_shared_taxonomy_decides():
    found = study(backbone("x", [1, 0, 0], [6, 4, 0]), backbone("y", [6, 4, 0], [8, 2, 0]))
    assert "In one taxonomy (abc) the order by VSS is x > y over all voxels, but y > x for OP>=3." in read(found)
    same = [backbone("x", SURE, SURE), backbone("y", SURE, SPLIT)]
    line = "In one taxonomy (abc) the order by VSS is x > y, over all voxels and for OP>=3 alike."
    assert line in read(study(*same))
    shared = [backbone("x", SURE, SPLIT, SHARED), backbone("y", SURE, SURE, SHARED)]
    assert any("the order by VSS is y > x" in sentence for sentence in read(study(*same, *shared)))


def test_the_scene_that_looks_steadiest_may_be_the_one_seen_least():
    scenes = [record(voxels((10, 4, SPLIT)), scene="looked at"), record(voxels((10, 1, SURE)), scene="passed by")]
    expected = "m looks steadiest in passed by (VSS 1.000), which is also the scene seen least: 1.00 frames a voxel."
    assert expected in read(study(*scenes))
    assert expected not in read(study(record(voxels((10, 4, SURE)), scene="looked at"), scenes[1]))


def agreement(name, agrees):
    return Agreement("s", "m", ("numpy", name), (1, 1), (0, 0), {}, agrees)


def test_the_reading_says_which_implementations_agree():
    rows = (agreement("numba", True), agreement("open3d", True), agreement("mine", True), agreement("mine", False))
    sentences = read(study(record(voxels((5, 1, SURE)))))
    assert not any("same maps" in sentence for sentence in sentences)
    found = dataclasses.replace(study(record(voxels((5, 1, SURE)))), agreement=rows)
    sentences = reading(found, ())
    assert "numba and open3d leave the same maps as numpy." in sentences
    assert "mine and numpy disagree in 1 of 2 comparisons." in sentences
    drawn = dataclasses.replace(found, agreement=tuple(dataclasses.replace(row, one_in=16) for row in rows[:1]))
    assert "numba leaves the same maps as numpy, as far as one voxel in 16 tells." in reading(drawn, ())


def test_the_reading_of_the_walls_says_their_numbers_and_findings(walls):
    (sentence,) = (s for s in read(walls[0]) if s.startswith("The paper's findings here:"))
    for line in ("recurrent voxels disagree more than the aggregate says", "mean SBD falls with OP"):
        assert f"{line} (not shown);" in sentence
    said = reading(walls[0], ())
    assert said[:1] == verdicts(walls[0])
    assert said[0].startswith("Verdict on ")
    assert any(line.startswith(f"{pooled(walls[0].select()).once:.0%} of the voxels were seen once") for line in said)
    assert (set(walls[0].scenes), walls[0].backbones) == (set(STEPS), tuple(BACKBONES)[:1])
