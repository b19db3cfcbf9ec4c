"""Common parts of the command lines: parser, `main` with its exit codes, counts, output folders, network address."""

from __future__ import annotations

import argparse
import errno
import fcntl
import os
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from perch_core.errors import ConfigError, PerchError
from perch_core.files import replacement
from perch_core.processes import discard_closed_output

_locked: dict[Path, int] = {}  # folder of results -> its open file, which holds the lock


def count(text: str) -> int:
    """Parse a count of at least one, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not >= 1")
    return value


def command_parser(name: str, description: str | None, examples: str) -> argparse.ArgumentParser:
    """Return a parser whose help shows the description and, below it, the examples verbatim."""
    return argparse.ArgumentParser(prog=name, description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter)


def command(parser: Callable[[], argparse.ArgumentParser], work: Callable[[argparse.Namespace], int], *refusals: type[Exception],
            interrupted: str = "interrupted") -> Callable[..., int]:
    """Return a program's `main`. Exit code: that of `work`; 1 if the reader of its output has ended (`... | head`); 2, with a
    one-line error, for invalid input; 130 after Ctrl-C.

    Args:
        parser: returns the command-line parser.
        work: does the program's work with the parsed arguments and returns the exit code.
        refusals: exceptions that count as invalid input, beside `PerchError` and `OSError`.
        interrupted: message after Ctrl-C.
    """
    errors: tuple[type[Exception], ...] = (OSError, PerchError, *refusals)

    def main(arguments: list[str] | None = None) -> int:
        args = parser().parse_args(arguments)
        try:
            code = work(args)
            sys.stdout.flush()
            return code
        except errors as error:
            if isinstance(error, BrokenPipeError) and discard_closed_output():
                return 1
            text = str(error)
            if isinstance(error, OSError) and error.strerror:
                text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
            print(f"error: {text}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print(interrupted, file=sys.stderr)
            return 130

    return main


def output_folder(path: Path, option: str = "--out") -> Path:
    """Create an output folder and lock it until this process ends, as nodes read their parameters from it.

    Args:
        path: of the folder.
        option: command-line option that names the folder, for error messages.

    Raises:
        ConfigError: the folder cannot be created or written to, or another process has locked it.
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


@contextmanager
def locked_folder(path: Path) -> Iterator[Path]:
    """Like `output_folder`, but the lock ends with the body, unless this process held it before."""
    place = path.resolve()
    held = place in _locked
    folder = output_folder(path)
    try:
        yield folder
    finally:
        if not held:
            os.close(_locked.pop(place))


@contextmanager
def output_file(path: Path, option: str = "--out") -> Iterator[Path]:
    """As `replacement`, in a folder that is created where it is missing.

    Args:
        path: of the file.
        option: command-line option that names the file, for error messages.

    Raises:
        ConfigError: the path is a device or pipe, which a file must not replace, or the file cannot be written; as far as possible,
            this is found before the body is run.
    """
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ConfigError(option, str(path), "is no regular file")
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        with replacement(path) as draft:
            yield draft
    except OSError as error:
        raise ConfigError(option, str(path), f"cannot be written: {error.strerror or error}") from None


def open_network(address: str | None) -> None:
    """Bind the ROS sockets of this process and its children to an address; None: that of $PERCH_NETWORK, or else loopback.

    Raises:
        ConfigError: the address is not that of exactly one network of this machine.
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
