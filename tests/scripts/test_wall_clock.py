"""``scripts/wall_clock.py``: CPU time to a result."""

from __future__ import annotations

import csv
import subprocess
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.helpers.script_runs import TIMEOUT, command, environment, refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType

    from tests.helpers.script_runs import Call

DRIVING, CARTPOLE = "mo-deepdrive-one-waypoint-v0", "CartPole-v1"
pytestmark = pytest.mark.slow


@pytest.fixture
def wall_clock(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("wall_clock")


@pytest.fixture
def clock(wall_clock: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The CPU time in seconds, which a test sets."""
    now = [100.0]
    monkeypatch.setattr(wall_clock, "process_time", lambda: now[0])
    return now


def test_a_result_that_holds_is_timed_without_evaluations(wall_clock: ModuleType, clock: list[float]) -> None:
    asked = []

    def done(policy: str) -> bool:
        asked.append(policy)
        clock[0] += 1000.0
        return policy == "good"

    watch = wall_clock.Stopwatch(60.0, done)
    clock[0] += 5.0  # making the agent
    watch.start()
    policies = ["bad", "good", "bad", *["good"] * 5]
    for update, policy in enumerate(policies[:-1], 1):
        clock[0] += 2.0
        watch.lap(4096 * update, policy)
        assert (watch.reached, watch.seconds, watch.steps) == (False, 2.0 * update, 4096 * update)
    clock[0] += 2.0
    with pytest.raises(wall_clock.Finished):
        watch.lap(4096 * 8, "good")
    assert asked == policies
    assert (watch.reached, watch.seconds, watch.steps) == (True, 8.0, 4096 * 4), "the first of the five that held"


def test_the_limit_ends_a_run(wall_clock: ModuleType, clock: list[float]) -> None:
    watch = wall_clock.Stopwatch(3.0)
    watch.start()
    clock[0] += 2.0
    watch.lap(1, "policy")
    clock[0] += 2.0
    with pytest.raises(wall_clock.Finished):
        watch.lap(2, "policy")
    assert (watch.reached, watch.seconds, watch.steps) == (False, 4.0, 2)


def results(wall_clock: ModuleType, *driving: tuple[bool, float, int]) -> list[object]:
    runs = [wall_clock.Result("ppo", DRIVING, seed, *run) for seed, run in enumerate(driving)]
    return [*runs, wall_clock.Result("ppo", CARTPOLE, 0, False, 2.0, 80_000)]


def test_the_table_has_the_median_and_the_range(wall_clock: ModuleType) -> None:
    runs = results(wall_clock, (True, 2.0, 100_000), (True, 1.0, 60_000), (True, 4.0, 400_000))
    assert wall_clock.summary(runs, "ppo") == [
        "ppo",
        "3 of 3",
        "2.0 (1.0 to 4.0)",
        "100,000 (60,000 to 400,000)",
        "60,000",
        "40,000",
    ]


def test_runs_that_did_not_arrive_are_slower_than_all_others(wall_clock: ModuleType) -> None:
    runs = results(wall_clock, (False, 60.0, 600_000), (True, 1.0, 60_000), (True, 4.0, 400_000))
    assert wall_clock.summary(runs, "ppo")[1:4] == [
        "2 of 3",
        "4.0 (1.0 to not reached)",
        "400,000 (60,000 to not reached)",
    ]
    runs = results(wall_clock, (False, 60.0, 600_000))
    assert wall_clock.summary(runs, "ppo")[1:4] == ["0 of 1", "not reached", "not reached"]
    assert wall_clock.summary(runs, "mo_ppo")[1:] == ["0 of 0", "-", "-", "-", "-"]


def test_cartpole_pays_a_vector(wall_clock: ModuleType) -> None:
    env = wall_clock.mo_gymnasium.make(wall_clock.VECTOR_CARTPOLE)
    env.reset(seed=0)
    assert env.unwrapped.reward_space.shape == (1,)
    for step in range(1, 501):
        _, reward, terminated, truncated, _ = env.step(step % 2)
        np.testing.assert_array_equal(reward, np.ones(1, dtype=np.float32))
        if terminated or truncated:
            break
    assert terminated, "CartPole falls"


def test_a_policy_that_stands_still_does_not_arrive(wall_clock: ModuleType) -> None:
    assert not wall_clock.arrives(lambda observations, *_: np.zeros(len(observations), dtype=np.int64))


@pytest.mark.parametrize("learner", ["ppo", "mo_ppo"])
def test_our_learners_run_in_both_environments(wall_clock: ModuleType, learner: str) -> None:
    for env_id in (DRIVING, CARTPOLE):
        found = wall_clock.race(learner, env_id, 3, limit=1e-6)
        assert (found.learner, found.environment, found.seed, found.reached) == (learner, env_id, 3, False)
        assert found.steps == wall_clock.ENVS * wall_clock.STEPS, "it ends after its first update"
        assert found.seconds > 0.0


@pytest.mark.processes
def test_the_command_runs_processes_and_writes_both_environments(tmp_path: Path) -> None:
    options = ("--seeds", 1, "--limit", 1e-6, "--cartpole", 1e-6, "--only", "ppo", "--output", "runs.csv")
    done = subprocess.run(
        command("wall_clock", *options),
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "0 of 1" in done.stdout
    with (tmp_path / "runs.csv").open(newline="") as file:
        assert [row["environment"] for row in csv.DictReader(file)] == [DRIVING, CARTPOLE]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", "0"], "--seeds 0 must be at least 1"),
        (["--limit", "0"], "--limit 0.0 must be positive"),
        (["--cartpole", "nan"], "--cartpole nan must be positive"),
        (["--only", "dqn"], "invalid choice: 'dqn'"),
        (["--only", "ppo", "--output", "no/runs.csv"], "there is no folder no"),
    ],
)
@pytest.mark.usefixtures("wall_clock")
def test_invalid_options_are_refused(call: Call, options: list[str], message: str) -> None:
    refused(call("wall_clock", *options), message)


@pytest.mark.usefixtures("wall_clock")
def test_a_library_that_is_missing_is_named(call: Call) -> None:
    try:
        import stable_baselines3  # noqa: F401
    except ImportError:
        refused(call("wall_clock", "--only", "stable_baselines3.ppo"), "stable_baselines3.ppo cannot run here", "peers")
