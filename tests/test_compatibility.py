"""The page on compatibility is what the tests of other libraries declare."""

from __future__ import annotations

import ast
from collections.abc import Callable

import pytest

from tests.helpers.paths import REPOSITORY
from tests.integrations.matrix import HERE, PAGE, Row, files, matrix, page

ROWS = [pytest.param(row, id=f"{library.name}: {row.tests[0]}") for library, rows in matrix() for row in rows]


def test_the_page_has_the_tables_that_the_tests_declare() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m tests.integrations.matrix"


@pytest.mark.parametrize("row", ROWS)
def test_the_tests_of_a_row_exist(row: Row) -> None:
    tests = ast.parse((REPOSITORY / row.file).read_text(encoding="utf-8")).body
    assert set(row.tests) <= {node.name for node in tests if isinstance(node, ast.FunctionDef)}


def test_every_test_file_with_a_library_is_on_the_page() -> None:
    declaring = {path for path in HERE.glob("test_*.py") if "\nLIBRARY = " in path.read_text(encoding="utf-8")}
    assert declaring == set(files())


@pytest.mark.slow
def test_the_page_is_written_without_the_libraries(run_python: Callable[[str], str]) -> None:
    names = ["stable_baselines3", "morl_baselines", "torchrl", "tianshou", "supersuit", "momaland", "jax", "ray"]
    snippet = f"import sys\nfor name in {names}: sys.modules[name] = None\n"
    snippet += "from tests.integrations.matrix import tables\nprint(len(tables()) > 5_000)"
    assert run_python(snippet).strip() == "True"
