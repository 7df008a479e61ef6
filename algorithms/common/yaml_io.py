"""Reading YAML as people write it: 3e-4 is a number, and a duplicated key is an error.

Files may come from others: what is nested too deeply, refers to itself or expands to more than a file of settings ever
holds is refused before it is built, as are keys that are not strings and integers of more than 64 bits.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from mo_deepdrive.atomic_io import DEEPEST

MOST_VALUES = 100_000  # of a file, after its aliases are expanded
LARGEST = 2**63 - 1  # integer

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
    """The safe loader, with numbers as above; keys are strings, none is duplicated, and all is of a sensible size."""

    def construct_document(self, node: yaml.Node) -> Any:
        _measure(node, {})
        return super().construct_document(node)

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

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        value = int(super().construct_yaml_int(node))
        if abs(value) > LARGEST:
            raise _refused(f"the integer in line {node.start_mark.line + 1} has more than 64 bits")
        return value


def _refused(problem: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, problem)


def _measure(node: yaml.Node, known: dict[yaml.Node, tuple[int, int]], depth: int = 0) -> tuple[int, int]:
    """The number of values in a node with its aliases expanded, and how deep they are; ``known`` has those measured.

    Raises:
        yaml.YAMLError: if there are too many, too deep in each other or without end.
    """
    if node not in known:
        inner = [] if isinstance(node, yaml.ScalarNode) else node.value
        if isinstance(node, yaml.MappingNode):
            inner = [each for pair in inner for each in pair]
        # Deeper than this in itself, by an alias, is without end.
        measured = [_measure(each, known, depth + 1) for each in inner if depth <= DEEPEST]
        known[node] = 1 + sum(count for count, _ in measured), 1 + max((deep for _, deep in measured), default=0)
    count, deep = known[node]
    if count > MOST_VALUES:
        raise _refused(f"it has more than {MOST_VALUES:,} values, with its aliases expanded")
    if depth + deep > DEEPEST:
        raise _refused(f"it is nested too deeply: more than {DEEPEST} mappings and lists in each other, or in itself")
    return count, deep


class _ArgumentLoader(_Loader):
    """For values on a command line, where sweep agents write Python's ``None`` for null."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in (INTEGER, FLOAT)]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_constructor(INTEGER, _Loader.construct_yaml_int)
_Loader.add_implicit_resolver(INTEGER, _INTEGER, list("-+0123456789"))
_Loader.add_implicit_resolver(FLOAT, _FLOAT, list("-+0123456789."))
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
    except (yaml.YAMLError, *_OF_TAGS) as error:
        raise ValueError(f"config file {str(path)!r} is not valid YAML: {_one_line(error)}") from None
    if not isinstance(values, dict):
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
    except (yaml.YAMLError, *_OF_TAGS) as error:
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
    what = "" if isinstance(error, (yaml.YAMLError, ValueError)) else f"{type(error).__name__}: "
    return what + " ".join(str(error).split())
