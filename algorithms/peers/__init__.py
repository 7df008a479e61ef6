"""Peers: algorithms of other libraries, trained and evaluated on any MO-Gymnasium environment like our own.

:data:`PEERS` lists them. The adapter of a peer trains it on :class:`algorithms.peers.peer_task.PeerEnv` and returns
:class:`algorithms.peers.peer_task.PeerPolicies`; :mod:`algorithms.peers.running` makes it a run like those of our own
algorithms. The libraries are only imported when a peer is trained: ``pip install --editable ".[peers]"``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from algorithms.peers import adapters
from algorithms.peers.peer_task import PeerConfig, PeerPolicies, PeerTask, ScalarConfig, WeightedConfig
from mo_deepdrive.support.extras import MissingExtraError, needed_for

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["PEERS", "Peer", "PeerConfig", "PeerPolicies", "PeerTask", "ScalarConfig", "WeightedConfig"]

DISCRETE, CONTINUOUS = "discrete", "continuous"


@dataclass(frozen=True)
class Peer:
    """An algorithm of another library."""

    path: str  # "module:class" of its implementation
    adapter: Callable[[PeerTask, Any], PeerPolicies]  # trains the class on a task
    actions: tuple[str, ...]  # kinds that it supports
    package: str  # that has to be installed
    known_utility: bool = False  # whether it learns one policy for a known utility, or else a front
    Config: type[PeerConfig] = PeerConfig
    objectives: tuple[int, int] | None = None  # least and greatest number that it supports; None for any
    parallel: bool = False  # whether it trains in several environments at a time

    def unavailable_reason(self) -> str | None:
        """Why it cannot run here, which is the error of its import; None if it can."""
        try:
            with needed_for("it"):
                resolve_name(self.path)
        except MissingExtraError as error:
            return str(error)
        except Exception as error:  # other libraries may raise anything on import
            return f"{type(error).__name__}: {error}"
        return None

    def check(self, name: str, task: PeerTask) -> None:
        """Check that the peer of this name supports a task."""
        env, d, known = task.env, len(task.env.objectives), task.utility is not None
        kind, (least, most) = CONTINUOUS if env.continuous else DISCRETE, self.objectives or (d, d)
        for fits, reason in (
            (env.vehicles == 1, f"supports one vehicle; the environment has {env.vehicles}"),
            (kind in self.actions, f"supports {self.actions[0]} actions; the environment has {kind} actions"),
            (least <= d <= most, f"supports {least} to {most} objectives; the environment has {d}"),
            (known or not self.known_utility, "needs a known utility; set one in the section 'utility'"),
            (self.known_utility or not known, "learns a front; remove the section 'utility'"),
            (env.num_envs == 1 or self.parallel, f"has one environment: training.num_envs = {env.num_envs} must be 1"),
        ):
            if not fits:
                raise ValueError(f"algorithm {name!r} {reason}")

    def train(self, task: PeerTask) -> PeerPolicies:
        """The policies that it learns on a task which :meth:`check` takes."""
        return self.adapter(task, resolve_name(self.path))


BOTH = (DISCRETE, CONTINUOUS)


def _morl(path: str, adapter: Any, actions: tuple[str, ...], **options: Any) -> Peer:
    return Peer(f"morl_baselines.{path}", adapter, actions, "morl-baselines", **options)


_weighted = partial(_morl, Config=WeightedConfig)


def _sb3(path: str) -> Peer:
    options: dict[str, Any] = {"known_utility": True, "Config": ScalarConfig, "parallel": True}
    return Peer(f"stable_baselines3.{path}", adapters.scalar, BOTH, "stable-baselines3", **options)


PEERS: dict[str, Peer] = {
    "morl_baselines.pcn": _morl("multi_policy.pcn.pcn:PCN", adapters.conditioned_on_returns, BOTH),
    "morl_baselines.lcn": _morl("multi_policy.lcn.lcn:LCN", adapters.conditioned_on_returns, BOTH),
    "morl_baselines.envelope": _weighted("multi_policy.envelope.envelope:Envelope", adapters.envelope, (DISCRETE,)),
    "morl_baselines.gpi_ls": _weighted("multi_policy.gpi_pd.gpi_pd:GPILS", adapters.gpi_ls, (DISCRETE,)),
    "morl_baselines.gpi_ls_continuous": _weighted(
        "multi_policy.gpi_pd.gpi_pd_continuous_action:GPILSContinuousAction", adapters.gpi_ls, (CONTINUOUS,)
    ),
    "morl_baselines.capql": _weighted("multi_policy.capql.capql:CAPQL", adapters.capql, (CONTINUOUS,)),
    "morl_baselines.morld": _morl("multi_policy.morld.morld:MORLD", adapters.morld, BOTH),
    "morl_baselines.pgmorl": _morl(
        "multi_policy.pgmorl.pgmorl:PGMORL", adapters.pgmorl, (CONTINUOUS,), objectives=(2, 3), parallel=True
    ),
    "morl_baselines.ipro": _morl("multi_policy.ipro.ipro:IPRO", adapters.ipro, (DISCRETE,), parallel=True),
    "morl_baselines.eupg": _morl("single_policy.esr.eupg:EUPG", adapters.eupg, (DISCRETE,), known_utility=True),
    "morl_baselines.nl_mo_ppo": _morl(
        "single_policy.ser.nl_mo_ppo:NLMOPPO", adapters.nl_mo_ppo, (DISCRETE,), known_utility=True, parallel=True
    ),
    "stable_baselines3.a2c": _sb3("a2c.a2c:A2C"),
    "stable_baselines3.ppo": _sb3("ppo.ppo:PPO"),
}
