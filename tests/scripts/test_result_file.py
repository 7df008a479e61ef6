"""``scripts/result_file.py``: the file of a comparison."""

from __future__ import annotations

from argparse import ArgumentParser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType


@dataclass(frozen=True)
class Result:
    name: str
    seed: int
    score: Annotated[float, ".3g"]
    seconds: float


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("result_file")


def test_what_is_written_is_read_again_in_the_format_of_its_field(script: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "results.csv"
    assert script.read_results(file, Result) == []
    script.write_results(file, [Result("a, b", 3, 0.123456, 1.25), Result("", 4, float("nan"), 2.0)])
    assert file.read_text() == 'name,seed,score,seconds\n"a, b",3,0.123,1.25\n,4,nan,2.0\n'
    first, second = script.read_results(file, Result)
    assert first == Result("a, b", 3, 0.123, 1.25)
    assert (second.name, second.seed, second.seconds) == ("", 4, 2.0)


def test_without_a_path_nothing_is_read_or_written(script: ModuleType) -> None:
    assert script.read_results(None, Result) == []
    script.write_results(None, [Result("a", 3, 0.5, 1.25)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "KeyError: 'name'"),
        ("name,seed,score,seconds\na,x,1,2\n", "ValueError: invalid literal for int"),
        ("name,seed,score,seconds\na\n", "TypeError"),
    ],
)
def test_another_file_is_refused(script: ModuleType, tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "results.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"results\.csv is not a file of this script: {message}"):
        script.read_results(file, Result)
    assert file.read_text() == text


def test_a_folder_that_is_missing_is_reported(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script.check_folder(ArgumentParser(), None)
    script.check_folder(ArgumentParser(), tmp_path / "results.csv")
    with pytest.raises(SystemExit):
        script.check_folder(ArgumentParser(), Path("nowhere/results.csv"))
    assert "--output nowhere/results.csv: there is no folder nowhere" in capsys.readouterr().err
