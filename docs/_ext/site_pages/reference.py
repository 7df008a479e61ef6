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
# What most programs need, by purpose: where a name is defined, and from where it is imported.
FIRST_NAMES: dict[str, tuple[tuple[str, str], ...]] = {
    "Environments": (
        ("mo_deepdrive.parallel_env", "mo_deepdrive"),
        ("mo_deepdrive.env", "mo_deepdrive"),
        ("mo_deepdrive.envs.single.DrivingEnv", "mo_deepdrive.envs.single"),
        ("mo_deepdrive.envs.vector.DrivingVectorEnv", "mo_deepdrive.envs.vector"),
        ("mo_deepdrive.envs.rllib.DrivingMultiAgentEnv", "mo_deepdrive.envs.rllib"),
        ("mo_deepdrive.envs.sb3.SB3VecEnv", "mo_deepdrive.envs.sb3"),
    ),
    "Wrappers": (
        ("mo_deepdrive.wrappers.UtilityReward", "mo_deepdrive.wrappers"),
        ("mo_deepdrive.wrappers.VectorUtilityReward", "mo_deepdrive.wrappers"),
        ("mo_deepdrive.wrappers.ParallelUtilityReward", "mo_deepdrive.wrappers"),
        ("mo_deepdrive.wrappers.VectorScaledObservation", "mo_deepdrive.wrappers"),
        ("mo_deepdrive.wrappers.VectorEpisodeStatistics", "mo_deepdrive.wrappers"),
    ),
    "Utilities, scores and fronts": (
        ("mo_deepdrive.utilities.make_utility", "mo_deepdrive.utilities"),
        ("mo_deepdrive.evaluation.episodes.evaluate", "mo_deepdrive.evaluation"),
        ("mo_deepdrive.evaluation.evaluation.Evaluation", "mo_deepdrive.evaluation"),
        ("mo_deepdrive.suite.scoring.score", "mo_deepdrive.suite"),
        ("mo_deepdrive.suite.scoring.check_policy", "mo_deepdrive.suite"),
        ("mo_deepdrive.fronts.reference_fronts.reference_front", "mo_deepdrive"),
        ("mo_deepdrive.fronts.reference_fronts.reference_point", "mo_deepdrive"),
    ),
    "Learners": (
        ("algorithms.ppo.PPO", "mo_deepdrive.learners"),
        ("algorithms.mo_ppo.MOPPO", "mo_deepdrive.learners"),
        ("algorithms.conditioned_mo_ppo.ConditionedMOPPO", "mo_deepdrive.learners"),
        ("algorithms.pcn.PCN", "mo_deepdrive.learners"),
        ("mo_deepdrive.evaluation.env_adapter.make_env", "mo_deepdrive.evaluation.env_adapter"),
        ("algorithms.runs.build.load_policy", "mo_deepdrive.learners.runs.build"),
    ),
    "Extensions": (
        ("mo_deepdrive.world.objectives.register_objective", "mo_deepdrive"),
        ("mo_deepdrive.world.scenarios.register_scenario", "mo_deepdrive"),
        ("algorithms.agent.Agent", "mo_deepdrive.learners"),
    ),
}


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
        "# API reference\n\nWhat most programs need:\n\n"
        + first_names()
        + "\n## Every module\n\n"
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


def first_names() -> str:
    """Tables of the names that are met first, with the first lines of their docstrings."""
    parts = []
    for purpose, names in FIRST_NAMES.items():
        rows = [
            [f"{{py:obj}}`{name.rpartition('.')[2]} <{name}>`", f"`{source}`", summary_of(name)]
            for name, source in names
        ]
        parts.append(f"## {purpose}\n\n" + table(["name", "import from", "what it is"], rows))
    return "\n".join(parts)


def summary_of(name: str) -> str:
    """The first line of the docstring of a public class or function."""
    module, _, last = name.rpartition(".")
    for node in modules()[module].body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == last:
            return as_markdown((ast.get_docstring(node) or "").partition("\n")[0])
    raise KeyError(name)


def summary(module: str) -> str:
    """The first line of a module's docstring."""
    return as_markdown((ast.get_docstring(modules()[module]) or "").partition("\n")[0])
