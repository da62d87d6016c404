"""The documentation site builds without a warning, has every page, and documents every public class and function."""

import ast
import html
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.version_info < (3, 11), reason="the site's tools need Python 3.11")

ROOT = Path(__file__).parents[2]
PACKAGES = ("sb3_por", "softbody_envs")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", folder]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout + done.stderr == "", done.stdout + done.stderr
    return folder


def public_names():
    """Dotted names of the classes and functions that a module defines at its top, and of their methods."""
    for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py") if file.name != "__main__.py"):
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                yield f"{module}.{node.name}"


def test_every_public_class_and_function_is_on_a_page(site):
    inventory = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    documented = {line.split()[0] for line in zlib.decompress(inventory).decode().splitlines()}
    missing = set(public_names()) - documented
    assert not missing and len(documented) > 300


def test_no_markup_of_docstrings_is_left(site):
    for page in (site / "docs" / "api").glob("*.html"):
        text = html.unescape(re.sub(r"<[^>]+>", "", page.read_text()))
        assert not re.search(r":(param|return|raises|var|func|class|meth|attr)\b[^:\n]*:", text), page.name


def test_every_page_of_the_repository_is_one_of_the_site(site):
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    pages = [re.sub(r"README$", "index", name.removesuffix(".md")) for name in listed]
    assert [name for name in pages if not (site / f"{name}.html").is_file()] == []


def test_tasks_are_documented_with_their_tables(site):
    page = (site / "docs" / "api" / "softbody_envs.tasks.html").read_text()
    assert "<td>move along x, toward the target</td>" in page


def test_a_link_to_a_module_leads_to_its_documentation(site):
    page = (site / "docs" / "howto" / "own_task.html").read_text()
    assert 'href="../api/softbody_envs.html#softbody_envs.env"' in page
    assert 'id="softbody_envs.env.SoftbodyEnv"' in (site / "docs" / "api" / "softbody_envs.html").read_text()


def test_pages_load_nothing_from_elsewhere(site):
    for page in site.rglob("*.html"):
        assert not re.search(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=\"?(?:https?:)?//", page.read_text()), page.name
