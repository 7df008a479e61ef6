"""Trained policies as ONNX files, which other programs run without this package and without PyTorch.

The graph takes what an environment gives: raw observations and, where the policy depends on them, the accrued reward,
its discount, and the condition of a front. Scales, networks and the greedy action are inside.
"""

from __future__ import annotations

import importlib.util
import json
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Discrete
from torch import Tensor, nn

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
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from algorithms.runs.config import Experiment

OBSERVATION, ACCRUED, DISCOUNT, DECISIONS = "observation", "accrued_reward", "discount", "decisions"
COMMAND, PREFERENCE = "command", "preference"  # conditions of PCN and of conditioned MO-PPO
ACTION, LOGITS, MEAN, STD = "action", "logits", "mean", "std"
CHECKED_STATES, CHECKED_ENVS = 1000, 50
TOLERANCE = 1e-5  # of logits, means and deviations, relative to their size where it is above 1


class OnnxExport(NamedTuple):
    """What was exported."""

    inputs: tuple[str, ...]  # with shapes, such as ``observation (N, 15)``
    outputs: tuple[str, ...]
    difference: float | None  # the largest one from PyTorch in the checked states; None without onnxruntime


def export_onnx(
    agent: Any, experiment: Experiment, path: Path, condition: NDArray[np.float32] | None = None
) -> OnnxExport:
    """Write an agent's policy as an ONNX file, and check it by driving; ``condition`` None of a front is an input."""
    with needed_for("exporting", "onnx"):
        import onnx

    graph = _graph(agent, condition)
    example, _ = next(_visited(graph, experiment, condition))
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")  # that the exporter is the older one, and that shapes are traced
        file = Path(folder) / "policy.onnx"
        try:
            torch.onnx.export(
                graph,
                tuple(example.values()),
                str(file),
                input_names=list(example),
                output_names=list(graph.output_names),
                dynamic_axes={name: {0: "N"} for name in (*example, *graph.output_names)},
                opset_version=17,
                dynamo=False,  # the other exporter needs onnxscript and twenty times as long
            )
        except Exception as error:  # of a user's network
            reason = " ".join(str(error).split())[:300]
            raise ValueError(f"the policy cannot be exported: {type(error).__name__}: {reason}") from error
        model = onnx.load(file)
    onnx.helper.set_model_props(model, _metadata(agent, experiment, graph, condition))
    model.producer_name, model.producer_version = "mo-deepdrive", mo_deepdrive.__version__
    content, difference = model.SerializeToString(), None
    if importlib.util.find_spec("onnxruntime") is not None:
        difference = _largest_difference(content, graph, experiment, condition)
    atomic_write(path, content)
    with torch.no_grad():
        results = graph(*example.values())
    inputs, outputs = (
        tuple(f"{name} ({', '.join(['N', *map(str, tensor.shape[1:])])})" for name, tensor in tensors)
        for tensors in (example.items(), zip(graph.output_names, results, strict=True))
    )
    return OnnxExport(inputs, outputs, difference)


