"""Trained policies as ONNX files, which other programs run without this package and without PyTorch.

The graph takes what an environment gives: raw observations and, where the policy depends on them, the accrued reward,
its discount, and the condition of a front. Scales, networks and the greedy action are inside.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.spaces import Discrete
from torch import nn

import mo_deepdrive
from algorithms.actor_critic import ActorCritic
from algorithms.agent import FrontAgent
from algorithms.conditioned_mo_ppo import ConditionedMOPPO
from algorithms.learning.actors import CategoricalActor
from algorithms.pcn import PCN
from algorithms.runs.build import make_environment
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.policy import SMALLEST_DISCOUNT, AccruedReward
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.support.extras import needed_for

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from algorithms.learning.actors import Actor
    from algorithms.runs.config import Experiment

OBSERVATION, ACCRUED, DISCOUNT, DECISIONS = "observation", "accrued_reward", "discount", "decisions"
COMMAND, PREFERENCE = "command", "preference"  # conditions of PCN and of conditioned MO-PPO
ACTION, LOGITS, MEAN, STD = "action", "logits", "mean", "std"
OPSET = 17
CHECKED_STATES, CHECKED_ENVS = 1000, 50
TOLERANCE = 1e-5  # of logits, means and deviations, relative to their size where it is above 1


@dataclass(frozen=True)
class OnnxExport:
    """What was exported.

    Attributes:
        inputs, outputs: names with shapes, such as ``observation (N, 15)``.
        difference: largest difference of an output from PyTorch's in the states that were checked; None if onnxruntime
            is not installed.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    difference: float | None


def export_onnx(
    agent: Any, experiment: Experiment, path: Path, condition: NDArray[np.float32] | None = None
) -> OnnxExport:
    """Write the policy of an agent as an ONNX file and, where onnxruntime is installed, check it by driving.

    Args:
        agent: trained, of one of this package's classes or a subclass of ActorCritic.
        experiment: that it was trained on.
        path: the file.
        condition: of a front, the row of its conditions that the file is to follow; None makes it an input.
    """
    with needed_for("exporting", "onnx"):
        import onnx

    graph = _graph(agent, condition)
    outputs = graph.output_names
    observations, past, conditions, _ = next(_visited(agent, experiment, condition))
    example = graph.inputs(observations, past, conditions)
    # PyTorch from 2.5 on has a second exporter, which needs onnxscript and twenty times as long.
    options: dict[str, Any] = {"dynamo": False} if "dynamo" in inspect.signature(torch.onnx.export).parameters else {}
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")  # that the exporter is the older one, and that shapes are traced
        file = Path(folder) / "policy.onnx"
        try:
            torch.onnx.export(
                graph,
                tuple(example.values()),
                str(file),
                input_names=list(example),
                output_names=list(outputs),
                dynamic_axes={name: {0: "N"} for name in (*example, *outputs)},
                opset_version=OPSET,
                **options,
            )
        except Exception as error:  # of a user's network
            reason = " ".join(str(error).split())[:300]
            raise ValueError(f"the policy cannot be exported: {type(error).__name__}: {reason}") from error
        model = onnx.load(file)
    onnx.helper.set_model_props(model, _about(agent, experiment, graph, condition))
    model.producer_name, model.producer_version = "mo-deepdrive", mo_deepdrive.__version__
    content = model.SerializeToString()
    difference = None
    if importlib.util.find_spec("onnxruntime") is not None:
        difference = _check(content, graph, agent, experiment, condition)
    atomic_write(path, content)
    with torch.no_grad():
        results = dict(zip(outputs, graph(*example.values()), strict=True))
    return OnnxExport(_shapes(example), _shapes(results), difference)


def _shapes(tensors: dict[str, torch.Tensor]) -> tuple[str, ...]:
    return tuple(f"{name} ({', '.join(['N', *map(str, each.shape[1:])])})" for name, each in tensors.items())


def _about(agent: Any, experiment: Experiment, graph: _Graph, condition: Any) -> dict[str, str]:
    """The metadata of the file."""
    about = {
        "environment": experiment.environment.id,
        "environment_arguments": json.dumps(experiment.environment.arguments),
        "objectives": json.dumps(list(agent.env.objectives)),
        "algorithm": experiment.algorithm.name,
        "steps": str(agent.step),
        "vehicles": json.dumps(graph.driven),
        "accrued_discount": repr(float(agent.accrued_discount)),
        "version": mo_deepdrive.__version__,
    }
    if isinstance(agent, FrontAgent):
        about["condition_names"] = json.dumps(list(agent.condition_names))
        if condition is not None:
            about["condition"] = json.dumps(condition.tolist())
    return about


