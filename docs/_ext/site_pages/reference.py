"""The API reference: a page per package with all of its public modules."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from typing import TYPE_CHECKING

from site_pages.markdown import as_markdown, table
from site_pages.repository import REPOSITORY

if TYPE_CHECKING:
    from pathlib import Path

PACKAGES = ("mo_deepdrive", "algorithms")
LONGEST_VALUE = 60  # letters


@cache
def modules() -> dict[str, ast.Module]:
    """The sources of all public modules and packages by name; nothing is imported."""
    found = {}
    for package in PACKAGES:
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            parts = path.relative_to(REPOSITORY).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            if not any(part.startswith("_") for part in name.split(".")):
                found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


def public_names(module: str) -> list[str]:
    """The full names of the public classes and functions that a module defines."""
    return [
        f"{module}.{node.name}"
        for node in modules()[module].body
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_")
    ]


def constants(module: str) -> dict[str, list[str]]:
    """The public constants of a module by name: the lines of the directives that describe them."""
    source = _path(module).read_text(encoding="utf-8").splitlines()
    found = {}
    for node in modules()[module].body:
        target = node.target if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [None])[0]
        if not (isinstance(target, ast.Name) and re.fullmatch(r"[A-Z][A-Z0-9_]+", target.id)):
            continue
        lines = [f".. py:data:: {target.id}", f"   :module: {module}"]
        if isinstance(node, ast.AnnAssign):
            lines.append(f"   :type: {ast.unparse(node.annotation)}")
        value = ast.unparse(node.value)  # type: ignore[attr-defined]  # both kinds of assignment have one
        if len(value) <= LONGEST_VALUE:
            lines.append(f"   :value: {value}")
        first = node.lineno - 1
        while source[first - 1].startswith("# ") and "----" not in source[first - 1]:
            first -= 1
        comments = [line.removeprefix("# ") for line in source[first : node.lineno - 1]]
        comments += re.findall(r"  # (.+)", source[node.lineno - 1])
        found[target.id] = [*lines, "", f"   {' '.join(comments)}".rstrip(), ""]
    return found


def exported(module: str) -> list[str]:
    """The names in ``__all__``."""
    for node in modules()[module].body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            names: list[str] = ast.literal_eval(node.value)
            return names
    return []


def _path(module: str) -> Path:
    path = REPOSITORY / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _is_package(name: str) -> bool:
    return (REPOSITORY / name.replace(".", "/")).is_dir()


def pages() -> dict[str, str]:
    """The text of every page by its path in docs."""
    grouped: dict[str, list[str]] = defaultdict(list)
    for name in sorted(modules()):
        grouped[name if _is_package(name) else name.rpartition(".")[0]].append(name)
    rows = [[f"[`{package}`]({package}.md)", summary(package)] for package in grouped]
    index = (
        "# API reference\n\nEvery public module, class and function.\n\n"
        + table(["package", "what it holds"], rows)
        + "\n```{toctree}\n:hidden:\n\n"
        + "\n".join(grouped)
        + "\n```\n"
    )
    return {
        "reference/index.md": index,
        **{f"reference/{package}.md": page(package, names) for package, names in grouped.items()},
    }


def page(package: str, names: list[str]) -> str:
    """The page of one package."""
    parts = [f"# {package}"]
    for name in names:
        heading = [f"## {name.rpartition('.')[2]}"] if name != package else []
        directives = [f".. automodule:: {name}\n   :members:\n   :ignore-module-all:\n   :show-inheritance:"]
        directives += ["\n".join(lines).rstrip() for lines in constants(name).values()]
        parts += [*heading, "```{eval-rst}\n" + "\n\n".join(directives) + "\n```"]
        own = [each.rpartition(".")[2] for each in public_names(name)] + list(constants(name))
        if others := [each for each in exported(name) if each not in own]:
            parts.append("Also to be imported from here: " + ", ".join(f"{{py:obj}}`{each}`" for each in others) + ".")
    return "\n\n".join(parts) + "\n"


def summary(module: str) -> str:
    """The first line of a module's docstring."""
    return as_markdown((ast.get_docstring(modules()[module]) or "").partition("\n")[0])
