"""Distributions of a vector return as outputs of a network: a categorical grid, and a set of particles.

Both describe the joint distribution of all objectives. Rows are samples: M of them, with d objectives.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mo_deepdrive.utilities import Utility

MAX_CELLS = 4096  # of a grid
MAX_RETURNS = 2**20  # whose utilities are computed at a time
SMOOTHING = 0.01  # of distances between scaled returns, at 0


def _check_bounds(minimum: Sequence[float], maximum: Sequence[float]) -> None:
    if any(low >= high for low, high in zip(minimum, maximum, strict=True)):
        raise ValueError(f"v_min = {list(minimum)} must be below v_max = {list(maximum)} in every objective")


class ReturnDistribution(ABC):
    """A family of joint distributions of d returns, parametrised by the outputs of a network.

    Attributes:
        outputs: width of the network's output.
    """

    outputs: int

    @abstractmethod
    def support(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The returns that have mass, (M, n, d) or (1, n, d) where all rows share them, and their masses (M, n)."""

    @abstractmethod
    def distance(
        self, outputs: torch.Tensor, shifts: torch.Tensor, discounts: torch.Tensor, following: torch.Tensor
    ) -> torch.Tensor:
        """D(target, prediction) (M,), where the target is the distribution of shift + discount Z.

        Args:
            outputs: (M, outputs) of the network: the predictions.
            shifts: (M, d).
            discounts: (M,); 0 gives the point ``shift`` for a target.
            following: (M, outputs) of the network: Z, without a gradient.
        """

    def expected_utility(
        self, utility: Utility, outputs: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor
    ) -> torch.Tensor:
        """E[u(R + D Z)] (M,), from the outputs (M, outputs) for Z, R (M, d) and D (M,)."""
        returns, masses = self.support(outputs)
        rows = max(1, MAX_RETURNS // returns[0].numel())
        found = []
        for first in range(0, len(outputs), rows):
            part = slice(first, first + rows)
            rest = returns if len(returns) == 1 else returns[part]
            final = accrued[part].unsqueeze(1) + discounts[part, None, None] * rest
            found.append((masses[part] * utility(final)).sum(-1))
        return torch.cat(found)


class CategoricalGrid(ReturnDistribution):
    """Masses on a regular grid of A atoms per objective, softmax of A^d logits (Reymond et al. 2023, section 4).

    The joint form of Bellemare, Dabney and Munos (2017). The loss is the cross entropy between the target, projected
    onto the grid by :func:`project`, and the prediction.

    ``minimum`` and ``maximum`` (d,) are the first and the last atom of each objective.
    """

    def __init__(self, minimum: Sequence[float], maximum: Sequence[float], atoms: int, device: torch.device):
        self.objectives, self.atoms = len(minimum), atoms
        self.outputs = atoms**self.objectives
        if self.outputs > MAX_CELLS:
            raise ValueError(
                f"atoms = {atoms} for {self.objectives} objectives makes a grid of {atoms}^{self.objectives} = "
                f"{self.outputs:,} cells; at most {MAX_CELLS:,} are allowed: choose fewer atoms, or critic: particles"
            )
        _check_bounds(minimum, maximum)
        # (A, d): one column of atoms per objective, and all their combinations (1, A^d, d).
        columns = [torch.linspace(low, high, atoms) for low, high in zip(minimum, maximum, strict=True)]
        self.values = torch.stack(columns, dim=1).to(device)
        points = torch.stack(torch.meshgrid(*columns, indexing="ij"), dim=-1)
        self.points = points.reshape(1, self.outputs, self.objectives).to(device)

    def support(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The grid's points (1, A^d, d), and softmax of the logits."""
        return self.points, outputs.softmax(-1)

    def distance(
        self, outputs: torch.Tensor, shifts: torch.Tensor, discounts: torch.Tensor, following: torch.Tensor
    ) -> torch.Tensor:
        """-m . log p for the projected targets m."""
        targets = project(following.softmax(-1), shifts, discounts, self.values)
        return -(targets * outputs.log_softmax(-1)).sum(-1)


def project(masses: torch.Tensor, shifts: torch.Tensor, discounts: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """The distribution of shift + discount Z, with Z on a grid, back onto that grid: (M, A^d).

    Every atom is clipped to the grid, and its mass shared among the 2^d corners of its cell by multilinear
    interpolation: for an atom b of an objective, in units of the spacing from its first atom, atom i receives the
    factor max(0, 1 - abs(b - i)). The means of atoms inside the grid are kept, and variances never become smaller.

    Args:
        masses: (M, A^d) of Z, the last objective varying fastest.
        shifts: (M, d).
        discounts: (M,).
        values: (A, d) atoms of each objective, evenly spaced.
    """
    atoms, d = values.shape
    number = torch.arange(atoms, dtype=values.dtype, device=values.device)
    spacing = (values[-1] - values[0]) / (atoms - 1)
    result = masses.reshape(len(masses), atoms, -1)
    for k in range(d):
        moved = shifts[:, k, None] + discounts.unsqueeze(-1) * values[:, k]
        position = ((moved - values[0, k]) / spacing[k]).clamp(0.0, atoms - 1.0)
        factors = (1.0 - (position.unsqueeze(1) - number.unsqueeze(-1)).abs()).clamp(min=0.0)  # (M, A to, A from)
        # The first objective's axis is contracted and becomes the last, so that after d rounds the order is as before.
        result = (factors @ result).transpose(1, 2).reshape(len(masses), atoms, -1)
    return result.reshape(len(masses), -1)


class Particles(ReturnDistribution):
    """K equally likely joint returns, trained by the energy distance to the target's (Székely and Rizzo 2013).

    Args:
        number: K.
        scales: (d,) nominal size of each objective's return, by which distances are measured.
        minimum, maximum: (d,) bounds to which targets are clipped.
    """

    def __init__(self, number: int, scales: torch.Tensor, minimum: Sequence[float], maximum: Sequence[float]):
        _check_bounds(minimum, maximum)
        self.number, self.scales = number, scales
        self.minimum, self.maximum = (scales.new_tensor(bound) / scales for bound in (minimum, maximum))
        self.outputs = number * len(scales)

    def support(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The particles (M, K, d), each of mass 1 / K."""
        particles = outputs.unflatten(-1, (self.number, -1))
        return self.scales * particles, torch.full_like(particles[..., 0], 1.0 / self.number)

    def distance(
        self, outputs: torch.Tensor, shifts: torch.Tensor, discounts: torch.Tensor, following: torch.Tensor
    ) -> torch.Tensor:
        """:func:`energy_score` between returns divided by their scales."""
        moved = discounts[:, None, None] * following.unflatten(-1, (self.number, -1))
        targets = ((shifts / self.scales).unsqueeze(1) + moved).clamp(self.minimum, self.maximum)
        return energy_score(outputs.unflatten(-1, (self.number, -1)), targets)


def energy_score(particles: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """``2 E|X - Y| - E|X - X'|`` (M,).

    This is the energy distance between particles and targets but for ``E|Y - Y'|``, which does not depend on the
    particles. It is linear in the distribution of Y, so that single outcomes give unbiased gradients, and smallest
    where X and Y have the same distribution (Gneiting and Raftery 2007, section 4.3). With
    ``|z| = sqrt(z . z + 0.01^2)``, which has a gradient at 0, it is a maximum mean discrepancy with a multiquadric
    kernel, as in Zhang et al. (2021).

    X are the particles (M, K, d), and Y the targets (M, J, d), without a gradient.
    """

    def distance(others: torch.Tensor) -> torch.Tensor:
        # |x - y|^2 = |x|^2 + |y|^2 - 2 x . y, so that nothing is (M, K, J, d).
        squares = particles.square().sum(-1).unsqueeze(-1) + others.square().sum(-1).unsqueeze(-2)
        squares = torch.baddbmm(squares, particles, others.transpose(1, 2), alpha=-2.0)
        return (squares.clamp(min=0.0) + SMOOTHING**2).sqrt().mean((-2, -1))

    return 2.0 * distance(targets) - distance(particles)
