"""Identification of the code of a result: commit, and digest of sources (without docstrings), configuration and pinned libraries.

    python3 -m perch_eval.revision [PAGE...]      mark the results pages that were made by other code
"""

from __future__ import annotations

import argparse
import hashlib
import re
import shlex
import subprocess
import sys
from collections.abc import Collection, Iterable
from pathlib import Path

from perch_core.config import config_dir
from perch_core.errors import PerchError

CODE = ("src", "config", "requirements")
OLDER = ", older than the code"
_DIGEST = re.compile(r"\(digest ([0-9a-f]{12})\)")
_DOCSTRING = re.compile(rb'^([ \t]*)"""(?![),])(?:[^"\\]|\\.|"(?!""))*"""[ \t]*$', re.MULTILINE | re.DOTALL)


class OtherCodeError(PerchError):
    """The code that runs is not that of the results."""


def root() -> Path:
    """The checkout that this code runs from, whatever PERCH_CONFIG_DIR is."""
    for folder in Path(__file__).resolve().parents:
        if (folder / "config" / "vehicles").is_dir():
            return folder
    return config_dir().resolve().parent


def _git(*arguments: str) -> str:
    """Return what git prints; empty where it fails or is not installed."""
    try:
        return subprocess.run(["git", "-C", str(root()), *arguments], capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""


def commit() -> str:
    """Return the commit of the code, with a plus sign if the sources have changed since or PERCH_CONFIG_DIR replaces some of them;
    `unknown` outside a repository."""
    found = _git("rev-parse", "--short=7", "HEAD")
    return found + "+" * bool(_git("status", "--porcelain", "--untracked-files=normal", *CODE) or _other_config()) if found else "unknown"


def _other_config() -> Path | None:
    """Return the configuration folder if it is not that of the checkout."""
    folder = config_dir().resolve()
    return None if folder == root() / "config" else folder


def _walked(*folders: Path) -> list[Path]:
    """Return the files in some folders, without hidden ones and those that Python writes."""
    found = [(path, path.relative_to(folder).parts) for folder in folders for path in folder.rglob("*") if path.is_file() or path.is_symlink()]
    return [path for path, parts in found if not any(part.startswith(".") or part == "__pycache__" or part.endswith(".egg-info") for part in parts)]


def without_docstrings(source: bytes) -> bytes:
    """Return Python source without the docstrings of modules, classes, functions and attributes, which do not affect results."""
    return _DOCSTRING.sub(rb"\1...", source)


def digest() -> str:
    """SHA-256 over all files of `CODE` that git does not ignore (outside a repository, or without git: all), as they are in the
    working tree, 12 digits; with PERCH_CONFIG_DIR also over those there.

    Docstrings do not count: rewording them does not invalidate results.
    """
    total, folder, other = hashlib.sha256(), root(), _other_config()
    names = (_git("ls-files", "--cached", "--others", "--exclude-standard", *CODE).splitlines()
             or [path.relative_to(folder).as_posix() for path in _walked(*(folder / part for part in CODE))])
    for name in sorted([*names, *(str(path) for path in _walked(*([other] if other else [])))]):
        path = folder / name
        content = path.read_bytes() if path.is_file() else b""
        total.update(name.encode() + b"\0" + (without_docstrings(content) if path.suffix == ".py" else content) + b"\0")
    return total.hexdigest()[:12] if names else ""


def require_code(expected: str, remedy: str) -> None:
    """Check that the code has a digest; an empty one is unknown and is not compared.

    Raises:
        OtherCodeError: it has another one.
    """
    if expected and (now := digest()) != expected:
        raise OtherCodeError(f"the code has digest {now}, its results would be stored under {expected}: {remedy}")


def code_version() -> dict[str, str]:
    """Return commit and digest of the code, the first entries of a results file."""
    return {"commit": commit(), "digest": digest()}


def command_line() -> str:
    """Return the command that this process was started by, as a user writes it."""
    return shlex.join(["python3", *sys.argv])


def banner(commits: Collection[str], codes: Collection[str]) -> str:
    """Return the banner of a results page: its commits, whether they are older than the code, and how to list the changes since
    the oldest of them, or since where their histories part.

    Args:
        commits: from `commit()` when the results were made.
        codes: from `digest()`; empty strings if unknown.
    """
    now, several = digest(), "s" * (len(set(commits)) > 1)
    status = f"** (digest {now})" if now and set(codes) == {now} else f"{OLDER}**"
    known = sorted({one.partition("+")[0] for one in commits})
    first = _git("merge-base", "--octopus", *known)[:7] or next(iter(known), "")
    return f"> **Of commit{several} {', '.join(sorted(set(commits)))}{status}. What has changed since: `git diff --stat {first} -- {' '.join(CODE)}`"


def out_of_date(page: str, now: str) -> bool:
    """Return whether a page was made by code of another digest than `now` and is not marked as older."""
    made = _DIGEST.search(page)
    return OLDER not in page.partition("\n## ")[0] and (made is None or made[1] != now)


def mark(pages: Iterable[Path]) -> list[Path]:
    """Mark the banner of each out-of-date page as older than the code; return these pages."""
    now, marked = digest(), []
    for path in pages:
        page = path.read_text()
        if out_of_date(page, now):
            path.write_text(re.sub(r"(\*\*[Oo]f commits? [^*\n]*?)\.?\*\*", rf"\g<1>{OLDER}**", page, count=1))
            marked.append(path)
    return marked


def main(arguments: list[str] | None = None) -> None:
    """Mark the pages of the command line, by default all results and README.md, and print those that were not marked yet."""
    parser = argparse.ArgumentParser(prog="python3 -m perch_eval.revision", description="Mark the pages that were made by other code.")
    parser.add_argument("pages", nargs="*", type=Path, metavar="PAGE", help="page with a banner (default: all of docs/results, and README.md)")
    pages = parser.parse_args(arguments).pages or [*sorted((root() / "docs" / "results").rglob("*.md")), root() / "README.md"]
    for page in mark(pages):
        print(f"{page}: older than the code")


if __name__ == "__main__":
    main()
