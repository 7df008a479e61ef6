"""Algorithms for multi-objective reinforcement learning, for a known utility or for every utility.

``from mo_deepdrive.learners import MOA2C`` imports what it names and nothing else; the package itself imports no
algorithm. Its modules import one another as ``algorithms``, a name that many projects give to a folder of their own.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from algorithms.a2c import A2C
    from algorithms.actor_critic import ActorCritic
    from algorithms.agent import Agent, FrontAgent
    from algorithms.conditioned_mo_ppo import ConditionedMOPPO
    from algorithms.mappo import MAPPO
    from algorithms.mo_a2c import MOA2C
    from algorithms.mo_ppo import MOPPO
    from algorithms.mocac import MOCAC
    from algorithms.pcn import PCN
    from algorithms.ppo import PPO
    from algorithms.rulebook_ppo import RulebookPPO

__all__ = [
    "A2C",
    "ALGORITHMS",
    "MAPPO",
    "MOA2C",
    "MOCAC",
    "MOPPO",
    "PCN",
    "PPO",
    "ActorCritic",
    "Agent",
    "ConditionedMOPPO",
    "FrontAgent",
    "RulebookPPO",
]

# The classes of the algorithms, each by its name, which is also that of its module; and the module of their bases.
_CLASSES = {
    "a2c": "A2C",
    "ppo": "PPO",
    "mo_a2c": "MOA2C",
    "mo_ppo": "MOPPO",
    "rulebook_ppo": "RulebookPPO",
    "mocac": "MOCAC",
    "mappo": "MAPPO",
    "pcn": "PCN",
    "conditioned_mo_ppo": "ConditionedMOPPO",
}
_MODULES = {
    **{class_name: module for module, class_name in _CLASSES.items()},
    "ActorCritic": "actor_critic",
    "Agent": "agent",
    "FrontAgent": "agent",
}


def __getattr__(name: str) -> Any:
    """Import a class when it is first asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mo_deepdrive.support.extras import needed_for

    with needed_for(f"algorithms.{name}"):
        value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    return value


def __dir__() -> list[str]:
    """The public names, including classes that have not been imported yet."""
    return sorted({*globals(), *__all__})


class _LazyClasses(Mapping[str, type[Any]]):
    """The classes by the names of the algorithms, each imported when it is first asked for."""

    def __getitem__(self, name: str) -> type[Any]:
        loaded: type[Any] = __getattr__(_CLASSES[name])
        return loaded

    def __contains__(self, name: object) -> bool:
        return name in _CLASSES

    def __iter__(self) -> Iterator[str]:
        return iter(_CLASSES)

    def __len__(self) -> int:
        return len(_CLASSES)


ALGORITHMS: Mapping[str, type[Any]] = _LazyClasses()
