"""The pages that `make docs` writes say what the code says, and grow with it."""

from __future__ import annotations

import importlib
import re

import pytest

from algorithms import ALGORITHMS as CLASSES
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.objectives import OBJECTIVES
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS
from site_pages import reference
from site_pages.explorer_examples import EXAMPLES
from site_pages.repository import outside_links, pages
from tests.helpers.markdown_tables import tables
from tests.helpers.paths import REPOSITORY

DOCS = REPOSITORY / "docs"
SHIPPED = tuple(SCENARIOS)
PAGES = {name: name for name in SHIPPED} | {"roundabout_solo": "roundabout"}  # of observations and objectives


def tables_with(page: str, column: str) -> list[dict[str, str]]:
    """The rows of the tables of a page that have a column, their cells without backticks."""
    text = (DOCS / page).read_text(encoding="utf-8").replace("`", "")
    return [row for table in tables(text) if table and column in table[0] for row in table]


def table_with(page: str, column: str) -> list[dict[str, str]]:
    """The first table of a page that has a column, its cells without backticks."""
    text = (DOCS / page).read_text(encoding="utf-8").replace("`", "")
    return next(table for table in tables(text) if table and column in table[0])


# --------------------------------------------------------------------------------------- environments and algorithms


@pytest.mark.parametrize("name", SHIPPED)
def test_the_pages_have_the_observation_of_an_environment(name: str) -> None:
    common, own = (tables_with(f"environments/{page}.md", "index") for page in ("index", PAGES[name]))
    found = [
        (int(index), entry, row["unit"], float(row["scale"]))
        for row in (*common, *own)
        if " to " not in row["index"]
        for index, entry in zip(row["index"].split(", "), row["name"].split(", "), strict=True)
    ]
    known = [(i, each.name, each.unit, each.scale) for i, each in enumerate(layout(SCENARIOS[name]))]
    assert found == known[: len(found)]
    repeated = known[len(found) :]
    ranges = [(row["index"], row["name"]) for row in own if " to " in row["index"]]
    if not ranges:
        assert not repeated
        return
    (first, first_name, *_), (last, last_name, *_) = repeated[0], repeated[-1]
    assert ranges == [(f"{first} to {last}", f"{first_name} to {last_name}")]
    period = sum(entry.startswith("near_1_") for _, entry, _, _ in known)  # the rows before say what is repeated
    assert [each[2:] for each in repeated] == [each[2:] for each in known[len(found) - period : -period]]


def test_the_overview_has_the_objectives() -> None:
    rows = table_with("environments/index.md", "magnitude")
    found = {row["objective"]: (row["magnitude"], row["unit"], row["sign"], float(row["scale"])) for row in rows}
    known = {each.name: (each.description, each.unit, "-+"[each.sign > 0], each.scale) for each in OBJECTIVES}
    assert found == {name: each for name, each in known.items() if name in found}
    assert {*found} == {"time", *(objective for name in SHIPPED for objective in SCENARIOS[name].objectives)}


@pytest.mark.parametrize("name", SHIPPED)
def test_the_page_of_an_environment_names_its_objectives(name: str) -> None:
    text = (DOCS / "environments" / f"{PAGES[name]}.md").read_text(encoding="utf-8")
    named = re.findall(r"`(\w+)`", text.partition("## Objectives\n\n")[2].partition(" (")[0])
    assert named == [*SCENARIOS[name].objectives, *(["time"] if "time" not in SCENARIOS[name].objectives else [])]


def test_every_argument_of_the_environments_is_on_a_page() -> None:
    pages = [f"environments/{name}.md" for name in ("index", *SHIPPED)]
    documented = {row["argument"] for page in pages for row in table_with(page, "argument") if row["meaning"]}
    assert {*EnvConfig.model_fields} - {"scenario"} <= documented


def test_the_overview_has_every_environment_and_algorithm() -> None:
    overview = (DOCS / "environments" / "index.md").read_text(encoding="utf-8")
    assert all(f"[{each.title}]({name}.md)" in overview for name, each in SCENARIOS.items())
    pages = "".join(path.read_text(encoding="utf-8") for path in (DOCS / "algorithms").glob("*.md"))
    assert all(
        f"mo-deepdrive keys --algorithm {name} " in pages or f"algorithms/{name}.py" in pages for name in CLASSES
    )


# ---------------------------------------------------------------------------------------------------------- reference


@pytest.mark.slow
def test_the_reference_has_every_module_once() -> None:
    pages = reference.pages()
    named = re.findall(r"^\.\. automodule:: (\S+)$", "".join(pages.values()), flags=re.MULTILINE)
    expected = set()
    for package in ("mo_deepdrive", "algorithms"):
        for path in (REPOSITORY / package).rglob("*.py"):
            parts = path.relative_to(REPOSITORY).with_suffix("").parts
            expected.add(".".join(part for part in parts if part != "__init__"))
    assert sorted(named) == sorted(name for name in expected if not name.endswith("__main__"))


def test_the_names_that_are_met_first_exist_where_the_reference_says() -> None:
    index = reference.pages()["reference/index.md"]
    for name, source in (each for names in reference.FIRST_NAMES.values() for each in names):
        last = name.rpartition(".")[2]
        assert f"| {{py:obj}}`{last} <{name}>` | `{source}` | {reference.summary_of(name)} |" in index
        if source not in ("mo_deepdrive.envs.rllib", "mo_deepdrive.envs.sb3"):  # which need extras
            assert callable(getattr(importlib.import_module(source), last))


def test_the_reference_has_every_public_constant() -> None:
    text = "".join(reference.pages().values())
    for name in ("SCENARIOS", "OBJECTIVES", "ALGORITHMS", "SPLITS"):
        assert f".. py:data:: {name}\n" in text
    lines = reference.constants("mo_deepdrive.simulation.observation")["ABSENT_DISTANCE"]
    assert "   :value: 100.0" in lines
    assert "   A vehicle that has left the road is observed straight ahead, at rest, at this distance (m)." in lines


# ---------------------------------------------------------------------------------------------------- pages from files


def test_links_to_files_outside_the_pages_are_text_as_long_as_the_repository_has_no_address() -> None:
    text = "[licence](../LICENSE), [results](results), [changes](../CHANGELOG.md), [GPU](gpu.md#a)"
    assert outside_links(text, "provenance.md") == "licence, results, [changes](changelog.md), [GPU](gpu.md#a)"
    assert "](LICENSE)" not in pages()["_readme.md"]


def test_the_explorers_pages_are_those_of_the_commands_in_the_documentation() -> None:
    text = (REPOSITORY / "docs" / "explorer.md").read_text(encoding="utf-8")
    for name, fronts in EXAMPLES.items():
        assert f'href="_static/{name}"' in text
        assert f"mo-deepdrive explore {' '.join(fronts)} --output explore.html\n" in text
    assert "/docs/_static/explore_*.html" in (REPOSITORY / ".gitignore").read_text(encoding="utf-8").split()
    assert all(name.startswith("explore_") for name in EXAMPLES)
