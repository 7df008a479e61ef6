"""The worked examples in docs/examples: an own algorithm and an own environment, through all commands."""

from __future__ import annotations

import importlib
import re
import shlex
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file

from algorithms.reporting.training_log import read_metrics
from mo_deepdrive.evaluation import evaluate
from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import Call, interrupt, refused
from tests.helpers.short_runs import assert_same_run

EXAMPLES = REPOSITORY / "docs" / "examples"
MODULES = ("reinforce", "kl_penalty", "slope", "commute", "constants", "plain_ppo", "pettingzoo_ppo")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: a folder with the examples, outside of the repository."""
    for path in EXAMPLES.iterdir():
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name in MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


def shorten(path: Path, changes: dict[str, dict[str, Any]]) -> None:
    values = yaml.safe_load(path.read_text())
    for section, settings in changes.items():
        values[section] = {**values.get(section, {}), **settings}
    path.write_text(yaml.safe_dump(values))


SHORT: dict[str, dict[str, Any]] = {
    "environment": {"arguments": {"time_limit": 2}},
    "algorithm": {"hidden": [8]},
    "training": {"total_timesteps": 960, "num_envs": 4},
    "evaluation": {"episodes": 2, "final_episodes": 4, "interval": 320},
    "logging": {"interval": 2, "checkpoint_interval": 80, "save_figures": False},
}


def documented_commands(document: str) -> list[list[str]]:
    """The words of the commands in the ``bash`` blocks of a document."""
    blocks = re.findall(r"^```bash\n(.*?)^```$", (REPOSITORY / document).read_text(), flags=re.DOTALL | re.MULTILINE)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


def test_the_documentation_shows_the_yaml_of_the_examples() -> None:
    for document, example in (("own_algorithm", "reinforce"), ("extend", "commute")):
        text = (REPOSITORY / "docs" / f"{document}.md").read_text()
        shown = re.findall(r"^```yaml\n(environment:.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
        assert yaml.safe_load((EXAMPLES / f"{example}.yaml").read_text()) in map(yaml.safe_load, shown)


@pytest.mark.slow
def test_ppo_in_plain_pytorch_trains_and_returns_a_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    plain_ppo = importlib.import_module("plain_ppo")
    monkeypatch.setattr(plain_ppo, "ENVS", 8)

    def returns(seed: int) -> Any:
        policy = plain_ppo.Policy("K5", seed, total_timesteps=2 * 8 * plain_ppo.STEPS)
        torch.manual_seed(0)
        return evaluate(policy, "mo-deepdrive-left-turn-v1", episodes=2).returns

    assert np.array_equal(returns(0), returns(0))
    assert not np.array_equal(returns(0), returns(1))


@pytest.mark.slow
def test_two_vehicles_learn_in_plain_pytorch_through_pettingzoo(monkeypatch: pytest.MonkeyPatch) -> None:
    pettingzoo_ppo = importlib.import_module("pettingzoo_ppo")
    monkeypatch.setattr(pettingzoo_ppo, "EPISODES", 2)

    def weights(updates: int, seed: int = 0) -> Any:
        *_, (learners, utilities, arrivals) = pettingzoo_ppo.train(updates, seed)
        assert utilities.keys() == arrivals.keys() == {"vehicle_0", "vehicle_1"}
        return [tensor for learner in learners.values() for tensor in learner.actor.parameters()]

    first = weights(1)
    assert all(map(torch.equal, first, weights(1)))
    assert not any(map(torch.equal, first, weights(1, seed=1)))


def test_the_keys_of_an_own_algorithm_are_listed_with_their_descriptions(folder: Path, call: Call) -> None:
    code, out, _ = call("keys", "--algorithm", "reinforce:REINFORCE")
    assert code == 0
    assert "\nalgorithm.learning_rate: float > 0, <= 1, default 0.005\n    Adam's step size.\n" in out
    text = (folder / "reinforce.py").read_text()
    (folder / "reinforce.py").write_text(text.replace('        """Adam\'s step size."""\n', ""))
    del sys.modules["reinforce"]
    out = call("keys", "--algorithm", "reinforce:REINFORCE")[1]
    assert out.endswith("\nalgorithm.learning_rate: float > 0, <= 1, default 0.005\n\n")


