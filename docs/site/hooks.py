"""Pages of the site that stand elsewhere in the repository or are notebooks, and links to what is no page of it."""

import base64
import json
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
LAB = "lab"
"""Not part of the source distribution."""
TUTORIALS = "docs/tutorials"
_LINK = re.compile(r"(\]\()(?!https?://|mailto:|#)([^)#\s]+)(#[^)\s]*)?(\))")


def _pages() -> dict[str, str]:
    """Files of the repository that become pages, other than those of docs/ that are ones, by their path in it."""
    fixed = {
        "README.md": "index.md",
        "CHANGELOG.md": "changelog.md",
        "CONTRIBUTING.md": "contributing.md",
        "cluster/README.md": "cluster.md",
        "policies/README.md": "policies.md",
    }
    if (ROOT / LAB).is_dir():
        fixed[f"{LAB}/README.md"] = "lab.md"
    results = sorted((ROOT / RESULTS).glob("*.md"))
    notebooks = sorted((ROOT / TUTORIALS).glob("*.ipynb"))
    return {
        **fixed,
        **{f"{RESULTS}/{path.name}": f"benchmarks/{path.name}" for path in results},
        **{f"{TUTORIALS}/{path.name}": f"tutorials/{path.stem}.md" for path in notebooks},
    }


PAGES = _pages()
_SOURCES = {page: source for source, page in PAGES.items()}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the measurements into the navigation."""
    assert config.nav is not None
    measured = [page for page in PAGES.values() if page.startswith("benchmarks/")]
    config.nav.insert(-1, {"Measurements": measured})
    if "lab.md" in PAGES.values():
        config.nav.append({"Lab": "lab.md"})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    for source, page in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        pictures: dict[str, bytes] = {}
        if source.endswith(".ipynb"):
            text, pictures = page_of(json.loads(text), page.removesuffix(".md"))
        files.append(File.generated(config, page, content=text))
        for path, content in pictures.items():
            files.append(File.generated(config, path, content=content))
    return files


def page_of(notebook: dict[str, Any], path: str) -> tuple[str, dict[str, bytes]]:
    """The Markdown of an executed notebook, and its pictures by their paths in the site.

    Args:
        notebook: the content of an .ipynb file.
        path: of the page in the site, without a suffix.

    Raises:
        ValueError: a cell has not been executed, or has an output that is neither text nor a picture.
    """
    name = posixpath.basename(path)
    parts, pictures = [], {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        if cell["execution_count"] is None:
            raise ValueError(f"{path}: a cell has not been executed; make notebooks")
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if output["output_type"] == "stream":
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            elif "image/png" in output.get("data", {}):
                picture = f"{path}_{len(pictures)}.png"
                pictures[picture] = base64.b64decode(output["data"]["image/png"])
                parts.append(f"![What the cell above draws]({name}_{len(pictures) - 1}.png)")
            else:
                raise ValueError(f"{path}: an output that is neither text nor a picture: {output}")
    source = f"[{name}.py]({name}.py), [{name}.ipynb]({name}.ipynb)"
    # Below the heading, which is the first line.
    heading, _, rest = parts[0].partition("\n")
    return "\n\n".join([f"{heading}\n\n*As a notebook: {source}*\n{rest}", *parts[1:]]) + "\n", pictures


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages; a link to a file that is not part of the
    site becomes its path."""
    here = page.file.src_uri
    source = _SOURCES.get(here, f"docs/{here}")

    def rewrite(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[2]))
        if not (ROOT / target).exists() and not target.startswith(f"{LAB}/"):
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
