"""Strict configuration: what is refused, and what the message says."""

import json
import math
import os
import time
from dataclasses import dataclass

import pytest

from perch_core import config
from perch_core.config import choice, derived, label, part, quantity, text
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
    told: float = derived(0.5)


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
    ("{name: a, told: 0.1}", "told", "unknown key; allowed: name, count, law, inner"),
    ("{count: 2}", "name", "missing"),
    ("{name: a, count: 20}", "count", "20 is outside [1, 9]"),
    ("{name: a, count: 2.5}", "count", "not of type int"),
    ("{name: a, count: true}", "count", "not of type int"),
    ("{name: a, inner: {gain: 0}}", "inner.gain", "0 is outside (0, 1e+06] 1/s"),
    ("{name: a, inner: {gain: .nan}}", "inner.gain", "nan is outside (0, 1e+06] 1/s"),
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


@dataclass(frozen=True, kw_only=True)
class Named:
    title: str = label("none")
    note: str = text("")
    limit: float = quantity(0.0, unit="m", low=1.0, high=5.0, doc="0: none")


@pytest.mark.parametrize("content, words", [
    ("{title: ../up}", "is no name"), ("{title: a/b}", "is no name"), ("{title: ''}", "is no name"), ("{title: .hidden}", "is no name"),
    (f"{{title: {'a' * 101}}}", "is no name"), ("{title: my wall_2.b+c-d}", ""), (f"{{note: {'x' * 2001}}}", "is not text of up to"), ("{note: two lines}", ""),
    ('{note: "a\\ab"}', "is not text of up to"), ("{limit: 0.5}", "0.5 is outside [1, 5] m"), ("{limit: 0}", ""), ("{limit: 5}", "")])
def test_names_of_files_texts_and_a_default_that_stands_for_none(tmp_path, content, words):
    """Folders and topics are called by labels; a value that is the default may be written, though it is outside the range."""
    path = tmp_path / "x.yaml"
    path.write_text(content)
    if words:
        with pytest.raises(ConfigError) as error:
            config.load(Named, path)
        assert words in str(error.value)
    else:
        config.load(Named, path)


def test_broken_yaml_and_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="not valid YAML"):
        read(tmp_path, "{a: [")
    (tmp_path / "picture.yaml").write_bytes(b"\x89PNG\xff\x00")
    with pytest.raises(ConfigError, match="picture.yaml: is not text"):
        config.load(Outer, tmp_path / "picture.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        config.load(Outer, tmp_path / "none.yaml")


DEEP = "[" * 100_000
BOMB = "\n".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9 if k else ['x'] * 9)}]" for k in range(9))
LADDER = "\n".join(f"a{k}: &a{k} [{f'*a{k - 1}' if k else 'x'}]" for k in range(30))


@pytest.mark.parametrize("content, words", [
    (DEEP, "line 1: more than 20 levels"), ("{a: " * 2000, "line 1: more than 20 levels"), ("- " * 2000, "more than 20 levels"),
    (LADDER, "more than 20 levels"), (BOMB, "more than 20000 values"), ("&a [*a]", "alias 'a' has no anchor before it"),
    ("name: a\nname: b", "line 2: duplicate key 'name'"), ("{name: a, inner: {gain: 1, gain: 2}}", "duplicate key 'gain'"),
    ("? [a]\n: b", "a key that is not a scalar"), ("!!python/object/apply:os.system [ls]", "tags are not used"), ("!!timestamp x", "tags are not used"),
    (f"[{'1, ' * 3000}]", "more than 2000 entries"),
    (f"count: {'9' * 400}", "an integer beyond 64 bits"), (f"# {'x' * (1 << 20)}", "more than 1048576 bytes"),
    ("--- a\n--- b", "is not valid YAML"), ("a: \x00", "is not valid YAML"), ("<<: 3", "is not valid YAML"),
])
def test_what_must_not_be_built_is_refused_while_it_is_read(tmp_path, content, words):
    path = tmp_path / "x.yaml"
    path.write_text(content)
    began = time.process_time()
    with pytest.raises(ConfigError) as error:
        config.read_yaml(path)
    assert words in str(error.value) and str(path) in str(error.value) and len(str(error.value).splitlines()) == 1
    assert time.process_time() - began < 2.0


