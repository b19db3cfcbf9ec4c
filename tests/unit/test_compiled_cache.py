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