class _Graph(nn.Module):
    """A policy from raw observations to greedy actions: what is exported.

    Attributes:
        driven: the vehicles whose actions it gives.
        input_names: of :meth:`forward`, in order.
        condition: (1, m) that a policy of a front follows; None if it is an input, or there is no front.
    """

    condition_name = ""

    def __init__(self, agent: Any, past: Sequence[str], condition: NDArray[np.float32] | None = None):
        super().__init__()
        self.env: EnvAdapter = agent.env
        self.driven = list(range(self.env.vehicles))
        self.condition = None if condition is None else torch.from_numpy(np.array(condition, dtype=np.float32)[None])
        self.input_names = [OBSERVATION, *past]
        if self.condition_name and condition is None:
            self.input_names.append(self.condition_name)

    @property
    def output_names(self) -> tuple[str, ...]:
        """The action as the environment takes it, and the distribution from which a policy samples."""
        return (ACTION, MEAN, STD) if self.env.continuous else (ACTION, LOGITS)

    def inputs(
        self, observations: NDArray[np.float32], accrued: AccruedReward, conditions: NDArray[np.float32] | None
    ) -> dict[str, torch.Tensor]:
        """The inputs by name, for observations (N, V, o) and conditions (N, m) of a front."""
        own = 0 if self.env.vehicles == 1 else slice(None)
        given: dict[str, Any] = {
            OBSERVATION: self.env.environment_observations(observations),
            ACCRUED: accrued.value[:, own],
            DISCOUNT: accrued.discounts[:, own],
            DECISIONS: accrued.decisions[:, own],
            self.condition_name: conditions,
        }
        return {name: torch.from_numpy(np.array(given[name])) for name in self.input_names}

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Outputs (N, ...), with a second axis of the vehicles that are driven where there are several vehicles."""
        given = dict(zip(self.input_names, inputs, strict=True))
        raw, space = given.pop(OBSERVATION), self.env.vector_env.single_observation_space
        if isinstance(space, Discrete):
            raw = nn.functional.one_hot(raw - int(space.start), int(space.n))
        observations = raw.to(torch.float32).reshape(-1, self.env.vehicles, self.env.observation_size)
        for name in (ACCRUED, DISCOUNT, DECISIONS):
            if name in given and self.env.vehicles == 1:
                given[name] = given[name].unsqueeze(1)
        if self.condition is not None:
            given[self.condition_name] = self.condition.expand(observations.shape[0], -1)
        each = [self.distribution(v, observations[:, v], given) for v in self.driven]
        parameters = [torch.stack(part, dim=1) for part in zip(*each, strict=True)]
        outputs = (self._actions(parameters[0]), *parameters)
        return tuple(part[:, 0] for part in outputs) if self.env.vehicles == 1 else outputs

    def distribution(
        self, vehicle: int, observations: torch.Tensor, given: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, ...]:
        """Logits (N, n), or mean and standard deviation (N, k), of the actions of one vehicle.

        Args:
            vehicle: one of those that are driven.
            observations: (N, o).
            given: the other inputs, with an axis of vehicles.
        """
        raise NotImplementedError

    def _actions(self, parameters: torch.Tensor) -> torch.Tensor:
        """The greedy actions from logits or means, in the environment's terms."""
        shape = (1, self.env.vehicles, *((self.env.actions,) if self.env.continuous else ()))
        # What the environment makes of 0 and 1: its first action, or the centre of its box and a corner.
        zero, one = (self.env.environment_actions(np.full(shape, each))[:1] for each in (0, 1))
        if not self.env.continuous:
            return parameters.argmax(-1) + int(zero.flat[0])
        k = self.env.actions
        centre, corner = (torch.from_numpy(each.reshape(-1, k)[0].astype(np.float32)) for each in (zero, one))
        return centre + (corner - centre) * parameters.clamp(-1.0, 1.0)


