"""How many threads the trainers use, and that others' settings are as before afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest
import torch
from threadpoolctl import ThreadpoolController, threadpool_limits

from algorithms.a2c import A2C
from algorithms.learning.threads import limited_threads, set_threads
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.scenarios import SCENARIOS

BLAS = ThreadpoolController().select(user_api="blas").lib_controllers


def blas_threads() -> set[int]:
    return {library.get_num_threads() for library in BLAS}


@pytest.fixture
def two_threads() -> Iterator[None]:
    """BLAS and torch use two threads, as on a machine with two cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with threadpool_limits(2, user_api="blas"):
        if blas_threads() != {2}:
            pytest.skip("this BLAS has no threads")
        yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_torch_and_blas_have_one_thread_while_an_agent_trains() -> None:
    seen = []

    def record(_agent: object) -> bool:
        seen.append({torch.get_num_threads(), *blas_threads()})
        return True

    env = make_env("mo-deepdrive-one-waypoint-v0", num_envs=2)
    agent = A2C(env, make_utility("one_waypoint_linear", SCENARIOS["one_waypoint"].objectives))
    agent.train(1, after_update=record)
    assert seen == [{1}]
    assert {torch.get_num_threads(), *blas_threads()} == {2}


@pytest.mark.usefixtures("two_threads")
def test_torch_has_as_many_threads_as_asked_for() -> None:
    try:
        set_threads(2)
        with limited_threads():
            assert torch.get_num_threads() == 2
    finally:
        set_threads(1)


FORKED = """
import multiprocessing, sys, torch

def train():
    from algorithms import A2C
    from algorithms.learning.threads import set_threads
    from mo_deepdrive.evaluation.env_adapter import make_env
    A2C(make_env("mo-deepdrive-one-waypoint-v0", num_envs=2), "one_waypoint_linear").train(100)
    try:
        set_threads(2)
    except ValueError as error:
        print(error)

torch.set_num_threads(2)
torch.randn(500, 500) @ torch.randn(500, 500)
torch.randn(10**6).exp()
if "before" in sys.argv:
    train()
process = multiprocessing.get_context("fork").Process(target=train)
process.start()
process.join()
sys.exit(process.exitcode)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no forks")
@pytest.mark.parametrize("trained", ["before", "never before"])
def test_a_forked_process_trains_although_its_parent_has_threads(trained: str) -> None:
    command = [sys.executable, "-c", FORKED, trained]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert ("threads = 2 must be 1 in a forked process" in done.stdout) == (trained == "before")
