"""Command lines: how a program begins and ends, and what it takes: counts, folders for results, the address of the network."""

from __future__ import annotations

import argparse
import fcntl
import os
import socket
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from perch_core.errors import ConfigError, PerchError

_locked: dict[Path, int] = {}  # folder of results -> its open file, whose lock ends with this process


def count(text: str) -> int:
    """How many, at least one, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not >= 1")
    return value


def command_parser(name: str, description: str | None, examples: str) -> argparse.ArgumentParser:
    """A command line with examples below its help, which stay as they are written."""
    return argparse.ArgumentParser(prog=name, description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter)


def command(parser: Callable[[], argparse.ArgumentParser], work: Callable[[argparse.Namespace], int], *refusals: type[Exception],
            interrupted: str = "interrupted") -> Callable[..., int]:
    """A program's `main`; it ends with what its work returns, 2 with one line where it is refused, 130 where it is interrupted.

    Args:
        parser: makes the command line.
        work: what is done with its arguments.
        refusals: errors beside `PerchError` and `OSError` that mean invalid input.
        interrupted: printed after Ctrl-C.
    """
    errors: tuple[type[Exception], ...] = (OSError, PerchError, *refusals)

    def main(arguments: list[str] | None = None) -> int:
        args = parser().parse_args(arguments)
        try:
            return work(args)
        except errors as error:
            text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else str(error)
            print(f"error: {text}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print(interrupted, file=sys.stderr)
            return 130

    return main


def output_folder(path: Path, option: str = "--out") -> Path:
    """Make a folder for results, which this process has to itself until it ends: nodes read their parameters there.

    Args:
        path: of the folder.
        option: what the caller named it with, for the message.

    Raises:
        ConfigError: it cannot be made, nothing can be written to it, or another process has it.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
        if (place := path.resolve()) not in _locked:
            lock = os.open(place, os.O_RDONLY)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _locked[place] = lock
        return path
    except BlockingIOError:
        os.close(lock)
        raise ConfigError(option, str(path), "another run is writing there: wait for its end, or choose another folder") from None
    except OSError as error:
        raise ConfigError(option, str(path), f"cannot be written: {error.strerror}") from None


def open_network(address: str | None) -> None:
    """Bind the ROS sockets of this process and its children to an address, instead of that of $PERCH_NETWORK (loopback by default).

    Raises:
        ConfigError: no network of this machine has the address.
    """
    source, address = ("--network", address) if address else ("PERCH_NETWORK", os.environ.get("PERCH_NETWORK", "127.0.0.1"))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            trial.bind((address, 0))
            bound = trial.getsockname()[0]
    except OSError as error:
        raise ConfigError(source, address, f"is not the IPv4 address of a network of this machine: {error.strerror}") from None
    if bound == "0.0.0.0":
        raise ConfigError(source, address, "is every network of this machine: name the one to open")
    os.environ["PERCH_NETWORK"] = bound
