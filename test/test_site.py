# SPDX-License-Identifier: Apache-2.0
"""The built documentation: one index, and every page fits the width of a telephone."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("furo", reason="the documentation's tools are not installed")

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures"
SIZE_OF_FIGURES = 1_000_000
"""Maximum size of all figures [bytes], so that a clone stays small."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site as `make docs` does; a broken link or a page without a place is an error."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "docs", folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_index_holds_the_readme_and_every_section(site):
    page = (site / "index.html").read_text()
    first = (ROOT / "README.md").read_text().split("\n\n")[1]
    assert first.split(".")[0].replace("\n", " ") in page.replace("\n", " ")
    captions = re.findall(r'class="caption-text">([^<]+)<', page)
    sections = ["Tutorials", "How-to", "Reference", "Explanation", "Results"]
    assert list(dict.fromkeys(captions)) == sections


@pytest.mark.parametrize("width", [390, 1280])
def test_no_page_scrolls_horizontally(site, browser, width):
    wide = {}
    pages = sorted(p for p in site.rglob("*.html") if "_static" not in p.parts)
    assert len(pages) > 30
    for page in pages:
        browser.open(page, width)
        scrolled = browser.value("document.documentElement.scrollWidth")
        if scrolled > width:
            wide[page.relative_to(site)] = scrolled
    assert wide == {}
    assert browser.complaints == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:"))] == []


def test_figures_are_small_and_all_shown():
    figures = [path for path in FIGURES.iterdir() if path.is_file()]
    assert sum(path.stat().st_size for path in figures) < SIZE_OF_FIGURES
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "".join(path.read_text() for path in pages if "_build" not in path.parts)
    shown = set(re.findall(r"figures/([\w.]+)\)", text))
    assert {path.name for path in figures} == shown
