"""MOMAland: its tests, wrappers, conversions, and its multi-agent PPO."""

from __future__ import annotations

import runpy
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mo_deepdrive
from tests.integrations.envs import TWO, WEIGHTS, one_leaves_early, parallel

pytestmark = pytest.mark.filterwarnings("ignore")
EARLY = {"harmful_g_force": 0.1}


def drive(env: Any) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rewards of an episode in which one vehicle leaves before the other, and the last infos."""
    env.reset(seed=0)
    rewards, infos = [], {}
    while env.agents:
        _, received, _, _, infos = env.step(one_leaves_early(env.agents))
        rewards.append(received)
    return rewards, infos


def test_rewards_are_linearised() -> None:
    from momaland.utils.parallel_wrappers import LinearizeReward

    plain, _ = drive(parallel(**EARLY))
    scalars, _ = drive(LinearizeReward(parallel(**EARLY), WEIGHTS))
    for vectors, numbers in zip(plain, scalars, strict=True):
        for agent, vector in vectors.items():
            assert numbers[agent] == pytest.approx(float(WEIGHTS[agent] @ vector))


@pytest.mark.parametrize("name", ["NormalizeReward", "RecordEpisodeStatistics", "CentraliseAgent"])
def test_wrappers_that_look_up_every_agent(name: str) -> None:
    from momaland.utils import parallel_wrappers

    wrap = getattr(parallel_wrappers, name)
    if name == "CentraliseAgent":
        env = wrap(parallel(keep_finished=True, **EARLY))
        observation, _ = env.reset(seed=0)
        terminated = truncated = False
        while not (terminated or truncated):
            observation, reward, terminated, truncated, _ = env.step(np.array([3, 0]))
            assert observation in env.observation_space
            assert reward.shape == (6,)
        return
    arguments = ("vehicle_0", 0) if name == "NormalizeReward" else ()
    rewards, _ = drive(wrap(parallel(keep_finished=True, **EARLY), *arguments))
    assert all(reward["vehicle_0"].shape == (6,) for reward in rewards)


def test_a_wrapped_parallel_environment_is_converted() -> None:
    from momaland.utils.conversions import mo_parallel_to_aec
    from momaland.utils.parallel_wrappers import LinearizeReward

    env = mo_parallel_to_aec(LinearizeReward(parallel(), WEIGHTS))
    env.reset(seed=0)
    for _ in range(6):
        env.step(3)
    assert np.shape(env.last()[1]) == ()


def test_the_conversions_run() -> None:
    from momaland.utils.conversions import mo_aec_to_parallel

    there, _ = drive(parallel(**EARLY))
    back, _ = drive(mo_aec_to_parallel(mo_deepdrive.env(**TWO, **EARLY)))
    assert len(there) == len(back)
    for first, second in zip(there, back, strict=True):
        for agent in first:
            np.testing.assert_array_equal(first[agent], second[agent])


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_multi_agent_ppo_trains(actions: str, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """The script of MOMAland as it is, with our environment among those that it knows."""
    for module in ("distrax", "supersuit", "morl_baselines"):
        pytest.importorskip(module)
    import jax
    from momaland.utils.all_modules import all_environments

    jax.config.update("jax_disable_most_optimizations", True)
    options = {**TWO, "action_type": actions, "keep_finished": True, "end_together": True}
    module = SimpleNamespace(parallel_env=lambda: mo_deepdrive.parallel_env(**options))
    monkeypatch.setitem(all_environments, "driving", module)
    sizes = ["--num-weights=1", "--timesteps-per-weight=128", "--num-steps-per-epoch=64"]
    networks = ["--actor-net-arch=8", "--critic-net-arch=8"]
    monkeypatch.setattr(sys, "argv", ["momappo", "--env-id=driving", "--ref-point", *["-100"] * 6, *sizes, *networks])
    script = f"momaland.learning.cooperative_momappo.{actions}_momappo"
    trained = runpy.run_module(script, run_name="__main__")
    assert trained["current_timestep"] == 128
    assert np.isfinite(trained["value"]).all()
    assert "Weight 1/1 done!" in capsys.readouterr().out


@pytest.mark.slow
def test_a_central_agent_learns_with_morl_baselines() -> None:
    pytest.importorskip("morl_baselines", reason="morl-baselines is not installed: make test-integrations")
    from momaland.utils.parallel_wrappers import CentraliseAgent
    from morl_baselines.multi_policy.capql.capql import CAPQL

    def central() -> Any:
        return CentraliseAgent(parallel(action_type="continuous", keep_finished=True))

    small = {"net_arch": [8], "batch_size": 4, "learning_starts": 50, "buffer_size": 100}
    agent = CAPQL(central(), log=False, seed=0, device="cpu", **small)
    agent.train(100, central(), np.full(6, -1e4), num_eval_weights_for_front=6, num_eval_episodes_for_front=1)
    assert agent.global_step == 100
