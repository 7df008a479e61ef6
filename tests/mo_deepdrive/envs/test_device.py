"""Environments of tensors equal those of arrays: on the CPU bit for bit, on a GPU (``make test-gpu``) nearly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from mo_deepdrive import Objective, register_objective
from mo_deepdrive.device.worlds import TensorWorlds, make_streams
from mo_deepdrive.envs.device import _Episode
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.simulation.state import ENDS
from mo_deepdrive.world.batch import Draws, WorldBatch

SCENARIOS = ("one_waypoint", "static_obstacle", "intersection", "left_turn")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def make(scenario: str, num_envs: int, **options: Any) -> Any:
    return gymnasium.make_vec(f"mo-deepdrive-{scenario.replace('_', '-')}-v0", num_envs=num_envs, **options)


def random_actions(env: Any, steps: int, seed: int = 0) -> np.ndarray:
    """Random ones that do not stand still."""
    rng, shape = np.random.default_rng(seed), (steps, *env.action_space.shape)
    if env.action_space.dtype == np.float32:
        return rng.uniform([-0.3, 0.0, -1.0], [0.3, 1.0, -0.5], shape).astype(np.float32)
    return rng.choice([3, 3, 3, 6, 9, 18, 21], shape)


def assert_close(ours: Any, theirs: Any) -> None:
    """Equal on the CPU, and up to 1e-5 on a GPU."""
    if not isinstance(ours, torch.Tensor) or ours.device.type == "cpu":
        np.testing.assert_array_equal(ours, theirs)
    else:
        np.testing.assert_allclose(ours.cpu().numpy(), theirs, rtol=1e-5, atol=1e-5)


def speed_squared(vehicles: Any, v: int, params: Any) -> float:
    return vehicles[v].speed ** 2


def with_own_objective() -> dict[str, Any]:
    own = Objective("speed_squared", "m^2/s^2", -1, 10.0, "square of the speed", 1e4, measure=speed_squared)
    register_objective(own)
    return {"objectives": ["time", "speed_squared", "distance", "destination", "jerk"]}


def adopt(arrays: Any, tensors: Any, worlds: np.ndarray) -> None:
    """New episodes are drawn in different ways: the arrays take those of the tensors."""
    if worlds.any():
        state = arrays.get_state()
        state["state"][worlds] = tensors.get_state()["state"][worlds]
        arrays.set_state(state)


def drive(arrays: Any, tensors: Any, actions: np.ndarray) -> set[str]:
    """Compare two environments under the same actions; returns how episodes ended."""
    mode, device, seen = arrays.autoreset_mode, tensors.device, set()
    for action in actions:
        waiting = arrays._over.copy()
        if mode is AutoresetMode.DISABLED and waiting.any():
            arrays.reset(options={"reset_mask": waiting})
            tensors.reset(options={"reset_mask": torch.as_tensor(waiting, device=device)})
            adopt(arrays, tensors, waiting)
        theirs, ours = arrays.step(action), tensors.step(torch.as_tensor(action, device=device))
        for mine, other in zip(ours[1:4], theirs[1:4], strict=True):
            assert_close(mine, other)
        infos, ends = theirs[4], ours[4]
        for name in set(infos) & {"acted", "arrived"}:
            np.testing.assert_array_equal(ends[name].cpu(), infos[name])
        nobody = {"_end": np.zeros(arrays.num_envs, dtype=np.bool_)}
        if mode is AutoresetMode.SAME_STEP:
            over = ends["_final_info"].cpu().numpy()
            if over.any():
                assert_close(ends["final_obs"][over], infos["final_obs"][over])
            infos, ends = infos.get("final_info", nobody), ends["final_info"]
        over = ends["_end"].cpu().numpy()
        np.testing.assert_array_equal(over, infos.get("_end", nobody["_end"]))
        if over.any():
            names = np.array(ENDS)[ends["end"].cpu().numpy()[over]]
            np.testing.assert_array_equal(names, infos["end"][over].astype(str))
            np.testing.assert_array_equal(ends["success"].cpu(), infos["success"])
            seen |= set(names.reshape(-1))
        adopt(
            arrays, tensors, {AutoresetMode.SAME_STEP: over, AutoresetMode.NEXT_STEP: waiting}.get(mode, over & False)
        )
        assert_close(ours[0], arrays._shaped(arrays.batch.observations))
    return seen


def both(scenario: str, device: str, **options: Any) -> tuple[Any, Any]:
    """Environments of arrays and of tensors that begin with the same scenarios of the test split."""
    seeds = list(SPLITS["test"][:64])
    arrays, tensors = make(scenario, 64, **options), make(scenario, 64, device=device, **options)
    assert_close(tensors.reset(seed=seeds)[0], arrays.reset(seed=seeds)[0])
    return arrays, tensors


@pytest.mark.slow
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_trajectories_equal_those_of_arrays(scenario: str, action_type: str, device: str, registries: None) -> None:
    own = with_own_objective() if action_type == "discrete" else {}
    options = {**own, "action_type": action_type, "time_limit": 8.0}
    arrays, tensors = both(scenario, device, autoreset_mode=AutoresetMode.SAME_STEP, **options)
    assert len(drive(arrays, tensors, random_actions(arrays, 200))) > 1


@pytest.mark.slow
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_other_autoreset_modes_are_those_of_arrays(mode: AutoresetMode, device: str) -> None:
    arrays, tensors = both("intersection", device, autoreset_mode=mode, time_limit=4.0, action_delay=2)
    assert len(drive(arrays, tensors, random_actions(arrays, 100))) > 1


def placed(config: Any, streams: np.ndarray) -> np.ndarray:
    """The states of episodes as the CPU draws and places them from streams of random numbers."""
    batch = WorldBatch(config, len(streams))
    batch.place(Draws(len(streams), batch.scenario.draws, [_Episode(each) for each in streams]))  # type: ignore[misc]
    return batch.state


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["static_obstacle", "left_turn"])
def test_an_episode_is_a_function_of_seed_environment_and_number(scenario: str, device: str) -> None:
    envs = [make(scenario, count, device=device, autoreset_mode=AutoresetMode.SAME_STEP) for count in (3, 40)]
    for env in envs:
        env.reset(seed=7)
    streams = make_streams(np.full(40, 7), np.arange(40))
    for number in range(3):
        streams["episode"] = number
        expected = placed(envs[0].config, streams)
        for env in envs:
            states = env.worlds.read_states()
            for field in ("x", "y", "heading", "waypoints", "obstacle"):
                np.testing.assert_allclose(states[field], expected[field][: env.num_envs], rtol=1e-12)
            env.reset()
    # Worlds with seeds of their own are environment 0 of their seed; the first episode is that of the CPU.
    env = make(scenario, 2, device=device)
    env.reset(seed=[11, 12])
    env.reset()
    streams = make_streams(np.array([11, 12]), np.zeros(2))
    streams["episode"] = 1
    np.testing.assert_allclose(env.worlds.read_states()["y"], placed(env.config, streams)["y"], rtol=1e-12)


def test_a_state_resumes_on_any_device(device: str) -> None:
    env = make("left_turn", 8, device=device)
    env.reset(seed=1)
    actions = torch.as_tensor(random_actions(env, 60), device=env.device)
    for action in actions[:10]:
        env.step(action)
    copy = make("left_turn", 8, device="cpu")
    copy.set_state(env.get_state())
    for action in actions[10:]:
        assert_close(env.step(action)[0], copy.step(action.cpu())[0])


def test_pins_and_masks_reset_the_worlds_that_they_say(device: str) -> None:
    env = make("one_waypoint", 3, device=device)
    first = env.reset(seed=0)[0]
    mask = torch.tensor([False, True, False], device=env.device)
    observations, _ = env.reset(options={"destination": (20.0, 20.0), "reset_mask": mask})
    assert (observations == first).all(dim=1).tolist() == [True, False, True]
    assert env.worlds.read_states()[1, 0].waypoints[0].tolist() == [20.0, 20.0]
    assert env.worlds.read_streams()["episode"].tolist() == [1, 2, 1]
    observations, _ = env.reset(seed=[None, None, 5], options={"reset_mask": np.array([False, True, True])})
    assert_close(observations[2], make("one_waypoint", 1).reset(seed=5)[0][0])
    assert env.worlds.read_streams()["episode"].tolist() == [1, 3, 1]


def step_and_wait(env: Any, actions: torch.Tensor) -> None:
    """By then every error of the step is known."""
    env.step(actions)
    env.get_state()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_steps_of_worlds_that_have_to_be_reset_are_refused(mode: AutoresetMode, device: str) -> None:
    env = make("one_waypoint", 2, device=device, autoreset_mode=mode)
    action = torch.zeros(2, dtype=torch.int64, device=env.device)
    with pytest.raises(ResetNeeded, match=r"before the first reset"):
        env.step(action)
    env.reset(options={"reset_mask": np.array([False, True])})
    with pytest.raises(ResetNeeded, match=r"one of them: 0"):
        step_and_wait(env, action)


REFUSED_STEPS: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "arrays": ("discrete", lambda device: np.zeros(2, dtype=np.int64), "'ndarray'; this environment takes tensors on"),
    "dtype": ("discrete", lambda device: torch.zeros(2, device=device), "dtype torch.float32; expected torch.int64"),
    "shape": ("discrete", lambda device: torch.zeros(3, dtype=torch.int64, device=device), r"(3,); expected (2,)"),
    "axes": ("continuous", lambda device: torch.zeros(2, device=device), "(2,); expected (2, 3)"),
    "device": ("discrete", lambda device: torch.zeros(2, dtype=torch.int64, device="meta"), "are on meta; expected"),
}


@pytest.mark.parametrize("name", REFUSED_STEPS)
def test_anything_but_tensors_of_the_action_space_is_refused(name: str, device: str) -> None:
    action_type, actions, message = REFUSED_STEPS[name]
    env = make("one_waypoint", 2, device=device, action_type=action_type)
    env.reset(seed=0)
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        env.step(actions(env.device))
    assert message in str(caught.value)


@pytest.mark.parametrize(("action_type", "wrong"), [("discrete", 22), ("discrete", -1), ("continuous", np.nan)])
def test_actions_that_are_not_allowed_are_reported_or_refused(action_type: str, wrong: Any, device: str) -> None:
    for check in (False, True):
        env = make("one_waypoint", 3, device=device, action_type=action_type, check_actions=check)
        env.reset(seed=0)
        actions = torch.as_tensor(random_actions(env, 1)[0], device=env.device)
        actions.view(3, -1)[1, 0] = wrong
        before = env.get_state()["state"]
        with pytest.raises(ValueError, match=r"world 1\b.* is not allowed; expected"):
            step_and_wait(env, actions)
        after = env.get_state()["state"]  # the error is raised once
        assert np.isfinite(env.worlds.read_states()["x"]).all()
        assert (before == after).all() == check


def test_what_a_device_cannot_do_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments, message in (
        ({"device": "cuda:99"}, "device = 'cuda:99' does not exist; PyTorch finds"),
        ({"device": "abacus"}, "device = 'abacus' is not a valid device"),
        ({"device": "cpu", "threads": 2}, "threads = 2 has no effect with device = 'cpu'; omit it"),
        ({"device": "cpu", "num_envs": 10**12}, r"num_envs = 1000000000000 takes at least .* GiB"),
    ):
        with pytest.raises(ValueError, match=message):
            make("one_waypoint", **{"num_envs": 2, **arguments})
    env = make("one_waypoint", 2, device="cpu")
    with pytest.raises(ValueError, match=r"seed 18446744073709551616 must be at most 2\*\*64 - 1"):
        env.reset(seed=2**64)
    with pytest.raises(ValueError, match=r"'reset_mask' = .* must be a bool tensor of shape \(2,\) on cpu"):
        env.reset(options={"reset_mask": torch.ones(3, dtype=torch.bool)})
    env = make("static_obstacle", 2, device="cpu")
    env.reset(seed=0)
    before = env.get_state()
    start = tuple(env.worlds.read_states()[0, 0].waypoints[0])
    with pytest.raises(ValueError, match="no valid scenario in 1000 draws with these reset options"):
        env.reset(seed=1, options={"obstacle": (start, start), "destination": start})
    for name, array in env.get_state().items():
        np.testing.assert_array_equal(array, before[name])


@pytest.mark.gpu
def test_more_worlds_than_fit_on_a_gpu_are_refused() -> None:
    with pytest.raises(ValueError, match=r"num_envs = 10000000000 takes at least .* of the memory of cuda:0"):
        make("one_waypoint", 10**10, device="cuda")


@pytest.mark.gpu
def test_other_libraries_take_the_tensors() -> None:
    env = make("one_waypoint", 4, device="cuda")
    observations, _ = env.reset(seed=0)
    assert observations.__dlpack_device__()[0] == 2  # kDLCUDA
    torch.testing.assert_close(torch.from_dlpack(observations), observations)


@pytest.mark.gpu
def test_steps_can_be_captured_in_a_graph() -> None:
    config = make("one_waypoint", 1).config
    ours, captured = (TensorWorlds(config, 256, "cuda") for _ in range(2))
    actions = torch.full((256, 1), 3, device="cuda")
    for worlds in (ours, captured):
        worlds.begin(np.full(256, 3), np.arange(256))
        worlds.step(actions)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured.step(actions)
    for _ in range(200):
        ours.step(actions)
        graph.replay()
    captured.check()
    for mine, theirs in zip(captured.outputs, ours.outputs, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0.0, atol=0.0)
