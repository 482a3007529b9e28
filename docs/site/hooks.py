"""Pages of the site that stand elsewhere in the repository, and links to what is no page of it."""

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.nav import Navigation
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
RESULTS = "benchmarks/results"
_LINK = re.compile(r"(\]\()(?!https?://|mailto:|#)([^)#\s]+)(#[^)\s]*)?(\))")


def _pages() -> dict[str, str]:
    """Files of the repository outside docs/ that become pages, by their path in it."""
    fixed = {
        "README.md": "index.md",
        "CONTRIBUTING.md": "contributing.md",
        "cluster/README.md": "cluster.md",
        "policies/README.md": "policies.md",
    }
    results = sorted((ROOT / RESULTS).glob("*.md"))
    return fixed | {f"{RESULTS}/{path.name}": f"benchmarks/{path.name}" for path in results}


PAGES = _pages()
_SOURCES = {page: source for source, page in PAGES.items()}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the measurements into the navigation."""
    assert config.nav is not None
    measured = [page for page in PAGES.values() if page.startswith("benchmarks/")]
    config.nav.insert(-1, {"Measurements": measured})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages; a link to a file that is not part of the
    site becomes its path."""
    here = page.file.src_uri
    source = _SOURCES.get(here, f"docs/{here}")

    def rewrite(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[2]))
        if not (ROOT / target).exists():
            return match[0]  # for `--strict` to find
        found = PAGES.get(target, target.removeprefix("docs/") if target.startswith("docs/") else None)
        if found is None or files.get_file_from_path(found) is None:
            return f"]({_OUTSIDE}{target})"
        return f"]({posixpath.relpath(found, posixpath.dirname(here) or '.')}{match[3] or ''})"

    return _UNLINK.sub(r"\1 (`\2`)", _LINK.sub(rewrite, markdown))


_OUTSIDE = "outside:"
_UNLINK = re.compile(rf"\[([^\]]*)\]\({_OUTSIDE}([^)]*)\)")


def on_nav(nav: Navigation, **_: Any) -> Navigation:
    """Measurements are named by their files, whose headings are sentences."""
    for page in nav.pages:
        if page.file.src_uri.startswith("benchmarks/"):
            page.title = page.file.name.replace("_", " ")
    return nav
