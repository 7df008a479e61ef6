"""Mutation testing: whether the tests notice small changes of the code.

    make mutants

draws a seeded sample of mutants with the operators of Cosmic Ray, runs the tests that mirror the mutated package on
each, in a copy of the repository, and writes what became of them to ``docs/results/mutants.csv``. A mutant that no
test notices has survived: a test is missing, or the change makes no difference. The latter are listed with the reason
in ``equivalent.yaml``.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import csv
import difflib
import io
import os
import queue
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from mo_deepdrive.atomic_io import atomic_write
from tests.helpers.paths import REPOSITORY

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

EQUIVALENT = Path(__file__).with_name("equivalent.yaml")
PYTEST = ("-m", "pytest", "--exitfirst", "--quiet", "-p", "no:cacheprovider")


@dataclass(frozen=True)
class Group:
    """A stratum of the sample.

    Attributes:
        name: for the tables.
        source: the mutated module, or package.
        tests: files and folders of tests that mirror it.
        count: number of mutants.
    """

    name: str
    source: str
    tests: tuple[str, ...]
    count: int


GROUPS = (
    Group("advantages", "algorithms/common/advantages.py", ("tests/algorithms/common/test_advantages.py",), 12),
    Group("pareto", "mo_deepdrive/evaluation/pareto.py", ("tests/algorithms/common/test_pareto.py",), 25),
    Group("scenarios", "mo_deepdrive/scenarios.py", ("tests/mo_deepdrive/test_own_scenario.py",), 10),
    # The rules of the kernel are tested in every scenario.
    Group(
        "simulation",
        "mo_deepdrive/simulation",
        ("tests/mo_deepdrive/simulation", "tests/mo_deepdrive/test_scenarios.py"),
        65,
    ),
    Group("sweeps", "algorithms/sweeps", ("tests/algorithms/sweeps",), 40),
)
# Their tests start clusters (`make test-cluster`) and take minutes for each mutant.
LEFT_OUT = ("algorithms/sweeps/ray_tune.py",)

ARITHMETIC = ("Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow")
BITWISE = ("RShift", "LShift", "BitOr", "BitAnd", "BitXor")


@dataclass(frozen=True)
class Mutant:
    """One change of one line, and what became of it.

    Attributes:
        group: name of its group.
        module: path of the mutated file in the repository.
        line: its number in the file.
        before: the line.
        after: the line as it was changed.
        operator: of Cosmic Ray.
        occurrence: which of the places in the file where the operator applies.
        outcome: "killed" by a failed test, or by the "timeout", "survived", or "equivalent"; empty if it has not run.
        seconds: that the tests took.
    """

    group: str
    module: str
    line: int
    before: str
    after: str
    operator: str
    occurrence: int
    outcome: str = ""
    seconds: float = 0.0


COLUMNS = tuple(field.name for field in fields(Mutant))


# ------------------------------------------------------------------------------------------------------- the sample


def is_useful(operator: str) -> bool:
    """Whether an operator of Cosmic Ray makes mutants that could survive, by its name.

    A bitwise operator for an arithmetic one is a TypeError in nearly every place; ``is`` for ``==`` is no change of
    meaning.
    """
    kind, *names = operator.removeprefix("core/").split("_")
    if kind == "ReplaceBinaryOperator":
        return any(set(names) <= set(family) for family in (ARITHMETIC, BITWISE))
    if kind == "ReplaceComparisonOperator":
        return len({"Is", "IsNot"} & set(names)) != 1
    if kind == "ReplaceUnaryOperator":
        return names[-1] not in ("Invert", "Not") or names[0] == "Delete"
    return True


class _WithoutTypes(ast.NodeTransformer):
    """Removes what is for type checkers alone."""

    def visit_arg(self, node: ast.arg) -> ast.AST:
        node.annotation = None
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.annotation = ast.Constant(None)
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> ast.AST | None:
        names = {name.id for name in ast.walk(node.test) if isinstance(name, ast.Name)}
        return None if "TYPE_CHECKING" in names else self.generic_visit(node)


def changes_code(before: str, after: str) -> bool:
    """Whether ``after`` is Python that differs from ``before`` in more than types and layout."""
    try:
        first, second = (ast.dump(_WithoutTypes().visit(ast.parse(text))) for text in (before, after))
    except SyntaxError:
        return False
    return first != second


def changed_lines(before: str, after: str) -> tuple[int, str, str]:
    """The number of the first line that differs, and the lines that differ, before and after, each as one line."""
    old, new = before.splitlines(), after.splitlines()
    changes = [c for c in difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes() if c[0] != "equal"]
    removed = " ".join(line for _, i, j, _, _ in changes for line in old[i:j])
    added = " ".join(line for _, _, _, i, j in changes for line in new[i:j])
    return changes[0][1] + 1, " ".join(removed.split()), " ".join(added.split())


def modules(group: Group, root: Path) -> list[str]:
    """The files of a group that are mutated, as paths in the repository."""
    source = root / group.source
    paths = sorted(source.rglob("*.py")) if source.is_dir() else [source]
    return [name for path in paths if (name := path.relative_to(root).as_posix()) not in LEFT_OUT]


def mutation_sites(path: Path) -> list[list[tuple[str, int]]]:
    """The mutants of a file, as pairs of operator and occurrence: one list for each place in it, in their order."""
    from cosmic_ray import plugins
    from cosmic_ray.ast import ast_nodes, get_ast_from_path

    nodes = list(ast_nodes(get_ast_from_path(path)))
    sites = defaultdict(list)
    for name in plugins.operator_names():
        operator = plugins.get_operator(name)
        if not operator.arguments() and is_useful(name):
            positions = (position for node in nodes for position in operator().mutation_positions(node))
            for occurrence, position in enumerate(positions):
                sites[position].append((name, occurrence))
    return [sites[position] for position in sorted(sites)]


def mutated(text: str, operator: str, occurrence: int) -> str:
    """A file's text with one mutation; unchanged if Cosmic Ray fails to make it."""
    from cosmic_ray import plugins
    from cosmic_ray.mutating import mutate_code

    try:
        changed = mutate_code(text, plugins.get_operator(operator)(), occurrence)
    except AttributeError:  # Cosmic Ray 8.7 replaces the names of exceptions only if they have no dots
        return text
    assert changed is not None, f"{operator} does not apply {occurrence + 1} times"
    return changed


