"""The search of best-known fronts: reproducible, measured by the simulator, and never for the worse."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import moocore
import numpy as np
import pytest

from algorithms.experiments.build import build
from algorithms.experiments.config import load_experiment
from algorithms.experiments.run_directory import Run
from mo_deepdrive import fronts

OPEN = ("one_waypoint", "static_obstacle")
SMALL = ["--decisions", "300000", "--anew"]


@pytest.fixture(scope="module")
def front(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("front")


@pytest.fixture
def shipped(front: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the script finds and leaves its fronts in a test: nothing is shipped there yet."""
    file = tmp_path / "shipped.json"
    monkeypatch.setattr(front, "front_file", lambda scenario, action_type: file)
    return file


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Save a run that has hardly been trained."""

    def make(env_id: str = "mo-deepdrive-one-waypoint-v0", algorithm: str = "a2c", **arguments: Any) -> Path:
        config = tmp_path / "experiment.yaml"
        settings: dict[str, Any] = {
            "environment": {"id": env_id, "arguments": arguments},
            "algorithm": {"name": algorithm, "hidden": [4]},
            "training": {"total_timesteps": 1, "num_envs": 8},
        }
        if algorithm == "pcn":
            settings["algorithm"] |= {"warmup_episodes": 8, "gradient_steps": 1, "max_policies": 5}
        else:
            weights = [1.0] * (5 if "obstacle" in env_id else 4)
            settings["utility"] = {"name": "linear", "arguments": {"weights": weights}}
        config.write_text(json.dumps(settings), encoding="utf-8")
        experiment = load_experiment(config)
        run = Run.create(experiment, tmp_path / "untrained" / f"{algorithm}-seed0")
        agent = build(experiment)
        agent.train(1)
        agent.save(run.checkpoint)
        return run.path

    return make


def returns_of(text: str, scenario: str, action_type: str) -> np.ndarray:
    """The discounted returns of a file's policies, by replay."""
    sequences = [fronts.decode(policy.actions, action_type) for policy in fronts.read(text)]
    return fronts.discounted_sum(fronts.replay(scenario, action_type, sequences), fronts.GAMMA)


@pytest.mark.parametrize("scenario", OPEN)
@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
def test_a_search_writes_drives_that_do_what_it_says(
    front: ModuleType, tmp_path: Path, scenario: str, action_type: str
) -> None:
    file = tmp_path / "front.json"
    arguments = ["--scenario", scenario, "--action-type", action_type, *SMALL, "--output", str(file)]
    assert front.main(arguments) == 0
    text = file.read_text(encoding="utf-8")
    policies = fronts.read(text)
    assert fronts.write(scenario, action_type, policies) == text
    replayed = returns_of(text, scenario, action_type)
    np.testing.assert_allclose(replayed, [policy.discounted for policy in policies], rtol=1e-5, atol=2e-5)
    assert (np.diff(replayed[:, 0]) <= 1e-5).all()
    assert {policy.source for policy in policies} == {
        f"python scripts/front.py --scenario {scenario} --action-type {action_type} --decisions 300000 --seed 0 --anew"
    }


