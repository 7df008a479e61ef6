"""Joint utilities: what a team of vehicles makes of the utilities of its members.

A joint utility J maps the utilities (..., V) of V vehicles to shape (...).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

JointUtility = Literal["sum", "worst_off", "gini"]


def total(utilities: torch.Tensor) -> torch.Tensor:
    """The sum: nobody counts for more than another (utilitarian)."""
    return utilities.sum(dim=-1)


def worst_off(utilities: torch.Tensor) -> torch.Tensor:
    """The least one (egalitarian)."""
    return utilities.amin(dim=-1)


def generalised_gini(utilities: torch.Tensor) -> torch.Tensor:
    """The sum of 2^-k u_k over the utilities u_1 <= u_2 <= ... from the worst-off on.

    Between the two others: a gain counts for more where it goes to somebody worse off (Weymark 1981, "Generalized Gini
    inequality indices"; Siddique et al. 2020 use it for fair policies).
    """
    weights = 0.5 ** torch.arange(1, utilities.shape[-1] + 1, dtype=utilities.dtype, device=utilities.device)
    return (utilities.sort(dim=-1).values * weights).sum(dim=-1)


JOINT_UTILITIES: dict[JointUtility, Callable[[torch.Tensor], torch.Tensor]] = {
    "sum": total,
    "worst_off": worst_off,
    "gini": generalised_gini,
}


def joint_utility(
    name: JointUtility, utilities: Sequence[Callable[[torch.Tensor], torch.Tensor]], returns: torch.Tensor
) -> torch.Tensor:
    """J(u_1(R_1), ..., u_V(R_V)) (...) of the returns (..., V, d) of V vehicles."""
    each = [utility(returns[..., v, :]) for v, utility in enumerate(utilities)]
    return JOINT_UTILITIES[name](torch.stack(each, dim=-1))