def sample(group: Group, root: Path, seed: int, count: int) -> list[Mutant]:
    """At most ``count`` mutants of a group: places in its files drawn uniformly, one mutation at each."""
    rng = random.Random(f"{seed} {group.name}")
    sites = [(module, site) for module in modules(group, root) for site in mutation_sites(root / module)]
    rng.shuffle(sites)
    found: list[Mutant] = []
    while sites and len(found) < count:
        module, site = sites.pop()
        operator, occurrence = rng.choice(site)
        text = (root / module).read_text(encoding="utf-8")
        after = mutated(text, operator, occurrence)
        if changes_code(text, after):
            name = operator.removeprefix("core/")
            found.append(Mutant(group.name, module, *changed_lines(text, after), name, occurrence))
    return sorted(found, key=lambda mutant: (mutant.module, mutant.line))


def tests_of(group: Group, module: str, root: Path) -> list[str]:
    """The files of tests that are run on the mutants of a module: its own first, then the small ones."""
    paths = [root / name for name in group.tests]
    files = [file for path in paths for file in (path.glob("test_*.py") if path.is_dir() else [path])]
    files.sort(key=lambda file: (file.stem != f"test_{Path(module).stem}", file.stat().st_size))
    return [file.relative_to(root).as_posix() for file in files]


# ---------------------------------------------------------------------------------------------------------- running


def copy_repository(target: Path) -> None:
    """Copy all files that are tracked by git or could be."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=REPOSITORY,
        capture_output=True,
        check=True,
        text=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (REPOSITORY / name).is_file():  # not if it was deleted since
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(REPOSITORY / name, target / name)


def run_tests(copy: Path, files: Sequence[str], limit: float | None = None) -> str:
    """Run tests in a copy of the repository; returns "survived" if all of them pass, "killed" or "timeout"."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen(
        [sys.executable, *PYTEST, f"--basetemp={copy}.tmp", *files],
        cwd=copy,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # so that processes which the tests started can be killed, too
    )
    try:
        return "killed" if process.wait(limit) else "survived"
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def run_mutant(mutant: Mutant, copy: Path, files: Sequence[str], limit: float) -> Mutant:
    """Run the tests on a mutant; returns it with its outcome. The copy is as before afterwards."""
    path = copy / mutant.module
    text = path.read_text(encoding="utf-8")
    began = time.monotonic()
    try:
        path.write_text(mutated(text, f"core/{mutant.operator}", mutant.occurrence), encoding="utf-8")
        outcome = run_tests(copy, files, limit)
    finally:
        path.write_text(text, encoding="utf-8")
    return replace(mutant, outcome=outcome, seconds=round(time.monotonic() - began, 1))


class TimeLimits:
    """The seconds after which tests are stopped, by how long they take without a mutation."""

    def __init__(self) -> None:
        self._limits: dict[frozenset[str], float] = {}
        self._lock = threading.Lock()

    def of(self, files: Sequence[str], copy: Path) -> float:
        """The limit of the tests in these files; they are run in a copy without a mutation, and must pass."""
        with self._lock:
            key = frozenset(files)
            if key not in self._limits:
                began = time.monotonic()
                if run_tests(copy, files) != "survived":
                    raise ValueError(f"tests fail without a mutation: pytest {' '.join(files)}")
                self._limits[key] = 60.0 + 3.0 * (time.monotonic() - began)
            return self._limits[key]


# ---------------------------------------------------------------------------------------------------------- results


