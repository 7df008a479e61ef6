"""Look up names of YAML files and command lines; what they refer to is imported when it is first used.

Algorithms are registered in ``algorithms/__init__.py``; a user's is named by its path, ``package.module:Class``.

Peers (other libraries' algorithms) and the zoo (trained policies) are layers above this one: they are found by their
dotted paths, so that an experiment can name them without importing them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from algorithms import ALGORITHMS
from mo_deepdrive.support.importing import import_named
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.config import Settings

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

# "module:attribute" of the table of other libraries' algorithms, the module that trains them, and "module:attribute" of
# the function that finds a trained policy.
PEER_TABLE = "algorithms.peers:PEERS"
PEER_RUNNING = "algorithms.peers.running"
FIND_TRAINED_POLICY = "algorithms.zoo:find"


@dataclass(frozen=True)
class AlgorithmEntry:
    """The properties of an algorithm that an experiment depends on."""

    name: str  # in YAML files
    known_utility: bool  # whether it learns for a utility that it is given, or a front for every utility
    config_class: type[Settings]  # of its hyperparameters
    is_peer: bool  # whether it is another library's, which the command peers trains


def algorithm_names() -> list[str]:
    """The names of this project's algorithms in alphabetical order; imports none of them."""
    return sorted(ALGORITHMS)


def find_algorithm(name: object, source: str = "algorithm.name") -> AlgorithmEntry:
    """The entry of an algorithm: this project's, another library's, or a user's; ``source`` is the key of its name."""
    if isinstance(name, str) and (name in ALGORITHMS or ":" in name):
        algorithm = agent_class(name)
        return AlgorithmEntry(name, bool(algorithm.known_utility), algorithm.Config, is_peer=False)
    peers: Mapping[str, Any] = resolve_name(PEER_TABLE)
    if not isinstance(name, str) or name not in peers:
        hint = nearest(name, [*ALGORITHMS, *peers])
        raise ValueError(f"{source} = {name!r} is unknown; {hint}; or package.module:Class")
    peer = peers[name]
    return AlgorithmEntry(name, bool(peer.known_utility), peer.Config, is_peer=True)


def agent_class(name: str) -> type[Any]:
    """The class of an algorithm, this project's or a user's."""
    if ":" in name:
        return _users_class(name)
    if name not in ALGORITHMS and find_algorithm(name).is_peer:
        raise ValueError(f"algorithm {name!r} is another library's; mo-deepdrive peers runs it")
    return ALGORITHMS[name]


def _users_class(path: str) -> type[Any]:
    from algorithms.agent import Agent, FrontAgent  # as late as this, because it imports torch

    algorithm, given = import_named("algorithm.name", path), f"algorithm.name = {path!r}"
    if not (isinstance(algorithm, type) and issubclass(algorithm, Agent)):
        raise ValueError(f"{given} must be a subclass of algorithms.Agent; it is {algorithm!r}")
    missing = {*algorithm.__abstractmethods__, *({"Config"} if not hasattr(algorithm, "Config") else ())}
    if missing:
        raise ValueError(f"{given} does not define {', '.join(sorted(missing))}")
    if not (algorithm.known_utility or issubclass(algorithm, FrontAgent)):
        raise ValueError(f"{given}: known_utility = False needs a subclass of algorithms.FrontAgent")
    if not (isinstance(algorithm.Config, type) and issubclass(algorithm.Config, Settings)):
        raise ValueError(f"{given}: Config = {algorithm.Config!r} must be a subclass of Settings")
    return algorithm


def peer_running() -> Any:
    """The module that trains other libraries' algorithms."""
    return resolve_name(PEER_RUNNING)


def directory_name(algorithm: str) -> str:
    """The name of an algorithm in names of directories: its name, or the class's where it is named by its path."""
    return algorithm.rpartition(":")[2]


def find_trained_policy(name: str) -> Path:
    """The directory of a policy of the zoo; a ValueError with the nearest name if there is none of this name."""
    directory: Path = resolve_name(FIND_TRAINED_POLICY)(name)
    return directory
