"""Registries: what a name stands for, and typed errors where it stands for nothing."""

from pathlib import Path

import pytest

from perch_core.errors import ConfigError
from perch_core.registry import resolved


def test_a_name_stands_for_what_is_in_its_module():
    assert resolved("pathlib:Path") is Path


@pytest.mark.parametrize("place, said", [("perch_nothing.law:Law", "no module 'perch_nothing'"), ("perch_core.nothing:Law", "'perch_core.nothing'"),
                                         ("perch_core.registry:Law", "no 'Law' in perch_core.registry")])
def test_what_is_not_there_is_a_typed_error(place, said):
    with pytest.raises(ConfigError, match=said):
        resolved(place)


def test_a_module_that_lacks_something_says_so_itself(tmp_path, monkeypatch):
    (tmp_path / "needs_more.py").write_text("import not_installed_anywhere\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="not_installed_anywhere"):
        resolved("needs_more:Law")
