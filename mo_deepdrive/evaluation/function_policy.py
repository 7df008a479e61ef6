"""A plain function as a policy, so that agents of any library can be evaluated, recorded and filmed."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from mo_deepdrive.support.importing import failure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.accrued_reward import AccruedReward
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility

    PolicyFunction = Callable[[NDArray[Any], NDArray[np.float32], NDArray[np.float32]], Any]


class FunctionPolicy:
    """A function behind the interface of agents (:class:`mo_deepdrive.evaluation.policy.Policy`).

    Args:
        function: called as ``function(observations, accrued, discounts)`` with the observations of N episodes as the
            environment returns them, their accrued reward R_t = sum_{i<t} gamma^i r_i (N, d) and gamma^t (N,). With V
            vehicles in an environment the shapes are (N, V, o), (N, V, d) and (N, V). It returns actions as the
            environment takes them: (N,) integers or (N, k) numbers, or (N, V) or (N, V, k).
        env: the environment in the shapes of agents.
        utilities: one per vehicle; empty if no utility is known.
        gamma: discount factor of the accrued reward.

    Raises:
        TypeError: for what cannot be called in this way.
    """

    def __init__(
        self, function: PolicyFunction, env: EnvAdapter, utilities: Sequence[Utility] = (), gamma: float = 0.99
    ):
        _check_signature(function)
        self.env = env
        self.utilities = utilities
        self.gamma = gamma
        self._function = function

    @property
    def device(self) -> torch.device:
        """The CPU; the function draws its own random numbers, if any."""
        import torch

        return torch.device("cpu")

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, _generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions of the function, in the shapes of agents.

        Raises:
            ValueError: for actions of the wrong shape or type, or outside of the environment's; for a function that
                fails, with its line and the shapes that it was given.
        """
        accrued, discounts = accrued_reward.value.copy(), accrued_reward.discounts.copy()
        if self.env.vehicles == 1:
            accrued, discounts = accrued[:, 0], discounts[:, 0]
        seen = self.env.environment_observations(observations)
        try:
            returned = self._function(seen, accrued, discounts)
        except (Exception, SystemExit) as error:  # a user's function may raise anything
            given = f"observations {seen.shape}, accrued rewards {accrued.shape} and discounts {discounts.shape}"
            raise ValueError(f"the policy failed for {given}: {failure(error)}") from error
        return self.env.policy_actions(self._checked(returned, len(observations)))

    def _checked(self, returned: Any, episodes: int) -> NDArray[Any]:
        """What the function returned as an array of actions."""
        space = self.env.vector_env.single_action_space
        expected = (episodes, *(space.shape or ()))
        numbers = "numbers" if isinstance(space, Box) else "integers"
        wanted = f"expected {expected} {numbers}, an action for each of {episodes} episodes"
        if np.ma.is_masked(returned):
            raise ValueError(f"the policy returned masked actions; {wanted}")
        try:
            actions = np.asarray(returned)
        except Exception as error:  # of any library's arrays
            reason = " ".join(str(error).partition(". ")[0].split())
            raise ValueError(f"the policy returned {type(returned).__name__}, no array: {reason}; {wanted}") from error
        if actions.shape != expected:
            raise ValueError(f"the policy returned actions of shape {actions.shape}; {wanted}")
        if actions.dtype.kind not in ("fiu" if isinstance(space, Box) else "iu"):
            raise ValueError(f"the policy returned actions of dtype {actions.dtype}; {wanted}")
        if isinstance(space, Box):
            fine, allowed = np.isfinite(actions), "finite"
        else:
            first = np.asarray(space.start)  # type: ignore[attr-defined]
            count = np.asarray(space.n if isinstance(space, Discrete) else space.nvec)  # type: ignore[attr-defined]
            fine = (actions >= first) & (actions < first + count)
            allowed = f"from {first.min()} to {(first + count).max() - 1}"
        if not fine.all():
            raise ValueError(f"the policy returned the action {actions[~fine][0]}; it must be {allowed}")
        return actions


CALL = "policy(observations, accrued, discounts)"


def _check_signature(function: Any) -> None:
    """Refuse what cannot be called as policies are, before an episode has been driven."""
    name = getattr(function, "__name__", type(function).__name__)
    if not callable(function):
        raise TypeError(
            f"policy = {function!r} must be an agent or a function {CALL} -> actions, "
            "such as lambda observations, *_: model.predict(observations)[0]"
        )
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of a function without one, as some that are compiled
        return
    try:
        signature.bind(*"oad")
    except TypeError:
        raise TypeError(
            f"policy = {name}{signature} cannot be called as {CALL}, with arrays (N, o), (N, d) and (N,) of N episodes;"
            " write *_ for what it does not need"
        ) from None
