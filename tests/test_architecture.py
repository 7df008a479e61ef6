"""Imports run one way, and nothing reads or sets what it should be given: over the syntax trees of the sources."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOTS = ("mo_deepdrive", "algorithms", "scripts")
Tree = ast.Module


# ---------------------------------------------------------------------------------------------------------- checkers


def imported(tree: ast.AST, module: str = "", is_package: bool = False) -> Iterator[tuple[str, ast.stmt]]:
    """Absolute names of all that is imported anywhere in ``tree``, the source of ``module``, with the statements.

    ``from a import b`` gives ``a.b``: b may be a module.
    """
    package = module if is_package else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = parts[: len(parts) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((f"{source}.{alias.name}", node) for alias in node.names)


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


def bans(*modules: str) -> Callable[..., list[str]]:
    """A checker that finds imports of any of ``modules``."""

    def check(tree: Tree, module: str = "", is_package: bool = False) -> list[str]:
        names = (name for name, _ in imported(tree, module, is_package))
        return [name for name in names if any(within(name, banned) for banned in modules)]

    return check


def allows(*modules: str) -> Callable[..., list[str]]:
    """A checker that finds imports from the project other than of ``modules``."""

    def check(tree: Tree, module: str = "", is_package: bool = False) -> list[str]:
        names = (name for name, _ in imported(tree, module, is_package))
        own = (name for name in names if any(within(name, root) for root in ROOTS))
        return [name for name in own if not any(within(name, allowed) for allowed in modules)]

    return check


def eager(target: str) -> Callable[..., list[str]]:
    """A checker that finds imports of ``target`` that are not inside a function."""

    def check(tree: Tree, module: str = "", is_package: bool = False) -> list[str]:
        late = for_types_only(tree) | {
            id(statement)
            for function in ast.walk(tree)
            if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
            for statement in ast.walk(function)
        }
        found = imported(tree, module, is_package)
        return [name for name, node in found if within(name, target) and id(node) not in late]

    return check


def aliases(tree: Tree) -> dict[str, str]:
    """Local name -> absolute name, for everything imported."""
    table = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                table[alias.asname or alias.name.split(".")[0]] = (
                    alias.name if alias.asname else alias.name.split(".")[0]
                )
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                table[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    return table


def dotted(node: ast.AST, table: dict[str, str]) -> str:
    """The absolute dotted name of an expression such as ``np.random.seed``, "" if it is none."""
    if isinstance(node, ast.Name):
        return table.get(node.id, "")
    if isinstance(node, ast.Attribute):
        base = dotted(node.value, table)
        return f"{base}.{node.attr}" if base else ""
    return ""


def names_used(tree: Tree) -> Iterator[str]:
    """Absolute dotted names used or imported anywhere."""
    table = aliases(tree)
    for node in ast.walk(tree):
        if isinstance(node, (ast.Attribute, ast.Name)):
            yield dotted(node, table)
    yield from table.values()


def surroundings_read(tree: Tree, module: str = "", is_package: bool = False) -> list[str]:
    """Uses of the command line and of environment variables."""
    banned = ("sys.argv", "os.environ", "os.environb", "os.getenv", "os.getenvb", "os.putenv", "os.unsetenv")
    return sorted({name for name in names_used(tree) if any(within(name, one) for one in banned)})


GENERATORS = {
    "Generator", "default_rng", "SeedSequence", "BitGenerator", "PCG64", "PCG64DXSM", "Philox", "SFC64", "MT19937",
}  # fmt: skip
TORCH_SEEDS = ("manual_seed", "seed", "manual_seed_all", "seed_all", "set_rng_state", "get_rng_state", "fork_rng")
TORCH_SAMPLERS = ("rand", "randn", "randint", "randperm", "multinomial", "normal", "bernoulli", "poisson")


def global_random_state(tree: Tree, module: str = "", is_package: bool = False) -> list[str]:
    """Uses of the global generators of random, NumPy and PyTorch. (Generator objects are what one should use.)"""
    found = set()
    for name in names_used(tree):
        head, _, last = name.rpartition(".")
        if head == "numpy.random" and last not in GENERATORS:
            found.add(name)
        if head == "random" and last not in ("Random", "SystemRandom"):
            found.add(name)
        if within(head, "torch") and last in TORCH_SEEDS and "Generator" not in head:
            found.add(name)
    table = aliases(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = dotted(node.func, table)
            given = {keyword.arg for keyword in node.keywords}
            if name in {f"torch.{sampler}" for sampler in TORCH_SAMPLERS} and "generator" not in given:
                found.add(f"{name} without generator")
    return sorted(found)


def for_types_only(tree: Tree) -> set[int]:
    """Statements (by id) under ``if TYPE_CHECKING``, which never run."""
    table = aliases(tree)
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and dotted(node.test, table) == "typing.TYPE_CHECKING":
            found |= {id(statement) for part in node.body for statement in ast.walk(part)}
    return found


def cycles(graph: dict[str, set[str]]) -> list[str]:
    """The modules that a chain of imports leads back to."""

    def reaches(start: str) -> bool:
        seen: set[str] = set()
        todo = list(graph[start])
        while todo:
            module = todo.pop()
            if module == start:
                return True
            if module not in seen:
                seen.add(module)
                todo += graph.get(module, set())
        return False

    return sorted(module for module in graph if reaches(module))


# ----------------------------------------------------------------------------------------------------------- sources


class Sources:
    """Every module of the project: its dotted name, its syntax tree and whether it is a package."""

    def __init__(self, repository: Path) -> None:
        self.modules: dict[str, tuple[Tree, bool]] = {}
        for root in ROOTS:
            for path in sorted((repository / root).rglob("*.py")):
                parts = path.relative_to(repository).with_suffix("").parts
                is_package = parts[-1] == "__init__"
                name = ".".join(parts[:-1] if is_package else parts)
                self.modules[name] = (ast.parse(path.read_text(encoding="utf-8"), str(path)), is_package)

    def below(self, *roots: str) -> list[str]:
        return [name for name in self.modules if any(within(name, root) for root in roots)]

    def offences(self, check: Callable[..., list[str]], modules: list[str]) -> dict[str, list[str]]:
        """What ``check`` finds in each of ``modules``; nothing where it finds nothing."""
        assert modules, "there is something to check"
        found = {name: check(self.modules[name][0], name, self.modules[name][1]) for name in modules}
        return {name: offence for name, offence in found.items() if offence}

    def graph(self) -> dict[str, set[str]]:
        """Which modules of the project a module imports when it runs."""
        graph: dict[str, set[str]] = {}
        for name, (tree, is_package) in self.modules.items():
            unused = for_types_only(tree)
            targets = {target for target, node in imported(tree, name, is_package) if id(node) not in unused}
            # ``from a import b`` is an import of a.b where that is a module, else of a.
            known = {target if target in self.modules else target.rpartition(".")[0] for target in targets}
            graph[name] = (known & set(self.modules)) - {name}
        return graph


@pytest.fixture(scope="module")
def sources(repository: Path) -> Sources:
    return Sources(repository)


def test_the_sources_are_found(sources: Sources) -> None:
    assert {"mo_deepdrive", "mo_deepdrive.envs.single", "mo_deepdrive.simulation.kernel"} <= set(sources.modules)
    assert sources.graph()["mo_deepdrive.simulation.kernel"] >= {"mo_deepdrive.simulation.dynamics"}


def test_the_simulation_knows_neither_environments_nor_algorithms(sources: Sources) -> None:
    check = bans("mo_deepdrive.envs", "mo_deepdrive.batch", "mo_deepdrive.rendering", "algorithms", "scripts")
    assert sources.offences(check, sources.below("mo_deepdrive.simulation")) == {}


def test_the_package_knows_neither_algorithms_nor_scripts(sources: Sources) -> None:
    assert sources.offences(bans("algorithms", "scripts"), sources.below("mo_deepdrive")) == {}


def test_algorithms_do_not_know_the_scripts(sources: Sources) -> None:
    modules = sources.below("algorithms")
    assert modules == [] or sources.offences(bans("scripts"), modules) == {}


def test_what_the_kernel_is_made_of_does_not_know_the_environments(sources: Sources) -> None:
    parts = ["config", "objectives", "scenarios", "actions", "observation"]
    check = bans("mo_deepdrive.envs", "mo_deepdrive.batch", "mo_deepdrive.simulation.kernel")
    assert sources.offences(check, [f"mo_deepdrive.{part}" for part in parts]) == {}


def test_objectives_import_nothing_of_the_project(sources: Sources) -> None:
    assert sources.offences(allows(), ["mo_deepdrive.objectives"]) == {}


def test_utilities_import_only_objectives_and_config(sources: Sources) -> None:
    if "mo_deepdrive.utilities" not in sources.modules:
        pytest.skip("there are no utilities yet")
    check = allows("mo_deepdrive.objectives", "mo_deepdrive.config")
    assert sources.offences(check, ["mo_deepdrive.utilities"]) == {}


def test_only_the_faces_import_rendering_and_only_when_they_draw(sources: Sources) -> None:
    others = [name for name in sources.modules if not within(name, "mo_deepdrive.envs")]
    assert sources.offences(bans("mo_deepdrive.rendering"), others) == {}
    others = [name for name in sources.modules if name != "mo_deepdrive.rendering"]
    assert sources.offences(bans("mo_deepdrive.drawing"), others) == {}
    assert sources.offences(eager("mo_deepdrive.rendering"), sources.below("mo_deepdrive.envs")) == {}


def test_fronts_are_imported_only_when_they_are_asked_for(sources: Sources) -> None:
    assert sources.offences(eager("mo_deepdrive.reference_fronts"), sources.below("mo_deepdrive")) == {}
    check = bans("mo_deepdrive.reference_fronts", "moocore")
    parts = ["config", "objectives", "scenarios", "actions", "observation", "batch", "simulation"]
    assert sources.offences(check, sources.below(*(f"mo_deepdrive.{part}" for part in parts))) == {}


def test_no_chain_of_imports_leads_back(sources: Sources) -> None:
    assert cycles(sources.graph()) == []


def test_nothing_below_the_scripts_reads_the_command_line_or_the_environment(sources: Sources) -> None:
    assert sources.offences(surroundings_read, sources.below("mo_deepdrive", "algorithms")) == {}


def test_nothing_uses_global_random_state(sources: Sources) -> None:
    assert sources.offences(global_random_state, sources.below("mo_deepdrive", "algorithms")) == {}


# ---------------------------------------------------------------------------------------- the checkers can find things

BAD: list[tuple[Callable[..., list[str]], str, list[str]]] = [
    (bans("algorithms"), "import algorithms", ["algorithms"]),
    (bans("algorithms"), "import algorithms.agent as b", ["algorithms.agent"]),
    (bans("algorithms"), "def f():\n    from algorithms import a2c", ["algorithms.a2c"]),
    (bans("mo_deepdrive.envs"), "from mo_deepdrive import envs", ["mo_deepdrive.envs"]),
    (bans("mo_deepdrive.envs"), "from ..envs import single", ["mo_deepdrive.envs.single"]),
    (bans("mo_deepdrive.simulation.kernel"), "from . import kernel", ["mo_deepdrive.simulation.kernel"]),
    (allows("mo_deepdrive.objectives"), "from mo_deepdrive.scenarios import x", ["mo_deepdrive.scenarios.x"]),
    (allows("mo_deepdrive.objectives"), "import scripts.train", ["scripts.train"]),
    (eager("mo_deepdrive.rendering"), "from mo_deepdrive.rendering import Viewer", ["mo_deepdrive.rendering.Viewer"]),
    (eager("mo_deepdrive.rendering"), "if True:\n    import mo_deepdrive.rendering", ["mo_deepdrive.rendering"]),
    (surroundings_read, "import sys\nprint(sys.argv[1])", ["sys.argv"]),
    (surroundings_read, "from sys import argv", ["sys.argv"]),
    (surroundings_read, "import os\nos.environ['A'] = '1'", ["os.environ"]),
    (surroundings_read, "import os as o\no.getenv('A')", ["os.getenv"]),
    (surroundings_read, "from os import environ as e\ne.get('A')", ["os.environ", "os.environ.get"]),
    (global_random_state, "import numpy as np\nnp.random.seed(0)", ["numpy.random.seed"]),
    (global_random_state, "import numpy\nx = numpy.random.rand", ["numpy.random.rand"]),
    (global_random_state, "from numpy.random import uniform", ["numpy.random.uniform"]),
    (global_random_state, "from numpy import random\nrandom.shuffle([])", ["numpy.random.shuffle"]),
    (global_random_state, "import random\nrandom.random()", ["random.random"]),
    (global_random_state, "import torch\ntorch.manual_seed(0)", ["torch.manual_seed"]),
    (global_random_state, "from torch import manual_seed", ["torch.manual_seed"]),
    (global_random_state, "import torch\ntorch.cuda.manual_seed_all(0)", ["torch.cuda.manual_seed_all"]),
    (global_random_state, "import torch\ntorch.randn(3)", ["torch.randn without generator"]),
]


@pytest.mark.parametrize(("check", "source", "found"), BAD)
def test_a_checker_finds_what_it_is_for(check: Callable[..., list[str]], source: str, found: list[str]) -> None:
    assert check(ast.parse(source), "mo_deepdrive.simulation.progress") == found


GOOD: list[tuple[Callable[..., list[str]], str]] = [
    (bans("algorithms"), "import algorithmsandmore, mo_deepdrive.config"),
    (allows("mo_deepdrive.objectives"), "import numpy\nfrom mo_deepdrive.objectives import NAMES"),
    (eager("mo_deepdrive.rendering"), "def render():\n    from mo_deepdrive.rendering import Viewer"),
    (
        eager("mo_deepdrive.reference_fronts"),
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import mo_deepdrive.reference_fronts",
    ),
    (surroundings_read, "import sys, os\nsys.path, os.path.join('a')\nargv = environ = 1"),
    (global_random_state, "import numpy as np\nrng = np.random.default_rng(0)\nrng.random()\nrng.seed(1)"),
    (global_random_state, "import torch\ng = torch.Generator()\ng.manual_seed(0)\ntorch.randn(3, generator=g)"),
    (global_random_state, "import torch\ntorch.Generator().manual_seed(0)"),
    (global_random_state, "def f(x: 'np.random.Generator'): ..."),
]


@pytest.mark.parametrize(("check", "source"), GOOD)
def test_a_checker_leaves_in_peace_what_is_allowed(check: Callable[..., list[str]], source: str) -> None:
    assert check(ast.parse(source), "mo_deepdrive.simulation.progress") == []


def test_imports_for_types_are_told_apart() -> None:
    tree = ast.parse("import a\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import b\nelse:\n    import c")
    unused = for_types_only(tree)
    assert [name for name, node in imported(tree) if id(node) not in unused] == ["a", "typing.TYPE_CHECKING", "c"]


def test_cycles_of_imports_are_found() -> None:
    graph: dict[str, Any] = {"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}
    assert cycles(graph) == ["b", "c"]
    assert cycles({"a": {"b"}, "b": set()}) == []
