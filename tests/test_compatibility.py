"""The page on compatibility is what the tests of other libraries declare."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

import pytest

from tests.helpers.paths import REPOSITORY
from tests.integrations.matrix import HERE, PAGE, Row, files, matrix, page

if TYPE_CHECKING:
    from collections.abc import Callable

ROWS = [pytest.param(row, id=f"{library.name}: {row.tests[0]}") for library, rows in matrix() for row in rows]


def source_of(row: Row, name: str) -> str:
    """The test, with comments."""
    text = (REPOSITORY / row.file).read_text(encoding="utf-8")
    functions = (node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef) and node.name == name)
    function = next(functions, None)
    assert function is not None, f"{row.file} has no {name}"
    return "\n".join(text.splitlines()[function.lineno - 1 : function.end_lineno])


def test_the_page_has_the_tables_that_the_tests_declare() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m tests.integrations.matrix"


@pytest.mark.parametrize("row", ROWS)
def test_what_a_row_says_is_asserted(row: Row) -> None:
    sources = [source_of(row, name) for name in row.tests]
    assert bool(row.breaks) == bool(row.whose)
    if row.breaks and "tests/ray" not in row.file:
        assert any(sign in source for source in sources for sign in ("pytest.raises(", "# breaks"))


def test_every_test_file_with_a_library_is_on_the_page() -> None:
    declaring = {path for path in HERE.glob("test_*.py") if "\nLIBRARY = " in path.read_text(encoding="utf-8")}
    assert declaring == set(files())


@pytest.mark.slow
def test_the_page_is_written_without_the_libraries(run_python: Callable[[str], str]) -> None:
    names = ["stable_baselines3", "morl_baselines", "torchrl", "tianshou", "supersuit", "momaland", "jax", "ray"]
    snippet = f"import sys\nfor name in {names}: sys.modules[name] = None\n"
    snippet += "from tests.integrations.matrix import tables\nprint(len(tables()) > 5_000)"
    assert run_python(snippet).strip() == "True"
