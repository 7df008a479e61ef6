"""How many threads the trainers use, and that others' settings are as before afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import numba
import pytest
import torch
from algorithms.networks.compiled import perceptron
from algorithms.networks.modules import Perceptron
from algorithms.networks.threads import limited_threads, one_blas_thread, set_threads, threads, wanted_threads
from threadpoolctl import ThreadpoolController, threadpool_limits

from algorithms.a2c import A2C
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.scenarios import SCENARIOS
from mo_deepdrive.utilities import make_utility

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
def test_blas_has_one_thread_for_a_while() -> None:
    with one_blas_thread():
        assert blas_threads() == {1}
        with one_blas_thread():
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == {2}
    with one_blas_thread():
        assert blas_threads() == {1}
    assert blas_threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_the_passes_of_a_network_run_on_one_blas_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    run = perceptron.forward_pass

    def record(*arrays: object) -> None:
        seen.append(blas_threads())
        run(*arrays)

    monkeypatch.setattr(perceptron, "forward_pass", record)
    network = Perceptron(torch.nn.Linear(3, 4), torch.nn.ReLU(), torch.nn.Linear(4, 2))
    with torch.no_grad():
        network(torch.zeros(5, 3))
    assert seen == [{1}]
    assert blas_threads() == {2}


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
def test_torch_has_as_many_threads_as_asked_for_however_few_the_cores(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
    try:
        set_threads(2)
        assert (threads(), wanted_threads()) == (1, 2)
        with limited_threads():
            assert torch.get_num_threads() == 2
    finally:
        monkeypatch.undo()
        set_threads(1)


def test_fewer_threads_stay_fewer() -> None:
    with limited_threads():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 1


FORKED = """
import multiprocessing, sys, torch

def train():
    from algorithms import A2C
    from algorithms.networks.threads import set_threads
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
