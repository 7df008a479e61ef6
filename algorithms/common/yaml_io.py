"""Reading YAML as people write it: 3e-4 is a number, and a duplicated key is an error."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

# YAML 1.1, which PyYAML follows, wants a dot and a signed exponent; everybody writes 3e-4 and 1e6.
_FLOAT = re.compile(
    r"""^(?:[-+]?[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?
    |[-+]?\.[0-9][0-9_]*(?:[eE][-+]?[0-9]+)?
    |[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+
    |[-+]?\.(?:inf|Inf|INF)
    |\.(?:nan|NaN|NAN))$""",
    re.VERBOSE,
)


class _Loader(yaml.SafeLoader):
    """The safe loader, with floats as above and duplicated keys refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: dict[Any, int] = {}
        for key_node, _ in node.value:
            key = key_node.value
            line = key_node.start_mark.line + 1
            if key in seen and key != "<<":
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is duplicated, in lines {seen[key]} and {line}"
                )
            if isinstance(key, str):
                seen[key] = line
        return super().construct_mapping(node, deep)


class _ArgumentLoader(_Loader):
    """For values on a command line, where sweep agents write Python's ``None`` for null."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:float"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))
_ArgumentLoader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile("^None$"), ["N"])


def read_mapping(path: str | Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises:
        ValueError: naming the file and what is wrong with it: missing, unreadable, not YAML, not a mapping, a
            duplicated key.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ValueError(f"config file {str(path)!r} does not exist") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"config file {str(path)!r} cannot be read: {error}") from None
    try:
        values = yaml.load(text, _Loader)
    except RecursionError:
        raise ValueError(f"config file {str(path)!r} is nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"config file {str(path)!r} is not valid YAML: {_one_line(error)}") from None
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        what = "is empty" if values is None else f"holds a {type(values).__name__}"
        raise ValueError(f"config file {str(path)!r} {what}; it must be a mapping of sections")
    return values


def read_value(text: str) -> Any:
    """A value written on a command line: a YAML scalar, list or mapping; ``None`` means null.

    Raises:
        ValueError: if it is not valid YAML.
    """
    try:
        return yaml.load(text, _ArgumentLoader)
    except RecursionError:
        raise ValueError(f"a value of {len(text):,} characters is nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{text!r} is not a valid value: {_one_line(error)}") from None


def dump(values: dict[str, Any]) -> str:
    """``values`` as YAML text that :func:`read_mapping` reads back equal."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


class _Dumper(yaml.SafeDumper):
    """Quotes strings that the loader above would read as numbers; writes lists in one line."""

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        del flow_style
        return super().represent_sequence(tag, sequence, flow_style=True)


_Dumper.yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
