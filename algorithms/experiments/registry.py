"""Look up names of YAML files and command lines; what they refer to is imported when it is first used.

Algorithms are registered in ``algorithms/__init__.py``.

Peers (other libraries' algorithms) and the zoo (trained policies) are layers above this one: they are found by their
dotted paths, so that an experiment can name them without importing them.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from algorithms import ALGORITHMS
from mo_deepdrive.config import Settings, nearest

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

# "module:attribute" of the table of other libraries' algorithms, and of the function that finds a trained policy.
PEER_TABLE = "algorithms.peers:PEERS"
FIND_TRAINED_POLICY = "algorithms.zoo:find"


@dataclass(frozen=True)
class AlgorithmEntry:
    """The properties of an algorithm that an experiment depends on.

    Attributes:
        name: its name in YAML files.
        known_utility: whether it learns for a utility that it is given, or a front for every utility.
        config_class: the settings model of its hyperparameters.
        is_peer: whether it is another library's, which the command peers trains.
    """

    name: str
    known_utility: bool
    config_class: type[Settings]
    is_peer: bool


def import_object(path: str) -> Any:
    """The object that ``"module:attribute"`` names.

    Raises:
        ImportError: if the module cannot be imported.
        AttributeError: if it has no such attribute.
    """
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


def algorithm_names() -> list[str]:
    """The names of this project's algorithms in alphabetical order; imports none of them."""
    return sorted(ALGORITHMS)


def find_algorithm(name: object) -> AlgorithmEntry:
    """The entry of an algorithm, this project's or another library's.

    Raises:
        ValueError: if there is none of this name, with the nearest name.
    """
    if isinstance(name, str) and name in ALGORITHMS:
        algorithm = ALGORITHMS[name]
        return AlgorithmEntry(name, bool(algorithm.known_utility), algorithm.Config, is_peer=False)
    peers: Mapping[str, Any] = import_object(PEER_TABLE)
    if not isinstance(name, str) or name not in peers:
        raise ValueError(f"algorithm.name = {name!r} is unknown; {nearest(name, [*ALGORITHMS, *peers])}")
    peer = peers[name]
    return AlgorithmEntry(name, bool(peer.known_utility), peer.Config, is_peer=True)


def agent_class(name: str) -> type[Any]:
    """The class of one of this project's algorithms.

    Raises:
        ValueError: if it is another library's or unknown.
    """
    if find_algorithm(name).is_peer:
        raise ValueError(f"algorithm {name!r} is another library's; mo-deepdrive peers runs it")
    return ALGORITHMS[name]


def find_trained_policy(name: str) -> Path:
    """The directory of a policy of the zoo.

    Raises:
        ValueError: if there is none of this name, with the nearest name.
    """
    directory: Path = import_object(FIND_TRAINED_POLICY)(name)
    return directory
