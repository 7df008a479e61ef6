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
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from algorithms.hyperparameters import a_twentieth
from algorithms.learning.checkpoints import (
    GUIDES,
    PARTNERS,
    POLICY_ONLY,
    RESIDENT,
    SEED,
    STEP,
    UPDATES,
    check_tensors,
    read_checkpoint,
    write_checkpoint,
)
from algorithms.learning.compiling import WORTHWHILE, has_compiler, origin
from algorithms.learning.storage import EpisodeSums
from algorithms.learning.threads import limited_threads
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
    vehicle_prefix,
)
from mo_deepdrive.evaluation.splits import FIRST_TRAINING_SEED, SPLITS
from mo_deepdrive.support.faults import Fault, check_numbers
from mo_deepdrive.world.config import Settings, parse

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from gymnasium.vector import VectorEnv
    from numpy.typing import ArrayLike, NDArray

    from mo_deepdrive.evaluation.episodes import UtilityLike
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.policy import AccruedReward, Policy
    from mo_deepdrive.utilities import Utility

ACTIONS, DRAWS, LEARNING = 0, 1, 2  # streams of random numbers; of the vehicle v, LEARNING + v
EPISODES = "episodes"  # the tensor of sums over the episodes that have not been logged yet

Log = Callable[[int, dict[str, float]], None]
LogFront = Callable[[int, Front], None]


@dataclass(frozen=True)
class EvaluationSchedule:
    """How an agent is evaluated while it trains; :meth:`Agent.train` describes the fields."""

    env: VectorEnv
    episodes: int
    seed: int
    gamma: float
    reference_point: Sequence[float] | None = None
    reference_front: NDArray[np.float64] | None = None


