"""Which code a result is of: commit, and a digest of all sources without their docstrings, configuration and pinned libraries.

    python3 -m perch_eval.revision [PAGE...]      mark the pages of results that are of other code
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from collections.abc import Collection, Iterable
from pathlib import Path

from perch_core.config import config_dir

CODE = ("src", "config", "requirements")
OLDER = ", older than the code"
_DIGEST = re.compile(r"\(digest ([0-9a-f]{12})\)")
_DOCSTRING = re.compile(rb'^([ \t]*)"""(?![),])(?:[^"\\]|\\.|"(?!""))*"""[ \t]*$', re.MULTILINE | re.DOTALL)


def root() -> Path:
    """The checkout that this code runs from."""
    return config_dir().resolve().parent


def _git(*arguments: str) -> str:
    return subprocess.run(["git", "-C", str(root()), *arguments], capture_output=True, text=True, check=False).stdout.strip()


def commit() -> str:
    """Of the code, with a plus sign where the sources have changed since; `unknown` outside a repository."""
    found = _git("rev-parse", "--short=7", "HEAD")
    return found + "+" * bool(_git("status", "--porcelain", "--untracked-files=no", *CODE)) if found else "unknown"


def without_docstrings(source: bytes) -> bytes:
    """Python source whose docstrings, of modules, classes, functions and attributes, are empty: what is left decides what it computes."""
    return _DOCSTRING.sub(rb"\1...", source)


def digest() -> str:
    """SHA-256 over all files of `CODE` that git tracks, as they are in the working tree, 12 digits; empty outside a repository.

    Docstrings do not count, so that results remain valid when these are edited.
    """
    total = hashlib.sha256()
    names = _git("ls-files", *CODE).splitlines()
    for name in names:
        path = root() / name
        content = path.read_bytes() if path.is_file() else b""
        total.update(name.encode() + b"\0" + (without_docstrings(content) if path.suffix == ".py" else content) + b"\0")
    return total.hexdigest()[:12] if names else ""


def code_version() -> dict[str, str]:
    """Commit and digest of the code, the first entries of a file of results."""
    return {"commit": commit(), "digest": digest()}


def banner(commits: Collection[str], codes: Collection[str]) -> str:
    """First lines of a page of results: its commits, whether they are older than the code, and how to see the changes.

    Args:
        commits: as `commit()` gave them when the results were made.
        codes: as `digest()` gave them; empty texts where that is not known.
    """
    now, several = digest(), "s" * (len(set(commits)) > 1)
    status = f"** (digest {now})" if now and set(codes) == {now} else f"{OLDER}**"
    first = min(commits, default="").partition("+")[0]
    return f"> **Of commit{several} {', '.join(sorted(set(commits)))}{status}. What has changed since: `git diff --stat {first} -- {' '.join(CODE)}`"


def out_of_date(page: str, now: str) -> bool:
    """Whether a page is of code of another digest than `now` and does not say so."""
    made = _DIGEST.search(page)
    return OLDER not in page.partition("\n## ")[0] and (made is None or made[1] != now)


def mark(pages: Iterable[Path]) -> list[Path]:
    """Write into the banner of each page that is out of date that it is older than the code; returns these pages."""
    now, marked = digest(), []
    for path in pages:
        page = path.read_text()
        if out_of_date(page, now):
            path.write_text(re.sub(r"(> \*\*Of commits? [^*\n]*?)\.?\*\*", rf"\g<1>{OLDER}**", page, count=1))
            marked.append(path)
    return marked


if __name__ == "__main__":
    for page in mark(map(Path, sys.argv[1:]) if sys.argv[1:] else sorted((root() / "docs" / "results").rglob("*.md"))):
        print(f"{page}: older than the code")
