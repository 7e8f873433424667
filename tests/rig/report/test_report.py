"""The report is one self-contained file, shows the content of the records, and escapes all names."""

import re
import time
from base64 import b64decode
from datetime import datetime, timedelta, timezone
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.report import Meta, Record, Truth, render_report, write_report
from tests.rig.report.report_samples import (
    NAMES,
    ambiguous,
    enrolled,
    identified,
    recorded,
    searching_densely,
)

VOID = {"meta", "link", "img", "br", "path", "circle", "line"}
META = Meta(
    {"seed": 7, "noise": {"backlash_deg": 0.25, "camera": {"gain": None}}},
    {"written": "2026-01-02 03:04"},
    datetime(2026, 1, 2, 4, 4, tzinfo=timezone(timedelta(hours=1))),
)


class Page(HTMLParser):
    """Collects the parts of a page for the tests; fails on tags that do not nest."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.tables: list[list[list[str]]] = []
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))
        if tag not in VOID:
            self._open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self._open:
            return
        self.texts.append(data)
        if {"td", "th"} & set(self._open):
            self.tables[-1][-1][-1] += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())


def demo(title: str = "Demo", names: tuple[str, ...] = NAMES) -> str:
    enrollments = [enrolled(name, retaken=(3,)) for name in names[:2]]
    identifications = [
        identified(names[0], truth=Truth(names[0], 32.0), names=names),
        identified(names[0], (90.0,), truth=Truth(names[1], 10.0), names=names),
        identified(None, (90.0,), truth=Truth(None, description="globe"), names=names),
        identified(names[0], (90.0,), truth=Truth(names[0], 30.0, 0.0), names=names),
    ]
    return render_report(title, "Two objects.", enrollments, identifications, meta=META)


def test_page_shows_the_content_of_the_records(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
        time.tzset()
        html = demo()
    time.tzset()
    page = Page(html)
    results = page.tables[0]
    assert results[0] == [
        "#", "on the table", "found as", "correct?", "views", "rotation", "pose error", "score", "margin"
    ]  # fmt: skip
    assert results[1:] == [
        ["1", "mug-white", "mug-white", "✓ correct", "4", "258°", "2.0°", "0.930", "+0.100"],
        ["2", "mug-star", "mug-white", "✗ wrong", "2", "90°", "–", "0.910", "+0.100"],
        ["3", "globe (never enrolled)", "unknown", "✓ correct", "2", "90°", "–", "0.910", "+0.100"],
        ["4", "mug-white", "mug-white", "✓ correct", "2", "90°", "–", "0.910", "+0.100"],
    ]
    assert set(results[0]) <= set(re.findall(r'<abbr title="[^"]+">([^<]+)</abbr>', html))
    assert page.text.startswith("Demo Demo 2026-01-02 04:04 CET Two objects.")
    # on a phone, which shows no heads, each cell has its own label
    labels = {attributes["data-label"] for attributes in page.all("td") if "data-label" in attributes}
    assert labels >= {"found as", "views", "rotation", "pose error", "score", "margin"}
    assert "found 2/3" in page.text
    assert "unknown objects recognised 1/1" in page.text
    assert "S_left 0.41 < S_right 0.66" in page.text
    assert len([a for a in page.all("svg") if "Camera positions" in a["aria-label"]]) == 4
    assert len([a for a in page.all("svg") if "The leading candidates. score per view" in a["aria-label"]]) == 4


def test_ambiguous_answer_is_neither_correct_nor_wrong() -> None:
    page = Page(render_report("t", "s", [], [ambiguous(Truth(NAMES[0]))] * 2, meta=Meta()))
    assert page.tables[0][1][2:4] == ["mug-white or mug-star", "? ambiguous"]
    assert "found 0/2 enrolled objects identified correctly ambiguous 2/2" in page.text


def test_azimuths_are_relative_to_the_enrollment_of_a_found_object() -> None:
    found = Page(render_report("", "", [], [identified("mug-white", (90.0,), yaw_deg=30.0)], meta=Meta()))
    unknown = Page(render_report("", "", [], [identified(None, (90.0,), yaw_deg=30.0)], meta=Meta()))
    assert [a["alt"] for a in found.all("img") if a["alt"]] == [
        "View 1 at azimuth 330.0°",
        "View 2 at azimuth 60.0°",
    ]
    assert any("330.0°, 60.0°" in a["aria-label"] for a in found.all("svg"))
    assert "Azimuths are as enrolled" in found.text
    assert [a["alt"] for a in unknown.all("img") if a["alt"]] == ["View 1 at azimuth 0.0°", "View 2 at azimuth 90.0°"]
    assert "Azimuths are on the table" in unknown.text


def test_page_loads_nothing_and_has_no_scripts() -> None:
    page = Page(demo())
    for _, attributes in page.tags:
        for key in ("src", "href", "xlink:href", "action", "srcset", "poster", "data"):
            if key in attributes:
                assert re.match(r"data:|#", attributes[key])
        assert not any(key.startswith("on") for key in attributes)
    assert not page.all("script")
    style = re.findall(r"<style>(.*?)</style>", demo(), re.DOTALL)
    assert len(style) == 1
    assert "@import" not in style[0]
    assert "url(" not in style[0]


def test_images_decode_and_have_alternative_text() -> None:
    page = Page(demo())
    images = page.all("img")
    assert len(images) > 10
    for attributes in images:
        head, data = attributes["src"].split(",", 1)
        assert head == "data:image/jpeg;base64"
        assert cv2.imdecode(np.frombuffer(b64decode(data), np.uint8), cv2.IMREAD_COLOR) is not None
        # a stamp repeats the text beside it, so it has no text for screen readers
        assert bool(attributes["alt"]) != (attributes.get("class") == "stamp")
    assert all(attributes["aria-label"] for attributes in page.all("svg"))
    assert all(attributes.get("scope") for attributes in page.all("th"))


def test_links_lead_to_their_searches() -> None:
    page = Page(demo())
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = [attributes["href"] for attributes in page.all("a")]
    assert links == [f"#search-{k}" for k in (1, 2, 3, 4)]
    assert {link[1:] for link in links} <= set(ids)


@pytest.mark.parametrize(
    "name", ["<script>alert(1)</script>", "\"'><img src=x onerror=alert(1)>", "{{ 7*7 }}", "&lt;b&gt;"]
)
def test_names_are_escaped(name: str) -> None:
    page = Page(demo(title=name, names=(name, *NAMES[1:])))
    assert not page.all("script")
    assert not any("onerror" in attributes for _, attributes in page.tags)
    assert page.text.startswith(name)
    assert page.tables[0][1][1] == name
    assert f"{name} at azimuth 315.0°" in [attributes["alt"] for attributes in page.all("img")]


def test_conditions_are_grouped_and_separate_from_the_wall_clock() -> None:
    page = Page(demo())
    assert page.tables[-2] == [
        ["seed", "7"], ["noise"], ["backlash_deg", "0.25"], ["noise camera"], ["gain", "–"]
    ]  # fmt: skip
    assert page.tables[-1] == [["written", "2026-01-02 03:04"]]


def test_equal_runs_give_equal_pages_except_for_the_wall_clock() -> None:
    assert demo() == demo()
    records = [enrolled()], [identified()]
    early, late = (
        render_report("t", "s", *records, meta=Meta({"seed": 1}, {"took": one})) for one in ("early", "late")
    )
    assert early.replace("early", "late") == late


def test_single_search_has_its_own_page() -> None:
    page = Page(render_report("Identification", "", [], [identified()], meta=Meta()))
    assert {attributes.get("id") for attributes in page.all("h2")} == {"searches"}
    assert "outcome" not in {attributes.get("class") for attributes in page.all("span")}
    assert "answer mug-white" in page.text
    assert "score 0.930 per view; margin +0.100" in page.text


def test_many_searches_are_folded_except_wrong_ones() -> None:
    records = [identified("mug-white", (90.0,), truth=Truth("lamp" if k == 5 else "mug-white")) for k in range(7)]
    page = Page(render_report("", "", [], records, meta=Meta()))
    searches = [attributes for attributes in page.all("details") if "class" not in attributes]
    assert [k for k, attributes in enumerate(searches) if "open" in attributes] == [0, 5]


def test_interrupted_runs_are_reported() -> None:
    page = Page(render_report("t", "", [Record()], [Record()], meta=Meta()))
    assert "The search ended without an answer." in page.text
    assert "No view was accepted." in page.text


def test_writing_replaces_the_whole_page(tmp_path: Path) -> None:
    path = tmp_path / "new" / "report.html"
    write_report(path, "first ✓")
    write_report(path, "second ✓")
    assert path.read_text(encoding="utf-8") == "second ✓"
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


def test_failed_write_is_a_clear_error_and_preserves_the_old_page(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.mkdir()
    (path / "kept").write_text("old")
    for failing in (path, path / "kept" / "report.html"):
        with pytest.raises(UsageError, match=r"cannot be written to .*report\.html") as caught:
            write_report(failing, "new")
        assert Do.RUN_AGAIN(out="FILE") in caught.value.steps
        assert caught.value.evidence["reason"]
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (path / "kept").read_text() == "old"


def test_dense_search_shows_its_decisions() -> None:
    page = Page(render_report("Search", "", [], [recorded(Record(), searching_densely())], meta=META))
    assert [one.strip() for one in page.texts].count("not enrolled") == 3  # in the table of each view
    assert "Not confident yet: 60.0 %, and 95.0 % ends the search." in page.text
    assert "Most objects were enrolled without an empty-table image, so the search does not use it" in page.text
    assert page.text.count("distinguishes mug-white from mug-star, similarity 0.50") == 2
    assert ["mug-white", "60.0 %", "0.900"] in [row for table in page.tables for row in table]


def test_long_search_shows_a_dozen_views_with_its_first_and_last() -> None:
    record = identified(rotations_deg=(10.0,) * 29)
    assert [view.index for view in (record.shown[0], record.shown[-1])] == [0, 29]
    page = Page(render_report("t", "s", [], [record], meta=META))
    assert "12 of 30 views are shown" in page.text
    assert len([a for a in page.all("img") if a["alt"].startswith("View")]) == 12
    numbers = re.findall(r"View (\d+)", " ".join(a["alt"] for a in page.all("img")))
    named = re.findall(r'class="stop-number"[^>]*>(\d+)<', render_report("t", "s", [], [record], meta=META))
    assert named == numbers, "the path names the views of the cards"


def test_object_has_the_same_colour_in_every_chart_and_card_of_a_page() -> None:
    records = [identified(NAMES[0], names=NAMES), identified(NAMES[1], names=NAMES[::-1])]
    html = render_report("t", "s", [], records, meta=META)
    keys = set(re.findall(r'<i class="key (c\d)"></i>([\w-]+)<', html))
    dots = set(re.findall(r'class="dot (c\d)"><title>([\w-]+) ', html))
    assert len({name for _, name in keys | dots}) == len({colour for colour, _ in keys | dots}) == len(NAMES)
    assert keys <= dots