@pytest.mark.slow
def test_the_commands_of_the_tutorial_train_resume_evaluate_sweep_and_plot_an_own_algorithm(
    folder: Path, call: Call
) -> None:
    shorten(folder / "reinforce.yaml", SHORT)
    shorten(folder / "reinforce_sweep.yaml", {"grid": {"algorithm.learning_rate": [0.002]}})
    sweep = yaml.safe_load((folder / "reinforce_sweep.yaml").read_text())
    (folder / "reinforce_sweep.yaml").write_text(yaml.safe_dump({**sweep, "seeds": 2}))
    printed = []
    for program, name, *words in documented_commands("docs/own_algorithm.md"):
        if name == "suite":
            continue
        code, out, error = call(name, *words)
        assert (program, code, error) == ("mo-deepdrive", 0, ""), out + error
        printed.append(out)
    assert len(printed) == 6
    assert "finished: runs/first" in printed[0]
    assert "runs/first is finished" in printed[1]
    assert "100 episodes of the test split" in printed[2]
    assert "2 done, 0 running, 0 failed, 0 waiting of 2" in printed[3]
    names = sorted(path.name for path in (folder / "runs" / "sweep" / "runs").iterdir())
    assert [re.sub("-[0-9a-f]+$", "", name) for name in names] == ["REINFORCE-seed0", "REINFORCE-seed1"]
    assert "1 of 1 cells" in printed[4]
    (figure,) = folder.glob("*.png")
    assert figure.name in printed[5]


OWN = [words[1:] for words in documented_commands("docs/change_algorithm.md") if "--config" in words]


@pytest.mark.slow
@pytest.mark.parametrize("command", OWN, ids=lambda command: command[-1])
def test_an_own_advantage_or_loss_trains_with_several_seeds_and_becomes_onnx(
    folder: Path, call: Call, command: list[str]
) -> None:
    sections = {name: SHORT[name] for name in ("training", "evaluation", "logging")}
    options = [f"--{name}.{key}={value}" for name, values in sections.items() for key, value in values.items()]
    code, out, error = call(*command, *options, "--training.seeds=[3, 4]", "--output", "runs")
    assert code == 0, out + error
    weights = [load_file(folder / "runs" / f"seed-{seed}" / "checkpoint.safetensors") for seed in (3, 4)]
    assert not torch.equal(*(each["vehicle_0.actor.body.0.weight"] for each in weights))
    pytest.importorskip("onnxruntime")
    assert call("export", "runs/seed-3", "--trust", "--output", "policy.onnx")[0] == 0


@pytest.mark.slow
def test_an_own_algorithm_that_is_killed_resumes_to_the_same_run_and_needs_trust(folder: Path, call: Call) -> None:
    shorten(folder / "reinforce.yaml", SHORT)
    arguments = ("--config", "reinforce.yaml", "--training.total_timesteps=8000", "--evaluation.interval=2000")
    assert call("train", *arguments, "--output", "whole")[0] == 0
    code, *_ = interrupt(folder / "killed", 1000, signal.SIGKILL, *arguments, "--output", "killed")
    assert code == -signal.SIGKILL
    assert yaml.safe_load((folder / "killed" / "status.json").read_text())["state"] == "running"
    hint = "choose another, or use --resume killed --trust"
    refused(call("train", *arguments, "--output", "killed"), hint)
    untrusted = ("config.yaml' has algorithm.name = 'reinforce:REINFORCE', code that", "add --trust if")
    refused(call("train", "--resume", "killed"), *untrusted)
    code, printed, _ = call("train", "--resume", "killed", "--trust")
    assert (code, "next: mo-deepdrive evaluate killed --video drive.mp4 --trust; " in printed) == (0, True)
    assert_same_run(folder / "whole", folder / "killed")

    for arguments in (
        ("evaluate", "whole"),
        ("play", "--env", "mo-deepdrive-intersection-v0", "--against", "whole"),
        ("gif", "whole", "--output", "x.gif"),
        ("choose", "whole", "--weights", "distance=1"),
    ):
        refused(call(*arguments), *untrusted)
    for name in ("table", "plot"):
        code, out, error = call(name, "whole")
        assert (code, error) == (0, ""), out


