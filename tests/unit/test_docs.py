"""The pages of docs: every link leads somewhere, every page is in the site's navigation, lines are short, and wheels are those that are pinned."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
TOP = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "SECURITY.md": "security.md",
       "QUALITY_DECLARATION.md": "quality_declaration.md"}
"""Pages of the site from the top of the repository, as docs/site_hooks.py has them."""
PAGES = sorted(DOCS.rglob("*.md"))
ALL = [*PAGES, *(ROOT / name for name in TOP)]
GENERATED = {DOCS / "equations.md", *(DOCS / "results").rglob("*.md")}
WIDTH = 120


def anchors(page: Path) -> set[str]:
    """Of the headings of a page, as GitHub and mkdocs make them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", head.lower()).strip()) for head in re.findall(r"^#+ (.*)$", text, re.M)}


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)", text):
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), f"{target} does not exist"
        if anchor and path.suffix == ".md":
            assert anchor in anchors(path), f"{target}#{anchor}: there is no such heading"


@pytest.mark.parametrize("page", [page for page in ALL if page not in GENERATED], ids=lambda page: str(page.relative_to(ROOT)))
def test_files_that_are_named_exist(page):
    named = re.findall(r"`((?:src|tests|scripts|config|docs|bench|requirements)/[\w./-]+)`", page.read_text())
    assert [name for name in named if not (ROOT / name).exists() and not (ROOT / f"{name}.py").exists()] == []


@cache
def texts_of_tests() -> dict[str, str]:
    """Name of each file of tests, and its text."""
    return {path.name: path.read_text() for path in (ROOT / "tests").rglob("test_*.py")}


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_tests_that_are_named_exist(page):
    named = re.findall(r"`(?:tests/\w+/)?(test_\w+\.py)(?:::(\w+))?`", page.read_text())
    assert [f"{file}::{test}" for file, test in named if f"def {test}" not in texts_of_tests().get(file, "")] == []


def leaves(nav) -> list[str]:
    """The pages of a navigation."""
    if isinstance(nav, str):
        return [nav]
    return [page for item in (nav if isinstance(nav, list) else nav.values()) for page in leaves(item)]


def test_every_page_is_in_the_navigation_once():
    listed = leaves(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    assert sorted(listed) == sorted([*(page.relative_to(DOCS).as_posix() for page in PAGES), *TOP.values()])


def test_the_site_takes_the_same_pages_from_the_top():
    pages = re.search(r"PAGES = (\{.*?\})", (DOCS / "site_hooks.py").read_text(), re.S)[1]
    assert yaml.safe_load(pages) == TOP


@pytest.mark.parametrize("page", [page for page in ALL if page not in GENERATED], ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_are_short(page):
    """But in tables, and in commands that cannot be broken."""
    text = re.sub(r"```.*?```", lambda block: "\n" * block[0].count("\n"), page.read_text(), flags=re.S)
    assert [k for k, line in enumerate(text.splitlines(), 1) if len(line) > WIDTH and not line.startswith("|")] == []


def test_wheels_named_for_the_companion_computer_are_those_that_are_pinned():
    locks = [ROOT / "requirements" / "python.lock", *(ROOT / "requirements" / "extras").glob("*.lock")]
    pinned = dict(re.findall(r"^([\w.-]+)==([^;\s]+)", "\n".join(lock.read_text() for lock in locks), re.M))
    rows = re.findall(r"^\| ([\w, -]+?) \| ([\d., ]+)", (DOCS / "howto" / "companion_computer.md").read_text(), re.M)
    named = {name: version for names, versions in rows for name, version in zip(names.split(", "), versions.strip().split(", "))}
    assert len(named) >= 10 and {name: pinned.get(name) for name in named} == named


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_paragraphs_of_list_items_are_indented_by_four(page):
    """With less they end the list on the site, and the items that follow are no items."""
    text = re.sub(r"^( *)```.*?^\1```", lambda block: "x\n" * block[0].count("\n") + "x", page.read_text(), flags=re.S | re.M)
    lines = text.splitlines()
    assert [k for k, (above, line) in enumerate(zip(lines, lines[1:]), 2) if not above.strip() and re.match(r" {1,3}\S", line)] == []
