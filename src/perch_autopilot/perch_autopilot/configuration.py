"""Configuration of the autopilot: a file of lines for Betaflight's CLI, sent to the autopilot and checked by reading it back."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from perch_core import config
from perch_core.errors import ConfigError, PerchError

_SET = re.compile(r"set\s+(\w+)\s*=\s*(\S.*)")
_ANSWER_TIME = 20.0  # for one line, on a busy machine [s]
_PROMPT = b"\n# "     # comments of a dump begin like it, and pieces of any size arrive: it is the prompt if nothing follows ...
_SILENCE = 0.05      # ... for this time, longer than an adapter keeps bytes back [s]


class CliError(PerchError):
    """Raised when the firmware's CLI does not answer or refuses a line, and when the settings differ from the configuration."""


@dataclass(frozen=True)
class Configuration:
    """Settings that the firmware is to have.

    Attributes:
        source: file, for messages.
        lines: lines for the CLI, without comments.
    """

    source: str
    lines: tuple[str, ...]

    @property
    def settings(self) -> dict[str, str]:
        """Mapping from name to value of the lines `set name = value`."""
        return _settings(self.lines)

    @property
    def identity(self) -> str:
        """Hash of the lines."""
        return hashlib.sha256("\n".join(self.lines).encode()).hexdigest()[:16]


def load_configuration(name: str) -> Configuration:
    """Return the configuration of `config/autopilot/<name>.txt`, or of a file.

    Raises:
        ConfigError: no such file, no line in it, or a line that is none of `set`, `feature`, `aux`, `map`, `rxrange`, `serial`, `mixer`.
    """
    file = Path(name) if Path(name).suffix else config.config_dir() / "autopilot" / f"{name}.txt"
    try:
        text = file.read_text()
    except (OSError, ValueError) as error:
        why = "no such file" if isinstance(error, FileNotFoundError) else str(error)
        raise ConfigError("autopilot.configuration", str(file), f"cannot be read: {why}") from None
    lines = tuple(line for raw in text.splitlines() if (line := " ".join(raw.split("#")[0].split())))
    for line in lines:
        if not (_SET.fullmatch(line) or line.split()[0] in ("feature", "aux", "map", "rxrange", "serial", "mixer")):
            raise ConfigError(str(file), line, "is not one of set NAME = VALUE, feature, aux, map, rxrange, serial, mixer")
    if not lines:
        raise ConfigError(str(file), "", "has no line")
    return Configuration(str(file), lines)


class Cli:
    """Betaflight's command line over a stream of bytes."""

    def __init__(self, send: Callable[[bytes], object], receive: Callable[[float], bytes]) -> None:
        """
        Args:
            send: sends bytes to the firmware.
            receive: returns the bytes that arrive within a time [s]; empty if there are none.

        Raises:
            CliError: the firmware does not answer.
        """
        self._send, self._receive, self._saved = send, receive, False
        self.query("#", end="")

    def query(self, line: str, end: str = "\r\n") -> str:
        """Send a line and return the answer.

        Raises:
            CliError: there is no answer.
        """
        self._send((line + end).encode())
        text, last = b"", time.monotonic() + _ANSWER_TIME
        while (more := self._receive(_SILENCE)) or not text.endswith(_PROMPT):
            text += more
            if time.monotonic() > last:
                noise = f": {len(text)} bytes received, the last {text[-8:]!r}: is the baud rate right?" if text else ""
                raise CliError(f"the autopilot's command line does not answer {line!r} within {_ANSWER_TIME:g} s{noise}")
        return text.decode("ascii", "replace")

    def apply(self, configuration: Configuration) -> None:
        """Send every line, then save, which restarts the firmware.

        Raises:
            CliError: a line is refused.
        """
        for line in configuration.lines:
            answer = self.query(line)
            if "###ERROR" in answer or "INVALID" in answer.upper() or "UNKNOWN" in answer.upper():
                words = " ".join(answer.replace(line, "").strip(" #\r\n").split())
                raise CliError(f"{configuration.source}: {line}: the firmware refuses it: {words[:200]}")
        self._send(b"save\r\n")
        self._saved = True

    def leave(self) -> None:
        """Leave the CLI, in which the firmware neither answers MSP nor arms: it restarts. Unsaved settings are lost."""
        if not self._saved:
            self._send(b"exit\r\n")

    def check(self, configuration: Configuration) -> None:
        """Compare the autopilot's settings with a configuration.

        Raises:
            CliError: a setting differs.
        """
        found = dump_lines(self.query("dump"))
        wrong = differences(configuration.lines, found)
        if wrong:
            more = f"; and {len(wrong) - 5} more" if len(wrong) > 5 else ""
            raise CliError(f"{configuration.source}: the autopilot's settings differ: " + "; ".join(wrong[:5]) + more)


def dump_lines(answer: str) -> list[str]:
    """Return the lines of a `dump`."""
    return [" ".join(line.split()) for line in answer.splitlines() if line.strip() and not line.startswith("#")]


def _settings(lines: Sequence[str]) -> dict[str, str]:
    return {found[1]: found[2] for line in lines if (found := _SET.fullmatch(line))}


def differences(wanted: Sequence[str], found: Sequence[str]) -> list[str]:
    """Describe the differences between the wanted lines and those of a dump."""
    settings = _settings(found)
    lines, wrong = set(found), []
    for line in wanted:
        pair = _SET.fullmatch(line)
        if pair is None:
            if line not in lines:
                wrong.append(f"{line} is missing")
        elif settings.get(pair[1]) != pair[2]:
            wrong.append(f"{pair[1]} is {settings.get(pair[1], 'unknown')}, not {pair[2]}")
    return wrong