# ------------------------------------------------------------------------------------------- an own front of policies

CONSTANTS = """
from dataclasses import dataclass
import numpy as np
import torch
from algorithms import FrontAgent
from mo_deepdrive.world.config import Settings

class Constants(FrontAgent):
    class Config(Settings):
        policies: int = 4
    condition_names = ("action",)
    def conditions(self):
        return np.arange(self.config.policies, dtype=np.float32)[:, None]
    def policies(self, conditions):
        return Constant(self, conditions[:, 0].astype(int))
    def update(self, progress):
        self.step += 100
        self.updates += 1
        return {"policy_loss": 0.0}
    def get_state(self):
        return {"nothing": torch.zeros(1)}
    def set_state(self, state):
        pass

@dataclass
class Constant:
    agent: Constants
    action: np.ndarray
    utilities = ()
    gamma = 1.0
    env = property(lambda self: self.agent.env)
    device = property(lambda self: self.agent.device)
    def act(self, observations, accrued_reward, generator):
        return np.broadcast_to(self.action, len(observations))[:, None].copy()
"""
FRONT = """
environment: {id: deep-sea-treasure-v0}
algorithm: {name: "constants:Constants"}
training: {total_timesteps: 400, num_envs: 2}
evaluation: {episodes: 1, final_episodes: 1, interval: 200, reference_point: [0.0, -150.0]}
logging: {save_figures: false}
"""


@pytest.mark.slow
def test_an_own_algorithm_learns_a_front_from_which_is_chosen(folder: Path, call: Call) -> None:
    (folder / "constants.py").write_text(CONSTANTS)
    (folder / "front.yaml").write_text(FRONT)
    assert call("train", "--config", "front.yaml", "--output", "run")[0] == 0
    header, *rows = (folder / "run" / "front.csv").read_text().splitlines()
    assert "action" in header
    assert rows
    refused(call("choose", "run", "--weights", "objective_0=1"), "algorithm.name = 'constants:Constants'", "--trust")
    code, out, error = call(
        "choose", "run", "--weights", "objective_0=1", "objective_1=0.01", "--episodes", 1, "--trust"
    )
    assert code == 0, error
    assert "chosen" in out
    assert call("evaluate", "run", "--trust")[0] == 0


# -------------------------------------------------------------------------------------------------- an own environment


@pytest.mark.slow
def test_an_own_environment_is_trained_by_yaml_with_its_names_and_weights_by_name(folder: Path, call: Call) -> None:
    short = {"training": {"total_timesteps": 2560, "num_envs": 8}, "logging": {"save_figures": False}}
    shorten(folder / "commute.yaml", {**short, "evaluation": {"episodes": 4, "final_episodes": 4}})
    assert call("train", "--config", "commute.yaml", "--output", "run")[0] == 0
    metrics = read_metrics(folder / "run" / "metrics.csv")
    assert {"eval/greedy/return/time", "eval/greedy/return/energy"} <= metrics.keys()
    assert not [name for name in metrics if "objective_" in name]
    at = {name: metrics[f"eval/greedy/{name}"][0] for name in ("return/time", "return/energy", "utility_ser")}
    assert at["utility_ser"] == pytest.approx(at["return/time"] + 2 * at["return/energy"])
    refused(call("evaluate", "run"), "environment.id = 'commute:commute-v0'", "--trust")
    assert call("evaluate", "run", "--trust")[0] == 0
    refused(
        call("train", "--config", "commute.yaml", "--utility.arguments.weights={enrgy: 1}", "--output", "other"),
        "weights of utility 'linear' has 'enrgy'; did you mean 'energy'? known: energy, time",
    )
