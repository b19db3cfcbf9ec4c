"""Hooks of mkdocs: pages from the top of the repository, and links to files that are no pages.

README.md becomes the first page. A link to a source file becomes its text and path: the site has pages only. A link whose
text is a path gets the title of its page.
"""

from __future__ import annotations

import re
from pathlib import Path
from posixpath import normpath, relpath
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "SECURITY.md": "security.md",
         "QUALITY_DECLARATION.md": "quality_declaration.md"}
"""File at the top of the repository -> page."""
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#:\s]+)(#[^)\s]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages from the top of the repository."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links from the layout of the repository into that of the site."""
    here = page.file.src_uri
    source = next((path for path, name in PAGES.items() if name == here), f"docs/{here}")
    return _LINK.sub(lambda link: _linked(link, here, source), markdown)


def _linked(link: re.Match[str], here: str, source: str) -> str:
    image, text, target, anchor = link[1], link[2], link[3], link[4] or ""
    path = normpath(f"{Path(source).parent.as_posix()}/{target}")
    if (ROOT / path).is_dir() and (ROOT / path / "README.md").exists():
        path = f"{path}/README.md"
    name = text.strip("`").lstrip("./")
    if name.endswith(".md") or "/" in name and path.removesuffix("/README.md").endswith(name):
        text = _title(path) or text
    if path in PAGES:
        there = PAGES[path]
    elif path.startswith("docs/") and (ROOT / path).is_file():
        there = path.removeprefix("docs/")
    elif (ROOT / path).exists():
        return text if path.endswith(name.partition(": ")[0]) else f"{text} (`{re.sub('^src/[^/]+/', '', path)}`)"
    else:
        return link[0]  # mkdocs says that it is broken
    return f"{image}[{text}]({relpath(there, Path(here).parent.as_posix())}{anchor})"


def _title(path: str) -> str:
    """First heading of a page; empty if the file is none."""
    found = re.search(r"^# (.+)$", (ROOT / path).read_text(), re.M) if path.endswith(".md") and (ROOT / path).is_file() else None
    return found[1] if found else ""
