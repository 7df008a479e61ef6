"""Values and mappings in YAML files and on command lines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from algorithms.common.yaml_io import dump, read_mapping, read_value

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-4", 3e-4),
        ("1e6", 1e6),
        ("-2.5E+3", -2500.0),
        (".5", 0.5),
        ("1_000", 1000),
        ("7", 7),
        ("true", True),
        ("None", None),
        ("null", None),
        ("[1, 2e-1]", [1, 0.2]),
        ("{'a': 1}", {"a": 1}),
        ("'3e-4'", "3e-4"),
        ("e5", "e5"),
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


def test_what_is_nested_too_deeply_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "deep.yaml"
    path.write_text("a: " + "[" * 5000)
    with pytest.raises(ValueError, match=r"config file '.*deep\.yaml' is nested too deeply"):
        read_mapping(path)
    with pytest.raises(ValueError, match="a value of 5,000 characters is nested too deeply"):
        read_value("[" * 5000)
