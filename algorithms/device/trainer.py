"""Trains the agents of several seeds side by side: world, rollout, advantages and updates stay on one device."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import torch

from algorithms.agent import EvaluationPlan
from algorithms.conditioned_mo_ppo import ConditionedMOPPO
from algorithms.device.collection import Collection
from algorithms.device.learner import ConditionedSeedLearner, SeedLearner
from algorithms.device.preferences import SeedPreferences
from algorithms.device.team import SeedTeams
from algorithms.files.checkpoints import SEED, STEP, UPDATES, read_checkpoint, strip_prefix, write_checkpoint
from algorithms.hyperparameters import a_twentieth
from algorithms.mappo import MAPPO
from algorithms.networks.compiled import plain_torch
from algorithms.networks.optimiser import geometric_schedule, linear_schedule
from mo_deepdrive.evaluation.metrics import (
    ENTROPY_COEFFICIENT,
    LEARNING_RATE,
    STEPS_PER_SECOND,
    TRAIN,
    vehicle_prefix,
)
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.faults import Fault, check_numbers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray

    from algorithms.agent import Log, LogFront
    from algorithms.device.worlds import SeedWorlds
    from mo_deepdrive.utilities import Utility

KEPT = "resident."  # prefix of the tensors of a checkpoint that its agent does not know
WARM_UP = 2  # updates before one is captured: what is compiled or allocated once must not be part of it


class SeedTrainer:
    """Trains S agents that differ in their seeds alone, none of which influences another.

    An update of all of them is one CUDA graph on a GPU; nothing waits for the device but logging, evaluation and
    checkpoints.

    Args:
        agents: S untrained agents on the CPU, with any number of environments, which they evaluate and are saved by.
        template: an agent of the same settings with its networks on the device; it lends the learners their equations.
        worlds: N for each seed.
        num_envs: N.
        compiled: whether ``torch.compile`` makes an update into fewer kernels.

    Attributes:
        step: environment steps of each seed.
        updates: rollouts that have been collected.
    """

    def __init__(
        self, agents: Sequence[Any], template: Any, worlds: SeedWorlds, num_envs: int, *, compiled: bool = False
    ):
        self.agents, self.num_envs, self.config = list(agents), num_envs, template.config
        self.device: torch.device = template.device
        self.env = template.env
        self.step = self.updates = 0
        count, steps = len(self.agents), self.config.steps
        utilities = [utility.unchecked() for utility in template.utilities]  # a check would wait for the device
        for learner in template.learners if utilities else ():
            learner.utility = utilities[learner.vehicle]
        self.collection = Collection(
            self.env,
            worlds,
            (count, steps, num_envs),
            template.accrued_discount,
            utilities,
            self.device,
            compiled=compiled,
        )
        self.teams = self.preferences = None
        kind: type[SeedLearner] = SeedLearner
        if isinstance(template, MAPPO):
            template.team.utilities = utilities
            self.teams = SeedTeams(template.team, count, num_envs, self.env.vehicles)
        elif isinstance(template, ConditionedMOPPO):
            kind, shape = ConditionedSeedLearner, (count, steps, num_envs, self.env.vehicles)
            self.preferences = SeedPreferences(template.preferences, shape, self.config.switching, self.device)
        self.learners = [
            kind(learner, [agent.learners[k] for agent in self.agents], num_envs, self.device, compiled=compiled)
            for k, learner in enumerate(template.learners)
        ]
        self._check_functions(utilities)
        self._generator = torch.Generator(self.device)
        self._learning_rate, self._entropy_coefficient = torch.zeros(2, device=self.device)
        self._graph: Any = None
        self._warmed_up = 0  # updates in this process

    def _check_functions(self, utilities: Sequence[Utility]) -> None:
        """Call what may be a user's own for all seeds at once, before a training that would fail in it.

        Raises:
            ValueError: if it cannot be called so.
        """
        returns = torch.zeros(len(self.agents), 2, len(self.env.objectives), device=self.device)
        calls: dict[str, Callable[[], Any]] = {
            f"utility {each.name!r}": partial(torch.func.vmap(each), returns) for each in utilities
        }
        if self.config.network is not None:
            calls[f"algorithm.network = {self.config.network!r}"] = partial(self._act, 0, self.collection.running)
        for name, call in calls.items():
            try:
                with plain_torch():
                    call()
            except Exception as error:
                reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
                raise ValueError(
                    f"{name} cannot be called by torch.func.vmap, as for several seeds and on a GPU: {reason}"
                ) from error

    # ------------------------------------------------------------------------------------------------------- an update

    def update(self, progress: float) -> None:
        """Collect a rollout of every seed and learn from it.

        Args:
            progress: fraction of training that is done, in [0, 1), for schedules.
        """
        config = self.config
        self._learning_rate.fill_(linear_schedule(config.learning_rate, config.learning_rate_end, progress))
        self._entropy_coefficient.fill_(
            geometric_schedule(config.entropy_start, config.entropy_end, progress / config.entropy_until)
        )
        if config.cost_growth:
            grown = self.preferences or self.collection
            grown.cost_share.fill_(min(1.0, progress / config.cost_growth))
        for seed, agent in enumerate(self.agents):
            agent.updates = self.updates
            drawing: list[Any] = [*self.learners, *([self.preferences] if self.preferences else [])]
            for stream, each in enumerate(drawing):
                each.draw(seed, self._generator.manual_seed(agent.update_generator(stream).initial_seed()))
        self._run()
        self.step += config.steps * self.num_envs
        self.updates += 1

    def _run(self) -> None:
        """The part of an update that is the same every time, as one CUDA graph where that is possible."""
        self._warmed_up += 1
        if self.device.type != "cuda" or self._warmed_up <= WARM_UP:
            self._update()
            return
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            torch.cuda.synchronize(self.device)
            with torch.cuda.device(self.device), torch.cuda.graph(self._graph):
                self._update()
        self._graph.replay()

    def _update(self) -> None:
        with plain_torch():
            self._collect_and_learn()

    def _collect_and_learn(self) -> None:
        collection = self.collection
        collection.collect(self._act)
        shared: list[Any] = []
        if self.teams is not None:
            shared = [self.teams.follow(collection.rollout)]
        if self.preferences is not None:
            shared = [self.preferences.rollout, self.preferences.running["ideal"]]
        for learner in self.learners:
            v = learner.vehicle
            learner.note_episodes(collection.ended_values[:, :, :, v], collection.ended[:, :, :, v])
            learner.update(collection.rollout, self._learning_rate, self._entropy_coefficient, *shared)
        if self.preferences is not None:
            self.preferences.note_episodes(collection.ended_values, collection.ended)

    def _act(self, t: int, now: Mapping[str, torch.Tensor]) -> torch.Tensor:
        shared: list[Any] = []
        if self.preferences is not None:
            shared = [self.preferences.follow(t, now["lengths"]), self.preferences.running["ideal"]]
        return torch.stack([learner.act(t, now, *shared) for learner in self.learners], dim=2)

    def metrics(self) -> list[dict[str, float]]:
        """Of every seed: the losses of the last update, and means over the episodes since the last call.

        Raises:
            NotFinite: naming the seed and the loss.
        """
        vehicles = self.env.vehicles
        schedules = {
            LEARNING_RATE: float(self._learning_rate),
            ENTROPY_COEFFICIENT: float(self._entropy_coefficient),
        }
        losses = [{name: loss.tolist() for name, loss in learner.losses.items()} for learner in self.learners]
        rows: list[dict[str, float]] = []
        for seed, means in enumerate(self.collection.take_totals()):
            row: dict[str, float] = {}
            for v, each in enumerate(means):
                prefix = TRAIN + vehicle_prefix(v, vehicles)
                row |= {prefix + name: value for name, value in each.items()}
            row |= schedules
            for learner, found in zip(self.learners, losses, strict=True):
                prefix = vehicle_prefix(learner.vehicle, vehicles)
                row |= {prefix + name: values[seed] for name, values in found.items()}
            with self._of_seed(seed, f"in the update before step {self.step:,}"):
                check_numbers(row)
            rows.append(row)
        return rows

    # -------------------------------------------------------------------------------------------------------- training

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
        log: Sequence[Log] = (),
        log_front: Sequence[LogFront] | None = None,
        log_interval: int = 10,
        after_update: Callable[[SeedTrainer], bool] | None = None,
    ) -> None:
        """Learn until every seed has taken ``total_timesteps`` environment steps.

        The arguments are those of :meth:`algorithms.agent.Agent.train`, but for ``log`` and ``log_front``, which are
        one function per seed.

        Raises:
            NotFinite: naming the seed and what is not finite.
            ValueError: if a world was given what it cannot do.
        """
        interval = a_twentieth(total_timesteps) if eval_interval is None else eval_interval
        plan = None
        if eval_env is not None:
            plan = EvaluationPlan(eval_env, eval_episodes, eval_seed, eval_gamma, reference_point, reference_front)
        if self.step == 0:
            self.collection.reset()
            self._log_evaluations(plan, log, log_front)
        started, first = perf_counter(), self.step
        while self.step < total_timesteps:
            before = self.step
            self.update(before / total_timesteps)
            last = self.step >= total_timesteps
            if (log and self.updates % log_interval == 0) or last:
                self.collection.worlds.check()
                rows = self.metrics()  # waits for the device
                rate = {STEPS_PER_SECOND: (self.step - first) / (perf_counter() - started)}
                for log_row, row in zip(log, rows, strict=bool(log)):
                    log_row(self.step, {**row, **rate})
            if self.step // interval > before // interval or last:
                paused = perf_counter()
                self._log_evaluations(plan, log, log_front)
                started += perf_counter() - paused
            if self._warmed_up == WARM_UP + 1:  # what was compiled and captured until now says nothing of the speed
                started, first = perf_counter(), self.step
            if after_update is not None and after_update(self):
                return

    def _log_evaluations(
        self, plan: EvaluationPlan | None, log: Sequence[Log], log_front: Sequence[LogFront] | None
    ) -> None:
        if plan is None or not log:
            return
        for seed, agent in enumerate(self.hand_over()):
            with self._of_seed(seed, f"in the evaluation at step {self.step:,}"):
                metrics, front = agent.evaluate(plan)
            log[seed](self.step, metrics)
            if log_front is not None and front is not None:
                log_front[seed](self.step, front)

    @contextmanager
    def _of_seed(self, seed: int, when: str) -> Iterator[None]:
        """Say in a fault when it happened, and to which seed."""
        try:
            yield
        except Fault as error:
            raise type(error)(f"seed {self.agents[seed].seed}, {when}: {error}") from error

    # ----------------------------------------------------------------------------------------------------- checkpoints

    @property
    def schedules(self) -> list[str]:
        """The settings by which training depends on its length, as of an agent."""
        found: list[str] = self.agents[0].schedules
        return found

    def hand_over(self) -> list[Any]:
        """Every seed's agent, with what has been learnt."""
        return [self._handed_over(seed) for seed in range(len(self.agents))]

    def _handed_over(self, seed: int) -> Any:
        agent = self.agents[seed]
        agent.step, agent.updates = self.step, self.updates
        for learner, own in zip(self.learners, agent.learners, strict=True):
            learner.write(seed, own)
        if self.preferences is not None:
            self.preferences.write(seed, agent.preferences)
        return agent

    def save(self, seed: int, path: str | Path) -> None:
        """Write the checkpoint of the seed with this index: the policy in the form of its agent, and what continues.

        Raises:
            NotFinite: naming the seed, if a number is not finite; a file of before is left as it was.
        """
        agent = self._handed_over(seed)
        tensors: dict[str, torch.Tensor] = agent.get_policy()
        for own in agent.learners:
            tensors |= {f"vehicle_{own.vehicle}.{name}": each for name, each in own.get_state().items()}
        tensors |= {f"{KEPT}{name}": each for name, each in self.collection.get_state(seed).items()}
        tensors |= {f"{KEPT}{name}": each[seed] for name, each in self._running().items()}
        with self._of_seed(seed, f"at step {self.step:,}"):
            write_checkpoint(path, tensors, {**self._identity(agent), STEP: self.step, UPDATES: self.updates})

    def load(self, paths: Sequence[str | Path]) -> None:
        """Resume from the checkpoints of all seeds, in their order.

        Raises:
            ValueError: if one cannot be read, is not of such a training, or they are of different steps.
        """
        counts, states = set(), []
        for seed, (path, agent) in enumerate(zip(paths, self.agents, strict=True)):
            tensors, found = read_checkpoint(path, self._identity(agent), whole=True)
            counts.add((found[STEP], found[UPDATES]))
            try:
                for learner, own in zip(self.learners, agent.learners, strict=True):
                    own.set_state(strip_prefix(tensors, f"vehicle_{own.vehicle}."))
                    learner.read(seed, own)
                states.append(strip_prefix(tensors, KEPT))
                for name, each in self._running().items():
                    each[seed] = states[-1][name]
            except (KeyError, RuntimeError) as error:
                raise ValueError(f"checkpoint {path}: {str(error).splitlines()[0]}") from None
        if len(counts) > 1:
            steps = ", ".join(f"{step:,}" for step, _ in sorted(counts))
            raise ValueError(f"the checkpoints are of the steps {steps}; resume those of the same step together")
        self.collection.set_state(states)
        self.step, self.updates = counts.pop()

    def _running(self) -> dict[str, torch.Tensor]:
        """What teams or preferences keep of running episodes, (S, ...)."""
        parts = [("team.", self.teams), ("preferences.", self.preferences)]
        return {prefix + name: each for prefix, part in parts if part for name, each in part.running.items()}

    def _identity(self, agent: Any) -> dict[str, Any]:
        return {**agent.identity(), "num_envs": self.num_envs, "resident": True, SEED: agent.seed}
