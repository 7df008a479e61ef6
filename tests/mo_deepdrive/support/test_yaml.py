"""Values and mappings in YAML files and on command lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mo_deepdrive.support.yaml import dump, read_mapping, read_value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-4", 3e-4),
        ("1e6", 1e6),
        (".5", 0.5),
        ("1_000", 1000),
        ("true", True),
        ("None", None),
        ("null", None),
        ("[1, 2e-1]", [1, 0.2]),
        ("{'a': 1}", {"a": 1}),
        ("'3e-4'", "3e-4"),
        ("010", "010"),
        ("1:30", "1:30"),
        ("{<<: {a: 1}, b: 2}", {"a": 1, "b": 2}),
    ],
)
def test_values_are_read_as_users_and_sweep_agents_write_them(text: str, value: Any) -> None:
    found = read_value(text)
    assert found == value
    assert type(found) is type(value)


def test_a_written_mapping_reads_back_equal(tmp_path: Path) -> None:
    values = {"a": "3e-4", "b": 3e-4, "c": [1, 2.5, "1e3"], "d": {"e": None, "f": {}}, "g": 1e22, "h": "yes", "i": "é"}
    path = tmp_path / "values.yaml"
    path.write_text(dump(values))
    assert read_mapping(path) == values


ODD = {
    "too much": ("a: " + " " * 2**20, "it has 1,048,579 characters, more than 1,048,576"),
    "depth": ("a: " + "[" * 5000, "it is nested too deeply"),
    "a key twice": ("a: {b: 1, b: 2}", "key 'b' is duplicated, in lines 1 and 1"),
    "a key that is a number": ("a:\n  1: 2", "the key in line 2 is not a string; write it in quotes"),
    "a larger integer": (f"a: {'9' * 9999}", "Exceeds the limit "),
    "code": ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor for the tag "),
}


@pytest.mark.parametrize("what", ODD)
def test_odd_contents_are_refused_in_one_line(tmp_path: Path, what: str) -> None:
    text, problem = ODD[what]
    path = tmp_path / "odd.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        read_mapping(path)
    assert str(caught.value).startswith(f"config file {str(path)!r} is not valid YAML: {problem}")
