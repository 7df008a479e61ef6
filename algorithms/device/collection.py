"""T steps of the worlds of all seeds as one rollout, and sums over the episodes that ended."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from algorithms.device.compiling import Compiled
from algorithms.files.checkpoints import strip_prefix
from mo_deepdrive.evaluation.metrics import LENGTH, SUCCESS, UTILITY, return_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from algorithms.device.worlds import SeedWorlds, WorldStep
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility

# Fields of a rollout with T + 1 steps.
WORLDS = "worlds."  # prefix of their part of a state
LONGER = ("observations", "accrued", "discounts")


class Collection:
    """Steps worlds and keeps what continues from one rollout to the next.

    Args:
        env: one with the shapes of the worlds.
        worlds: of S seeds.
        shape: S, T (the length of a rollout) and N.
        accrued_discount: g.
        utilities: one per vehicle; empty where none is known.
        device: of the tensors.
        compiled: whether ``torch.compile`` makes what follows a step of the worlds into few kernels.

    Attributes:
        rollout: the fields of :class:`algorithms.rollouts.buffers.Rollout` with an axis of seeds before the others,
            (S, T, N, V, ...), overwritten by the next rollout.
        running: (S, N, V, ...) observations, accrued rewards, discounts, returns and lengths of the running episodes.
        ended_values: (S, T, N, V, d) accrued rewards after each step.
        ended: (S, T, N, V) whether a vehicle's episode ended in it.
        cost_share: by which the rewards of costs are multiplied.
        totals: (S, V, d + 4) sums over the episodes that ended since :meth:`take_totals`: their number, utilities,
            successes, lengths and returns.
    """

    def __init__(
        self,
        env: EnvAdapter,
        worlds: SeedWorlds,
        shape: tuple[int, int, int],
        accrued_discount: float,
        utilities: Sequence[Utility],
        device: torch.device,
        *,
        compiled: bool,
    ):
        seeds, steps, num_envs = shape
        v, o, d = env.vehicles, env.observation_size, len(env.objectives)
        self.worlds, self.steps, self.objectives = worlds, steps, env.objectives
        self._accrued_discount, self._utilities = accrued_discount, list(utilities)
        kinds: dict[str, Any] = {"device": device}
        action_shape, action_type = ((env.actions,), torch.float32) if env.continuous else ((), torch.int64)
        shapes = {"observations": (v, o), "final": (v, o), "rewards": (v, d), "accrued": (v, d), "discounts": (v,)}
        self.rollout = {
            name: torch.zeros(seeds, steps + (name in LONGER), num_envs, *shape, **kinds)
            for name, shape in shapes.items()
        }
        for name in ("terminated", "truncated", "acted"):
            self.rollout[name] = torch.zeros(seeds, steps, num_envs, v, dtype=torch.bool, **kinds)
        self.rollout["actions"] = torch.zeros(seeds, steps, num_envs, v, *action_shape, dtype=action_type, **kinds)
        self.running = {
            "observations": torch.zeros(seeds, num_envs, v, o, **kinds),
            "accrued": torch.zeros(seeds, num_envs, v, d, **kinds),
            "discounts": torch.ones(seeds, num_envs, v, **kinds),
            "returns": torch.zeros(seeds, num_envs, v, d, dtype=torch.float64, **kinds),
            "lengths": torch.zeros(seeds, num_envs, v, dtype=torch.int64, **kinds),
        }
        self.ended = torch.zeros_like(self.rollout["acted"])
        self.ended_values = torch.zeros_like(self.rollout["rewards"])
        # After each step: successes, lengths and returns.
        self._after = torch.zeros(seeds, steps, num_envs, v, 2 + d, dtype=torch.float64, **kinds)
        self.cost_share = torch.ones((), **kinds)
        self._costs = torch.from_numpy(env.costs).to(device)
        self.totals = torch.zeros(seeds, v, d + 4, dtype=torch.float64, **kinds)
        self._keep = Compiled(self._keep_step, enabled=compiled)

    def reset(self) -> None:
        """Begin the first episodes."""
        self.running["observations"].copy_(self.worlds.reset())

    @torch.no_grad()
    def collect(self, act: Callable[[int, Mapping[str, torch.Tensor]], torch.Tensor]) -> None:
        """Run all worlds for T steps.

        Args:
            act: actions (S, N, V) or (S, N, V, k) of step t for :attr:`running`.
        """
        rollout, now = self.rollout, self.running
        shares = torch.where(self._costs, self.cost_share, 1.0)
        for t in range(self.steps + 1):
            for name in LONGER:
                rollout[name][:, t] = now[name]
            if t == self.steps:
                break
            actions = act(t, now)
            rollout["actions"][:, t] = actions
            kept = {name: rollout[name][:, t] for name in ("final", "terminated", "truncated", "acted", "rewards")}
            kept |= {"ended": self.ended[:, t], "ended_values": self.ended_values[:, t], "after": self._after[:, t]}
            self._keep(self.worlds.step(actions), shares, now, kept)
        self._add_episodes()

    def _keep_step(
        self, step: WorldStep, shares: torch.Tensor, now: dict[str, torch.Tensor], kept: dict[str, torch.Tensor]
    ) -> None:
        """Write a step of the worlds into its place in the rollout, and what runs on after it.

        Args:
            step: of the worlds.
            shares: (d,) by which rewards are multiplied.
            now: :attr:`running`, overwritten.
            kept: of a rollout's fields (S, N, V, ...), and of "ended", "ended_values" and "after"; overwritten.
        """
        learnt = step.rewards * shares
        ended = (step.terminated | step.truncated) & step.acted
        accrued = now["accrued"] + now["discounts"].unsqueeze(-1) * learnt
        returns, lengths = now["returns"] + step.rewards, now["lengths"] + 1
        for name in ("final", "terminated", "truncated", "acted"):
            kept[name].copy_(getattr(step, name))
        for name, tensor in (("rewards", learnt), ("ended", ended), ("ended_values", accrued)):
            kept[name].copy_(tensor)
        kept["after"].copy_(torch.cat([torch.stack([step.succeeded, lengths], dim=-1), returns], dim=-1))
        # Who did not act has no episode under way.
        begins = ended | ~step.acted
        now["observations"].copy_(step.observations)
        now["accrued"].copy_(accrued.masked_fill(begins.unsqueeze(-1), 0.0))
        now["discounts"].mul_(self._accrued_discount).masked_fill_(begins, 1.0)
        now["returns"].copy_(returns.masked_fill(begins.unsqueeze(-1), 0.0))
        now["lengths"].copy_(lengths.masked_fill(begins, 0))

    def _add_episodes(self) -> None:
        returns = self._after[..., 2:]
        utilities = [u(returns[..., v, :]) for v, u in enumerate(self._utilities)]
        utility = torch.stack(utilities, dim=-1) if utilities else torch.zeros_like(returns[..., 0])
        counted = [torch.ones_like(utility), utility]
        episodes = torch.cat([torch.stack(counted, dim=-1), self._after], dim=-1)
        self.totals += episodes.masked_fill(~self.ended.unsqueeze(-1), 0.0).sum((1, 2))

    def take_totals(self) -> list[list[dict[str, float]]]:
        """Means over the episodes that ended since the last call, of every seed and vehicle; without any, empty."""
        found = self.totals.tolist()
        self.totals.zero_()
        return [[self._means(*numbers) for numbers in vehicles] for vehicles in found]

    def _means(self, count: float, *sums: float) -> dict[str, float]:
        names = (UTILITY, SUCCESS, LENGTH, *map(return_of, self.objectives))
        means = {name: each / count for name, each in zip(names, sums, strict=True)} if count else {}
        return means if self._utilities else {name: each for name, each in means.items() if name != UTILITY}

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def get_state(self, seed: int) -> dict[str, torch.Tensor]:
        """What continues from one rollout to the next of the seed with this index, the worlds included."""
        state = {name: tensor[seed] for name, tensor in self.running.items()}
        state |= {f"{WORLDS}{name}": tensor for name, tensor in self.worlds.get_state(seed).items()}
        return {**state, "totals": self.totals[seed]}

    def set_state(self, states: Sequence[Mapping[str, torch.Tensor]]) -> None:
        """Resume from the states of all seeds.

        Raises:
            ValueError: for one that no world can have.
        """
        for seed, state in enumerate(states):
            for name, tensor in (*self.running.items(), ("totals", self.totals)):
                tensor[seed] = state[name]
        self.worlds.set_state([strip_prefix(state, WORLDS) for state in states])
