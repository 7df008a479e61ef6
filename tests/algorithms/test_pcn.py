"""Pareto Conditioned Networks: commands, episodes, losses and fronts, each against the plainest computation of it."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mo_gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv
from safetensors.torch import load_file

from algorithms import PCN
from algorithms.pcn import Episode
from algorithms.runs.build import build
from algorithms.runs.config import load_experiment
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.front import Front, indicators
from mo_deepdrive.evaluation.pareto import non_dominated
from mo_deepdrive.evaluation.policy import AccruedReward
from tests.helpers.agents import CONTINUOUS, ONE_WAYPOINT, SEA, recorded, same
from tests.helpers.toy_env import Toy

SHORT = {"time_limit": 2, "fixed_destination": True}
PLACES: dict[str, tuple[str, dict[str, Any]]] = {
    "one_waypoint": (ONE_WAYPOINT, SHORT),
    "one_waypoint, continuous": (ONE_WAYPOINT, {**SHORT, **CONTINUOUS}),
    "static_obstacle": ("mo-deepdrive-static-obstacle-v0", {"time_limit": 2}),
    "deep-sea-treasure": (SEA, {}),
}
EVERYWHERE = pytest.mark.parametrize("place", PLACES)
SMALL: dict[str, Any] = {"hidden": [16, 16], "batch_size": 32, "gradient_steps": 5, "warmup_episodes": 8}
TOTAL = 600  # environment steps of a small run


def make_pcn(env_id: str = ONE_WAYPOINT, *, num_envs: int = 4, env: Any = None, seed: int = 0, **changed: Any) -> PCN:
    return PCN(make_env(env_id, num_envs, env), seed=seed, **{**SMALL, **changed})


def small_pcn(place: str, seed: int = 0, num_envs: int = 4, **changed: Any) -> PCN:
    env_id, arguments = PLACES[place]
    return make_pcn(env_id, num_envs=num_envs, env=arguments, seed=seed, **changed)


def saved(agent: PCN, folder: Path) -> dict[str, torch.Tensor]:
    """Everything that determines the future of an agent."""
    agent.save(folder / "saved.safetensors")
    return load_file(folder / "saved.safetensors")


def scramble(agent: PCN, size: float) -> None:
    """Take the policies far from their initial, nearly uniform ones."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in agent.network.parameters():
            parameter.normal_(0.0, size, generator=generator)


def collected(agent: PCN, monkeypatch: pytest.MonkeyPatch) -> list[list[Episode]]:
    """The episodes that are added to the buffer from now on, one list per round."""
    rounds: list[list[Episode]] = []
    add = agent.buffer.add

    def spy(episodes: list[Episode]) -> None:
        rounds.append(episodes)
        add(episodes)

    monkeypatch.setattr(agent.buffer, "add", spy)
    return rounds


# What is refused.


@pytest.mark.parametrize(
    ("env_id", "arguments", "warned"),
    [
        (ONE_WAYPOINT, {}, True),
        (ONE_WAYPOINT, {"fixed_destination": True}, False),
        ("mo-deepdrive-static-obstacle-v0", {"fixed_destination": True}, True),
        ("mo-deepdrive-static-obstacle-v0", {"fixed_destination": True, "fixed_obstacle": True}, False),
        ("mo-deepdrive-left-turn-v0", {}, True),
        (SEA, {}, False),
    ],
)
def test_scenarios_that_are_drawn_are_warned_of(env_id: str, arguments: dict[str, Any], *, warned: bool) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        PCN(make_env(env_id, 1, arguments))
    assert any("draws its scenarios" in str(each.message) for each in caught) is warned


def test_an_untrained_agent_has_no_commands() -> None:
    agent = small_pcn("deep-sea-treasure")
    with pytest.raises(ValueError, match="holds no episode yet: train first"):
        agent.conditions()


