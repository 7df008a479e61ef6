"""What acts: policies, the past on which they may depend, functions as policies, and the loop that drives them."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from gymnasium.spaces import Box, Discrete

from mo_deepdrive.support.importing import failure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import torch
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.env_adapter import EnvAdapter, Step
    from mo_deepdrive.utilities import Utility

    PolicyFunction = Callable[[NDArray[Any], NDArray[np.float32], NDArray[np.float32]], Any]

SMALLEST_DISCOUNT = 1e-6  # a gamma^t below it counts as this
CALL = "policy(observations, accrued, discounts)"


@dataclass
class AccruedReward:
    """Accrued rewards of the running episodes of N environments with V vehicles."""

    value: NDArray[np.float32]  #: (N, V, d) accrued reward R_t = sum_{i<t} g^i r_i
    discounts: NDArray[np.float32]  #: (N, V) g^t
    decisions: NDArray[np.int64]  #: (N, V) t

    @classmethod
    def begin(cls, num_envs: int, vehicles: int, objectives: int) -> AccruedReward:
        """Episodes before their first decision."""
        return cls(
            value=np.zeros((num_envs, vehicles, objectives), dtype=np.float32),
            discounts=np.ones((num_envs, vehicles), dtype=np.float32),
            decisions=np.zeros((num_envs, vehicles), dtype=np.int64),
        )

    def add(self, rewards: NDArray[np.float32], discount: float | NDArray[np.float32]) -> None:
        """Add the ``rewards`` (N, V, d) of one decision; ``discount`` is g, or one g per vehicle (V,)."""
        self.value += self.discounts[..., None] * rewards
        self.discounts *= discount
        self.decisions += 1

    def restart(self, where: NDArray[np.bool_]) -> None:
        """Start new episodes where the mask (N, V) is True."""
        self.value[where] = 0.0
        self.discounts[where] = 1.0
        self.decisions[where] = 0

    def take(self, rows: NDArray[np.intp]) -> AccruedReward:
        """Copies of the environments at ``rows``."""
        return AccruedReward(self.value[rows], self.discounts[rows], self.decisions[rows])


class Policy(Protocol):
    """What can be evaluated: an agent, a policy of a front, or another library's policy behind an adapter."""

    @property
    def env(self) -> EnvAdapter:
        """The environment that it was trained on."""

    @property
    def utilities(self) -> Sequence[Utility]:
        """One per vehicle; empty if no utility is known."""

    @property
    def gamma(self) -> float | NDArray[np.float32]:
        """Discount factor of the accrued reward that it observes; one per vehicle (V,) where they differ."""

    @property
    def device(self) -> torch.device:
        """Where its generator draws random numbers."""

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy if ``generator`` is None."""


def seeded_generator(policy: Policy, seed: int) -> torch.Generator:
    """A generator on the policy's device."""
    import torch

    return torch.Generator(policy.device).manual_seed(seed)


def check_same_task(found: EnvAdapter, expected: EnvAdapter) -> None:
    """Refuse, with a ValueError, policies of an environment of another id, spaces or objectives."""
    for attribute in ("name", "vehicles", "observation_size", "actions", "continuous", "objectives", "cost_sign"):
        mine, other = getattr(expected, attribute), getattr(found, attribute)
        if mine != other:
            raise ValueError(f"a policy for {attribute} = {other!r} cannot drive where {attribute} = {mine!r}")


class FunctionPolicy:
    """A function behind the interface of agents (:class:`Policy`).

    The function is called as of :func:`mo_deepdrive.evaluation.evaluate`; a TypeError for what cannot be called so. The
    utilities are one per vehicle, or none; ``gamma`` discounts the accrued reward.
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

        A ValueError for actions of the wrong shape or type, or outside of the environment's; for a function that fails,
        with its line and the shapes that it was given.
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


class Decision(NamedTuple):
    """One decision of the first episodes of N environments."""

    actions: NDArray[Any]  #: (N, V) or (N, V, k) of the policy
    step: Step  #: what they led to
    counted: NDArray[np.bool_]  #: (N, V) which vehicles were in their first episode
    running: NDArray[np.bool_]  #: (N, V) which are still, after it


def drive(
    policy: Policy, env: EnvAdapter, observations: NDArray[np.float32], generator: torch.Generator | None = None
) -> Iterator[Decision]:
    """Drive the first episode of every environment, until all vehicles have ended.

    What evaluates, records and films policies reads the decisions from here. The environment has just been reset to the
    ``observations`` (N, V, o); without a generator actions are greedy.
    """
    accrued_reward = AccruedReward.begin(env.num_envs, env.vehicles, len(env.objectives))
    running = np.ones((env.num_envs, env.vehicles), dtype=np.bool_)
    for _ in env.decisions():
        actions = policy.act(observations, accrued_reward, generator)
        step = env.step(actions)
        counted = running & step.acted
        running = running & ~(step.terminated | step.truncated)
        accrued_reward.add(step.rewards, policy.gamma)
        yield Decision(actions, step, counted, running)
        if not running.any():
            break
        observations = step.observations
