"""Strict configuration: what is refused, and what the message says."""

from dataclasses import dataclass

import pytest

from perch_core import config
from perch_core.config import choice, part, quantity, text
from perch_core.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Inner:
    gain: float = quantity(1.0, unit="1/s", above=0.0)
    axes: tuple[float, float] = quantity((1.0, 2.0), unit="m", low=0.0, high=5.0)


@dataclass(frozen=True, kw_only=True)
class Outer:
    name: str = text()
    count: int = quantity(3, low=1, high=9)
    law: str = choice("geometric", options=("geometric", "nmpc"))
    inner: Inner = part(Inner)


def read(tmp_path, content):
    path = tmp_path / "x.yaml"
    path.write_text(content)
    return config.load(Outer, path)


def test_defaults_and_nesting(tmp_path):
    value = read(tmp_path, "{name: a, inner: {gain: 2}}")
    assert value == Outer(name="a", inner=Inner(gain=2.0))
    assert isinstance(value.inner.gain, float)


@pytest.mark.parametrize("content, key, words", [
    ("{name: a, cuont: 2}", "cuont", "unknown key; allowed: name, count, law, inner"),
    ("{count: 2}", "name", "missing"),
    ("{name: a, count: 20}", "count", "20 is outside [1, 9]"),
    ("{name: a, count: 2.5}", "count", "not of type int"),
    ("{name: a, count: true}", "count", "not of type int"),
    ("{name: a, inner: {gain: 0}}", "inner.gain", "0 is not > 0 1/s"),
    ("{name: a, inner: {gain: .nan}}", "inner.gain", "nan"),
    ("{name: a, inner: {gain: fast}}", "inner.gain", "'fast' is not of type float"),
    ("{name: a, inner: {axes: [1]}}", "inner.axes", "has 1 entries, needs 2"),
    ("{name: a, inner: {axes: [1, 7]}}", "inner.axes", "7 is outside [0, 5] m"),
    ("{name: a, inner: 3}", "inner", "3 is not a mapping"),
    ("{name: a, law: pid}", "law", "'pid' is not one of geometric, nmpc"),
    ("[1, 2]", "", "is not a mapping"),
])
def test_refusals_name_file_key_and_range(tmp_path, content, key, words):
    with pytest.raises(ConfigError) as error:
        read(tmp_path, content)
    assert error.value.key == key
    assert words in str(error.value) and "x.yaml" in str(error.value)


def test_broken_yaml_and_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="not valid YAML"):
        read(tmp_path, "{a: [")
    (tmp_path / "picture.yaml").write_bytes(b"\x89PNG\xff\x00")
    with pytest.raises(ConfigError, match="picture.yaml: is not text"):
        config.load(Outer, tmp_path / "picture.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        config.load(Outer, tmp_path / "none.yaml")


def test_unknown_name_lists_the_names_there_are():
    with pytest.raises(ConfigError, match="there are: .*snapdragon"):
        config.find("vehicles", "snapdragoon")


def test_replace_checks_ranges():
    with pytest.raises(ConfigError):
        config.replace(Outer(name="a"), count=100)
