"""The sample of mutants, their tests and the table of results; not the mutants themselves (``make mutants``)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from tests.helpers.paths import REPOSITORY
from tests.mutation import mutants
from tests.mutation.mutants import GROUPS, Group, Mutant

if TYPE_CHECKING:
    from pathlib import Path

SUM = Mutant("sums", "package/sums.py", 3, "return a + b", "return a - b", "ReplaceBinaryOperator_Add_Sub", 0)
SIGN = Mutant("signs", "package/signs.py", 7, "if a > 0:", "if a >= 0:", "ReplaceComparisonOperator_Gt_GtE", 1)


def test_every_group_names_code_and_tests() -> None:
    for group in GROUPS:
        modules = mutants.modules(group, REPOSITORY)
        assert modules
        for module in modules:
            assert (REPOSITORY / module).is_file()
            files = mutants.tests_of(group, module, REPOSITORY)
            assert files
            assert all((REPOSITORY / name).is_file() for name in files)
    assert all((REPOSITORY / name).is_file() for name in mutants.LEFT_OUT)


@pytest.mark.parametrize(
    ("operator", "useful"),
    [
        ("core/ReplaceBinaryOperator_Add_Sub", True),
        ("core/ReplaceBinaryOperator_BitOr_BitAnd", True),
        ("core/ReplaceBinaryOperator_Add_BitAnd", False),
        ("core/ReplaceComparisonOperator_Eq_NotEq", True),
        ("core/ReplaceComparisonOperator_Is_IsNot", True),
        ("core/ReplaceComparisonOperator_Eq_Is", False),
        ("core/ReplaceUnaryOperator_USub_UAdd", True),
        ("core/ReplaceUnaryOperator_Delete_Not", True),
        ("core/ReplaceUnaryOperator_USub_Not", False),
        ("core/NumberReplacer", True),
    ],
)
def test_an_operator_is_useful_unless_its_mutants_are_type_errors(operator: str, useful: bool) -> None:
    assert mutants.is_useful(operator) == useful


@pytest.mark.parametrize(
    ("before", "after", "changes"),
    [
        ("a = 1 + 2", "a = 1 - 2", True),
        ("a = 1 + 2", "a = 1 +  2  # three", False),
        ("a = f(*b)", "a = f(+*b)", False),
        ("def f(a: int | str) -> int | None: return a", "def f(a: int & str) -> int & None: return a", False),
        ("def f(a: int = 1) -> int: return a", "def f(a: int = 2) -> int: return a", True),
        ("a: int | str = 1", "a: int & str = 1", False),
        ("a: int | str = 1", "a: int | str = 2", True),
        ("if TYPE_CHECKING:\n    import b", "if not TYPE_CHECKING:\n    import b", False),
    ],
)
def test_types_layout_and_what_does_not_parse_are_no_mutants(before: str, after: str, changes: bool) -> None:
    assert mutants.changes_code(before, after) == changes


def test_the_lines_that_differ_are_shown_with_their_number() -> None:
    assert mutants.changed_lines("a\nif b:\n  c\n", "a\nif not b:\n  c\n") == (2, "if b:", "if not b:")
    assert mutants.changed_lines("a\n@b\nc\n", "a\nc\n") == (2, "@b", "")
    assert mutants.changed_lines("for a in b(\n  c\n):\n", "for a in []:\n") == (1, "for a in b( c ):", "for a in []:")


def test_the_sample_is_the_same_for_the_same_seed_and_has_one_mutant_of_a_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "sums.py").write_text("\n".join(f"a{i} = {i}" for i in range(50)))

    def sites(path: Path) -> list[list[tuple[str, int]]]:
        return [[("core/Next", i), ("core/Same", i)] for i in range(50)]

    def mutated(text: str, operator: str, occurrence: int) -> str:
        return text.replace(f" {occurrence}\n", f" {occurrence + 100}\n") if operator == "core/Next" else text

    monkeypatch.setattr(mutants, "mutation_sites", sites)
    monkeypatch.setattr(mutants, "mutated", mutated)
    group = Group("sums", "package", ("tests",), 10)
    found = mutants.sample(group, tmp_path, 0, 10)
    assert found == mutants.sample(group, tmp_path, 0, 10)
    assert found != mutants.sample(group, tmp_path, 1, 10)
    assert set(found) > set(mutants.sample(group, tmp_path, 0, 5))
    assert found == sorted(found, key=lambda mutant: mutant.line)
    assert len({mutant.line for mutant in found}) == 10
    assert {mutant.operator for mutant in found} == {"Next"}
    assert all(mutant.before == f"a{mutant.line - 1} = {mutant.line - 1}" for mutant in found)
    assert all(mutant.after == f"a{mutant.line - 1} = {mutant.line + 99}" for mutant in found)
    assert len(mutants.sample(group, tmp_path, 0, 1000)) < 50


def test_a_modules_own_tests_come_first_then_the_small_ones(tmp_path: Path) -> None:
    tests = tmp_path / "tests"
    tests.mkdir()
    for name, size in (("test_large.py", 300), ("test_own.py", 200), ("test_small.py", 100), ("conftest.py", 1)):
        (tests / name).write_text("#" * size)
    group = Group("g", "package", ("tests",), 1)
    assert mutants.tests_of(group, "package/own.py", tmp_path) == [
        "tests/test_own.py",
        "tests/test_small.py",
        "tests/test_large.py",
    ]
    alone = Group("g", "package/own.py", ("tests/test_own.py",), 1)
    assert mutants.tests_of(alone, "package/own.py", tmp_path) == ["tests/test_own.py"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("test", "outcome"),
    [
        ("assert sums.add(1, 2) == 3", "killed"),
        ("assert sums.add(0, 0) == 0", "survived"),
        ("while True: pass", "timeout"),
    ],
)
def test_a_mutant_is_killed_by_a_test_that_fails_or_does_not_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, test: str, outcome: str
) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    source = "def add(a, b):\n    return a + b\n"
    (copy / "sums.py").write_text(source)
    (copy / "test_sums.py").write_text(f"import sums\ndef test_add():\n    {test}\n")
    monkeypatch.setattr(mutants, "mutated", lambda text, operator, occurrence: text.replace("+", "-"))
    limit = 2.0 if outcome == "timeout" else 60.0
    done = mutants.run_mutant(replace(SUM, module="sums.py"), copy, ["test_sums.py"], limit)
    assert done.outcome == outcome
    assert done.seconds > 0.0
    assert (copy / "sums.py").read_text() == source


def test_killed_mutants_are_not_repeated_while_their_line_is_the_same(tmp_path: Path) -> None:
    file = tmp_path / "mutants.csv"
    killed, survived = replace(SUM, outcome="killed", seconds=1.5), replace(SIGN, outcome="survived", seconds=2.0)
    mutants.write_results(file, [killed, survived, replace(SIGN, line=9)])
    assert mutants.read_results(file) == [killed, survived]
    moved = replace(SUM, line=4)
    assert mutants.with_results([moved, SIGN, SUM], mutants.read_results(file)) == [moved, SIGN, killed]


def test_the_score_is_the_share_of_killed_mutants_of_those_that_make_a_difference() -> None:
    outcomes = ["killed"] * 5 + ["timeout"] + ["survived"] * 2 + ["equivalent"]
    found = [*(replace(SUM, outcome=outcome) for outcome in outcomes), replace(SIGN, outcome="killed")]
    assert mutants.table(found).splitlines()[2:] == [
        "| sums | 9 | 6 | 1 | 2 | 75% |",
        "| signs | 1 | 1 | 0 | 0 | 100% |",
        "| all | 10 | 7 | 1 | 2 | 78% |",
    ]
    assert mutants.survivors([replace(SUM, outcome="survived"), replace(SIGN, outcome="killed")]).splitlines() == [
        "package/sums.py:3 (ReplaceBinaryOperator_Add_Sub)",
        "  - return a + b",
        "  + return a - b",
    ]


def test_equivalent_mutants_are_of_lines_that_exist_and_have_a_reason() -> None:
    for (module, before, after), reason in mutants.read_equivalent().items():
        lines = " ".join((REPOSITORY / module).read_text(encoding="utf-8").split())
        assert before in lines, f"{module} has no line {before!r}"
        assert before != after
        assert len(reason) > 10