def test_the_same_seed_finds_the_same_front_and_another_seed_another(
    front: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(front, "CHILDREN", 256)
    files = [tmp_path / f"{name}.json" for name in "abc"]
    for file, seed in zip(files, ("0", "0", "1"), strict=True):
        # More than RULED generations, so that children are bred too.
        front.main(["--decisions", "600000", "--anew", "--seed", seed, "--output", str(file)])
    assert files[0].read_bytes() == files[1].read_bytes()
    assert json.loads(files[0].read_text())["policies"] != json.loads(files[2].read_text())["policies"]


def test_breeding_finds_what_rules_alone_do_not(front: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front, "CHILDREN", 512)
    search = front.Search("one_waypoint", "discrete", 0)
    for _ in range(front.RULED):
        search.generation(0)
    before = search.volumes(search.archive)
    for _ in range(5):
        search.generation(0)
    assert all(new > old for new, old in zip(search.volumes(search.archive), before, strict=True))


def test_a_front_is_replaced_by_a_larger_one_and_kept_otherwise(
    front: ModuleType, shipped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert front.main(SMALL) == 0
    first = shipped.read_bytes()
    assert "policies written to" in capsys.readouterr().out
    assert front.main(["--decisions", "0", "--anew"]) == 0
    assert "nothing is written" in capsys.readouterr().out
    assert shipped.read_bytes() == first
    assert front.main(["--decisions", "3000000", "--seed", "7"]) == 0
    assert "policies written to" in capsys.readouterr().out
    sources = {policy.source for policy in fronts.read(shipped.read_text(encoding="utf-8"))}
    assert any("--seed 7" in source for source in sources)


def test_a_search_of_no_decisions_keeps_the_shipped_front(front: ModuleType, shipped: Path) -> None:
    front.main(SMALL)
    first = returns_of(shipped.read_text(encoding="utf-8"), "one_waypoint", "discrete")
    assert front.main(["--decisions", "0"]) == 0
    second = returns_of(shipped.read_text(encoding="utf-8"), "one_waypoint", "discrete")
    reference = fronts.reference_point().values
    volumes = [moocore.hypervolume(each, ref=reference, maximise=True) for each in (first, second)]
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)


@pytest.mark.parametrize("arguments", [{}, {"objectives": ["jerk", "distance", "destination", "g_force"]}])
def test_drives_of_a_run_join_the_search(
    front: ModuleType, shipped: Path, make_run: Callable[..., Path], arguments: dict[str, Any]
) -> None:
    path = make_run(**arguments)
    name, about, sequences = front.drives_of_run(str(path), "one_waypoint", "discrete", 3)
    assert name.endswith("/untrained/a2c-seed0")
    assert about.startswith("a2c, seed 0, ")
    assert len(sequences) == 4
    assert all(1 <= len(sequence) <= 600 and sequence.max() < 22 for sequence in sequences)
    assert front.main(["--decisions", "0", "--anew", "--episodes", "3", "--from", str(path)]) == 0
    policies = fronts.read(shipped.read_text(encoding="utf-8"))
    assert {policy.source.split()[0] for policy in policies} == {"run", "python"}


def test_every_policy_of_a_front_drives_once_greedily_and_then_sampled(
    front: ModuleType, make_run: Callable[..., Path]
) -> None:
    path = make_run("mo-deepdrive-static-obstacle-v0", algorithm="pcn", fixed_destination=True)
    agent = build(load_experiment(path / "config.yaml"), num_envs=1)
    agent.load(path / "checkpoint.safetensors", policy_only=True)
    policies = len(agent.commands()[1])
    greedy = front.drives_of_run(str(path), "static_obstacle", "discrete", 0)[2]
    sampled = front.drives_of_run(str(path), "static_obstacle", "discrete", 3)[2]
    assert len(greedy) == policies
    assert len(sampled) == 4 * policies
    for first, again in zip(greedy, sampled, strict=False):
        np.testing.assert_array_equal(first, again)


def test_continuous_drives_of_a_run_are_rounded_to_what_can_be_written(
    front: ModuleType, make_run: Callable[..., Path]
) -> None:
    path = make_run("mo-deepdrive-static-obstacle-v0", action_type="continuous")
    _, _, sequences = front.drives_of_run(str(path), "static_obstacle", "continuous", 2)
    driver = front.Driver("static_obstacle", "continuous")
    plans = driver.plans(sequences)
    for plan, sequence in zip(plans, sequences, strict=True):
        written = driver.sequence(plan)
        np.testing.assert_allclose(written, sequence[: len(written)], atol=0.5 / 1024)
        np.testing.assert_array_equal(fronts.decode(fronts.encode(written), "continuous"), written)


def test_a_run_of_another_scenario_or_action_set_is_refused(
    front: ModuleType, shipped: Path, make_run: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(make_run())
    assert front.main(["--scenario", "static_obstacle", "--decisions", "0", "--from", path]) == 2
    assert "has scenario = 'one_waypoint'; the front needs 'static_obstacle'" in capsys.readouterr().err
    assert front.main(["--action-type", "continuous", "--decisions", "0", "--from", path]) == 2
    assert "has action_type = 'discrete'; the front needs 'continuous'" in capsys.readouterr().err
    assert front.main(["--decisions", "0", "--from", "no/such/run"]) == 2
    assert "no/such/run" in capsys.readouterr().err
    assert not shipped.exists()


def test_the_subset_of_most_hypervolume_is_found_one_after_the_other(front: ModuleType) -> None:
    rng = np.random.default_rng(0)
    returns = rng.random((40, 3))
    reference = np.full(3, -0.1)
    chosen = front.largest_subset(returns, reference, 6)
    expected: list[int] = []
    for _ in range(6):
        volumes = [front.hypervolume(returns[[*expected, row]], reference) for row in range(40)]
        expected.append(int(np.argmax(volumes)))
    assert chosen == expected
    full = front.largest_subset(returns, reference, 40)
    assert set(full) == set(np.flatnonzero(moocore.is_nondominated(returns, maximise=True)))


def test_drives_that_do_not_dominate_the_reference_points_are_not_kept(front: ModuleType) -> None:
    driver = front.Driver("one_waypoint", "continuous")
    gentle, hard = np.array([[0.0, 0.1, -1.0]] * 30), np.array([[0.0, 1.0, -1.0], [0.0, -0.9, -1.0]] * 30)
    drives = driver.drive(driver.plans([gentle, hard, np.zeros((0, 3))]), 0)
    references = [fronts.reference_point("one_waypoint", "continuous", gamma).values for gamma in front.GAMMAS]
    assert (drives.returns[0][1] < references[0]).any()
    few = front.chosen_few(drives, references)
    np.testing.assert_array_equal(few.plans, drives.plans[[0, 2]])


def test_splicing_moves_what_follows(front: ModuleType) -> None:
    def spliced(first: int, last: int, room: int) -> list[int]:
        plan = np.arange(10, dtype=np.int16)[:, None]
        size = front.splice(plan, 8, first, last, room)
        kept = plan[:size, 0].tolist()
        kept[first : min(first + room, size)] = [-1] * (min(first + room, size) - first)
        return kept

    assert spliced(2, 4, 2) == [0, 1, -1, -1, 4, 5, 6, 7]
    assert spliced(2, 4, 0) == [0, 1, 4, 5, 6, 7]
    assert spliced(2, 2, 1) == [0, 1, -1, 2, 3, 4, 5, 6, 7]
    assert spliced(6, 8, 4) == [0, 1, 2, 3, 4, 5, -1, -1, -1, -1]
    assert spliced(1, 2, 6) == [0, -1, -1, -1, -1, -1, -1, 2, 3, 4]  # no longer than a plan
    assert spliced(0, 8, 0) == []


@pytest.mark.parametrize("n_actions", [0, 16, 22])
def test_children_are_plans(front: ModuleType, n_actions: int) -> None:
    rng = np.random.default_rng(0)
    k = 1 if n_actions else 3
    idle = np.array([0] if n_actions else [0, 0, -1024], dtype=np.int16)
    low, high = (0, n_actions) if n_actions else (-1024, 1025)
    parents = np.repeat(rng.integers(low, high, (300, 12, k)), 5, axis=1).astype(np.int16)
    lengths = rng.integers(0, 61, 300)
    plans = np.tile(idle, (300, 60, 1))
    front.breed(parents, lengths, parents[::-1].copy(), lengths[::-1].copy(), plans, n_actions, idle, rng)
    assert plans.min() >= low
    assert plans.max() < high
    same = [np.array_equal(*each) for each in zip(plans, parents, strict=True)]
    assert sum(same) < 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "intersection"], "invalid choice: 'intersection'"),
        (["--decisions", "-1"], "--decisions -1 must be at least 0"),
        (["--seed", "-1"], "--seed -1 must be at least 0"),
        (["--episodes", "-1"], "--episodes -1 must be at least 0"),
        (["--output", "/no/such/folder/front.json"], "there is no folder /no/such/folder"),
    ],
)
def test_bad_arguments(
    front: ModuleType, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        front.main(arguments)
    assert message in capsys.readouterr().err
