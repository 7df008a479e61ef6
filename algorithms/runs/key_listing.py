"""The keys of YAML files, from the settings models that read them: types, defaults and descriptions."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args, get_origin

from pydantic import BaseModel

from algorithms.runs.config import Experiment, find_environment, is_ours
from algorithms.runs.registry import find_algorithm
from mo_deepdrive.world.config import EnvConfig

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_TYPES = {"integer": "int", "number": "float", "boolean": "bool", "string": "str", "object": "mapping"}
_BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}


@dataclass(frozen=True)
class Key:
    """A key of a YAML file."""

    name: str  # dotted path; a part in capitals stands for any name
    type: str  # as text, such as "float > 0"; "section" where the keys below it follow
    default: str  # in JSON; "required" if there is none, and empty for a section whose keys have defaults
    description: str  # a line; empty if the settings model has none

    def text(self) -> str:
        """The key in a line and its description, if it has one, in another one."""
        default = {"": "", "required": ", required"}.get(self.default, f", default {self.default}")
        return f"{self.name}: {self.type}{default}" + (f"\n    {self.description}" if self.description else "")


def experiment_keys(algorithm: str, env_id: str | None = None) -> list[Key]:
    """The keys of an experiment with an algorithm, in an environment; None stands for this package's environments."""
    ours = env_id is None or is_ours(find_environment(env_id))
    hyperparameters = find_algorithm(algorithm).config_class
    keys: list[Key] = []
    for key in model_keys(Experiment):
        if key.name == "algorithm.config":  # in the same section as the name
            keys += model_keys(hyperparameters, "algorithm.")
            continue
        keys.append(key)
        if key.name == "environment.arguments" and ours:
            # The id chooses the scenario.
            keys += [inner for inner in model_keys(EnvConfig, f"{key.name}.") if not inner.name.endswith(".scenario")]
    return keys


def model_keys(model: type[BaseModel], prefix: str = "") -> list[Key]:
    """The keys that a settings model reads, each section followed by the keys in it.

    Args:
        model: its fields are described by the strings under them, or with ``Field(description=...)``.
        prefix: of the names.
    """
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
    for argument in get_args(annotation):
        section = _section(argument)
        if section is not None:
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


def differing_values(values: Mapping[str, Any], keys: Sequence[Key], prefix: str = "") -> dict[str, str]:
    """The values in nested sections that differ from the defaults of their keys, in JSON, by dotted name."""
    defaults = {key.name: key.default for key in keys}
    differing: dict[str, str] = {}
    for name, value in values.items():
        path = prefix + name
        if isinstance(value, dict) and any(known.startswith(f"{path}.") for known in defaults):
            differing |= differing_values(value, keys, f"{path}.")
        elif (text := json.dumps(value)) != defaults.get(path):
            differing[path] = text
    return differing