def test_words_are_those_of_json():
    text = '{a: 1, b: -2.5, c: 1e-3, d: true, e: null, f: on, g: 1:30, h: 2024-99-99, i: 0x10, j: .inf, k: &k {x: 1}, l: {<<: *k, y: [*k]}, m: "1"}'
    assert config.parse_yaml(text, "") == {
        "a": 1, "b": -2.5, "c": 0.001, "d": True, "e": None, "f": "on", "g": "1:30", "h": "2024-99-99", "i": "0x10", "j": math.inf, "k": {"x": 1},
        "l": {"x": 1, "y": [{"x": 1}]}, "m": "1"}
    value = {"a": [1, 1e-05, -1e22, "x\n\u00e9\"", None, False, {}]}
    assert config.parse_yaml(json.dumps(value), "") == value


def test_bytes_of_a_command_line_that_are_no_text_are_refused():
    text = os.fsdecode(b"mission.name:=\xff")
    with pytest.raises(ConfigError, match="is not text in UTF-8") as error:
        config.parse_yaml(text, f"-p {text}")
    assert str(error.value).isprintable()


def test_errors_are_one_line_whatever_they_quote(tmp_path):
    with pytest.raises(ConfigError) as error:
        read(tmp_path, f'{{name: "a\\nb\\e[31m{"x" * 5000}"}}')
    assert len(str(error.value)) < 2000 and str(error.value).isprintable()


def test_names_stay_in_their_folders():
    for name in ("../vehicles/rpg", "/etc/passwd", ".", "a/b", "a" * 5000, "\0", "a" * 5000 + ".yaml", "\0.yaml"):
        with pytest.raises(ConfigError):
            config.find("vehicles", name)


def test_unknown_name_lists_the_names_there_are():
    with pytest.raises(ConfigError, match="there are: .*snapdragon"):
        config.find("vehicles", "snapdragoon")


def test_another_configuration_folder_without_the_file_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("PERCH_CONFIG_DIR", str(tmp_path))
    with pytest.raises(ConfigError, match=f"^vehicles: snapdragon: unknown; there are none in {tmp_path}/vehicles$"):
        config.find("vehicles", "snapdragon")
    monkeypatch.setenv("PERCH_CONFIG_DIR", str(tmp_path / "gone"))
    with pytest.raises(ConfigError, match=f"^PERCH_CONFIG_DIR: {tmp_path}/gone: no such folder$"):
        config.find("vehicles", "snapdragon")


def test_replace_checks_ranges():
    with pytest.raises(ConfigError):
        config.replace(Outer(name="a"), count=100)


@pytest.mark.parametrize("key, names, words", [
    ("foo", [f"speed_{k}" for k in "abcdefghijklmnopqrst"], "unknown setting; allowed: speed_a, speed_b, speed_c, speed_d,"),
    ("speed_ab", [f"speed_{k}" for k in "abcdefghijklmnopqrst"], "unknown setting; did you mean speed_b"),
    ("motor_lag", ["motor_time", "lag_max", "rotor_yaw_sign", *[f"x_{k}" for k in "abcdefghijklmnopqrst"]], "did you mean motor_time, "),
    ("arm", ["name", "cameras", *[f"x_{k}" for k in "abcdefghijklmnopqrst"]], "unknown setting; allowed: name, cameras, x_a"),
    ("foo", [f"{group}.gain_{k}" for group in ("rate", "tilt") for k in range(10)], "unknown setting; the 20 names begin with rate, tilt")])
def test_an_unknown_name_comes_with_those_allowed_or_near_or_their_groups(key, names, words):
    assert words in str(config.unknown("x.yaml", key, "setting", names))
