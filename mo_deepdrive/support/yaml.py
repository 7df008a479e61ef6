"""Reading YAML as people write it: 3e-4 is a number, and a duplicated key is an error."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

LONGEST, LONGEST_SHOWN = 2**20, 200  # characters of a file or value, and of a value in a message

# YAML 1.1, which PyYAML follows, wants a dot and a signed exponent; everybody writes 3e-4 and 1e6.
# It also reads 010 as 8 and 1:30 as 90, which nobody means.
_INTEGER = re.compile(r"^(?:[-+]?(?:0|[1-9][0-9_]*)|[-+]?0x[0-9a-fA-F_]+|[-+]?0b[01_]+)$")
_FLOAT = re.compile(
    r"""^(?:[-+]?[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?
    |[-+]?\.[0-9][0-9_]*(?:[eE][-+]?[0-9]+)?
    |[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+
    |[-+]?\.(?:inf|Inf|INF)
    |\.(?:nan|NaN|NAN))$""",
    re.VERBOSE,
)


STRING, INTEGER, FLOAT, MERGE = (f"tag:yaml.org,2002:{name}" for name in ("str", "int", "float", "merge"))
# What PyYAML raises for values that do not fit their explicit tags, such as !!int ''.
_OF_TAGS = (ValueError, LookupError, AttributeError, TypeError)


class _Loader(yaml.SafeLoader):
    """The safe loader, with numbers as above; keys are strings, and none is duplicated."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: dict[str, int] = {}
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            line = key_node.start_mark.line + 1
            if key_node.tag == MERGE:
                continue
            if key_node.tag != STRING:
                raise _refused(f"the key in line {line} is not a string; write it in quotes")
            if key_node.value in seen:
                raise _refused(f"key {key_node.value!r} is duplicated, in lines {seen[key_node.value]} and {line}")
            seen[key_node.value] = line
        return super().construct_mapping(node, deep)


def _refused(problem: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, problem)


class _ArgumentLoader(_Loader):
    """For values on a command line, where sweep agents write Python's ``None`` for null."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in (INTEGER, FLOAT)]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(INTEGER, _INTEGER, list("-+0123456789"))
_Loader.add_implicit_resolver(FLOAT, _FLOAT, list("-+0123456789."))
_ArgumentLoader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile("^None$"), ["N"])


def read_mapping(path: str | Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    The ValueError names the file and what is wrong: missing, unreadable, not YAML, not a mapping, a duplicated key.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ValueError(f"config file {str(path)!r} does not exist") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"config file {str(path)!r} cannot be read: {error}") from None
    values = _parse(text, _Loader, f"config file {str(path)!r} is not valid YAML")
    if not isinstance(values, dict):
        what = "is empty" if values is None else f"holds a {type(values).__name__}"
        raise ValueError(f"config file {str(path)!r} {what}; it must be a mapping of sections")
    return values


def read_value(text: str) -> Any:
    """A value written on a command line, a YAML scalar, list or mapping; ``None`` means null."""
    shown = text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."
    return _parse(text, _ArgumentLoader, f"{shown!r} is not a valid value")


def dump(values: dict[str, Any]) -> str:
    """``values`` as YAML text that :func:`read_mapping` reads back equal."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


class _Dumper(yaml.SafeDumper):
    """Quotes strings that the loader above would read as numbers; writes lists in one line."""

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        del flow_style
        return super().represent_sequence(tag, sequence, flow_style=True)


_Dumper.yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers


def _parse(text: str, loader: type[_Loader], problem: str) -> Any:
    if len(text) > LONGEST:
        raise ValueError(f"{problem}: it has {len(text):,} characters, more than {LONGEST:,}")
    try:
        return yaml.load(text, loader)
    except RecursionError:
        raise ValueError(f"{problem}: it is nested too deeply") from None
    except (yaml.YAMLError, *_OF_TAGS) as error:
        kind = "" if isinstance(error, (yaml.YAMLError, ValueError)) else f"{type(error).__name__}: "
        raise ValueError(f"{problem}: {kind}{' '.join(str(error).split())}") from None
