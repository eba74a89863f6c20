"""Report page: completeness, no external resources, keyboard and screen reader access, and correct counts in charts."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from mitsplat.pages.svg_charts import HeatMap, Histogram, bars, columns
from mitsplat.report.dataset_report import SAMPLES, write_report
from tests.audit.test_audit import swap_a_class
from tests.cli.typed import run
from tests.manifests import records_of, store


class Page(HTMLParser):
    """Parser of a page: elements with their attributes, and the text of each."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in ("meta", "img", "input", "rect", "path", "line", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("meta", "img", "input", "rect", "path", "line", "br"):
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open and "script" not in self.open:
            self.text += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture
def page(clean: Path, tmp_path: Path) -> Page:
    path, _, _ = write_report(clean, tmp_path / "report.html")
    return Page(path.read_text())


def test_the_report_states_contents_and_settings_of_the_dataset(page: Page) -> None:
    for text in ("small", "4 train, 2 val", "64 x 48 px", "No violations in", "Seed", "Device", "hidden", "yolo-pose"):
        assert text in page.text
    assert "2.0e-05 of the range on average, 0.0040 at most" in page.text  # all frames record their error
    assert Path(sys.argv[0]).name in page.text  # the command that wrote the page
    assert len(page.all("img")) == min(SAMPLES, 6)
    captions = (
        "Instances by class",
        "Instances per image",
        "Positions of boxes",
        "Sizes of boxes",
        "Visible fraction",
    )
    for caption in (*captions, "Truncation", "Agreement", "Brightness of pixels", "Seconds per frame by stage"):
        assert caption in page.text


def test_the_report_loads_no_other_file(page: Page) -> None:
    for tag, attributes in page.elements:
        for name in ("src", "href", "srcset", "data", "action"):
            if name in attributes:
                assert attributes[name].startswith("data:"), (tag, attributes[name])
    assert not page.all("link") and not page.all("iframe")


def test_the_report_is_well_formed_with_names_for_screen_readers(page: Page) -> None:
    assert page.open == []
    assert page.all("html")[0]["lang"] == "en"
    assert len(page.all("h1")) == 1 and len(page.all("main")) == 1
    assert all(image["alt"] for image in page.all("img"))
    for drawing in page.all("svg"):
        assert drawing.get("aria-hidden") == "true" or (drawing["role"] == "img" and drawing["aria-label"])
    ids = {attributes["id"] for _, attributes in page.elements if "id" in attributes}
    assert {section["aria-labelledby"] for section in page.all("section")} <= ids
    assert len(page.all("input")) == len(page.all("label")) == 4  # each inside its label, in a named fieldset
    assert len(page.all("fieldset")) == len(page.all("legend")) == 1
    assert not any("tabindex" in attributes and attributes["tabindex"] != "0" for _, attributes in page.elements)


def test_overlays_of_the_report_are_toggled_in_a_browser(clean: Path, tmp_path: Path) -> None:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium on this machine")
    path, _, _ = write_report(clean, tmp_path / "report.html")
    press = (
        "<script>for (const key of ['mask', 'box']) document.querySelector(`[data-overlay=${key}]`).click();"
        "document.body.dataset.shown = [...document.querySelectorAll('.picture .box')]"
        ".every(e => getComputedStyle(e).display === 'inline');"
        "document.body.dataset.hidden = [...document.querySelectorAll('.picture .mask')]"
        ".every(e => getComputedStyle(e).display === 'none');</script></body>"
    )
    path.write_text(path.read_text().replace("</body>", press))
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]
    done = subprocess.run([chromium, *options, path.as_uri()], capture_output=True, text=True, timeout=120, check=True)
    body = re.search(r"<body[^>]*>", done.stdout)
    assert body is not None and 'data-shown="true"' in body[0] and 'data-hidden="true"' in body[0]


def test_violations_are_shown_with_escaped_text(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = records_of(dataset)
    swap_a_class(dataset, records)
    (dataset / "images/train/<b>.png").write_bytes(b"")
    store(dataset, records)
    assert run("report", dataset) == 0
    assert capsys.readouterr().out == f"report: {dataset / 'report.html'} (2 violations)\n"
    text = (dataset / "report.html").read_text()
    assert "2 violations" in text and "images/train/&lt;b&gt;.png" in text and "class is" in text
    assert "<b>.png" not in text


def test_a_damaged_dataset_has_a_report(dataset: Path) -> None:
    (dataset / "images/train/000000.png").unlink()
    with (dataset / "manifest.jsonl").open("a") as file:
        file.write("{\n")
    page, audit, _ = write_report(dataset)
    assert len(audit.violations) >= 2
    text = page.read_text()
    assert "Frame 0: its image cannot be read" in text and "line 7 is not the record" in text


class TestCharts:
    def test_a_histogram_counts_every_value_once(self) -> None:
        counted = Histogram((0, 1), bins=10)
        counted.add([0.0, 0.05, 0.5])
        counted.add([1.0, 1.0])
        text = counted.draw("shares")
        counts = dict(re.findall(r'<th scope="row">([^<]+)</th><td>(\d+)</td>', text))
        assert counts == {"0 to 0.1": "2", "0.5 to 0.6": "1", "0.9 to 1": "2"}

    def test_bars_and_columns_are_proportional_to_counts(self) -> None:
        heights = [float(h) for h in re.findall(r'class="bar"[^>]* height="([\d.]+)"', columns("c", [1, 4, 2], "abc"))]
        np.testing.assert_allclose(np.array(heights) / heights[1], (0.25, 1, 0.5), atol=0.01)
        widths = [float(w) for w in re.findall(r'class="bar"[^>]* width="([\d.]+)"', bars("c", {"a": 3, "b": 6}))]
        assert widths[0] == pytest.approx(widths[1] / 2)

    def test_a_heat_map_counts_points_in_their_cells(self) -> None:
        counted = HeatMap((100, 50), (10, 5))
        counted.add([99.0, 99.0, 1.0], [49.0, 49.0, 1.0])
        text = counted.draw("m", "px")
        assert "<td>10, 5: 2</td>" in text and "<td>2 of 50</td>" in text

    @pytest.mark.parametrize("chart", [bars("c", {}), Histogram((0, 1)).draw("c"), columns("c", [0], ["0"])])
    def test_charts_without_data_are_well_formed(self, chart: str) -> None:
        assert Page(chart).open == []