def _metadata(agent: Any, experiment: Experiment, graph: _Graph, condition: Any) -> dict[str, str]:
    values = {
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
        values["condition_names"] = json.dumps(list(agent.condition_names))
        if condition is not None:
            values["condition"] = json.dumps(condition.tolist())
    return values


class _Graph(nn.Module):
    """A policy from raw observations to greedy actions of the vehicles in ``driven``: what is exported.

    ``past`` are the inputs that say what happened in the episode so far. A policy of a front follows ``condition``
    (m,), which is an input if it is None; without a front it has no name.
    """

    def __init__(self, agent: Any, past: list[str], condition: Any = None, condition_name: str = ""):
        super().__init__()
        self.agent, self.env = agent, agent.env
        self.driven = list(range(self.env.vehicles))
        self.condition = None if condition is None else torch.from_numpy(np.array(condition, dtype=np.float32)[None])
        self.condition_name = condition_name
        self.input_names = [OBSERVATION, *past, *([condition_name] if condition_name and condition is None else [])]
        # The action as the environment takes it, and the distribution from which a policy samples.
        self.output_names = (ACTION, MEAN, STD) if self.env.continuous else (ACTION, LOGITS)

    def inputs(self, observations: NDArray[np.float32], accrued: AccruedReward, conditions: Any) -> dict[str, Tensor]:
        """The inputs by name, for observations (N, V, o) and conditions (N, m) of a front."""
        vehicles = 0 if self.env.vehicles == 1 else slice(None)
        given: dict[str, Any] = {
            OBSERVATION: self.env.environment_observations(observations),
            ACCRUED: accrued.value[:, vehicles],
            DISCOUNT: accrued.discounts[:, vehicles],
            DECISIONS: accrued.decisions[:, vehicles],
            self.condition_name: conditions,
        }
        return {name: torch.from_numpy(np.array(given[name])) for name in self.input_names}

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
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
        by_vehicle = [self.distribution(v, observations[:, v], given) for v in self.driven]
        parameters = [torch.stack(part, dim=1) for part in zip(*by_vehicle, strict=True)]
        outputs = (self._greedy_actions(parameters[0]), *parameters)
        return tuple(part[:, 0] for part in outputs) if self.env.vehicles == 1 else outputs

    def distribution(self, v: int, observations: Tensor, given: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """Logits (N, n), or mean and standard deviation (N, k), of vehicle ``v`` with ``observations`` (N, o)."""
        raise NotImplementedError

    def _greedy_actions(self, parameters: Tensor) -> Tensor:
        """From logits or means, in the environment's terms."""
        shape, size = (1, self.env.vehicles), self.env.actions
        if not self.env.continuous:
            return parameters.argmax(-1) + int(self.env.environment_actions(np.zeros(shape)).flat[0])
        # What the environment makes of 0 and 1: the centre of its box and a corner.
        zero, one = (self.env.environment_actions(np.full((*shape, size), value)) for value in (0, 1))
        centre, corner = (torch.from_numpy(point.reshape(-1, size)[0].astype(np.float32)) for point in (zero, one))
        return centre + (corner - centre) * parameters.clamp(-1.0, 1.0)


class _ActorsGraph(_Graph):
    """An actor per vehicle that learnt, which may be conditioned on preferences (N, V m)."""

    def __init__(self, agent: Any, *arguments: Any):
        super().__init__(agent, *arguments)
        self.learners = {v: learner for learner in agent.learners for v in learner.vehicles}
        self.networks = nn.ModuleList(learner.actor for learner in agent.learners)
        self.driven = sorted(self.learners)

    def distribution(self, v: int, observations: Tensor, given: dict[str, Tensor]) -> tuple[Tensor, ...]:
        # What is no input has no influence, but the shape of one.
        d = len(self.env.objectives)
        accrued = given[ACCRUED][:, v] if ACCRUED in given else observations[:, :1].expand(-1, d)
        discounts = given[DISCOUNT][:, v] if DISCOUNT in given else observations[:, 0]
        preference = None
        if PREFERENCE in given:
            preference = given[PREFERENCE].unflatten(1, (self.env.vehicles, -1))[:, v], self.agent.ideal[0]
        actor: Any = self.learners[v].actor
        outputs = actor.body(self.agent.inputs(observations, accrued, discounts, preference))
        if isinstance(actor, CategoricalActor):
            return (outputs,)
        mean, log_std = actor.mean_and_log_std(outputs)
        return mean, log_std.exp().expand_as(mean)


class _CommandGraph(_Graph):
    """PCN, under commands (N, d + 1): the desired discounted return of the whole episode and its horizon."""

    def __init__(self, agent: PCN, *arguments: Any):
        super().__init__(agent, *arguments)
        self.network = agent.network

    def distribution(self, v: int, observations: Tensor, given: dict[str, Tensor]) -> tuple[Tensor, ...]:
        command, o = given[COMMAND], self.env.observation_size
        low, high = map(torch.from_numpy, self.agent.bounds)
        wanted = command[:, :-1]
        # As PCN.act_under: equation 4, applied t times, and then the clip.
        desired = (wanted - given[ACCRUED][:, v]) / given[DISCOUNT].clamp(min=SMALLEST_DISCOUNT)
        desired = desired.maximum(wanted.minimum(low)).minimum(wanted.maximum(high))
        horizon = (command[:, -1:] - given[DECISIONS].to(command.dtype)).clamp(min=1.0)
        shift, scale = torch.from_numpy(self.agent.inputs)
        asked = (torch.cat([desired, horizon], dim=1) - shift[o:]) / scale[o:]
        outputs = self.network((observations - shift[:o]) / scale[:o], asked)
        if not self.env.continuous:
            return (outputs,)
        return outputs.tanh(), torch.full_like(outputs, self.agent.config.action_noise)


def _graph(agent: Any, condition: NDArray[np.float32] | None) -> _Graph:
    graph: _Graph
    if isinstance(agent, PCN):
        graph = _CommandGraph(agent, [ACCRUED, DISCOUNT, DECISIONS], condition, COMMAND)
    elif isinstance(agent, ConditionedMOPPO):
        linear = agent.preferences.width == len(agent.preferences.names)  # then they do not depend on the past
        graph = _ActorsGraph(agent, [] if linear else [ACCRUED, DISCOUNT], condition, PREFERENCE)
    elif isinstance(agent, ActorCritic) and type(agent).act is ActorCritic.act:
        graph = _ActorsGraph(agent, [ACCRUED] * agent.observes_accrued + [DISCOUNT] * agent.observes_discount)
    else:
        raise ValueError(f"algorithm {agent.name!r} cannot be exported: its class defines how it acts itself")
    return graph.eval()


def _visited(
    graph: _Graph, experiment: Experiment, condition: NDArray[np.float32] | None
) -> Iterator[tuple[dict[str, Tensor], NDArray[Any]]]:
    """The inputs in 1,000 states on the way of the policy, and its greedy actions there."""
    env, agent = EnvAdapter(make_environment(experiment.environment, CHECKED_ENVS)), graph.agent
    conditions, policy = None, agent
    if isinstance(agent, FrontAgent):
        rows = agent.conditions() if condition is None else condition[None]
        conditions = rows[np.arange(CHECKED_ENVS) % len(rows)]
        policy = agent.policies(conditions)
    past = AccruedReward.begin(CHECKED_ENVS, env.vehicles, len(env.objectives))
    observations = env.reset(0)
    for _ in range(CHECKED_STATES // CHECKED_ENVS):
        actions = policy.act(observations, past, None)
        yield graph.inputs(observations, past, conditions), actions
        step = env.step(actions)
        past = past.take(np.arange(CHECKED_ENVS))
        past.add(step.rewards, policy.gamma)
        past.restart(step.terminated | step.truncated)
        observations = step.observations
    env.vector_env.close()


def _largest_difference(
    content: bytes, graph: _Graph, experiment: Experiment, condition: NDArray[np.float32] | None
) -> float:
    """Of a file's outputs from PyTorch's, in 1,000 states."""
    import onnxruntime

    session, largest = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"]), 0.0
    for inputs, actions in _visited(graph, experiment, condition):
        exported = session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})
        with torch.no_grad():
            expected = [tensor.numpy() for tensor in graph(*inputs.values())]
        expected[0] = graph.env.environment_actions(actions)
        if graph.env.vehicles > 1:
            expected[0] = expected[0][:, graph.driven]
        if not graph.env.continuous:
            second, first = np.moveaxis(np.partition(exported[1], -2, axis=-1)[..., -2:], -1, 0)
            if ((exported[0] != expected[0]) & (first - second > TOLERANCE * np.maximum(1.0, np.abs(first)))).any():
                raise ValueError("the file chooses other actions than the policy")
            expected[0] = exported[0]  # of actions that are as good, either may be chosen
        for of_file, of_agent in zip(exported, expected, strict=True):
            largest = max(largest, float((np.abs(of_file - of_agent) / np.maximum(1.0, np.abs(of_agent))).max()))
    if not largest <= TOLERANCE:
        raise ValueError(f"the file differs from the policy by {largest:.2g}, more than {TOLERANCE:g}")
    return largest
