"""The cache of compiled libraries: used again, following its source, safe for two at once, optional."""

from __future__ import annotations

import ctypes
import errno
import multiprocessing
from pathlib import Path

import pytest

from perch_core import compiled
from perch_core.errors import PerchError

SOURCE = "int answer(void) { return %d; }"

if compiled.compiler() is None:
    pytest.skip("no C compiler here: everything is interpreted", allow_module_level=True)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PERCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def answer(library: Path) -> int:
    return ctypes.CDLL(str(library)).answer()


def test_a_library_is_compiled_once(cache: Path) -> None:
    first = compiled.library("test", SOURCE % 42)
    assert first.parent == cache and answer(first) == 42
    stamp = first.stat().st_mtime_ns
    assert compiled.library("test", SOURCE % 42) == first and first.stat().st_mtime_ns == stamp


def test_another_source_or_flag_is_another_library(cache: Path) -> None:
    paths = {compiled.library("test", SOURCE % 1), compiled.library("test", SOURCE % 2),
             compiled.library("test", SOURCE % 2, ("-O0", "-fPIC", "-shared"))}
    assert sorted(answer(path) for path in paths) == [1, 2, 2]
    assert {path.suffix for path in cache.iterdir()} == {".so"}  # nothing temporary is left


def test_another_compiler_or_processor_is_another_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache may be on a disk that machines share, and outlives an update of the compiler."""
    paths, (program, version) = [compiled.library("test", SOURCE % 5)], compiled.compiler()
    for name, other in (("compiler", (program, f"{version} of another day")), ("_processor", "flags : another")):
        with monkeypatch.context() as patched:
            patched.setattr(compiled, name, lambda other=other: other)
            paths.append(compiled.library("test", SOURCE % 5))
    with monkeypatch.context() as patched:
        patched.setattr(compiled.platform, "machine", lambda: "another")
        paths.append(compiled.library("test", SOURCE % 5))
    assert len(set(paths)) == 4 and compiled.library("test", SOURCE % 5) == paths[0]


def test_a_library_is_never_there_in_part(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process would load it: it is complete when it gets its name, also where another one was faster."""
    compiled.library("test", SOURCE % 6)
    [product], seen, replace = cache.iterdir(), [], compiled.os.replace
    product.unlink()

    def watched(source: str, target: Path) -> None:
        seen.append((target.exists(), answer(Path(source))))
        replace(source, target)

    monkeypatch.setattr(compiled.os, "replace", watched)
    assert compiled.library("test", SOURCE % 6) == product and seen == [(False, 6)]


def test_two_processes_at_once_get_the_same_library(cache: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        first, second = pool.starmap(compiled.library, [("test", SOURCE % 7)] * 2)
    assert first == second and answer(first) == 7


def test_a_source_that_does_not_compile_says_so() -> None:
    with pytest.raises(RuntimeError, match="cannot compile test"):
        compiled.library("test", "int answer(void) { return }")


def test_a_cache_that_cannot_be_written_says_so(cache: Path) -> None:
    cache.write_text("not a folder")
    with pytest.raises(PerchError, match="cannot be written: .*cache.*; set PERCH_CACHE"):
        compiled.library("test", SOURCE % 1)


def test_a_cache_that_is_full_says_so(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(PerchError, match="cannot be written: .*No space left"):
        compiled.library("test", SOURCE % 3)


def test_compilation_can_be_turned_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PERCH_COMPILE", "0")
    assert compiled.library("test", SOURCE % 1) is None


def test_no_compiler_means_no_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "compiler", lambda: None)
    assert compiled.library("test", SOURCE % 1) is None