@pytest.fixture(scope="module")
def seasoned() -> PCN:
    """An agent that has been trained a little at sea."""
    agent = small_pcn("deep-sea-treasure")
    agent.train(TOTAL)
    return agent


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_command_far_outside_the_buffer_is_refused_by_name(seasoned: PCN, which: int, side: int) -> None:
    low, high = (bound.astype(np.float64) for bound in seasoned.bounds)
    edge = (high if side > 0 else low) + side * seasoned.scales
    command = (low + high) / 2
    command[which] = edge[which] - 1e-3 * side
    seasoned.policies([[*command, 5]])
    command[which] = edge[which] + 1e-3 * side
    with pytest.raises(ValueError, match=f"desired return of objective_{which} = .* must be between"):
        seasoned.policy([*command, 5])
    command[which] = np.nan
    with pytest.raises(ValueError, match=f"desired return of objective_{which} = nan"):
        seasoned.policy([*command, 5])


@pytest.mark.parametrize(
    ("commands", "message"),
    [
        ([[1.0, -1.0, 5.0], [1.0, -1.0, 0.5]], "horizon = 0.5 must be at least 1"),
        ([[1.0, -1.0, np.nan]], "horizon = nan must be at least 1"),
        ([[1.0, 5.0]], "commands of shape (1, 2) must be (n, 3): objective_0, objective_1, horizon"),
        ([1.0, -1.0, 5.0], "commands of shape (3,) must be (n, 3)"),
    ],
)
def test_commands_of_the_wrong_shape_are_refused(seasoned: PCN, commands: Any, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        seasoned.policies(commands)


# What the network is asked.


def asked_of(gamma: float, low: Any, high: Any, desired: Any, horizon: Any, rewards: np.ndarray) -> list[Any]:
    """What a commanded policy asks for before each of ``rewards`` (T, N, d): wanted returns and decisions left."""
    asked: list[Any] = []

    def choose(observations: Any, wanted: Any, left: Any, generator: Any) -> Any:
        asked.append((wanted.copy(), left.copy()))
        return np.zeros(len(wanted), dtype=np.int64)

    bounds = np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
    agent: Any = SimpleNamespace(bounds=bounds, choose_actions=choose)
    commands = np.column_stack([desired, horizon]).astype(np.float32)
    _, n, d = rewards.shape
    accrued_reward = AccruedReward.begin(n, 1, d)
    for reward in rewards.astype(np.float32):
        observations = np.zeros((n, 1, 3), dtype=np.float32)
        assert PCN.act_under(agent, commands, observations, accrued_reward, None).shape == (n, 1)
        accrued_reward.add(reward[:, None], gamma)
    return asked


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_the_command_is_updated_with_every_reward_and_decision(gamma: float) -> None:
    rewards = np.random.default_rng(0).normal(size=(12, 3, 2))
    desired, horizon = [[5.0, -3.0], [0.0, 0.0], [-2.0, 9.0]], [20.0, 5.0, 1.0]
    asked = asked_of(gamma, [-1e6] * 2, [1e6] * 2, desired, horizon, rewards)
    rest, left = np.array(desired), np.array(horizon)
    for t, (wanted, remaining) in enumerate(asked):
        np.testing.assert_allclose(wanted, rest, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(remaining, left)
        rest = (rest - rewards[t]) / gamma
        left = np.maximum(left - 1.0, 1.0)
    assert asked[-1][1].tolist() == [9.0, 1.0, 1.0]


def test_the_desired_return_is_clipped_to_the_buffer_and_the_command() -> None:
    # Per column: the rest falls below the bounds, rises above them, and the same from a command outside of them.
    gamma, low, high = 0.5, [-1.0] * 4, [2.0] * 4
    rewards = np.tile([1.0, -1.0, 1.0, -1.0], (6, 1, 1))
    asked = asked_of(gamma, low, high, [[0.0, 0.0, -3.0, 5.0]], [9.0], rewards)
    rest = np.array([0.0, 0.0, -3.0, 5.0])
    for t, (wanted, _) in enumerate(asked):
        expected = [max(-1.0, rest[0]), min(2.0, rest[1]), max(-3.0, rest[2]), min(5.0, rest[3])]
        np.testing.assert_allclose(wanted[0], expected, atol=1e-5)
        rest = (rest - rewards[t, 0]) / gamma
    np.testing.assert_allclose(asked[-1][0][0], [-1.0, 2.0, -3.0, 5.0], atol=1e-5)


def by_hand(agent: PCN, observations: Any, wanted: Any, left: Any) -> np.ndarray:
    """Outputs of the network for scaled inputs, from its weights alone."""
    weights = {name: tensor.double().numpy() for name, tensor in agent.network.state_dict().items()}

    def linear(x: np.ndarray, name: str) -> np.ndarray:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    def sigmoid(x: np.ndarray) -> np.ndarray:
        return 1.0 / (1.0 + np.exp(-x))

    scales = np.array([*agent.env.observation_scales, *agent.scales, agent.config.horizon_scale])
    shift, scale = agent.get_state().get("inputs", torch.from_numpy(np.stack([np.zeros_like(scales), scales]))).numpy()
    x = (np.column_stack([observations, wanted, left]) - shift) / scale
    o = agent.env.observation_size
    x = sigmoid(linear(x[:, :o], "observation.0")) * sigmoid(linear(x[:, o:], "command.0"))
    layers = len(agent.config.hidden)
    for i in range(layers):
        x = linear(x, f"body.{2 * i}")
        if i < layers - 1:
            x = np.maximum(x, 0.0)
    return np.tanh(x) if agent.env.continuous else x


def inputs(agent: PCN, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random observations, wanted returns and decisions left."""
    rng = np.random.default_rng(seed)
    observations = rng.normal(size=(n, agent.env.observation_size)) * agent.env.observation_scales
    wanted = rng.normal(size=(n, len(agent.scales))) * agent.scales
    left = rng.integers(1, 100, n)
    return observations.astype(np.float32), wanted.astype(np.float32), left.astype(np.float32)


@pytest.mark.parametrize("hidden", [[8], [16, 8, 4]])
@EVERYWHERE
def test_the_greedy_action_has_the_largest_output(place: str, hidden: list[int]) -> None:
    scales = [3.0, 7.0] if place == "deep-sea-treasure" else None
    agent = small_pcn(place, hidden=hidden, objective_scales=scales, horizon_scale=40.0)
    scramble(agent, 1.0)
    given = inputs(agent, 200)
    outputs, actions = by_hand(agent, *given), agent.choose_actions(*given, None)
    if agent.env.continuous:
        np.testing.assert_allclose(actions, outputs, atol=2e-3)
    else:
        ordered = np.sort(outputs, axis=1)
        clear = ordered[:, -1] - ordered[:, -2] > 1e-3
        assert clear.mean() > 0.9
        np.testing.assert_array_equal(actions[clear], outputs.argmax(axis=1)[clear])
        assert len(set(actions.tolist())) > 1 or place == "deep-sea-treasure"  # its numbers are all positive


def test_exploring_actions_follow_the_softmax() -> None:
    agent = small_pcn("one_waypoint")
    scramble(agent, 0.5)
    n = 20_000
    given = tuple(np.repeat(array, n, axis=0) for array in inputs(agent, 1))
    logits = by_hand(agent, *inputs(agent, 1))[0]
    expected = np.exp(logits) / np.exp(logits).sum()
    assert expected.max() > 3 * expected.min()
    actions = agent.choose_actions(*given, torch.Generator().manual_seed(0))
    found = np.bincount(actions, minlength=len(expected)) / n
    np.testing.assert_array_less(np.abs(found - expected), 4.5 * np.sqrt(expected * (1.0 - expected) / n))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_exploring_continuous_actions_are_noisy_and_stay_in_the_box(noise: float) -> None:
    agent = small_pcn("one_waypoint, continuous", action_noise=noise)
    given = tuple(np.repeat(array, 5000, axis=0) for array in inputs(agent, 1))
    greedy = agent.choose_actions(*given, None)[0]
    assert np.abs(greedy).max() < 0.5
    scattered = agent.choose_actions(*given, torch.Generator().manual_seed(0))
    np.testing.assert_allclose(scattered.mean(axis=0), greedy, atol=5 * noise / 5000**0.5 + 1e-6)
    np.testing.assert_allclose(scattered.std(axis=0), noise, rtol=0.06, atol=1e-6)
    scramble(agent, 10.0)
    assert np.abs(agent.choose_actions(*given, torch.Generator().manual_seed(0))).max() <= 1.0


class Tales(Toy):
    """An observation that never changes in one entry, rarely in another, and is large in the last."""

    def __init__(self) -> None:
        super().__init__(spaces.Discrete(3), spaces.Box(0.0, 8.0, (4,), dtype=np.float32))
        self.episodes = 0

    def _observed(self) -> Any:
        self.episodes += self.count == 0
        rare = self.episodes % 50 == 0 and self.count == 2
        return np.array([self.count, 3.0, rare, 1000.0 + self.count], dtype=np.float32)


def test_inputs_from_another_library_are_standardised_after_the_warm_up() -> None:
    agent = PCN(MOSyncVectorEnv(Tales for _ in range(4)), warmup_episodes=200, buffer_size=200, gradient_steps=5)
    agent.begin()
    rows = agent.buffer.decisions()
    assert rows.shape == (600, 4 + 2 + 1)
    np.testing.assert_array_equal(rows[:3, -1], [3, 2, 1])
    seen, asked = agent._scaled(rows[:, :4], rows[:, 4:6], rows[:, 6])
    found = np.concatenate([seen, asked], axis=1)
    constant, rare = 1, 2
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=2e-3)
    usual = [i for i in range(7) if i not in (constant, rare)]
    np.testing.assert_allclose(found[:, usual].std(axis=0), 1.0, rtol=1e-3)
    assert found[:, constant].tolist() == [0.0] * 600
    assert agent._scaled(rows[:1, :4] + 8.0, rows[:1, 4:6], rows[:1, 6])[0][0, constant] == 1.0  # of its bounds
    assert np.ptp(found[:, rare]) == pytest.approx(10.0, rel=1e-5)
    # It is measured once, and part of the agent.
    before = agent.get_state()["inputs"].clone()
    agent.train(1000)
    assert torch.equal(agent.get_state()["inputs"], before)


# Episodes.


@pytest.mark.parametrize("exploration", [0.0, 0.3, 1.0])
def test_a_share_of_the_episodes_explores_from_a_decision_within_its_horizon(exploration: float) -> None:
    agent = small_pcn("one_waypoint", num_envs=3000, exploration=exploration)
    horizon = np.tile(np.float32([1.0, 5.0, 40.0]), 1000)
    found = agent._random_from(horizon)
    explores = np.isfinite(found)
    assert explores.mean() == pytest.approx(exploration, abs=0.03)
    assert (found[explores] < horizon[explores]).all()
    if exploration:
        for each in (1, 5, 40):
            assert set(found[explores & (horizon == each)].tolist()) == set(range(each))


@EVERYWHERE
def test_the_buffer_holds_what_a_replay_of_the_actions_gives(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env_id, arguments = PLACES[place]
    agent = small_pcn(place, gamma=0.9)
    seeds: list[int] = []
    reset = agent.env.reset
    monkeypatch.setattr(agent.env, "reset", lambda seed: (seeds.append(seed), reset(seed))[1])
    rounds = collected(agent, monkeypatch)
    agent.train(TOTAL // 2)
    assert agent.updates == len(rounds) == len(seeds)
    assert agent.step == sum(len(episode.returns) for episodes in rounds for episode in episodes)
    assert len({seed + i for seed in seeds for i in range(4)}) == 4 * len(rounds)  # every episode on a seed of its own
    assert min(seeds) >= 2**32
    env = mo_gymnasium.make(env_id, **arguments)
    for episodes, seed in zip(rounds[:: max(1, len(rounds) // 3)], seeds[:: max(1, len(rounds) // 3)], strict=True):
        for i, episode in enumerate(episodes):
            observation, _ = env.reset(seed=(seed + i))
            rewards: list[Any] = []
            over = False
            for t, action in enumerate(episode.actions):
                assert not over
                np.testing.assert_allclose(episode.observations[t], np.ravel(observation), rtol=1e-6, atol=1e-6)
                (taken,) = agent.env.environment_actions(action[None, None])
                observation, reward, terminated, truncated, _ = env.step(taken)
                rewards.append(reward)
                over = terminated or truncated
            assert over
            for t in (0, len(rewards) // 2, len(rewards) - 1):
                expected = sum(0.9**k * np.float64(reward) for k, reward in enumerate(rewards[t:]))
                np.testing.assert_allclose(episode.returns[t], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("persistence", [0.0, 0.9])
def test_random_actions_repeat_with_the_given_probability(persistence: float, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_pcn(env={"time_limit": 4}, num_envs=64, warmup_episodes=130, persistence=persistence)
    rounds = collected(agent, monkeypatch)
    agent.train(1)  # nothing but the warm-up
    assert len(rounds) == 3  # of 64 episodes each, the first number that is not below 130
    repeated = np.concatenate([episode.actions[1:] == episode.actions[:-1] for each in rounds for episode in each])
    assert len(repeated) > 5000
    k = agent.env.actions
    p = persistence + (1.0 - persistence) / k
    assert repeated.mean() == pytest.approx(p, abs=4.5 * (p * (1.0 - p) / len(repeated)) ** 0.5)
    begun = np.bincount([episode.actions[0] for each in rounds for episode in each], minlength=k)
    assert begun.min() > 0


@pytest.mark.parametrize(("return_noise", "horizon_reduction"), [(0.0, 0), (0.5, 3), (2.0, 1000)])
def test_sampled_commands_ask_for_more_of_one_objective_in_fewer_decisions(
    seasoned: PCN, monkeypatch: pytest.MonkeyPatch, return_noise: float, horizon_reduction: int
) -> None:
    monkeypatch.setattr(
        seasoned,
        "config",
        seasoned.config.model_copy(update={"return_noise": return_noise, "horizon_reduction": horizon_reduction}),
    )
    monkeypatch.setattr(seasoned, "draws", torch.Generator().manual_seed(0))
    best = seasoned.buffer.best()
    returns, lengths = seasoned.buffer.returns[best], seasoned.buffer.lengths[best]
    assert len(best) > 2
    deviation = [float(np.sqrt(np.mean((column - column.mean()) ** 2))) for column in returns.T]
    raised: dict[tuple[int, int], list[float]] = {}
    for _ in range(150):
        commands = seasoned._sample_commands()
        assert commands.shape == (4, 3)
        for desired, horizon in zip(commands[:, :2], commands[:, 2], strict=True):
            possible = []
            for k, (wanted, length) in enumerate(zip(returns, lengths, strict=True)):
                if horizon != max(length - horizon_reduction, 1):
                    continue
                for i in range(2):
                    more = (float(desired[i]) - wanted[i]) / deviation[i]
                    others = np.delete(desired - wanted, i)
                    if -1e-6 <= more <= return_noise + 1e-6 and (np.abs(others) < 1e-6).all():
                        possible.append((k, i, more))
            assert possible, (desired, horizon)
            k, i, more = possible[0]
            raised.setdefault((k, i), []).append(more)
    amounts = np.concatenate(list(raised.values()))
    if return_noise == 0.0:
        np.testing.assert_allclose(amounts, 0.0, atol=1e-6)
    elif return_noise < 1.0:  # otherwise what is raised from one episode may be taken for another
        assert {k for k, _ in raised} == set(range(len(best)))
        assert {i for _, i in raised} == {0, 1}
        assert amounts.mean() == pytest.approx(return_noise / 2, rel=0.15)
        assert amounts.max() > 0.95 * return_noise


# Learning.


@pytest.mark.parametrize("place", ["one_waypoint", "one_waypoint, continuous", "deep-sea-treasure"])
def test_the_loss_is_the_prediction_error_on_the_actions_of_the_buffer(place: str) -> None:
    agent = small_pcn(place, batch_size=50)
    agent.train(1)
    scramble(agent, 0.5)
    draws = torch.Generator()
    draws.set_state(agent.draws.get_state())
    observations, actions, returns, left = agent.buffer.sample(50, draws)

    def loss() -> float:
        total = 0.0
        for row, action in zip(by_hand(agent, observations, returns, left), actions, strict=True):
            if agent.env.continuous:
                total += sum((x - a) ** 2 for x, a in zip(row, action, strict=True)) / len(row)
            else:
                total += np.log(np.exp(row).sum()) - row[action]
        return total / 50

    before, weights = loss(), [parameter.detach().clone() for parameter in agent.network.parameters()]
    rate = torch.tensor(agent.config.learning_rate)
    found = agent.learner.minimise(agent.loss, agent._batch(), [], rate)
    assert float(found["loss/policy"]) == pytest.approx(before, rel=1e-4)
    # The first step of Adam goes as far as the learning rate says, downhill.
    for old, new in zip(weights, agent.network.parameters(), strict=True):
        assert float((new.detach() - old).abs().max()) == pytest.approx(agent.config.learning_rate, rel=1e-2)
    assert loss() < before


@pytest.mark.parametrize("log_interval", [1, 3])
def test_training_metrics_are_means_over_the_exploring_episodes(
    log_interval: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = small_pcn("deep-sea-treasure", gamma=1.0)
    rounds, commands = collected(agent, monkeypatch), []
    sample = agent._sample_commands
    monkeypatch.setattr(agent, "_sample_commands", lambda: (commands.append(sample()), commands[-1])[1])
    lines = recorded(agent, TOTAL, log_interval=log_interval)
    assert lines[-1][0] == agent.step
    warmup = 2
    ends = [sum(len(episode.returns) for each in rounds[: k + 1] for episode in each) for k in range(len(rounds))]
    begun = 0
    for step, metrics in lines:
        k = ends.index(step)
        assert (k + 1) % log_interval == 0 or k == len(rounds) - 1
        episodes = [episode for each in rounds[begun : k + 1] for episode in each]
        begun = k + 1
        assert metrics["train/length"] == pytest.approx(np.mean([len(episode.returns) for episode in episodes]))
        assert metrics["train/success"] == 0.0
        for i in range(2):
            expected = np.mean([episode.returns[0, i] for episode in episodes])
            assert metrics[f"train/return/objective_{i}"] == pytest.approx(expected, rel=1e-5)
        attained = np.array([episode.returns[0] for episode in rounds[k]])
        error = np.abs(attained - commands[k - warmup][:, :-1]) / agent.scales
        assert metrics["policy/command_error"] == pytest.approx(error.mean(), rel=1e-5)
        assert np.isfinite(metrics["loss/policy"])
    assert begun == len(rounds)
    assert lines[-1][1]["policy/non_dominated"] == len(agent.buffer.best())


@pytest.mark.slow
@pytest.mark.parametrize("place", ["one_waypoint", "deep-sea-treasure"])
def test_evaluations_do_not_disturb_training(place: str, tmp_path: Path) -> None:
    states, lines = [], []
    for watched in (False, True):
        agent = small_pcn(place)
        env = make_env(*PLACES[place][:1], 3, PLACES[place][1]) if watched else None
        lines.append(recorded(agent, TOTAL, eval_env=env, eval_interval=TOTAL // 5, eval_episodes=1))
        states.append(saved(agent, tmp_path))
    assert same(*states)
    evaluated = [step for step, metrics in lines[1] if "eval/front/cardinality" in metrics]
    assert len(evaluated) >= 5
    assert evaluated[-1] == lines[1][-1][0]
    assert [line for line in lines[1] if "train/length" in line[1]] == lines[0]


def test_logged_fronts_have_the_logged_indicators() -> None:
    agent, env = small_pcn("deep-sea-treasure"), make_env(SEA, 3)
    known = np.array(env.envs[0].unwrapped.pareto_front(0.99))
    fronts: list[tuple[int, Front]] = []
    lines = recorded(
        agent,
        TOTAL,
        eval_env=env,
        eval_episodes=2,
        eval_gamma=0.99,
        eval_seed=7,
        reference_point=[0.0, -25.0],
        reference_front=known,
        log_front=lambda step, front: fronts.append((step, front)),
    )
    evaluated = [(step, metrics) for step, metrics in lines if "eval/front/hypervolume" in metrics]
    assert [step for step, _ in fronts] == [step for step, _ in evaluated]
    for (_, metrics), (_, front) in zip(evaluated, fronts, strict=True):
        assert (front.gamma, front.episodes, front.seed) == (0.99, 2, 7)
        expected = indicators(front.discounted, reference_point=[0.0, -25.0], reference_front=known, scales=[1.0, 1.0])
        expected |= {f"return/objective_{i}": front.returns[:, i].max() for i in range(2)}
        assert metrics == {f"eval/front/{name}": pytest.approx(value) for name, value in expected.items()}


# Fronts.


def drive(agent: PCN, env: Any, condition: np.ndarray, seed: int, gamma: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Return, discounted return and length of an episode under a command, with the bookkeeping written out."""
    observation, _ = env.reset(seed=seed)
    command, left = condition[:-1].astype(np.float64), float(condition[-1])
    low, high = np.minimum(agent.bounds[0], command), np.maximum(agent.bounds[1], command)
    wanted, total, discounted, length, over = command, np.zeros(len(command)), np.zeros(len(command)), 0, False
    while not over:
        action = agent.eval(observation, np.clip(wanted, low, high), left)
        assert env.action_space.contains(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        total += reward
        discounted += gamma**length * np.asarray(reward)
        wanted, left, length = (wanted - reward) / agent.gamma, max(left - 1.0, 1.0), length + 1
    return total, discounted, length


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "arguments"),
    [(ONE_WAYPOINT, {"time_limit": 2}), (ONE_WAYPOINT, {"time_limit": 2, **CONTINUOUS}), (SEA, {})],
    ids=["discrete", "continuous", "deep-sea-treasure"],
)
def test_a_front_equals_episodes_run_one_by_one(env_id: str, arguments: dict[str, Any]) -> None:
    agent = make_pcn(env_id, env=arguments, gamma=0.95, max_policies=8)
    agent.train(2 * TOTAL)
    env, seeds = mo_gymnasium.make(env_id, **arguments), (40, 41)
    front = agent.front(make_env(env_id, 3, arguments), episodes=2, seed=40, gamma=0.99)
    assert (front.gamma, front.episodes, front.seed) == (0.99, 2, 40)
    assert front.condition_names == (*agent.env.objectives, "horizon")
    commands = agent.conditions()
    driven = []
    for command in commands:
        total, discounted, lengths = (
            np.mean(each, axis=0)
            for each in zip(*(drive(agent, env, command, seed, 0.99) for seed in seeds), strict=True)
        )
        driven.append((discounted, total, lengths, command))
    points = np.array([each[0] for each in driven])
    kept = sorted((driven[k] for k in np.flatnonzero(non_dominated(points))), key=lambda each: each[0][0])
    assert len(front) == len(kept)
    for k, (discounted, total, length, command) in enumerate(kept):
        np.testing.assert_allclose(front.discounted[k], discounted, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(front.returns[k], total, rtol=1e-4, atol=1e-4)
        assert front.length[k] == length
        np.testing.assert_array_equal(front.conditions[k], command)
    assert np.isnan(front.success).all() == (env_id == SEA)


def test_a_front_has_no_more_policies_than_allowed_and_keeps_the_extremes(
    seasoned: PCN, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = seasoned.conditions()[:, :-1]
    assert len(whole) > 2
    monkeypatch.setattr(seasoned, "config", seasoned.config.model_copy(update={"max_policies": 2}))
    part = seasoned.conditions()[:, :-1]
    assert len(part) == 2
    np.testing.assert_array_equal(part.max(axis=0), whole.max(axis=0))


# Other environments.


@pytest.mark.slow
def test_the_defaults_find_all_fruits_of_a_tree() -> None:
    agent = PCN(make_env("fruit-tree-v0", 16), seed=0)
    agent.train(10_000)
    front = agent.front(make_env("fruit-tree-v0", 64), episodes=1, seed=0, gamma=0.99)
    assert len(front) >= 62  # of 64


@pytest.mark.slow
def test_nine_treasures_of_the_deep_sea_at_least_are_driven_to(repository: Path) -> None:
    """All ten on most seeds; docs/results/deep_sea_treasure.csv has no seed with fewer where the scales are kept."""
    experiment = load_experiment(repository / "configs" / "deep_sea_treasure" / "pcn.yaml", ["--seed=0"])
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    env = make_env(SEA, 8)
    front = agent.front(env, episodes=1, seed=2_000_000, gamma=0.99)
    known = np.array(env.envs[0].unwrapped.pareto_front(0.99))
    reached = np.isclose(known[:, None], front.discounted[None], rtol=1e-5).all(axis=2).any(axis=1)
    assert len(known) == 10
    assert reached.sum() >= 9
