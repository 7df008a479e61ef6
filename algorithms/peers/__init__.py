"""Other libraries' algorithms by name, on our environments and any other of MO-Gymnasium's.

A peer is a row of :data:`PEERS`. Its adapter trains it on one environment in the form of `algorithms.peers.environment`
and gives back policies in that of `algorithms.peers.task`; `algorithms.peers.running` makes a run of it, like one of
our own algorithms. The libraries are imported when a peer trains: ``pip install "mo-deepdrive[peers]"``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from algorithms.peers import morl, sb3
from algorithms.peers.task import PeerConfig, Policies, ScalarConfig, Task, WeightedConfig

__all__ = ["PEERS", "Peer", "PeerConfig", "Policies", "ScalarConfig", "Task", "WeightedConfig"]

DISCRETE, CONTINUOUS = "discrete", "continuous"


@dataclass(frozen=True)
class Peer:
    """An algorithm of another library.

    Attributes:
        path: "module:class" where it is.
        package: what to install for it.
        known_utility: whether it learns for a utility that it is given, or a front for every utility.
        actions: the kinds of action that it takes.
        adapter: trains it and gives its policies.
        Config: its settings.
        objectives: least and greatest number of objectives that it takes; None for any.
    """

    path: str
    package: str
    known_utility: bool
    actions: tuple[str, ...]
    adapter: Callable[[Task], Policies]
    Config: type[PeerConfig] = PeerConfig
    objectives: tuple[int, int] | None = None

    def obstacle(self) -> str | None:
        """Why it cannot run in this Python, as the import says; None where it can."""
        module, _, name = self.path.partition(":")
        try:
            getattr(importlib.import_module(module), name)
        except Exception as error:  # whatever a foreign library raises when it is imported
            return f"{type(error).__name__}: {error}"
        return None

    def check(self, name: str, task: Task) -> None:
        """Whether it fits what it is to learn.

        Args:
            name: its own, for the message.
            task: the environment, the utility and the settings.

        Raises:
            ValueError: saying what it needs.
        """
        worlds, d = task.env, len(task.objectives)
        if worlds.vehicles != 1:
            raise ValueError(f"algorithm {name!r} drives one vehicle; the environment has {worlds.vehicles}")
        kind = CONTINUOUS if worlds.continuous else DISCRETE
        if kind not in self.actions:
            raise ValueError(f"algorithm {name!r} takes {self.actions[0]} actions; the environment has {kind} ones")
        if self.objectives is not None and not self.objectives[0] <= d <= self.objectives[1]:
            least, most = self.objectives
            raise ValueError(f"algorithm {name!r} takes {least} to {most} objectives; the environment has {d}")
        if self.known_utility and task.utility is None:
            raise ValueError(f"algorithm {name!r} learns for a known utility; give one in the section 'utility'")
        if not self.known_utility and task.utility is not None:
            raise ValueError(f"algorithm {name!r} learns a front; it takes no utility")


def _morl(
    path: str,
    adapter: Callable[[Task], Policies],
    *actions: str,
    known_utility: bool = False,
    config: type[PeerConfig] = PeerConfig,
    objectives: tuple[int, int] | None = None,
) -> Peer:
    return Peer(f"morl_baselines.{path}", "morl-baselines", known_utility, actions, adapter, config, objectives)


def _sb3(path: str, adapter: Callable[[Task], Policies]) -> Peer:
    return Peer(f"stable_baselines3.{path}", "stable-baselines3", True, (DISCRETE, CONTINUOUS), adapter, ScalarConfig)


PEERS: dict[str, Peer] = {
    "morl_baselines.pcn": _morl("multi_policy.pcn.pcn:PCN", morl.pcn, DISCRETE, CONTINUOUS),
    "morl_baselines.lcn": _morl("multi_policy.lcn.lcn:LCN", morl.lcn, DISCRETE, CONTINUOUS),
    "morl_baselines.envelope": _morl(
        "multi_policy.envelope.envelope:Envelope", morl.envelope, DISCRETE, config=WeightedConfig
    ),
    "morl_baselines.gpi_ls": _morl("multi_policy.gpi_pd.gpi_pd:GPILS", morl.gpi_ls, DISCRETE, config=WeightedConfig),
    "morl_baselines.gpi_ls_continuous": _morl(
        "multi_policy.gpi_pd.gpi_pd_continuous_action:GPILSContinuousAction",
        morl.gpi_ls_continuous,
        CONTINUOUS,
        config=WeightedConfig,
    ),
    "morl_baselines.capql": _morl("multi_policy.capql.capql:CAPQL", morl.capql, CONTINUOUS, config=WeightedConfig),
    "morl_baselines.morld": _morl("multi_policy.morld.morld:MORLD", morl.morld, DISCRETE, CONTINUOUS),
    "morl_baselines.pgmorl": _morl("multi_policy.pgmorl.pgmorl:PGMORL", morl.pgmorl, CONTINUOUS, objectives=(2, 3)),
    "morl_baselines.ipro": _morl("multi_policy.ipro.ipro:IPRO", morl.ipro, DISCRETE),
    "morl_baselines.eupg": _morl("single_policy.esr.eupg:EUPG", morl.eupg, DISCRETE, known_utility=True),
    "morl_baselines.nl_mo_ppo": _morl(
        "single_policy.ser.nl_mo_ppo:NLMOPPO", morl.nl_mo_ppo, DISCRETE, known_utility=True
    ),
    "stable_baselines3.a2c": _sb3("a2c.a2c:A2C", sb3.a2c),
    "stable_baselines3.ppo": _sb3("ppo.ppo:PPO", sb3.ppo),
}
