"""Peers: algorithms of other libraries, trained and evaluated on any MO-Gymnasium environment like our own.

:data:`PEERS` lists them. The adapter of a peer trains it on :class:`algorithms.peers.peer_env.PeerEnv` and returns
:class:`algorithms.peers.peer_task.PeerPolicies`; :mod:`algorithms.peers.running` makes it a run like those of our own
algorithms. The libraries are only imported when a peer is trained: ``pip install "mo-deepdrive[peers]"``.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from algorithms.peers import morl, sb3
from algorithms.peers.peer_task import PeerConfig, PeerPolicies, PeerTask, ScalarConfig, WeightedConfig
from mo_deepdrive.support.extras import MissingExtraError, needed_for

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["PEERS", "Peer", "PeerConfig", "PeerPolicies", "PeerTask", "ScalarConfig", "WeightedConfig"]

DISCRETE, CONTINUOUS = "discrete", "continuous"


@dataclass(frozen=True)
class Peer:
    """An algorithm of another library.

    Attributes:
        path: "module:class" of its implementation.
        package: that has to be installed.
        known_utility: whether it learns one policy for a known utility, or else a front.
        actions: kinds of actions that it supports.
        adapter: trains it and returns its policies.
        Config: class of its settings.
        objectives: minimum and maximum number of objectives that it supports; None for any.
        parallel: whether it trains in several environments at a time.
    """

    path: str
    package: str
    known_utility: bool
    actions: tuple[str, ...]
    adapter: Callable[[PeerTask], PeerPolicies]
    Config: type[PeerConfig] = PeerConfig
    objectives: tuple[int, int] | None = None
    parallel: bool = False

    def unavailable_reason(self) -> str | None:
        """Why it cannot run here, which is the error of its import; None if it can."""
        module, _, name = self.path.partition(":")
        try:
            with needed_for("it"):
                getattr(importlib.import_module(module), name)
        except MissingExtraError as error:
            return str(error)
        except Exception as error:  # other libraries may raise anything on import
            return f"{type(error).__name__}: {error}"
        return None

    def check(self, name: str, task: PeerTask) -> None:
        """Check that the peer supports a task.

        Args:
            name: of the peer, for error messages.
            task: environment, utility and settings.

        Raises:
            ValueError: naming what the peer does not support.
        """
        env, d = task.env, len(task.objectives)
        if env.vehicles != 1:
            raise ValueError(f"algorithm {name!r} supports one vehicle; the environment has {env.vehicles}")
        kind = CONTINUOUS if env.continuous else DISCRETE
        if kind not in self.actions:
            raise ValueError(
                f"algorithm {name!r} supports {self.actions[0]} actions; the environment has {kind} actions"
            )
        if self.objectives is not None and not self.objectives[0] <= d <= self.objectives[1]:
            least, most = self.objectives
            raise ValueError(f"algorithm {name!r} supports {least} to {most} objectives; the environment has {d}")
        if self.known_utility and task.utility is None:
            raise ValueError(f"algorithm {name!r} needs a known utility; set one in the section 'utility'")
        if not self.known_utility and task.utility is not None:
            raise ValueError(f"algorithm {name!r} learns a front; remove the section 'utility'")
        if task.num_envs > 1 and not self.parallel:
            raise ValueError(f"training.num_envs = {task.num_envs} must be 1: algorithm {name!r} has one environment")


def _morl(
    path: str,
    adapter: Callable[[PeerTask], PeerPolicies],
    *actions: str,
    known_utility: bool = False,
    config: type[PeerConfig] = PeerConfig,
    objectives: tuple[int, int] | None = None,
    parallel: bool = False,
) -> Peer:
    path = f"morl_baselines.{path}"
    return Peer(path, "morl-baselines", known_utility, actions, adapter, config, objectives, parallel)


def _sb3(path: str, adapter: Callable[[PeerTask], PeerPolicies]) -> Peer:
    actions = DISCRETE, CONTINUOUS
    return Peer(f"stable_baselines3.{path}", "stable-baselines3", True, actions, adapter, ScalarConfig, parallel=True)


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
    "morl_baselines.pgmorl": _morl(
        "multi_policy.pgmorl.pgmorl:PGMORL", morl.pgmorl, CONTINUOUS, objectives=(2, 3), parallel=True
    ),
    "morl_baselines.ipro": _morl("multi_policy.ipro.ipro:IPRO", morl.ipro, DISCRETE, parallel=True),
    "morl_baselines.eupg": _morl("single_policy.esr.eupg:EUPG", morl.eupg, DISCRETE, known_utility=True),
    "morl_baselines.nl_mo_ppo": _morl(
        "single_policy.ser.nl_mo_ppo:NLMOPPO", morl.nl_mo_ppo, DISCRETE, known_utility=True, parallel=True
    ),
    "stable_baselines3.a2c": _sb3("a2c.a2c:A2C", sb3.a2c),
    "stable_baselines3.ppo": _sb3("ppo.ppo:PPO", sb3.ppo),
}
