"""
The hooks of the documentation site (mkdocs.yml).

The site has the paths of the repository, so that a link works in both. It has a page more for each package: the API, to which
links to the packages' modules lead.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
#: What pages are, show and link to.
PATTERNS = (
    "*.md",
    "LICENSE",
    "CITATION.cff",
    "docs/**/*.md",
    "docs/**/*.png",
    "docs/**/*.gif",
    "docs/_scripts/*.py",
    "docs/_scripts/*.css",
    "results/**/*.*",
    "suites/*.*",
)
PACKAGES = ("sb3_por", "softbody_envs")


def api_pages() -> dict[str, str]:
    """
    Write the page of each package.

    :return: path in the site -> Markdown
    """
    pages = {}
    for folder in sorted(path.parent for top in PACKAGES for path in (ROOT / top).rglob("__init__.py")):
        package = ".".join(folder.relative_to(ROOT).parts)
        modules = [path.stem for path in sorted(folder.glob("*.py")) if not path.stem.startswith("_")]
        parts = [f"# {package}", f"::: {package}\n    options: {{show_root_heading: false}}"]
        parts += [f"::: {package}.{module}" for module in modules]
        pages[f"docs/api/{package}.md"] = "\n\n".join(parts) + "\n"
    return pages


def on_config(config: MkDocsConfig) -> None:
    """Append the API to the navigation."""
    assert config.nav is not None
    config.nav.append({"API": [*api_pages()]})


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put files of the repository and the API in the place of those of ``docs/``."""
    for file in [file for file in files if file.src_dir == config.docs_dir]:
        files.remove(file)
    for path in sorted({path for pattern in PATTERNS for path in ROOT.glob(pattern)}):
        files.append(File(str(path.relative_to(ROOT)), str(ROOT), config.site_dir, config.use_directory_urls))
    for name, text in api_pages().items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **kwargs: Any) -> str:
    """Let links to modules lead to the API; the first page has no neighbours to show."""
    if page.is_homepage:
        page.meta["hide"] = ["navigation"]

    def to_api(link: re.Match[str]) -> str:
        up, package, module = link[1], link[2].replace("/", "."), link[3]
        anchor = "" if module == "__init__" else f"#{package}.{module}"
        return f"]({up}docs/api/{package}.md{anchor})"

    return re.sub(rf"\]\(((?:\.\./)*)((?:{'|'.join(PACKAGES)})(?:/\w+)*)/(\w+)\.py\)", to_api, markdown)
