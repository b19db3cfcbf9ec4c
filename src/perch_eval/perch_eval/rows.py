"""Results of long runs in a file, one line of JSON each: a row is read completely or not at all, even after a killed process."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from perch_core.files import replacement


def rows_of(path: Path) -> Iterator[Any]:
    """Yield the rows of a file, also while it is being written; none if there is no file. An incomplete last line is ignored.

    Raises:
        ValueError: a line is no JSON.
    """
    lines = path.read_text().splitlines(keepends=True) if path.exists() else ()
    yield from (json.loads(line) for line in lines if line.endswith("\n"))


class Rows:
    """Writes a file of rows, from one process at a time."""

    def __init__(self, path: Path, known: Iterable[Any] = ()) -> None:
        """
        Args:
            path: of the file, which is replaced.
            known: rows to begin with.

        Raises:
            OSError: it cannot be written.
        """
        with replacement(path) as draft:
            draft.write_text("".join(json.dumps(row) + "\n" for row in known))
        self._file = path.open("a")

    def add(self, row: Any) -> None:
        """Write a row."""
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
