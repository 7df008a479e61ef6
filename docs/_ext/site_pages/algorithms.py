"""The pages of the algorithms, from their module docstrings, Config classes and the shipped YAML files."""

from __future__ import annotations

import inspect
import sys
from typing import Any

from algorithms import ALGORITHMS, zoo
from algorithms.common.yaml_io import read_mapping
from algorithms.experiments.key_listing import model_keys
from algorithms.zoo import CONFIG
from site_pages.markdown import as_markdown, source_link, table
from site_pages.repository import REPOSITORY

UTILITY = {True: "known", False: "unknown: learns a front"}


def pages() -> dict[str, str]:
    """The text of every page by its path in docs."""
    return {"algorithms/index.md": index(), **{f"algorithms/{name}.md": page(name) for name in ALGORITHMS}}


def index() -> str:
    """The page that lists the algorithms."""
    rows = [
        [f"[{title(name)}]({name}.md)", f"`{name}`", UTILITY[bool(ALGORITHMS[name].known_utility)], summary(name)]
        for name in ALGORITHMS
    ]
    return (
        "# Algorithms\n\n"
        + table(["algorithm", "name in YAML", "utility", "what it is"], rows)
        + "\n```{include} ../_fragments/which_algorithm.md\n```\n"
        + "\n```{toctree}\n:hidden:\n\n"
        + "\n".join(ALGORITHMS)
        + "\n```\n"
    )


def page(name: str) -> str:
    """The page of one algorithm."""
    algorithm = ALGORITHMS[name]
    _, _, body = _docstring(algorithm).partition("\n")
    configs, policies = configs_of(name), policies_of(name)
    parts = [
        f"# {title(name)}",
        f"{summary(name)}",
        table(
            ["", ""],
            [
                ["name in YAML", f"`{name}`"],
                ["utility", UTILITY[bool(algorithm.known_utility)]],
                ["class", f"{{py:class}}`{algorithm.__module__}.{algorithm.__name__}`"],
                ["file", source_link(f"{algorithm.__module__.replace('.', '/')}.py")],
            ],
        ),
        "## Equations",
        as_markdown(body.strip()),
        "## Hyperparameters",
        f"Keys of the section `algorithm` in YAML, and fields of `{algorithm.Config.__name__}`.",
        hyperparameters(algorithm.Config),
        "## Configurations",
        "\n".join(f"- {source_link(path)}" for path in configs) or "None is shipped.",
        "## Trained policies",
        "\n".join(f"- `{policy}`" for policy in policies) or "None is in the zoo.",
    ]
    return "\n\n".join(parts) + "\n"


def _docstring(algorithm: type[Any]) -> str:
    return inspect.cleandoc(sys.modules[algorithm.__module__].__doc__ or "")


def title(name: str) -> str:
    """The name of an algorithm in titles: what its module's docstring begins with."""
    return _docstring(ALGORITHMS[name]).partition(":")[0]


def summary(name: str) -> str:
    """What an algorithm is: the rest of the first line of its module's docstring."""
    text = as_markdown(_docstring(ALGORITHMS[name]).partition("\n")[0].partition(":")[2].strip())
    return text[:1].upper() + text[1:]


def hyperparameters(config: type[Any]) -> str:
    """One row per field of a Config class."""
    rows = [[f"`{key.name}`", key.type, f"`{key.default}`", key.description] for key in model_keys(config)]
    return table(["key", "type", "default", "meaning"], rows)


def configs_of(name: str) -> list[str]:
    """The shipped YAML files that train an algorithm."""
    found = []
    for path in sorted((REPOSITORY / "configs").rglob("*.yaml")):
        algorithm = read_mapping(path).get("algorithm", {})
        if isinstance(algorithm, dict) and algorithm.get("name") == name:
            found.append(path.relative_to(REPOSITORY).as_posix())
    return found


def policies_of(name: str) -> list[str]:
    """The policies of the zoo that an algorithm has trained."""
    return [each for each in zoo.names() if read_mapping(zoo.find(each) / CONFIG)["algorithm"]["name"] == name]
