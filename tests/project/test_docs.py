"""The tables of the documents are those of the committed results, and their links lead somewhere."""

import importlib.util
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()


@pytest.fixture(scope="module")
def make_results():
    spec = importlib.util.spec_from_file_location("make_results", DOCS / "_scripts" / "make_results.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_are_those_of_the_results(make_results):
    pages = {name: (DOCS / name).read_text() for name in make_results.PAGES}
    for name, page in pages.items():
        assert make_results.fill_in(page) == page, f"docs/{name} is not up to date: python docs/_scripts/make_results.py"
    assert all(f"<!-- table: {name} -->" in "".join(pages.values()) for name in make_results.TABLES)


def test_a_table_that_says_something_else_is_replaced(make_results):
    page = "before\n<!-- table: leak -->\n| 1 |\n<!-- end -->\nafter\n"
    filled = make_results.fill_in(page)
    assert filled.startswith("before\n<!-- table: leak -->\n\n| ") and filled.endswith(" |\n\n<!-- end -->\nafter\n")
    assert "| 1 |" not in filled and "`SwingingBall-v0`" in filled


def anchors(page):
    """Anchors of a page's titles, as code hosts make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name):
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if not target.startswith(("http", "mailto:")):
            file, _, anchor = target.partition("#")
            linked = (page.parent / file) if file else page
            assert linked.exists(), target
            assert not anchor or anchor in anchors(linked), target
