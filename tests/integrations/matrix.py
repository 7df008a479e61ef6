"""What runs of other libraries: what the tests of this folder declare, as the tables of ``docs/compatibility.md``.

A test file has a ``LIBRARY``, and its tests have rows::

    @row("Collector and DQN", how="`DummyVectorEnv` of `UtilityReward`")
    def test_dqn_trains() -> None: ...

``python -m tests.integrations.matrix`` writes the tables. It imports the test files, which import their libraries in
tests alone, so none of them has to be installed.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from tests.helpers.paths import REPOSITORY

Test = TypeVar("Test", bound=Callable[..., Any])

HERE = REPOSITORY / "tests" / "integrations"
PAGE = REPOSITORY / "docs" / "compatibility.md"
BEGIN, END = "<!-- written by python -m tests.integrations.matrix -->", "<!-- end -->"
CONSTRAINTS = ("constraints-integrations.txt", "constraints-peers.txt", "constraints.txt")


@dataclass(frozen=True)
class Library:
    """A library that a test file runs.

    Attributes:
        name: on the page.
        package: whose version is on the page.
        module: the tests are skipped where it cannot be imported; None for a style of code, which has no version.
        how: how it is used in general.
        constraints: the files with its version, the first that has it.
    """

    name: str
    package: str
    module: str | None
    how: str
    constraints: tuple[str, ...] = CONSTRAINTS

    def version(self) -> str:
        """The tested version, from the constraints (of Python 3.11)."""
        for file in self.constraints:
            for line in (REPOSITORY / file).read_text(encoding="utf-8").splitlines():
                pin, _, condition = line.partition(";")
                package, _, version = pin.strip().partition("==")
                if package.lower().replace("_", "-") == self.package and '< "3.11"' not in condition:
                    return version
        raise ValueError(f"no version of {self.package!r} in {self.constraints}")


@dataclass(frozen=True)
class Row:
    """What a test shows.

    Attributes:
        what: of the library.
        how: what to write, where that is not obvious, or the library takes something else.
        tests: names of the tests.
        file: theirs, relative to the repository.
    """

    what: str
    how: str
    tests: tuple[str, ...]
    file: str


def row(what: str, *, how: str = "") -> Callable[[Test], Test]:
    """Declare the row of the matrix that a test checks."""

    def declare(test: Test) -> Test:
        file = f"tests/integrations/{test.__module__.rpartition('.')[2]}.py"
        test.row = Row(what, how, (test.__name__,), file)  # type: ignore[attr-defined]
        return test

    return declare


def _rllib() -> tuple[Library, list[Row]]:
    """RLlib pins an older Gymnasium, so its tests are elsewhere: ``make test-ray``."""
    older = Library("Gymnasium", "gymnasium", "gymnasium", "", ("constraints-ray.txt",)).version()
    how = f"`mo_deepdrive.envs.rllib.DrivingMultiAgentEnv`, in an environment with Gymnasium {older} (`make test-ray`)"
    file = "tests/ray/test_rllib.py"
    rows = [
        Row("PPO, one vehicle", "", ("test_ppo_trains_one_vehicle",), file),
        Row(
            "PPO, two vehicles with a policy each",
            "`policy_mapping_fn=lambda agent, episode, **_: agent`",
            (
                "test_ppo_trains_two_vehicles_with_separate_utilities_if_one_leaves_early",
                "test_ppo_trains_on_samples_of_another_process",
            ),
            file,
        ),
        Row(
            "vector rewards",
            'a utility, as `env_config={"utility": ...}` or MO-Gymnasium\'s `LinearReward`; the vector is in `infos`',
            ("test_ppo_trains_on_a_gymnasium_id_that_mo_gymnasium_scalarises",),
            file,
        ),
    ]
    return Library("RLlib", "ray", "ray", how, ("constraints.txt",)), rows


def files() -> list[Path]:
    """The test files with a library, in the order of the page."""
    order = (
        "gymnasium",
        "mo_gymnasium",
        "stable_baselines3",
        "cleanrl",
        "morl_baselines",
        "torchrl",
        "tianshou",
        "pettingzoo",
        "supersuit",
        "momaland",
    )
    return [HERE / f"test_{name}.py" for name in order]


def matrix() -> Iterator[tuple[Library, list[Row]]]:
    """The libraries and their rows, in the order of the page."""
    for file in files():
        module = importlib.import_module(f"tests.integrations.{file.stem}")
        tests = (value for name, value in vars(module).items() if name.startswith("test_"))
        yield module.LIBRARY, [test.row for test in tests if hasattr(test, "row")]
    yield _rllib()


def _line(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _anchor(title: str) -> str:
    """The link of a heading, as GitHub forms it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def tables() -> str:
    """The generated part of the page."""
    overview = [_line("library", "version", "how"), "|---|---|---|"]
    sections = []
    for library, rows in matrix():
        version = library.version() if library.module else ""
        title = f"{library.name} {version}".strip()
        overview.append(_line(f"[{library.name}](#{_anchor(title)})", version, library.how))
        sections += [f"## {title}", "", _line(f"what runs ([tests](../{rows[0].file}))", "how"), "|---|---|"]
        sections += [_line(each.what, each.how) for each in rows] + [""]
    return "\n".join([*overview, "", *sections])


def page() -> str:
    """The page with new tables."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{tables()}\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(REPOSITORY)}")
