"""Preferences: the families of utilities that one network serves.

:mod:`algorithms.conditioned_mo_ppo` has the equations, to which the numbers here refer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from algorithms.hyperparameters import NonNegative, Positive
from mo_deepdrive.evaluation.policy import SMALLEST_DISCOUNT
from mo_deepdrive.world.config import Settings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

Share = Annotated[float, Field(ge=0.0, le=1e6)]
Concentration = Annotated[float, Field(gt=0.0, le=1e3)]
Family = Literal["linear", "chebyshev", "comfort_budget"]
FAMILIES: tuple[Family, ...] = ("linear", "chebyshev", "comfort_budget")
LINEAR, CHEBYSHEV, COMFORT_BUDGET = range(3)  # indices of FAMILIES
FURTHEST = 2.0  # how far a gap is behind the largest one, and what is left of a budget, are clipped at (eqs. 10 and 11)
TINY = 1e-9  # added to the weights of gains, so that they are equal where all are 0


class PreferenceSettings(Settings):
    """What preferences are drawn from."""

    families: dict[Family, Share] = {"linear": 1.0}
    """Share of the episodes by family of utilities ("linear", "chebyshev", "comfort_budget")."""
    concentration: Concentration = 0.5
    """Concentration of the Dirichlet distribution from which weights are drawn; below 1 favours few objectives."""
    emphasis: dict[str, Concentration] = {}
    """Factor of the concentration by objective, 1 unless set; with 3 an objective has, in the mean, three times the
    weight of another."""
    rho: NonNegative = 0.05
    """rho of the Chebyshev function (eq. 2)."""
    budgets: dict[str, Positive] = {}
    """Largest budget by objective (a cost), for "comfort_budget"; budgets are drawn evenly from 0 to it."""
    price: Positive = 5.0
    """Price of what exceeds a budget, in units of a scale (eq. 3)."""

    @model_validator(mode="after")
    def _one_family_at_least(self) -> PreferenceSettings:
        if not any(self.families.values()):
            raise ValueError(f"families = {self.families} must have a positive share of one of {', '.join(FAMILIES)}")
        if bool(self.families.get("comfort_budget")) != bool(self.budgets):
            raise ValueError(
                f"budgets = {self.budgets} must name the largest budget of at least one objective if and only if "
                f"families = {self.families} has a share of comfort_budget"
            )
        return self


class Preferences:
    """The preferences that one network serves: how they are drawn, what they are worth, what it sees of them.

    A preference is a row (m,) of numbers: an indicator of each family of the mixture if there are several, d weights
    unless all are budgets, and a budget for each budgeted objective. What a family does not use is 0.
    """

    def __init__(self, config: PreferenceSettings, objectives: Sequence[str], scales: NDArray[np.float32]):
        for key, names in (("budgets", config.budgets), ("emphasis", config.emphasis)):
            if unknown := [name for name in names if name not in objectives]:
                raise ValueError(f"{key} has {unknown[0]!r}; the objectives are {tuple(objectives)}")
        self.config, self.objectives = config, tuple(objectives)
        self.emphasis = np.array([config.emphasis.get(name, 1.0) for name in objectives])
        self.scales = torch.from_numpy(scales)
        shares = np.array([config.families.get(family, 0.0) for family in FAMILIES])
        self.shares, self.used = shares / shares.sum(), np.flatnonzero(shares).tolist()
        self.budgeted = [self.objectives.index(name) for name in config.budgets]
        # Indices as tensors: lists would have to be copied to a device whenever they are used.
        self._with_budget = torch.tensor(self.budgeted, dtype=torch.int64)
        self._free = torch.tensor([i for i in range(len(objectives)) if i not in self.budgeted], dtype=torch.int64)
        self.largest = torch.tensor([*config.budgets.values()], dtype=torch.float32)
        weighted = self.used != [COMFORT_BUDGET]
        d, first = len(objectives), len(self.used) if len(self.used) > 1 else 0
        self.weight_columns = slice(first, first + d * weighted)
        self.budget_columns = slice(self.weight_columns.stop, self.weight_columns.stop + len(self.budgeted))
        self.names = (
            *((FAMILIES[family] for family in self.used) if first else ()),
            *((f"weight/{name}" for name in objectives) if weighted else ()),
            *(f"budget/{name}" for name in config.budgets),
        )

        # Weights become of mean 1, whatever the number of objectives, and budgets shares of the largest.
        self.factors, self.divisors = torch.ones(2, len(self.names))
        self.factors[self.weight_columns] = float(d)
        self.divisors[self.budget_columns] = self.largest

    def to(self, device: torch.device) -> None:
        """Move its tensors to a device."""
        for name, each in vars(self).items():
            if isinstance(each, Tensor):
                setattr(self, name, each.to(device))

    def rows(self, family: Tensor, weights: Tensor, budgets: Tensor) -> Tensor:
        """Preferences (..., m) of families (...), which are positions in ``used``, weights, and shares of budgets."""
        positions = torch.arange(len(self.used), device=family.device)
        indicators = (family.unsqueeze(-1) == positions).to(weights.dtype)
        has_budgets = indicators[..., -1:] if self.used[-1] == COMFORT_BUDGET else torch.zeros_like(indicators[..., :1])
        parts = [indicators] if len(self.used) > 1 else []
        parts += [weights * (1.0 - has_budgets)] if self.weight_columns.stop > self.weight_columns.start else []
        return torch.cat([*parts, budgets * self.largest * has_budgets], dim=-1)

    def draw(self, count: int, rng: np.random.Generator, *, emphasis: bool = True) -> NDArray[np.float32]:
        """(count, m) preferences from the distribution of training; without ``emphasis`` all objectives are alike."""
        rows = np.zeros((count, len(self.names)), dtype=np.float32)
        family = rng.choice(len(FAMILIES), size=count, p=self.shares)
        if len(self.used) > 1:
            rows[np.arange(count), np.searchsorted(self.used, family)] = 1.0
        weighted = family != COMFORT_BUDGET
        if weighted.any():
            alpha = np.full(len(self.objectives), self.config.concentration)
            if emphasis:
                alpha *= self.emphasis
            rows[weighted, self.weight_columns] = rng.dirichlet(alpha, int(weighted.sum()))
        if not weighted.all():
            highest = self.largest.numpy()
            rows[~weighted, self.budget_columns] = highest * rng.random((int((~weighted).sum()), len(highest)))
        return rows

    def condition(
        self, family: str, weights: Mapping[str, float] | None = None, budgets: Mapping[str, float] | None = None
    ) -> NDArray[np.float32]:
        """The row (m,) of a preference.

        Args:
            family: of the mixture that was trained.
            weights: by objective, in units of its scale, for "linear" and "chebyshev"; 0 for those that are not named,
                and divided by their sum.
            budgets: by objective, for "comfort_budget"; 0 for those that are not named.

        Raises:
            ValueError: for a family that was not trained, or numbers that are not valid, as a budget above the largest.
        """
        families = [FAMILIES[each] for each in self.used]
        if family not in families:
            raise ValueError(f"family = {family!r} was not trained; it must be one of {', '.join(families)}")
        chosen = FAMILIES.index(family)
        budgeted = chosen == COMFORT_BUDGET
        key, given, other = ("budgets", budgets, weights) if budgeted else ("weights", weights, budgets)
        if given is None or other is not None:
            raise ValueError(f"family {family!r} needs {key} and nothing else")
        allowed = [*self.config.budgets] if budgeted else self.objectives
        for name, value in given.items():
            if name not in allowed:
                raise ValueError(f"{key} has {name!r}; it must be one of {', '.join(allowed)}")
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{key} of {name!r} = {value} must be finite and not negative")
            if budgeted and value > self.config.budgets[name]:
                raise ValueError(f"{key} of {name!r} = {value} must be at most {self.config.budgets[name]}")
        numbers = np.array([given.get(name, 0.0) for name in allowed])
        if not (budgeted or numbers.any()):
            raise ValueError(f"weights = {dict(given)} must have a positive number")
        row = np.zeros(len(self.names), dtype=np.float32)
        if len(self.used) > 1:
            row[self.used.index(chosen)] = 1.0
        row[self.budget_columns if budgeted else self.weight_columns] = numbers if budgeted else numbers / numbers.sum()
        return row

    def check(self, rows: NDArray[np.float32]) -> None:
        """Refuse rows (..., m) that no :meth:`draw` gives."""
        weights, budgets = rows[..., self.weight_columns], rows[..., self.budget_columns]
        families = rows[..., : len(self.used)] if len(self.used) > 1 else np.ones((*rows.shape[:-1], 1))
        budgeted = (families[..., -1] == 1.0) & (self.used[-1] == COMFORT_BUDGET)
        weighing = (weights >= 0.0).all(-1) & (np.abs(weights.sum(-1) - ~budgeted) < 1e-3)
        spending = ((budgets >= 0.0) & (budgets <= budgeted[..., None] * self.largest.numpy())).all(-1)
        fine = np.isin(families, (0, 1)).all(-1) & (families.sum(-1) == 1.0) & weighing & spending
        if not fine.all():
            raise ValueError(
                f"{rows[~fine][0].tolist()} is no preference; it must have one family, weights that sum to 1 or none "
                f"and budgets of at most {self.largest.tolist()}, in this order: {', '.join(self.names)}"
            )

    def is_family(self, preferences: Tensor, family: int) -> Tensor:
        """Mask (...) of the preferences (..., m) of a family."""
        if len(self.used) > 1 and family in self.used:
            return preferences[..., self.used.index(family)] > 0.5
        shape = preferences.shape[:-1]
        return torch.full(shape, family in self.used, dtype=torch.bool, device=preferences.device)

    def weights(self, preferences: Tensor) -> Tensor:
        """The weights w (..., d) of preferences (..., m); 0 under budgets."""
        return preferences[..., self.weight_columns]

    def gaps(self, returns: Tensor, preferences: Tensor, ideal: Tensor) -> Tensor:
        """The gaps q of eq. 2 (..., d)."""
        return self.weights(preferences) * (ideal.to(returns) - returns) / self.scales.to(returns)

    def utility(self, returns: Tensor, preferences: Tensor, ideal: Tensor) -> Tensor:
        """u(R; p) (...) of eqs. 1 to 3, for returns (..., d), preferences (..., m) and z (..., d)."""
        scaled = returns / self.scales.to(returns)
        value = torch.zeros(returns.shape[:-1], device=returns.device, dtype=returns.dtype)
        if LINEAR in self.used:
            linear = (self.weights(preferences) * scaled).sum(-1)
            value = torch.where(self.is_family(preferences, LINEAR), linear, value)
        if CHEBYSHEV in self.used:
            gaps = self.gaps(returns, preferences, ideal)
            chebyshev = -(gaps.amax(-1) + self.config.rho * gaps.sum(-1))
            value = torch.where(self.is_family(preferences, CHEBYSHEV), chebyshev, value)
        if COMFORT_BUDGET in self.used:
            excess = (-returns[..., self._with_budget] - preferences[..., self.budget_columns]).clamp(min=0.0)
            price = self.config.price / self.scales.to(returns)[self._with_budget]
            budget = scaled[..., self._free].sum(-1) - (price * excess).sum(-1)
            value = torch.where(self.is_family(preferences, COMFORT_BUDGET), budget, value)
        return value

    @property
    def width(self) -> int:
        """Number of columns of :meth:`features`."""
        d = len(self.objectives)
        return len(self.names) + d * (CHEBYSHEV in self.used) + len(self.budgeted)

    def features(self, preferences: Tensor, accrued: Tensor, discounts: Tensor, ideal: Tensor) -> Tensor:
        """(p, c_t) of eq. 6, scaled: (..., width), from R_t (..., d), gamma^t (...) and z (..., d)."""
        left = discounts.unsqueeze(-1).clamp(min=SMALLEST_DISCOUNT)
        parts = [preferences * self.factors / self.divisors]
        if CHEBYSHEV in self.used:
            gaps = self.gaps(accrued, preferences, ideal)
            behind = ((gaps - gaps.amax(-1, keepdim=True)) / left).clamp(min=-FURTHEST)
            parts.append(behind * self.is_family(preferences, CHEBYSHEV).unsqueeze(-1))
        if COMFORT_BUDGET in self.used:
            unspent = (accrued[..., self._with_budget] + preferences[..., self.budget_columns]) / left / self.largest
            is_budget = self.is_family(preferences, COMFORT_BUDGET).unsqueeze(-1)
            parts.append(unspent.clamp(-FURTHEST, FURTHEST) * is_budget)
        return torch.cat(parts, dim=-1)


class TrainingPreferences:
    """The preferences of N environments of S seeds while they train, and the best returns that they have seen.

    The shape is S, T, N and V; a preference changes within an episode with the probability ``switching`` per decision.
    """

    def __init__(
        self, preferences: Preferences, shape: tuple[int, int, int, int], switching: float, device: torch.device
    ):
        seeds, _, num_envs, vehicles = shape
        d, self.width = len(preferences.objectives), len(preferences.names)
        self._preferences, self._switching = preferences, switching
        self.current = torch.zeros(seeds, num_envs, vehicles, self.width, device=device)  # of the running episodes
        self.ideal = torch.zeros(seeds, d, device=device)  # z, the best accrued rewards; 0 before an episode has ended
        self.seen_any = torch.zeros(seeds, dtype=torch.bool, device=device)  # whether one has
        self.cost_share = torch.ones((), device=device)  # c of eq. 12
        concentration = torch.from_numpy(preferences.config.concentration * preferences.emphasis)
        self._concentration = concentration.float().to(device)
        shares = torch.from_numpy(preferences.shares[preferences.used]).float()
        self._thresholds = shares.cumsum(0)[:-1].to(device)
        # Of every decision: weights, and uniform numbers for family, switching and budgets.
        self._weights = torch.zeros(*shape, d, device=device)
        self._uniform = torch.zeros(*shape, 2 + len(preferences.budgeted), device=device)

    def draw(self, seed: int, generator: torch.Generator) -> None:
        """Draw the random numbers of a rollout of the seed with this index."""
        concentration = self._concentration.expand(self._weights[seed].shape)
        self._weights[seed] = torch._sample_dirichlet(concentration, generator=generator)
        self._uniform[seed].uniform_(generator=generator)

    def begin_rollout(self) -> None:
        """Make preferences of the random numbers, for every decision of a rollout at once."""
        weights, uniform = self._weights, self._uniform
        # Equation 12.
        gains = self.ideal[:, None, None, None] > 0.0
        of_gains = torch.where(gains, weights + TINY, 0.0)
        of_gains = of_gains / of_gains.sum(-1, keepdim=True).clamp(min=TINY)
        grown = (1.0 - self.cost_share) * of_gains + self.cost_share * weights
        weights = torch.where(gains.any(-1, keepdim=True), grown, weights)
        family = (uniform[..., :1] >= self._thresholds).sum(-1)
        self._drawn = self._preferences.rows(family, weights, uniform[..., 2:])
        self._switches = uniform[..., 1] < self._switching

    def follow(self, t: int, lengths: Tensor) -> Tensor:
        """The preferences (S, N, V, m) of decision t of a rollout; new where ``lengths`` are 0, and by chance."""
        changes = (lengths == 0) | self._switches[:, t]
        return self.current.copy_(torch.where(changes.unsqueeze(-1), self._drawn[:, t], self.current))

    def update_on_episode_end(self, values: Tensor, ended: Tensor) -> None:
        """Raise z to the best accrued rewards (S, T, N, V, d) of the episodes that ended, where a mask says."""
        best = values.masked_fill(~ended.unsqueeze(-1), -torch.inf).amax((1, 2, 3))
        any_ended = ended.flatten(1).any(-1)
        before = torch.where(self.seen_any.unsqueeze(-1), self.ideal, -torch.inf)
        self.ideal.copy_(torch.where((self.seen_any | any_ended).unsqueeze(-1), torch.maximum(before, best), 0.0))
        self.seen_any.logical_or_(any_ended)
