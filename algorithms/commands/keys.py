"""List the keys of YAML files: type, default and what they do.

    mo-deepdrive keys                                          # of every algorithm, of sweeps and studies
    mo-deepdrive keys --algorithm mo_ppo                       # of an experiment with this algorithm
    mo-deepdrive keys --config one_waypoint/mo_ppo_nonlinear   # and what the file sets

On the command line of train every key of an experiment is an option: --section.key=value.
"""

from __future__ import annotations

import json
import re
import textwrap
from typing import TYPE_CHECKING, Any, NamedTuple, get_args, get_origin

from pydantic import BaseModel

from algorithms import ALGORITHMS
from algorithms.runs import cli
from algorithms.runs.config import (
    Experiment,
    agent_class,
    find_algorithm,
    find_environment,
    is_peer,
    load_experiment,
)
from algorithms.runs.run_directory import entry_in
from algorithms.studies.settings import Learner, Study, StudyTask, SweepSettings
from mo_deepdrive.world.config import EnvConfig, is_ours

if TYPE_CHECKING:
    from collections.abc import Mapping

_TYPES = {"integer": "int", "number": "float", "boolean": "bool", "string": "str", "object": "mapping"}
_BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
_OTHERS: dict[str, type[BaseModel]] = {
    "sweep": SweepSettings,
    "study": Study,
    "task of a study": StudyTask,
    "learner of a study": Learner,
}


class Key(NamedTuple):
    """A key of a YAML file."""

    name: str  # dotted path; a part in capitals stands for any name
    type: str  # as text, such as "float > 0"; "section" where the keys below it follow
    default: str  # in JSON; "required" if there is none, and empty for a section whose keys have defaults
    description: str  # a line; empty if the settings model has none


def experiment_keys(algorithm: str, env_id: str | None = None) -> list[Key]:
    """The keys of an experiment with an algorithm, in an environment; None stands for this package's environments."""
    ours = env_id is None or is_ours(find_environment(env_id))
    keys: list[Key] = []
    for key in model_keys(Experiment):
        if key.name == "algorithm.config":  # in the same section as the name
            keys += model_keys(find_algorithm(algorithm).Config, "algorithm.")
            continue
        keys.append(key)
        if key.name == "environment.arguments" and ours:
            # The id chooses the scenario.
            keys += [inner for inner in model_keys(EnvConfig, f"{key.name}.") if not inner.name.endswith(".scenario")]
    return keys


def model_keys(model: type[BaseModel], prefix: str = "") -> list[Key]:
    """The keys that a settings model reads, each section followed by the keys in it; ``prefix`` precedes the names."""
    schema = model.model_json_schema()
    keys: list[Key] = []
    for name, field in model.model_fields.items():
        inner = _section(field.annotation)
        value = field.get_default(call_default_factory=True)
        default = "required" if field.is_required() else "" if isinstance(value, BaseModel) else json.dumps(value)
        kind = _type_text(schema["properties"][name]) if inner is None else "section"
        keys.append(Key(prefix + name, kind, default, _description(model, name)))
        if inner is not None:
            keys += model_keys(inner[1], f"{prefix}{name}.{inner[0]}")
    return keys


def _description(model: type[BaseModel], name: str) -> str:
    """A field in a line, without markup and with YAML's name of None; as a base describes it, if the model does not."""
    fields = (base.model_fields.get(name) for base in model.__mro__ if issubclass(base, BaseModel))
    text = next((field.description for field in fields if field and field.description), "")
    text = re.sub(r":\w+:`~?([^`]+)`", r"\1", " ".join(text.split())).replace("``", "")
    return re.sub(r"\bNone\b", "null", text)


def _section(annotation: Any) -> tuple[str, type[BaseModel]] | None:
    """The settings model in an annotation, and what comes before its keys: ``NAME.`` in a mapping of them."""
    # In Python 3.10 list[int] is an instance of type, too.
    if get_origin(annotation) is None and isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "", annotation
    for section in filter(None, map(_section, get_args(annotation))):
        return ("NAME." if get_origin(annotation) is dict else "") + section[0], section[1]
    return None


def _type_text(schema: Mapping[str, Any]) -> str:
    """A type of a JSON schema in the words of Python's."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(map(_type_text, schema["anyOf"])))
    if "enum" in schema or "const" in schema:
        return " or ".join(json.dumps(value) for value in schema.get("enum", [schema.get("const")]))
    kind = schema.get("type")
    if kind == "array":
        return f"list of {_type_text(schema['items'])}" if schema.get("items") else "list"
    bounds = [f"{sign} {schema[bound]:.12g}" for bound, sign in _BOUNDS.items() if bound in schema]
    return f"{_TYPES.get(str(kind), str(kind or 'any'))} {', '.join(bounds)}".rstrip()


def list_keys(options: cli.Options) -> int:
    """Print the keys of one algorithm, of an experiment's, or of all, of sweeps and of studies."""
    from algorithms.runs.console import make_console, print_line

    values: dict[str, Any] = {}
    name, env_id = options.algorithm, None
    if options.config is not None:
        experiment = load_experiment(options.config)
        values, name, env_id = experiment.to_dict(), experiment.algorithm.name, experiment.environment.id
    elif name is not None:
        find_algorithm(name, "--algorithm")
    sections: dict[str, list[Key]] = {}
    for algorithm in [name] if name else sorted(ALGORITHMS):
        keys = experiment_keys(algorithm, env_id)
        of_algorithm = [key for key in keys if key.name.startswith("algorithm.") and key.name != "algorithm.name"]
        sections.setdefault("experiment", [key for key in keys if key not in of_algorithm])
        equations = "" if is_peer(algorithm) else f"; equations: help({agent_class(algorithm).__module__!r})"
        sections[f"hyperparameters of {algorithm}{equations}"] = of_algorithm
    if not name:
        sections |= {title: model_keys(model) for title, model in _OTHERS.items()}
    console = make_console()
    for title, keys in sections.items():
        console.print(f"{title}\n", style="bold", markup=False, highlight=False)
        for key in keys:
            default = {"": "", "required": ", required"}.get(key.default, f", default {key.default}")
            value = entry_in(values, *key.name.split("."), absent=...)
            has_keys = any(other.name.startswith(f"{key.name}.") for other in keys)
            set_here = value is not ... and not has_keys and json.dumps(value) != key.default
            here = f"; here {json.dumps(value)}" if set_here else ""
            lines = [f"{key.name}: {key.type}{default}{here}", *([f"    {key.description}"] if key.description else [])]
            for text in lines:
                wrapped = textwrap.fill(text, console.width, subsequent_indent="    ", break_on_hyphens=False)
                print_line(console, wrapped)
        console.print()
    return 0


ALGORITHM = cli.option("--algorithm", "NAME", "an algorithm, another library's, or your own: package.module:Class")
main = cli.Command("keys", __doc__, (cli.one_of(cli.CONFIG, ALGORITHM),), list_keys)
