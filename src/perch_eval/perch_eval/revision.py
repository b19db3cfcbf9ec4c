"""Which code a result is of."""

from __future__ import annotations

import subprocess

FLOWN = ("src", "config")


def commit() -> str:
    """Of the code, with a plus sign where the sources have changed since; `unknown` outside a repository."""
    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], capture_output=True, text=True, check=False).stdout.strip()

    found = git("rev-parse", "--short", "HEAD")
    return found + "+" * bool(git("status", "--porcelain", "--untracked-files=no", *FLOWN)) if found else "unknown"


def banner(commits: str) -> str:
    """What a page of results begins with: the commits that it is of, and how to see what has changed since."""
    first = commits.partition("+")[0].partition(",")[0].partition(" ")[0]
    return f"> **Of commit {commits}.** What has changed since: `git diff --stat {first} -- {' '.join(FLOWN)}`"
