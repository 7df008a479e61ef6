"""Imports run downwards (contracts in pyproject.toml), and torch draws random numbers from given generators alone."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

PACKAGES = ("mo_deepdrive", "algorithms")
SAMPLERS = ("rand", "randn", "randint", "randperm", "multinomial", "normal", "bernoulli", "poisson")


def test_the_import_contracts_are_kept(
    repository: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(repository)
    exit_code = lint_imports(config_filename=str(repository / "pyproject.toml"), no_cache=True, no_logo=True)
    assert exit_code == 0, capsys.readouterr().out


def samples_without_generator(tree: ast.AST) -> Iterator[str]:
    """Calls of torch's samplers that use its global generator."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        function = node.func
        of_torch = isinstance(function.value, ast.Name) and function.value.id == "torch"
        seeded = any(keyword.arg == "generator" for keyword in node.keywords)
        if of_torch and function.attr in SAMPLERS and not seeded:
            yield f"torch.{function.attr} in line {node.lineno}"


def test_torch_samples_from_given_generators(repository: Path) -> None:
    files = [path for package in PACKAGES for path in sorted((repository / package).rglob("*.py"))]
    assert len(files) > 50
    found = {str(path): list(samples_without_generator(ast.parse(path.read_text(encoding="utf-8")))) for path in files}
    assert {path: calls for path, calls in found.items() if calls} == {}