class Agent(ABC):
    """Base of all agents.

    An algorithm defines

    - ``Config``, a subclass of :class:`mo_deepdrive.world.config.Settings` with its hyperparameters: the keys of the
      ``algorithm`` section. ``gamma`` is the discount of the accrued reward that ``act`` is given; 1 without it.
    - ``__init__(self, env, utility, **options)``, which calls that of this class with the same arguments and makes
      networks and optimisers.
    - :meth:`act`, the policy.
    - :meth:`update`, which collects experience and learns from it once.
    - :meth:`get_state` and :meth:`set_state`: what determines the rest of the run, as named tensors. The names of an
      optimiser's contain "optimiser.". ``step``, ``updates`` and ``episodes`` are saved here.

    It may define ``name``, :meth:`begin`, :meth:`get_policy` and :meth:`set_policy`, :meth:`identity` and
    :attr:`varying_shapes`, and use :class:`algorithms.learning.learner.Learner` and what else is in that package.
    Everything random is drawn from ``initial``, ``generator`` or a generator with the seed :meth:`seed_of`, so that a
    run can be repeated and resumed bit for bit.

    Args:
        env: a vector environment with vector rewards, from `mo_deepdrive.evaluation.env_adapter.make_env`.
        utility: the known utility, its name or a function of returns (..., d), or a list with one per vehicle; None for
            agents that learn a front.
        seed: determines the run, bit for bit on one machine; several seeds train side by side.
        device: of what learns; "cuda" moves the environments there, too.
        compiled: whether gradient steps go through ``torch.compile``; "auto" where that saves more time than it takes
            and a compiler is there. The numbers are the same but for rounding.
        config: the hyperparameters, an instance of the class's Config.
        **hyperparameters: fields of the Config, in place of ``config``.

    Attributes:
        name: of the algorithm, in checkpoints; that of the class where it is not set.
        known_utility: whether the agent learns for a known utility, or a front for every utility.
        trains_with_partners, trains_with_guides, shares_policies: whether its constructor takes ``partners``,
            ``guides`` and ``share_policy``, as that of :class:`algorithms.actor_critic.ActorCritic`.
        trains_on_devices: whether it can train on a GPU, and several seeds side by side.
        compiled_saves: seconds by which a compiled gradient step is shorter.
        varying_shapes: parts of the names of tensors whose shapes are not known before a checkpoint is read.
        env: the training environment, an EnvAdapter: its reset and step are in shapes (N, V, ...).
        learners: what learns by gradient steps, each a Learner.
        scales: (d,) nominal size of each objective's return.
        utilities: one per vehicle; empty where none is known.
        seeds: all S of them.
        failed: why seeds ended before the others, by their indices.
        step: environment steps that each seed has taken, over all its parallel environments.
        updates: rollouts, or rounds of episodes, that have been collected.
        episodes: sums over those that ended since training metrics were last logged.
        initial, generator: of the initial weights, and of the exploring actions of an update.

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
    compiled_saves: ClassVar[float] = 1.4e-3
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
        seed: int | Sequence[int] = 0,
        device: str = "cpu",
        compiled: bool | Literal["auto"] = "auto",
        config: Settings | None = None,
        **hyperparameters: Any,
    ):
        if config is not None and hyperparameters:
            raise ValueError(f"{', '.join(hyperparameters)}: give either config or single hyperparameters")
        self.config = config or parse(self.Config, hyperparameters, f"hyperparameters of {self.name}")
        if not isinstance(self.config, self.Config):
            needed = self.Config.__qualname__
            raise ValueError(f"config of class {type(config).__qualname__} must be an instance of {needed}")
        if self.known_utility and utility is None:
            raise ValueError(f"utility is missing: algorithm {self.name!r} learns for a known utility")
        self.env = EnvAdapter(env)
        self.scales = self.env.objective_scales
        self.seeds = (seed,) if isinstance(seed, int) else tuple(seed)
        self.device, self.compiled = torch.device(device), compiled
        self.learners: Sequence[Any] = ()
        if not self.seeds or (self.resident and not (self.trains_on_devices and self.env.native)):
            raise ValueError(
                f"seed = {seed!r}, device = {device!r}: algorithm {self.name!r} in {self.env.name} trains one seed, on "
                "the CPU"
            )
        self.utilities: list[Utility] = list(vehicle_utilities(utility, self.env))
        for known in self.utilities if self.resident else ():  # they are called for all seeds at once
            try:
                torch.func.vmap(known.unchecked())(torch.zeros(2, 3, len(self.env.objectives), device=self.device))
            except Exception as error:
                raise ValueError(
                    f"utility {known.name!r} cannot be calculated for several seeds at once, because of "
                    f"{origin(error)}; take operations of torch on whole tensors, such as torch.where instead of if"
                ) from error
        self.step, self.updates = 0, 0
        self.failed: dict[int, str] = {}
        self.initial = self.initial_generator(0)
        self.generator = torch.Generator(self.device).manual_seed(self.seed_of(ACTIONS))
        unchecked = [known.unchecked() for known in self.utilities]
        self.episodes = EpisodeSums(len(self.seeds), self.env.vehicles, self.env.objectives, unchecked, self.device)

    @property
    def seed(self) -> int:
        """The only seed, or the first one."""
        return self.seeds[0]

    def initial_generator(self, index: int) -> torch.Generator:
        """The generator of the initial weights of the seed with this index."""
        return torch.Generator().manual_seed(int(np.random.SeedSequence(self.seeds[index]).generate_state(2)[0]))

    @property
    def env_seeds(self) -> list[int]:
        """Of the first reset of every seed's training environment."""
        return [FIRST_TRAINING_SEED + int(np.random.SeedSequence(seed).generate_state(2)[1]) for seed in self.seeds]

    @property
    def env_seed(self) -> int:
        """Of the first reset of the only seed's training environment."""
        return self.env_seeds[0]

    def of_seed(self, index: int) -> Any:
        """The agent of one seed, on the CPU, with what it has learnt; itself if there is no other."""
        assert index == 0
        return self

    def seed_of(self, stream: int, index: int = 0) -> int:
        """The seed of an update's random numbers, a function of a seed of the run, a stream and the updates so far."""
        entropy = [self.seeds[index], stream, self.updates]
        return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0]) >> 1

    @property
    def resident(self) -> bool:
        """Whether the worlds are on the device, as those of several seeds are."""
        return len(self.seeds) > 1 or self.device.type != "cpu"

    def vehicle_groups(self, share_policy: bool, partners: Container[int] = ()) -> list[tuple[int, ...]]:
        """The vehicles of each policy that learns: one each, or all that no partner drives."""
        learning = [v for v in range(self.env.vehicles) if v not in partners]
        if not share_policy:
            return [(v,) for v in learning]
        if len(learning) == 1:
            raise ValueError(f"share_policy = True needs several vehicles that learn; {self.env.name} has one")
        utilities = [(self.utilities[v].name, self.utilities[v].arguments) for v in learning if self.utilities]
        if any(utility != utilities[0] for utility in utilities):
            names = ", ".join(repr(name) for name, _ in utilities)
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

    # ---------------------------------------------------------------------------------------- what an algorithm defines

    @abstractmethod
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o) of running episodes; greedy without a generator."""

    def begin(self) -> None:
        """Prepare the first update: reset environments, collect first episodes."""
        return

    @abstractmethod
    def update(self, progress: float) -> dict[str, Any]:
        """Act and learn once, and return the losses by name: numbers, or tensors (S,) with one for each seed.

        Adds the environment steps that it took to ``step``, 1 to ``updates``, and to ``episodes`` those that ended.
        ``progress`` is the fraction of training that is done, in [0, 1), for schedules.
        """

    @abstractmethod
    def get_state(self) -> dict[str, Tensor]:
        """What determines the rest of the run, as finite named tensors: networks, optimisers, running episodes."""

    @abstractmethod
    def set_state(self, state: dict[str, Tensor]) -> None:
        """Resume from :meth:`get_state`; ``step`` and ``updates`` are set already."""

    def get_policy(self) -> dict[str, Tensor]:
        """What acting needs: a part of :meth:`get_state`, or a summary of it."""
        return self.get_state()

    def set_policy(self, state: dict[str, Tensor]) -> None:
        """Act as the agent of :meth:`get_policy` or :meth:`get_state`."""
        self.set_state(state)

    def evaluate(self, schedule: EvaluationSchedule) -> tuple[dict[str, float], Front | None]:
        """Metrics of the current policy, greedy and stochastic; a front too where the agent learns one."""
        metrics: dict[str, float] = {}
        options: dict[str, Any] = {"episodes": schedule.episodes, "seed": schedule.seed, "gamma": schedule.gamma}
        for policy in (GREEDY, STOCHASTIC):
            result = evaluate(self, schedule.env, greedy=policy == GREEDY, **options)
            metrics |= {evaluation_prefix(policy) + name: value for name, value in result.metrics().items()}
        return metrics, None

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must share with the agent that reads it."""
        return {
            **({RESIDENT: True} if self.resident else {}),
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
        log: Log | Sequence[Log] | None = None,
        log_front: LogFront | Sequence[LogFront] | None = None,
        log_interval: int = 10,
        after_update: Callable[[Any], bool] | None = None,
    ) -> None:
        """Learn until ``total_timesteps`` environment steps have been taken, over all parallel environments together.

        On one thread, unless :func:`algorithms.learning.threads.set_threads` has been called with more.

        Args:
            total_timesteps: also the length of schedules; a resumed run passes the same number.
            eval_env: a separate environment for evaluations before, during and after training; None for none.
            eval_interval: environment steps between evaluations; a twentieth of the total if None.
            eval_episodes: episodes per evaluation (per policy of a front).
            eval_seed: seed of the first episode.
            eval_gamma: discount of the reported returns.
            reference_point: (d,) of the hypervolume of a front; None for no hypervolume.
            reference_front: (k, d) best-known front; None where there is none.
            log: called as ``log(step, metrics)``; with several seeds one function for each.
            log_front: called as ``log_front(step, front)`` by agents that learn a front; one for each seed.
            log_interval: updates between two rows of training metrics.
            after_update: called as ``after_update(agent)``; True stops training.

        Raises:
            ValueError: for negative steps, or intervals below 1.
            NotFinite: if something is not finite, with where it comes from; of several seeds when all have failed.
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
        schedule = None
        if eval_env is not None:
            schedule = EvaluationSchedule(
                eval_env, eval_episodes, eval_seed, eval_gamma, reference_point, reference_front
            )
        self._choose_compiled(total_timesteps)
        logs = [log] if callable(log) else list(log or ())
        log_fronts = [log_front] if callable(log_front) else list(log_front or ())
        if self.step == 0:
            with self._located("before the first update"):
                self.begin()
            self._log_evaluations(schedule, logs, log_fronts)
        begun = first = self.step
        started = perf_counter()
        while self.step < total_timesteps:
            before, when = self.step, f"in the update after step {self.step:,}"
            with self._located(when):
                self.generator.manual_seed(self.seed_of(ACTIONS))
                losses = self.update(before / total_timesteps)
            if self.step <= before:
                raise RuntimeError(f"{type(self).__name__}.update must add the environment steps that it takes to step")
            last = self.step >= total_timesteps
            due = self.updates % log_interval == 0 or last
            if due or self.device.type == "cpu":  # on a GPU a check has to wait for it
                self._check(losses, when)
            if due:
                rows, now = self._training_metrics(losses), perf_counter()
                for seed, row in rows.items() if logs else ():
                    logs[seed](self.step, {**row, STEPS_PER_SECOND: (self.step - first) / (now - started)})
            if self.step // interval > before // interval or last:
                paused = perf_counter()
                self._log_evaluations(schedule, logs, log_fronts)
                started += perf_counter() - paused
            if before == begun:  # code may have been compiled, which says nothing of the speed
                started, first = perf_counter(), self.step
            if after_update is not None and after_update(self):
                return

    def gradient_steps(self, total_timesteps: int) -> int:
        """How many of :attr:`learners` there are in a training; 0 where that is not known."""
        del total_timesteps
        return 0

    def _choose_compiled(self, total_timesteps: int) -> None:
        """Decide whether gradient steps are compiled."""
        device, compiled = self.device.type, self.compiled
        if compiled is True and not has_compiler(device):
            needed = "a C++ compiler such as g++" if device == "cpu" else "Triton"
            raise ValueError(f"training.compiled = True needs {needed}, which is not installed; take auto or false")
        if compiled == "auto":
            pays = self.compiled_saves * self.gradient_steps(total_timesteps) >= WORTHWHILE[device]
            compiled = "auto" if pays and has_compiler(device) else False
        for learner in self.learners:
            learner.compiled = compiled
            learner.computes_compiled = False if device == "cpu" else compiled  # there it pays for gradient steps alone

    def _log_evaluations(
        self, schedule: EvaluationSchedule | None, logs: Sequence[Log], log_fronts: Sequence[LogFront]
    ) -> None:
        if schedule is None or not (logs or log_fronts):
            return
        for seed in self._alive():
            with self.alone(seed, f"in the evaluation at step {self.step:,}"):
                metrics, front = self.of_seed(seed).evaluate(schedule)
                if logs:
                    logs[seed](self.step, metrics)
                if log_fronts and front is not None:
                    log_fronts[seed](self.step, front)

    def _check(self, losses: Mapping[str, Any], when: str) -> None:
        """Find the seeds of which a loss is not finite, or whose worlds or networks have failed."""
        for seed in self._alive():
            with self.alone(seed, when):
                self.check(seed)
                check_numbers(_of_seed(losses, seed))

    def check(self, seed: int) -> None:
        """Refuse what the seed with this index has computed since the last call, if it is not finite."""
        del seed

    def fail(self, seed: int, error: Fault, when: str) -> None:
        """End a seed; the others go on, or the fault is raised if there is none."""
        name = f"seed {self.seeds[seed]}, " if len(self.seeds) > 1 else ""
        fault = type(error)(f"{name}{when}: {error}")
        self.failed[seed] = str(fault)
        if len(self.failed) == len(self.seeds):
            raise fault from error

    def _alive(self) -> list[int]:
        """The indices of the seeds that have not failed."""
        return [seed for seed in range(len(self.seeds)) if seed not in self.failed]

    @contextmanager
    def alone(self, seed: int, when: str) -> Iterator[None]:
        """Let a fault end this seed alone."""
        try:
            yield
        except Fault as error:
            self.fail(seed, error, when)

    @contextmanager
    def _located(self, when: str) -> Iterator[None]:
        """Say in a fault when it happened, which ends all seeds."""
        try:
            yield
        except Fault as error:
            raise type(error)(f"{when}: {error}") from error

    def _training_metrics(self, losses: Mapping[str, Any]) -> dict[int, dict[str, float]]:
        """By seed: means over the episodes that ended since the last call, and the losses."""
        rows, episodes = {}, self.episodes.take()
        prefixes = [TRAIN + vehicle_prefix(v, self.env.vehicles) for v in range(self.env.vehicles)]
        for seed in self._alive():
            with self.alone(seed, f"in the episodes up to step {self.step:,}"):
                vehicles = zip(prefixes, episodes[seed], strict=True)
                means = {prefix + name: value for prefix, sums in vehicles for name, value in sums.items()}
                check_numbers(means)
                rows[seed] = {**means, **_of_seed(losses, seed)}
        return rows

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def save(self, path: str | Path, seed: int = 0) -> None:
        """Write the complete training state of the seed with this index to one safetensors file, atomically.

        A number that is not finite is refused; a file of before is then left as it was.
        """
        state = {**self.get_seed_state(seed), EPISODES: self.episodes.totals[seed]}
        write_checkpoint(path, state, {**self.identity(), **self._counts(seed)})

    def save_policy(self, path: str | Path) -> None:
        """Write only what acting needs to one file, atomically; ``load(..., policy_only=True)`` reads it."""
        write_checkpoint(path, self.get_policy(), {**self.identity(), **self._counts(), POLICY_ONLY: True})

    def _counts(self, seed: int = 0) -> dict[str, int]:
        return {STEP: self.step, UPDATES: self.updates, SEED: self.seeds[seed]}

    def get_seed_state(self, seed: int) -> dict[str, Tensor]:
        """:meth:`get_state` of the seed with this index."""
        del seed  # the only one
        return self.get_state()

    def set_seed_states(self, states: Sequence[dict[str, Tensor]]) -> None:
        """Resume from :meth:`get_seed_state` of all seeds."""
        self.set_state(states[0])

    def load(self, *paths: str | Path, policy_only: bool = False) -> None:
        """Resume from the checkpoint of every seed, of :meth:`save`; no code is run from the files.

        With ``policy_only`` load the policy alone, to act in any number of environments; :meth:`save_policy` is enough.

        Raises:
            ValueError: if a file is missing or broken, belongs to another algorithm, environment or network, has
                numbers that are not finite, or holds the policy alone where more is needed; or the files are of
                different steps.
        """
        whole = not policy_only
        may_differ = () if whole else ("num_envs", RESIDENT, PARTNERS, GUIDES)
        expected = {**self.get_seed_state(0), EPISODES: self.episodes.totals[0]} if whole else self.get_policy()
        headers, states = [], []
        for path in paths:
            tensors, header = read_checkpoint(path, self.identity(), may_differ, whole=whole)
            states.append(check_tensors(path, tensors, expected, self.varying_shapes, whole=whole))
            headers.append(header)
        if len(steps := {header[STEP] for header in headers}) > 1:
            named = ", ".join(f"{step:,}" for step in sorted(steps))
            raise ValueError(f"the checkpoints are of the steps {named}; resume those of the same step together")
        if policy_only:
            self.set_policy(states[0])
            return
        self.step, self.updates = headers[0][STEP], headers[0][UPDATES]
        self.seeds = tuple(header[SEED] for header in headers)
        self.set_seed_states(states)
        for seed, state in enumerate(states):
            self.episodes.totals[seed] = state[EPISODES]


def _of_seed(losses: Mapping[str, Any], seed: int) -> dict[str, float]:
    """The numbers of one seed."""
    return {
        name: float(value[seed]) if isinstance(value, Tensor) and value.dim() else float(value)
        for name, value in losses.items()
    }


class FrontAgent(Agent):
    """Base of the agents that learn a front: one policy for every condition.

    An algorithm defines what :class:`Agent` says except :meth:`act`, and

    - :meth:`conditions` and :attr:`condition_names`: what its policies are conditioned on, such as commands or weights.
    - :meth:`policies`: what acts under conditions, such as a :class:`PolicyOfFront`.

    With V vehicles a policy drives all of them, and its front has their V d objectives: those of each vehicle in turn.
    """

    known_utility = False

    @property
    def front_objectives(self) -> tuple[str, ...]:
        """Names of the V d objectives of a front."""
        return joint_objectives(self.env.objectives, self.env.vehicles)

    @property
    def front_scales(self) -> NDArray[np.float64]:
        """(V d,) their :attr:`scales`."""
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
        """That of one row (m,) of a front's ``conditions``, for any number of environments."""
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
        """Evaluate the greedy policy under each of ``conditions`` (K, m), all on the same seeds, as :meth:`front`."""
        rows = np.asarray(conditions, dtype=np.float32)
        options: dict[str, Any] = {"episodes": episodes, "seed": seed, "gamma": gamma}
        return evaluate_each(lambda chosen: self.policies(rows[chosen]), len(rows), env, **options)

    def front(self, env: VectorEnv, *, episodes: int, seed: int, gamma: float) -> Front:
        """Evaluate the greedy policy under each of :meth:`conditions` and keep the non-dominated policies.

        Args:
            env: a raw environment, from `mo_deepdrive.evaluation.env_adapter.make_env`; not the one that trains.
            episodes: per policy; one is enough where every episode is the same.
            seed: of the first episode.
            gamma: discount of the returns by which policies dominate each other.
        """
        conditions, names = self.conditions(), tuple(self.condition_names)
        evaluations = self.evaluate_policies(conditions, env, episodes=episodes, seed=seed, gamma=gamma)
        return Front.of_evaluations(evaluations, conditions, names, gamma=gamma, seed=seed).non_dominated()

    def evaluate(self, schedule: EvaluationSchedule) -> tuple[dict[str, float], Front]:
        """The front and its indicators."""
        front = self.front(schedule.env, episodes=schedule.episodes, seed=schedule.seed, gamma=schedule.gamma)
        points = {"reference_point": schedule.reference_point, "reference_front": schedule.reference_front}
        metrics = measure_front(front, **points, scales=self.env.joint_scales)
        vehicles = range(self.env.vehicles)
        prefixes = [vehicle_prefix(v, len(vehicles)) for v in vehicles]
        names = (prefix + return_of(name) for prefix in prefixes for name in self.env.objectives)
        metrics |= dict(zip(names, front.returns.max(axis=0).tolist(), strict=True))
        return {evaluation_prefix(FRONT) + name: value for name, value in metrics.items()}, front


class PolicyOfFront:
    """An agent that learns a front, under conditions: a policy (:class:`mo_deepdrive.evaluation.policy.Policy`).

    It acts by ``agent.act_under(conditions, observations, accrued_reward, generator)``; the conditions (N, ...) are one
    per environment, or (1, ...) for all.
    """

    utilities: tuple[Utility, ...] = ()

    def __init__(self, agent: Any, conditions: NDArray[np.float32]):
        self.agent, self.conditions = agent, conditions
        self.env, self.gamma, self.device = agent.env, agent.gamma, agent.device

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy where ``generator`` is None."""
        actions: NDArray[Any] = self.agent.act_under(self.conditions, observations, accrued_reward, generator)
        return actions
