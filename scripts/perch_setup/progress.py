"""Shows what set-up is doing, and keeps the full output of every tool in a log file."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from typing import Callable, Mapping, Optional, Sequence

from .errors import FAILED, SetupError
from .layout import STATE
from .lock import descriptors

_TAIL = 15
_QUIET_PERIOD_S = 10.0


class Step:
    """One step of the set-up, on one line of a terminal or a few lines of a log.

    Args:
        title: what is being done.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._start = time.monotonic()
        self._shown = 0.0
        self._terminal = sys.stderr.isatty()

    def __enter__(self) -> "Step":
        self._write("")
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        word = "done" if kind is None else "stopped"
        self._write(f"{word} in {time.monotonic() - self._start:.0f} s", final=True)

    def show(self, detail: str) -> None:
        """Report progress; without a terminal, at most every ten seconds."""
        now = time.monotonic()
        if self._terminal or now - self._shown > _QUIET_PERIOD_S:
            self._write(detail)

    def run(self, command: Sequence[object], log: str, environment: Mapping[str, str],
            describe: Callable[[str], Optional[str]] = lambda line: None) -> None:
        """Run a tool, log its output, and show what `describe` returns for each line.

        Raises:
            SetupError: the tool fails; the message has the last lines of its output.
        """
        file = STATE / "log" / f"{log}.log"
        file.parent.mkdir(parents=True, exist_ok=True)
        lines: list[str] = []
        with file.open("w") as sink, subprocess.Popen(
                [str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, text=True,
                errors="replace", env=dict(environment), pass_fds=descriptors()) as process:
            try:
                for line in process.stdout or ():
                    sink.write(line)
                    lines = [*lines[1 - _TAIL :], line.rstrip()]
                    detail = describe(line)
                    if detail:
                        self.show(detail)
            except KeyboardInterrupt:
                _wait_or_kill(process)
                raise
        if process.returncode:
            shown = "\n".join(f"    {line}" for line in lines)
            raise SetupError(f"set-up failed in step {log} (exit code {process.returncode}). Its last lines:\n{shown}\nAll of them: {file}", FAILED)

    def _write(self, detail: str, final: bool = False) -> None:
        self._shown = time.monotonic()
        text = f"perch set-up: {self._title}{': ' + detail if detail else ' ...'}"
        if self._terminal:
            sys.stderr.write(f"\r\033[K{text[:shutil.get_terminal_size().columns - 1]}" + ("\n" if final else ""))
        else:
            sys.stderr.write(text + "\n")
        sys.stderr.flush()


def _wait_or_kill(process: subprocess.Popen) -> None:
    """Wait for a tool to end after Ctrl-C, which it received as well; kill it after a time-out."""
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        process.kill()
