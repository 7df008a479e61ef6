"""Base classes of the agents: acting, training with periodic evaluation, saving and loading.

A new algorithm is a subclass of :class:`Agent`, or of :class:`FrontAgent` if it learns a front; the docstrings say what
it defines. A YAML file names it by its path, ``algorithm.name: package.module:Class``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from algorithms.files.checkpoints import (
    GUIDES,
    PARTNERS,
    POLICY_ONLY,
    SEED,
    STEP,
    UPDATES,
    check_tensors,
    read_checkpoint,
    strip_prefix,
    write_checkpoint,
)
from algorithms.hyperparameters import a_twentieth
from algorithms.networks.threads import limited_threads
from algorithms.rollouts.buffers import Episodes
from mo_deepdrive.config import Settings, parse
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.episodes import evaluate, evaluate_each, vehicle_utilities
from mo_deepdrive.evaluation.front import Front, measure_front
from mo_deepdrive.evaluation.metrics import (
    FRONT,
    GREEDY,
    STEPS_PER_SECOND,
    STOCHASTIC,
    TRAIN,
    evaluation_prefix,
    joint_objectives,
    return_of,
    summarise,
    vehicle_prefix,
)
from mo_deepdrive.evaluation.splits import FIRST_TRAINING_SEED, SPLITS
from mo_deepdrive.faults import Fault, check_numbers

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from gymnasium.vector import VectorEnv
    from numpy.typing import ArrayLike, NDArray

    from mo_deepdrive.evaluation.accrued_reward import AccruedReward
    from mo_deepdrive.evaluation.episodes import UtilityLike
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.utilities import Utility

ACTIONS, DRAWS, SHUFFLES = 0, 1, 2  # streams of random numbers; of the vehicle v, SHUFFLES + v
EPISODES = "unlogged."  # prefix of the tensors of episodes that have not been logged yet

Log = Callable[[int, dict[str, float]], None]
LogFront = Callable[[int, Front], None]


@dataclass(frozen=True)
class EvaluationPlan:
    """How an agent is evaluated while it trains.

    Attributes:
        env: a raw environment, used for nothing else.
        episodes: per evaluation (per policy of a front).
        seed: of the first episode.
        gamma: discount of the reported returns.
        reference_point: (d,) of the hypervolume of a front; None for no hypervolume.
        reference_front: (k, d) best-known front; None where there is none.
    """

    env: VectorEnv
    episodes: int
    seed: int
    gamma: float
    reference_point: Sequence[float] | None = None
    reference_front: NDArray[np.float64] | None = None


class Agent(ABC):
    """Base of all agents.

    An algorithm defines

    - ``Config``, a subclass of :class:`mo_deepdrive.config.Settings` with its hyperparameters: the keys of the
      ``algorithm`` section. ``gamma`` is the discount of the accrued reward that ``act`` is given; 1 without it.
    - ``__init__(self, env, utility, **options)``, which calls that of this class with the same arguments and makes
      networks and optimisers.
    - :meth:`act`, the policy.
    - :meth:`update`, which collects experience and learns from it once.
    - :meth:`get_state` and :meth:`set_state`: what determines the rest of the run, as named tensors. The names of an
      optimiser's contain "optimiser.". ``step``, ``updates`` and ``episodes`` are saved here.

    It may define ``name``, :meth:`begin`, :meth:`get_policy` and :meth:`set_policy`, :meth:`identity` and
    :attr:`varying_shapes`. It may use the attributes below and

    - :class:`algorithms.rollouts.collector.Collector`: T steps of all environments as one rollout, and the episodes
      that ended; its state is part of the agent's unless every update resets it.
    - :class:`mo_deepdrive.evaluation.env_adapter.EnvAdapter`, which is ``env``: reset and step in shapes (N, V, ...).
    - :mod:`algorithms.networks.modules`, with :class:`algorithms.hyperparameters.NetworkSettings` for a Config.
    - :mod:`algorithms.rollouts.advantages` and :mod:`algorithms.networks.optimiser`.

    Everything random is drawn from ``initial``, ``generator`` or what :meth:`update_generator` makes, so that a run can
    be repeated and resumed bit for bit.

    Args:
        env: a vector environment with vector rewards, from `mo_deepdrive.evaluation.env_adapter.make_env`.
        utility: the known utility, its name or a function of returns (..., d), or a list with one per vehicle; None for
            agents that learn a front.
        seed: determines the run, bit for bit on one machine.
        device: of the networks.
        config: the hyperparameters, an instance of the class's Config.
        **hyperparameters: fields of the Config, in place of ``config``.

    Attributes:
        name: of the algorithm, in checkpoints; that of the class where it is not set.
        known_utility: whether the agent learns for a known utility, or a front for every utility.
        trains_with_partners: whether its constructor takes ``partners``, which drive vehicles that do not learn.
        trains_with_guides: whether it takes ``guides``, which begin episodes of vehicles that learn.
        shares_policies: whether it takes ``share_policy``, with which one policy drives all vehicles.
        trains_on_devices: whether :mod:`algorithms.device` can train it, with several seeds side by side.
        varying_shapes: parts of the names of tensors whose shapes are not known before a checkpoint is read;
            ``set_state`` and ``set_policy`` check them.
        config: the hyperparameters.
        env: the training environment in the trainers' shapes.
        utilities: one per vehicle; empty where none is known.
        device: of the networks.
        step: environment steps taken, over all parallel environments.
        updates: rollouts, or rounds of episodes, that have been collected.
        episodes: those that ended since training metrics were last logged.
        initial: generator of the initial weights.
        generator: generator of the exploring actions, seeded anew before every update of :meth:`train`.
        env_seed: of the first reset of the training environment.

    Raises:
        ValueError: for unknown or invalid hyperparameters, spaces or utilities.
    """

    name: ClassVar[str]
    Config: ClassVar[type[Settings]]
    known_utility: ClassVar[bool] = True
    trains_with_partners: ClassVar[bool] = False
    trains_with_guides: ClassVar[bool] = False
    shares_policies: ClassVar[bool] = False
    trains_on_devices: ClassVar[bool] = False
    varying_shapes: ClassVar[tuple[str, ...]] = ()
    config: Any

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        if "name" not in vars(cls):
            cls.name = cls.__name__

    def __init__(
        self,
        env: VectorEnv,
        utility: UtilityLike | Sequence[UtilityLike] | None = None,
        *,
        seed: int = 0,
        device: str = "cpu",
        config: Settings | None = None,
        **hyperparameters: Any,
    ):
        self.config = self._config_of(config, hyperparameters)
        if self.known_utility and utility is None:
            raise ValueError(f"utility is missing: algorithm {self.name!r} learns for a known utility")
        self.env = EnvAdapter(env)
        self.seed = seed
        self.device = torch.device(device)
        self.utilities: list[Utility] = list(vehicle_utilities(utility, self.env))
        weights_seed, env_seed = np.random.SeedSequence(seed).generate_state(2)
        self.initial = torch.Generator().manual_seed(int(weights_seed))
        self.generator = torch.Generator(self.device)
        self.env_seed = FIRST_TRAINING_SEED + int(env_seed)
        self.step = 0
        self.updates = 0
        self.episodes: list[Episodes] = []
        self._seed_actions()

    def update_generator(self, stream: int) -> torch.Generator:
        """The random numbers of an update: a function of the run's seed, a stream and the number of updates so far.

        Nothing of them has to be saved. Stream 0 has the exploring actions.
        """
        return torch.Generator().manual_seed(self._seed_of(stream))

    def _seed_of(self, stream: int) -> int:
        return int(np.random.SeedSequence([self.seed, stream, self.updates]).generate_state(1, np.uint64)[0]) >> 1

    def _seed_actions(self) -> None:
        self.generator.manual_seed(self._seed_of(ACTIONS))

    @classmethod
    def _config_of(cls, config: Settings | None, hyperparameters: dict[str, Any]) -> Settings:
        if config is None:
            return parse(cls.Config, hyperparameters, f"hyperparameters of {cls.name}")
        if not isinstance(config, cls.Config):
            raise ValueError(f"config = {config!r} must be an instance of {cls.Config.__name__}")
        if hyperparameters:
            raise ValueError(f"{', '.join(hyperparameters)}: give either config or single hyperparameters")
        return config

    def vehicle_groups(self, share_policy: bool, partners: Container[int] = ()) -> list[tuple[int, ...]]:
        """The vehicles of each policy that learns: one each, or all that no partner drives.

        Raises:
            ValueError: if a policy cannot be shared.
        """
        learning = [v for v in range(self.env.vehicles) if v not in partners]
        if not share_policy:
            return [(v,) for v in learning]
        if len(learning) == 1:
            raise ValueError(f"share_policy = True needs several vehicles that learn; {self.env.name} has one")
        utilities = [self.utilities[v] for v in learning] if self.utilities else []
        if any((each.name, each.arguments) != (utilities[0].name, utilities[0].arguments) for each in utilities):
            names = ", ".join(repr(each.name) for each in utilities)
            raise ValueError(f"share_policy = True needs one utility for all vehicles, not {names}")
        return [tuple(learning)]

    @property
    def observes_accrued_reward(self) -> bool:
        """Whether :meth:`act` depends on the accrued reward or its discount."""
        return True

    @property
    def accrued_discount(self) -> float:
        """Discount of the accrued reward that the policy observes."""
        return float(getattr(self.config, "gamma", 1.0))

    @property
    def gamma(self) -> float | NDArray[np.float32]:
        """Discount of the accrued rewards that :meth:`act` is given: one number, or one per vehicle (V,)."""
        return self.accrued_discount

    @property
    def schedules(self) -> list[str]:
        """The settings by which :meth:`update` depends on the length of the training, as ``name = value``.

        A run without any can be trained longer. Of an algorithm that does not define it none is known to be constant.
        """
        return [f"update(progress) of {self.name}"]

    def get_config(self) -> dict[str, Any]:
        """The resolved hyperparameters, for logs."""
        return {"algorithm": self.name, "seed": self.seed, **self.config.model_dump()}

    # ---------------------------------------------------------------------------------------- what an algorithm defines

    @abstractmethod
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o) and the accrued rewards of the running episodes.

        ``generator`` None acts greedily.
        """

    def begin(self) -> None:
        """Prepare the first update: reset environments, collect first episodes."""
        return

    @abstractmethod
    def update(self, progress: float) -> dict[str, float]:
        """Act and learn once, and return the losses by name, which must be finite.

        Adds the environment steps that it took to ``step``, 1 to ``updates``, and to ``episodes`` those that ended.

        Args:
            progress: fraction of training that is done, in [0, 1), for schedules.
        """

    @abstractmethod
    def get_state(self) -> dict[str, torch.Tensor]:
        """What determines the rest of the run, as named tensors: networks, optimisers, running episodes.

        Every number must be finite.
        """

    @abstractmethod
    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`; ``step`` and ``updates`` are set already.

        Raises:
            ValueError: for values from which training cannot continue; a part of the state may be set already.
        """

    def get_policy(self) -> dict[str, torch.Tensor]:
        """What acting needs: a part of :meth:`get_state`, or a summary of it."""
        return self.get_state()

    def set_policy(self, state: dict[str, torch.Tensor]) -> None:
        """Act as the agent of :meth:`get_policy` or :meth:`get_state`."""
        self.set_state(state)

    def evaluate(self, plan: EvaluationPlan) -> tuple[dict[str, float], Front | None]:
        """Metrics of the current policy, greedy and stochastic; a front too where the agent learns one."""
        metrics: dict[str, float] = {}
        for policy in (GREEDY, STOCHASTIC):
            result = evaluate(
                self, plan.env, episodes=plan.episodes, seed=plan.seed, greedy=policy == GREEDY, gamma=plan.gamma
            )
            metrics |= {evaluation_prefix(policy) + name: value for name, value in result.metrics().items()}
        return metrics, None

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share with the agent that reads it."""
        return {
            "algorithm": self.name,
            "environment": self.env.name,
            "observation_size": self.env.observation_size,
            "objectives": list(self.env.objectives),
            "cost_sign": self.env.cost_sign,
            "actions": [self.env.actions, self.env.continuous],
            "num_envs": self.env.num_envs,
        }

    # -------------------------------------------------------------------------------------------------------- training

    @limited_threads()
    def train(
        self,
        total_timesteps: int,
        eval_env: VectorEnv | None = None,
        *,
        eval_interval: int | None = None,
        eval_episodes: int = 100,
        eval_seed: int = SPLITS["validation"].start,
        eval_gamma: float = 0.99,
        reference_point: Sequence[float] | None = None,
        reference_front: NDArray[np.float64] | None = None,
        log: Log | None = None,
        log_front: LogFront | None = None,
        log_interval: int = 10,
        after_update: Callable[[Any], bool] | None = None,
    ) -> None:
        """Learn until ``total_timesteps`` environment steps have been taken, over all parallel environments together.

        On one thread, unless :func:`algorithms.networks.threads.set_threads` has been called with more.

        Args:
            total_timesteps: also the length of schedules; a resumed run passes the same number.
            eval_env: a separate environment for evaluations before, during and after training; None for none.
            eval_interval: environment steps between evaluations; a twentieth of the total if None.
            eval_episodes: episodes per evaluation (per policy of a front).
            eval_seed: seed of the first episode.
            eval_gamma: discount of the reported returns.
            reference_point: (d,) of the hypervolume of a front; None for no hypervolume.
            reference_front: (k, d) best-known front; None where there is none.
            log: called as ``log(step, metrics)``.
            log_front: called as ``log_front(step, front)`` by agents that learn a front.
            log_interval: updates between two rows of training metrics.
            after_update: called as ``after_update(agent)``; True stops training.

        Raises:
            ValueError: for negative steps, or intervals below 1.
            NotFinite: in the update or evaluation in which something is not finite, with where it comes from.
            EndlessEpisode: as :func:`mo_deepdrive.evaluation.evaluate`.
            RuntimeError: if an update takes no steps.
        """
        for name, value, least in (
            ("total_timesteps", total_timesteps, 0),
            ("eval_interval", eval_interval, 1),
            ("log_interval", log_interval, 1),
        ):
            if value is not None and value < least:
                raise ValueError(f"{name} = {value} must be at least {least}")
        interval = a_twentieth(total_timesteps) if eval_interval is None else eval_interval
        plan = None
        if eval_env is not None:
            plan = EvaluationPlan(eval_env, eval_episodes, eval_seed, eval_gamma, reference_point, reference_front)
        if self.step == 0:
            with self._located("before the first update"):
                self.begin()
            self._log_evaluation(plan, log, log_front)
        begun = self.step
        started, first = perf_counter(), begun
        while self.step < total_timesteps:
            before = self.step
            with self._located(f"in the update after step {before:,}"):
                self._seed_actions()
                metrics = self.update(before / total_timesteps)
                check_numbers(metrics)
            if self.step <= before:
                raise RuntimeError(f"{type(self).__name__}.update must add the environment steps that it takes to step")
            last = self.step >= total_timesteps
            if log is None:
                self.episodes.clear()
            elif self.updates % log_interval == 0 or last:
                rate = (self.step - first) / (perf_counter() - started)
                log(self.step, {**self._training_metrics(), **metrics, STEPS_PER_SECOND: rate})
            if self.step // interval > before // interval or last:
                paused = perf_counter()
                self._log_evaluation(plan, log, log_front)
                started += perf_counter() - paused
            if before == begun:  # code may have been compiled, which says nothing of the speed
                started, first = perf_counter(), self.step
            if after_update is not None and after_update(self):
                return

    def _log_evaluation(self, plan: EvaluationPlan | None, log: Log | None, log_front: LogFront | None) -> None:
        if plan is None or (log is None and log_front is None):
            return
        with self._located(f"in the evaluation at step {self.step:,}"):
            metrics, front = self.evaluate(plan)
        if log is not None:
            log(self.step, metrics)
        if log_front is not None and front is not None:
            log_front(self.step, front)

    @contextmanager
    def _located(self, when: str) -> Iterator[None]:
        """Say in a fault when it happened."""
        try:
            yield
        except Fault as error:
            raise type(error)(f"{when}: {error}") from error

    def _training_metrics(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call, which are then forgotten."""
        episodes, self.episodes = Episodes.join(self.episodes, len(self.env.objectives)), []
        metrics: dict[str, float] = {}
        for v in range(self.env.vehicles):
            mine = episodes.vehicles == v
            if mine.any():
                summary = summarise(
                    self.env.objectives,
                    episodes.returns[mine],
                    episodes.lengths[mine],
                    episodes.succeeded[mine],
                    utility=self.utilities[v] if self.utilities else None,
                )
                prefix = TRAIN + vehicle_prefix(v, self.env.vehicles)
                metrics |= {prefix + name: value for name, value in summary.items()}
        return metrics

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def save(self, path: str | Path) -> None:
        """Write the complete training state to one safetensors file, atomically.

        Raises:
            NotFinite: if a number is not finite; a file of before is left as it was.
        """
        episodes = Episodes.join(self.episodes, len(self.env.objectives))
        unlogged = {f"{EPISODES}{name}": torch.from_numpy(array) for name, array in vars(episodes).items()}
        write_checkpoint(path, {**self.get_state(), **unlogged}, {**self.identity(), **self._counts()})

    def save_policy(self, path: str | Path) -> None:
        """Write only what acting needs to one safetensors file, atomically; ``load(..., policy_only=True)`` reads it.

        Raises:
            ValueError: if there is no policy yet.
            NotFinite: as :meth:`save`.
        """
        write_checkpoint(path, self.get_policy(), {**self.identity(), **self._counts(), POLICY_ONLY: True})

    def _counts(self) -> dict[str, int]:
        return {STEP: self.step, UPDATES: self.updates, SEED: self.seed}

    def load(self, path: str | Path, *, policy_only: bool = False) -> None:
        """Resume from :meth:`save`; no code is run from the file.

        Args:
            path: the checkpoint.
            policy_only: load the policy alone, to act in any number of environments; :meth:`save_policy` is enough.

        Raises:
            ValueError: if the file is missing or broken, belongs to another algorithm, environment or network, has
                values from which training cannot continue, or holds the policy alone where more is needed.
        """
        may_differ = ("num_envs", PARTNERS, GUIDES) if policy_only else ()
        tensors, found = read_checkpoint(path, self.identity(), may_differ, whole=not policy_only)
        expected = self.get_policy() if policy_only else self.get_state()
        tensors = check_tensors(path, tensors, expected, (EPISODES, *self.varying_shapes), whole=not policy_only)
        counts = self.step, self.updates, self.seed
        before = {name: each.clone() for name, each in {**self.get_state(), **expected}.items()}
        try:
            if policy_only:
                self.set_policy(tensors)
                return
            self.step, self.updates, self.seed = found[STEP], found[UPDATES], found[SEED]
            self.set_state(tensors)
            unlogged = {name: tensor.numpy() for name, tensor in strip_prefix(tensors, EPISODES).items()}
            self.episodes = [Episodes.of_arrays(unlogged, len(self.env.objectives))] if unlogged else []
        except (ValueError, RuntimeError) as error:
            self.step, self.updates, self.seed = counts
            self.set_state(before)
            raise ValueError(f"checkpoint {path}: {str(error).splitlines()[0]}") from None


class FrontAgent(Agent):
    """Base of the agents that learn a front: one policy for every condition.

    An algorithm defines what :class:`Agent` says except :meth:`act`, and

    - :meth:`conditions` and :attr:`condition_names`: what its policies are conditioned on, such as commands or weights.
    - :meth:`policies`: what acts under conditions.

    Args:
        env: a vector environment with vector rewards, from `mo_deepdrive.evaluation.env_adapter.make_env`.
        **options: ``seed``, ``device`` and the hyperparameters, as of :class:`Agent`.

    Attributes:
        scales: (d,) nominal size of each objective's return, by which distances between returns are measured.

    With V vehicles a policy drives all of them, and its front has their V d objectives.
    """

    known_utility = False

    def __init__(self, env: VectorEnv, **options: Any):
        super().__init__(env, **options)
        self.scales = self.env.objective_scales

    @property
    def front_objectives(self) -> tuple[str, ...]:
        """Names of the V d objectives of a front: those of each vehicle in turn."""
        return joint_objectives(self.env.objectives, self.env.vehicles)

    @property
    def front_scales(self) -> NDArray[np.float64]:
        """(V d,) :attr:`scales` of each vehicle in turn."""
        return np.tile(np.asarray(self.scales, dtype=np.float64), self.env.vehicles)

    @property
    @abstractmethod
    def condition_names(self) -> Sequence[str]:
        """Names of the m components of a condition, which become columns of front.csv."""

    @abstractmethod
    def conditions(self) -> NDArray[np.float32]:
        """(K, m) conditions of the policies of the front as it has been learnt; K is at least 1."""

    @abstractmethod
    def policies(self, conditions: NDArray[np.float32]) -> Policy:
        """What acts in N environments under ``conditions`` (N, m), or in all of them under one condition (1, m)."""

    def policy(self, condition: ArrayLike) -> Policy:
        """The policy of one row (m,) of a front's ``conditions``, for any number of environments."""
        return self.policies(np.asarray(condition, dtype=np.float32)[None])

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Not supported: the action depends on a condition; see :meth:`policy`."""
        del observations, accrued_reward, generator
        raise TypeError(f"{self.name} acts under a condition: agent.policy(condition).act(...)")

    def evaluate_policies(
        self, conditions: ArrayLike, env: VectorEnv, *, episodes: int, seed: int, gamma: float
    ) -> list[Evaluation]:
        """Evaluate the greedy policy under each of ``conditions`` (K, m), all on the same seeds.

        Args:
            conditions: rows of a front's ``conditions``.
            env: a raw environment; not the one that trains.
            episodes: per policy.
            seed: of the first episode.
            gamma: discount of the reported returns.
        """
        rows = np.asarray(conditions, dtype=np.float32)
        return evaluate_each(
            lambda chosen: self.policies(rows[chosen]), len(rows), env, episodes=episodes, seed=seed, gamma=gamma
        )

    def front(self, env: VectorEnv, *, episodes: int, seed: int, gamma: float) -> Front:
        """Evaluate the greedy policy under each of :meth:`conditions` and keep the non-dominated policies.

        Args:
            env: a raw environment, from `mo_deepdrive.evaluation.env_adapter.make_env`; not the one that trains.
            episodes: per policy; one is enough where every episode is the same.
            seed: of the first episode.
            gamma: discount of the returns by which policies dominate each other.
        """
        conditions = self.conditions()
        evaluations = self.evaluate_policies(conditions, env, episodes=episodes, seed=seed, gamma=gamma)
        return Front.of_evaluations(
            evaluations, conditions, tuple(self.condition_names), gamma=gamma, seed=seed
        ).non_dominated()

    def evaluate(self, plan: EvaluationPlan) -> tuple[dict[str, float], Front]:
        """The front and its indicators."""
        front = self.front(plan.env, episodes=plan.episodes, seed=plan.seed, gamma=plan.gamma)
        found = measure_front(
            front,
            reference_point=plan.reference_point,
            reference_front=plan.reference_front,
            scales=self.env.joint_scales,
        )
        vehicles = self.env.vehicles
        for v, best in enumerate(front.returns.max(axis=0).reshape(vehicles, -1)):
            names = (vehicle_prefix(v, vehicles) + return_of(name) for name in self.env.objectives)
            found |= dict(zip(names, best.tolist(), strict=True))
        return {evaluation_prefix(FRONT) + name: value for name, value in found.items()}, front


class PolicyOfFront(ABC):
    """An agent that learns a front, under conditions: base of what :meth:`FrontAgent.policies` returns.

    It is a policy in the sense of :class:`mo_deepdrive.evaluation.policy.Policy`; a subclass has the conditions and
    defines :meth:`act`.

    Attributes:
        agent: whose networks act.
    """

    agent: FrontAgent

    @property
    def env(self) -> EnvAdapter:
        """The agent's training environment."""
        return self.agent.env

    @property
    def gamma(self) -> float | NDArray[np.float32]:
        """Discount of the accrued reward."""
        return self.agent.gamma

    @property
    def device(self) -> torch.device:
        """Device of the networks."""
        return self.agent.device

    @property
    def utilities(self) -> tuple[Utility, ...]:
        """None is known."""
        return ()

    @abstractmethod
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy where ``generator`` is None."""
