"""Peers: algorithms of other libraries, trained and evaluated on any MO-Gymnasium environment like our own.

:data:`PEERS` lists them. The adapter of a peer trains it on :class:`algorithms.peers.peer_env.PeerEnv` and returns
:class:`algorithms.peers.peer_task.PeerPolicies`; :mod:`algorithms.peers.running` makes it a run like those of our own
algorithms. The libraries are only imported when a peer is trained: ``pip install "mo-deepdrive[peers]"``.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

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
        adapter: of its library: trains the class on a task and returns its policies.
        actions: kinds of actions that it supports.
        package: that has to be installed.
        known_utility: whether it learns one policy for a known utility, or else a front.
        Config: class of its settings.
        objectives: minimum and maximum number of objectives that it supports; None for any.
        parallel: whether it trains in several environments at a time.
    """

    path: str
    adapter: Callable[[PeerTask, Any], PeerPolicies]
    actions: tuple[str, ...]
    package: str
    known_utility: bool = False
    Config: type[PeerConfig] = PeerConfig
    objectives: tuple[int, int] | None = None
    parallel: bool = False

    def unavailable_reason(self) -> str | None:
        """Why it cannot run here, which is the error of its import; None if it can."""
        try:
            with needed_for("it"):
                self._algorithm()
        except MissingExtraError as error:
            return str(error)
        except Exception as error:  # other libraries may raise anything on import
            return f"{type(error).__name__}: {error}"
        return None

    def _algorithm(self) -> Any:
        module, _, name = self.path.partition(":")
        return getattr(importlib.import_module(module), name)

    def train(self, task: PeerTask) -> PeerPolicies:
        """The policies that it learns on a task which :meth:`check` takes."""
        return self.adapter(task, self._algorithm())

    def check(self, name: str, task: PeerTask) -> None:
        """Check that the peer supports a task.

        Args:
            name: of the peer, for error messages.
            task: environment, utility and settings.
        """
        env, d = task.env, len(task.env.objectives)
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
        if env.num_envs > 1 and not self.parallel:
            raise ValueError(f"training.num_envs = {env.num_envs} must be 1: algorithm {name!r} has one environment")


BOTH = (DISCRETE, CONTINUOUS)
_morl = partial(Peer, package="morl-baselines")
_weighted = partial(_morl, Config=WeightedConfig)
_sb3 = partial(
    Peer,
    adapter=sb3.train,
    actions=BOTH,
    package="stable-baselines3",
    known_utility=True,
    Config=ScalarConfig,
    parallel=True,
)

PEERS: dict[str, Peer] = {
    "morl_baselines.pcn": _morl("morl_baselines.multi_policy.pcn.pcn:PCN", morl.conditioned_on_returns, BOTH),
    "morl_baselines.lcn": _morl("morl_baselines.multi_policy.lcn.lcn:LCN", morl.conditioned_on_returns, BOTH),
    "morl_baselines.envelope": _weighted(
        "morl_baselines.multi_policy.envelope.envelope:Envelope", morl.envelope, (DISCRETE,)
    ),
    "morl_baselines.gpi_ls": _weighted("morl_baselines.multi_policy.gpi_pd.gpi_pd:GPILS", morl.gpi_ls, (DISCRETE,)),
    "morl_baselines.gpi_ls_continuous": _weighted(
        "morl_baselines.multi_policy.gpi_pd.gpi_pd_continuous_action:GPILSContinuousAction", morl.gpi_ls, (CONTINUOUS,)
    ),
    "morl_baselines.capql": _weighted("morl_baselines.multi_policy.capql.capql:CAPQL", morl.capql, (CONTINUOUS,)),
    "morl_baselines.morld": _morl("morl_baselines.multi_policy.morld.morld:MORLD", morl.morld, BOTH),
    "morl_baselines.pgmorl": _morl(
        "morl_baselines.multi_policy.pgmorl.pgmorl:PGMORL", morl.pgmorl, (CONTINUOUS,), objectives=(2, 3), parallel=True
    ),
    "morl_baselines.ipro": _morl("morl_baselines.multi_policy.ipro.ipro:IPRO", morl.ipro, (DISCRETE,), parallel=True),
    "morl_baselines.eupg": _morl(
        "morl_baselines.single_policy.esr.eupg:EUPG", morl.eupg, (DISCRETE,), known_utility=True
    ),
    "morl_baselines.nl_mo_ppo": _morl(
        "morl_baselines.single_policy.ser.nl_mo_ppo:NLMOPPO",
        morl.nl_mo_ppo,
        (DISCRETE,),
        known_utility=True,
        parallel=True,
    ),
    "stable_baselines3.a2c": _sb3("stable_baselines3.a2c.a2c:A2C"),
    "stable_baselines3.ppo": _sb3("stable_baselines3.ppo.ppo:PPO"),
}