def _distribution_of(actor: Actor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """What an actor's network says of the actions: logits, or mean and standard deviation."""
    outputs: torch.Tensor = actor.body(x)
    if isinstance(actor, CategoricalActor):
        return (outputs,)
    gaussian: Any = actor
    mean, log_std = gaussian.mean_and_log_std(outputs)
    return mean, log_std.exp().expand_as(mean)


class _LearnersGraph(_Graph):
    """An actor per vehicle that learnt: A2C, MO-A2C, PPO, MO-PPO, MOCAC and MAPPO."""

    def __init__(self, agent: Any, past: Sequence[str], condition: NDArray[np.float32] | None = None):
        super().__init__(agent, past, condition)
        self.agent = agent
        self.learners = {v: learner for learner in agent.learners for v in learner.vehicles}
        self.networks = nn.ModuleList(learner.actor for learner in agent.learners)
        self.driven = sorted(self.learners)

    def distribution(
        self, vehicle: int, observations: torch.Tensor, given: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, ...]:
        # What is no input has no influence, but the shape of one.
        d = len(self.env.objectives)
        accrued = given[ACCRUED][:, vehicle] if ACCRUED in given else observations[:, :1].expand(-1, d)
        discounts = given[DISCOUNT][:, vehicle] if DISCOUNT in given else observations[:, 0]
        seen = self.agent.inputs(observations, accrued, discounts, self.preference(vehicle, given))
        return _distribution_of(self.learners[vehicle].actor, seen)

    def preference(self, vehicle: int, given: dict[str, torch.Tensor]) -> Any:
        """What the agent's inputs take as the preference of a vehicle."""


class _PreferenceGraph(_LearnersGraph):
    """Conditioned MO-PPO, under preferences (N, V m)."""

    condition_name = PREFERENCE

    def preference(self, vehicle: int, given: dict[str, torch.Tensor]) -> Any:
        return given[PREFERENCE].unflatten(1, (self.env.vehicles, -1))[:, vehicle], self.agent.ideal[0]


class _CommandGraph(_Graph):
    """PCN, under commands (N, d + 1): the desired discounted return of the whole episode and its horizon."""

    condition_name = COMMAND

    def __init__(self, agent: PCN, condition: NDArray[np.float32] | None):
        super().__init__(agent, [ACCRUED, DISCOUNT, DECISIONS], condition)
        self.agent = agent
        self.network = agent.network

    def distribution(
        self, vehicle: int, observations: torch.Tensor, given: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, ...]:
        agent, command = self.agent, given[COMMAND]
        low, high = (torch.from_numpy(bound) for bound in agent.bounds)
        wanted = command[:, :-1]
        # As PCN.act_under: equation 4, applied t times, and then the clip.
        left = given[DISCOUNT].clamp(min=SMALLEST_DISCOUNT)
        desired = (wanted - given[ACCRUED][:, vehicle]) / left
        desired = desired.maximum(wanted.minimum(low)).minimum(wanted.maximum(high))
        horizon = (command[:, -1:] - given[DECISIONS].to(command.dtype)).clamp(min=1.0)
        shift, scale = torch.from_numpy(agent.inputs)
        o = self.env.observation_size
        seen = (observations - shift[:o]) / scale[:o]
        asked = (torch.cat([desired, horizon], dim=1) - shift[o:]) / scale[o:]
        outputs = self.network(seen, asked)
        if not self.env.continuous:
            return (outputs,)
        return outputs.tanh(), torch.full_like(outputs, agent.config.action_noise)


def _graph(agent: Any, condition: NDArray[np.float32] | None) -> _Graph:
    """The graph of an agent."""
    if isinstance(agent, PCN):
        return _CommandGraph(agent, condition).eval()
    if isinstance(agent, ConditionedMOPPO):
        linear = agent.preferences.width == len(agent.preferences.names)  # then they do not depend on the past
        return _PreferenceGraph(agent, [] if linear else [ACCRUED, DISCOUNT], condition).eval()
    if isinstance(agent, ActorCritic) and type(agent).act is ActorCritic.act:
        past = [ACCRUED] * agent.observes_accrued + [DISCOUNT] * agent.observes_discount
        return _LearnersGraph(agent, past).eval()
    raise ValueError(f"algorithm {agent.name!r} cannot be exported: its class defines how it acts itself")


def _visited(
    agent: Any, experiment: Experiment, condition: NDArray[np.float32] | None
) -> Iterator[tuple[NDArray[np.float32], AccruedReward, NDArray[np.float32] | None, NDArray[Any]]]:
    """States on the way of the policy, and some random ones: observations, past, conditions and greedy actions."""
    env = EnvAdapter(make_environment(experiment.environment, CHECKED_ENVS))
    conditions, policy = None, agent
    if isinstance(agent, FrontAgent):
        rows = agent.conditions() if condition is None else condition[None]
        conditions = rows[np.arange(CHECKED_ENVS) % len(rows)]
        policy = agent.policies(conditions)
    past = AccruedReward.begin(CHECKED_ENVS, env.vehicles, len(env.objectives))
    observations = env.reset(0)
    for _ in range(CHECKED_STATES // CHECKED_ENVS):
        actions = policy.act(observations, past, None)
        yield observations, past, conditions, actions
        step = env.step(actions)
        past = past.take(np.arange(CHECKED_ENVS))
        past.add(step.rewards, policy.gamma)
        past.restart(step.terminated | step.truncated)
        observations = step.observations
    env.vector_env.close()


def _check(
    content: bytes, graph: _Graph, agent: Any, experiment: Experiment, condition: NDArray[np.float32] | None
) -> float:
    """Run the file in 1,000 states; the largest difference from PyTorch."""
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    largest = 0.0
    for observations, past, conditions, actions in _visited(agent, experiment, condition):
        inputs = graph.inputs(observations, past, conditions)
        found = session.run(None, {name: each.numpy() for name, each in inputs.items()})
        with torch.no_grad():
            expected = [each.numpy() for each in graph(*inputs.values())]
        for mine, other in zip(found[1:], expected[1:], strict=True):
            largest = max(largest, float((np.abs(mine - other) / np.maximum(1.0, np.abs(other))).max()))
        own = agent.env.environment_actions(actions)
        own = own if graph.env.vehicles == 1 else own[:, graph.driven]
        if graph.env.continuous:
            largest = max(largest, float((np.abs(found[0] - own) / np.maximum(1.0, np.abs(own))).max()))
        else:
            first, second = np.moveaxis(np.partition(found[1], -2, axis=-1)[..., -2:], -1, 0)
            if ((found[0] != own) & (second - first > TOLERANCE * np.maximum(1.0, np.abs(second)))).any():
                raise ValueError("the file chooses other actions than the policy")
    if not largest <= TOLERANCE:
        raise ValueError(f"the file differs from the policy by {largest:.2g}, more than {TOLERANCE:g}")
    return largest
