"""The pages that `make docs` writes say what the code says, and grow with it."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from functools import cache
from typing import TYPE_CHECKING

import polars as pl
import pytest

from algorithms import ALGORITHMS as CLASSES
from mo_deepdrive.config import EnvConfig
from mo_deepdrive.envs import spaces
from mo_deepdrive.envs.single import DrivingEnv
from mo_deepdrive.objectives import INDEX, OBJECTIVES
from mo_deepdrive.observation import layout
from mo_deepdrive.scenarios import SCENARIOS, Route, Scenario
from site_pages import algorithms, docstrings, environments, markdown, reference, repository, results
from site_pages.explorer_examples import EXAMPLES
from site_pages.local_links import broken_links
from tests.helpers.markdown_tables import tables
from tests.helpers.paths import REPOSITORY

if TYPE_CHECKING:
    from pathlib import Path

SHIPPED = tuple(SCENARIOS)


@cache
def page_of(name: str) -> str:
    """The page of a shipped environment."""
    return environments.page(SCENARIOS[name])


def table_with(text: str, column: str) -> list[dict[str, str]]:
    """The first table of a page that has a column."""
    return next(table for table in tables(text) if table and column in table[0])


# ------------------------------------------------------------------------------------------------------- environments


@pytest.mark.parametrize("name", SHIPPED)
def test_the_page_of_an_environment_has_its_observation(name: str) -> None:
    space = spaces.observation_space(EnvConfig(scenario=name))
    rows = table_with(page_of(name), "scale")
    assert [(row["index"], row["name"], row["unit"], float(row["scale"])) for row in rows] == [
        (str(i), entry.name, entry.unit, entry.scale) for i, entry in enumerate(layout(SCENARIOS[name]))
    ]
    assert [float(row["low"]) for row in rows] == pytest.approx(space.low.tolist(), rel=1e-5)
    assert [float(row["high"]) for row in rows] == pytest.approx(space.high.tolist(), rel=1e-5)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_page_of_an_environment_has_its_objectives(name: str) -> None:
    rows = table_with(page_of(name), "magnitude")
    expected = [OBJECTIVES[INDEX[objective]] for objective in SCENARIOS[name].objectives]
    assert [(row["objective"], row["magnitude"], row["unit"], row["sign"], float(row["scale"])) for row in rows] == [
        (each.name, each.description, each.unit, "+" if each.sign > 0 else "-", each.scale) for each in expected
    ]


@pytest.mark.parametrize("name", SHIPPED)
def test_the_page_of_an_environment_has_every_argument(name: str) -> None:
    rows = table_with(page_of(name), "argument")
    assert [row["argument"] for row in rows] == [field for field in EnvConfig.model_fields if field != "scenario"]
    assert all(row["meaning"] for row in rows)
    assert next(row for row in rows if row["argument"] == "harmful_jerk")["default"] == "None"


@pytest.mark.parametrize("name", SHIPPED)
def test_the_page_of_an_environment_has_the_sections_of_its_docstring(name: str) -> None:
    page = page_of(name)
    doc = markdown.sections(environments.environment_class(SCENARIOS[name]))
    for section in ("Description", "Starting State", "Episode End", "Version History"):
        assert doc[section]
        assert doc[section] in page
    assert f'mo_gymnasium.make("mo_deepdrive:{SCENARIOS[name].id}")' in page


def test_learning_results_of_left_turn_have_rules_and_policies_with_intervals() -> None:
    rows = {row["driver"]: row for row in table_with(results.results_text(SCENARIOS["left_turn"]), "driver")}
    published = pl.read_csv(results.RESULTS / "left_turn_rules.csv", infer_schema_length=None)
    assert list(rows) == published["driver"].to_list()
    for row in published.iter_rows(named=True):
        value, low, high = (float(each) for each in re.findall(r"[\d.e-]+", rows[row["driver"]]["arrived"]))
        expected = [row["arrived"], row["arrived_low"], row["arrived_high"]]
        assert [value, low, high] == pytest.approx(expected, rel=1e-3)
    assert results.driver_tables(results.RESULTS / "left_turn_rules.csv", SCENARIOS["intersection"]) == []


@pytest.mark.parametrize("name", SHIPPED)
def test_the_page_of_an_environment_has_the_conflicts_that_were_measured(name: str) -> None:
    measured = pl.read_csv(results.RESULTS / "conflicts.csv").filter(
        pl.col("population").str.split(",").list.first() == SCENARIOS[name].title
    )
    texts = results.conflicts_of_drivers(SCENARIOS[name])
    assert len(texts) == measured["population"].n_unique() > 0
    shown = [row for text in texts for row in table_with(text, "rank correlation")]
    assert sorted(float(row["rank correlation"].split(" ")[0]) for row in shown) == sorted(measured["spearman"])
    assert all(text in page_of(name) for text in texts)


def test_nothing_that_code_knows_is_written_by_hand() -> None:
    observed = {entry.name for scenario in SCENARIOS.values() for entry in layout(scenario)}
    known = observed | {row.name for row in OBJECTIVES} | {each.id for each in SCENARIOS.values()}
    known |= {*EnvConfig.model_fields} - {"scenario", "objectives", "action_type"}  # which select what is shown
    known -= {"time"}  # an everyday word, too
    for module in (environments, markdown, results):
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                words = set(re.findall(r"[\w-]+", node.value))
                assert not words & known, node.value
                assert not re.search(r"\d(\.\d+)? (m|s|g|rad|Hz)\b", node.value), node.value
    fragments = list((REPOSITORY / "docs" / "_fragments").glob("*.md"))
    assert fragments
    for path in fragments:
        assert not set(re.findall(r"`([^`]+)`", path.read_text(encoding="utf-8"))) & known


def test_a_registered_scenario_gets_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environments, "environment_class", lambda _: DrivingEnv)
    scenario = Scenario(
        name="page_of_its_own",
        title="PageOfItsOwn",
        routes=(Route(start=(7.0, 25.0, 0.0), waypoints=((20.0, 5.0),)),),
        obstacles=2,
        objectives=("distance", "collision"),
    )
    monkeypatch.setitem(SCENARIOS, scenario.name, scenario)
    page = environments.page(scenario)
    assert page.startswith("# PageOfItsOwn\n")
    assert "obstacle_2_a_distance" in {row["name"] for row in table_with(page, "scale")}
    assert "Random actions." in page
    assert "\npage_of_its_own\n" in environments.index()


# --------------------------------------------------------------------------------------------------------- algorithms


@pytest.mark.parametrize("name", list(CLASSES))
def test_the_page_of_an_algorithm_has_its_hyperparameters_and_equations(name: str) -> None:
    page = algorithms.page(name)
    rows = table_with(page, "key")
    assert [row["key"] for row in rows] == list(CLASSES[name].Config.model_fields)
    assert all(row["meaning"] for row in rows)
    doc = inspect.getdoc(importlib.import_module(CLASSES[name].__module__)) or ""
    equations = [" ".join(line.split()) for line in doc.splitlines() if line.startswith("    ")]
    assert equations
    literal = "\n".join(re.findall(r"^```text\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE))
    literal = re.sub(r" +", " ", literal)
    assert [line for line in equations if line not in literal] == []


# ---------------------------------------------------------------------------------------------------------- reference


def test_the_reference_has_every_module_once() -> None:
    pages = reference.pages()
    named = re.findall(r"^\.\. automodule:: (\S+)$", "".join(pages.values()), flags=re.MULTILINE)
    expected = set()
    for package in ("mo_deepdrive", "algorithms"):
        for path in (REPOSITORY / package).rglob("*.py"):
            parts = path.relative_to(REPOSITORY).with_suffix("").parts
            expected.add(".".join(part for part in parts if part != "__init__"))
    assert sorted(named) == sorted(name for name in expected if not name.endswith("__main__"))


def test_the_reference_has_every_public_constant() -> None:
    text = "".join(reference.pages().values())
    for name in ("SCENARIOS", "OBJECTIVES", "ALGORITHMS", "SPLITS"):
        assert f".. py:data:: {name}\n" in text
    lines = reference.constants("mo_deepdrive.simulation.observation")["ABSENT_DISTANCE"]
    assert "   :value: 100.0" in lines
    assert "   A vehicle that has left the road is observed straight ahead, at rest, at this distance (m)." in lines


# --------------------------------------------------------------------------------------------- docstrings and Markdown


def test_equations_become_literal_blocks_until_the_first_section() -> None:
    lines = ["Sum.", "", "The sum,", "", "    R = r_0", "      + r_1", "", "ends.", "", "Args:", "", "    x: a number."]
    assert docstrings.literal_equations(lines) == [*lines[:4], "::", "", *lines[4:]]
    kept = ["Such as::", "", "    code", "", "- a list", "", "    of paragraphs"]
    assert docstrings.literal_equations(kept) == kept


# ---------------------------------------------------------------------------------------------------- pages from files


def test_links_of_root_files_lead_to_pages_or_to_the_repository() -> None:
    pages = repository.pages()
    assert "](docs/" not in pages["changelog.md"] + pages["contributing.md"]
    assert "(simulator.md#versions-of-the-ids)" in pages["contributing.md"]
    text = "[a](../configs/studies/paper.yaml) [b](../CONTRIBUTING.md#style) [c](x.md)"
    outside = f"[a]({markdown.REPOSITORY_URL}configs/studies/paper.yaml)"
    assert repository.outside_links(text, "peers.md") == f"{outside} [b](contributing.md#style) [c](x.md)"
    assert repository.outside_links("[b](../../CONTRIBUTING.md)", "results/x.md") == "[b](../contributing.md)"


def test_links_of_built_pages_that_lead_nowhere_are_found(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    for folder in ("_static", "_modules"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.html").write_text("<a href='nowhere.html'>not checked</a><i id='f'>f</i>")
    (tmp_path / "index.html").write_text("<h1 id='top'>T</h1><a name='old'></a><a href='a/b/page.html#x%20y'>p</a>")
    (tmp_path / "a" / "b" / "page.html").write_text(
        "<p id='x y'>P</p><img src='../picture.png'><a href='#here'>h</a><a href='../../#top'>i</a>"
        "<a href='../../index.html#old'>o</a><a href='../../_static/own.html#mode=budget'>s</a>"
        "<a href='../../_modules/own.html#f'>f</a><a href='../../_modules/own.html#g'>g</a>"
        "<a href='https://example.org/#x'>e</a><a href='mailto:a@example.org'>m</a><a href='../../../out.html'>u</a>"
    )
    page = "a/b/page.html"
    assert broken_links(tmp_path) == [
        f"{page}: ../picture.png: no such file",
        f"{page}: #here: no such anchor",
        f"{page}: ../../_modules/own.html#g: no such anchor",
        f"{page}: ../../../out.html: no such file",
    ]
    (tmp_path / "index.html").write_text("<h1>T</h1>")
    assert f"{page}: ../../#top: no such anchor" in broken_links(tmp_path)


def test_the_explorers_pages_are_those_of_the_commands_in_the_documentation() -> None:
    text = (REPOSITORY / "docs" / "explorer.md").read_text(encoding="utf-8")
    for name, fronts in EXAMPLES.items():
        assert f'href="_static/{name}"' in text
        assert f"mo-deepdrive explore {' '.join(fronts)} --output explore.html\n" in text
    assert "/docs/_static/explore_*.html" in (REPOSITORY / ".gitignore").read_text(encoding="utf-8").split()
    assert all(name.startswith("explore_") for name in EXAMPLES)