def write_results(path: Path, mutants: Iterable[Mutant]) -> None:
    """Write the mutants that have run as CSV, atomically."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(mutant) for mutant in mutants if mutant.outcome)
    atomic_write(path, text.getvalue().encode())


def read_results(path: Path) -> list[Mutant]:
    """The mutants of a file that :func:`write_results` wrote."""
    with path.open(encoding="utf-8", newline="") as file:
        return [
            Mutant(
                **row
                | {"line": int(row["line"]), "occurrence": int(row["occurrence"]), "seconds": float(row["seconds"])}
            )
            for row in csv.DictReader(file)
        ]


def with_results(mutants: Sequence[Mutant], results: Iterable[Mutant]) -> list[Mutant]:
    """The mutants, with the outcomes of those that were killed before."""
    killed = {replace(done, outcome="", seconds=0.0): done for done in results if done.outcome in ("killed", "timeout")}
    return [killed.get(mutant, mutant) for mutant in mutants]


def read_equivalent(path: Path = EQUIVALENT) -> dict[tuple[str, str, str], str]:
    """(module, line before, line after) of mutants that make no difference -> why."""
    entries = yaml.safe_load(path.read_text(encoding="utf-8")) or []
    return {(entry["module"], entry["before"], entry["after"]): entry["reason"] for entry in entries}


def table(mutants: Sequence[Mutant]) -> str:
    """A Markdown table of the outcomes per group. The score is the share of killed mutants of those not equivalent."""
    lines = ["| group | mutants | killed | equivalent | survived | score |", "|---|---|---|---|---|---|"]
    for name in [*dict.fromkeys(mutant.group for mutant in mutants), "all"]:
        counts = Counter(mutant.outcome for mutant in mutants if name in (mutant.group, "all"))
        killed = counts["killed"] + counts["timeout"]
        of = killed + counts["survived"]
        cells = (name, counts.total(), killed, counts["equivalent"], counts["survived"])
        lines.append(f"| {' | '.join(map(str, cells))} | {100 * killed / max(of, 1):.0f}% |")
    return "\n".join(lines)


def survivors(mutants: Iterable[Mutant]) -> str:
    """The mutants that survived, each with its place and its line before and after."""
    return "\n".join(
        f"{mutant.module}:{mutant.line} ({mutant.operator})\n  - {mutant.before}\n  + {mutant.after}"
        for mutant in mutants
        if mutant.outcome == "survived"
    )


def main() -> None:
    """Run the sample and print its score and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--limit", type=int, default=1000, help="at most so many mutants of each group")
    parser.add_argument("--workers", type=int, default=1, help="number of mutants that are tested at the same time")
    parser.add_argument("--output", type=Path, default=REPOSITORY / "docs" / "results" / "mutants.csv")
    parser.add_argument("--resume", action="store_true", help="do not repeat the mutants that were killed in --output")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    mutants = [
        mutant
        for group in GROUPS
        for mutant in sample(group, REPOSITORY, options.seed, min(group.count, options.limit))
    ]
    if options.resume and options.output.is_file():
        mutants = with_results(mutants, read_results(options.output))
    groups = {group.name: group for group in GROUPS}
    equivalent = read_equivalent()
    limits = TimeLimits()
    files = [tests_of(groups[mutant.group], mutant.module, REPOSITORY) for mutant in mutants]
    to_run = sorted((i for i, mutant in enumerate(mutants) if not mutant.outcome), key=lambda i: len(files[i]))
    print(f"{len(to_run)} of {len(mutants)} mutants to test", flush=True)
    with tempfile.TemporaryDirectory(prefix="mutants-") as directory, ThreadPoolExecutor(options.workers) as executor:
        copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for number in range(options.workers):
            copies.put(Path(directory) / str(number) / REPOSITORY.name)
            copy_repository(Path(directory) / str(number) / REPOSITORY.name)

        def run(i: int) -> tuple[int, Mutant]:
            copy = copies.get()
            try:
                return i, run_mutant(mutants[i], copy, files[i], limits.of(files[i], copy))
            finally:
                copies.put(copy)

        running = [executor.submit(run, i) for i in to_run]
        try:
            for number, future in enumerate(as_completed(running), 1):
                i, mutant = future.result()
                if mutant.outcome == "survived" and (mutant.module, mutant.before, mutant.after) in equivalent:
                    mutant = replace(mutant, outcome="equivalent")
                mutants[i] = mutant
                write_results(options.output, mutants)
                place = f"{mutant.module}:{mutant.line}"
                print(f"{number:4} {mutant.outcome:10} {mutant.seconds:6} s  {place} {mutant.operator}", flush=True)
        except KeyboardInterrupt:
            print("interrupted: ends after the mutants in progress; --resume continues", file=sys.stderr)
            raise SystemExit(128 + signal.SIGINT) from None
        finally:
            executor.shutdown(cancel_futures=True)
    print(f"\n{table(mutants)}\n\n{survivors(mutants)}")


if __name__ == "__main__":
    main()
