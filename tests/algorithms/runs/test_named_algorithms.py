"""A user's algorithm is found by its path, and what cannot be used is refused."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from algorithms.runs.config import (
    agent_class,
    directory_name,
    find_algorithm,
    is_peer,
)

USERS = """
from algorithms import Agent, FrontAgent
from mo_deepdrive.world.config import Settings

class Learner(Agent):
    class Config(Settings):
        rate: float = 1.0
    def act(self, observations, accrued_reward, generator): ...
    def update(self, progress): ...
    def get_state(self): ...
    def set_state(self, state): ...

class Partial(Agent):
    Config = Learner.Config
    def act(self, observations, accrued_reward, generator): ...
    def update(self, progress): ...

class WithoutConfig(Learner):
    Config = dict

class Front(FrontAgent):
    Config = Learner.Config
    def update(self, progress): ...
    def get_state(self): ...
    def set_state(self, state): ...

class Unknown(Learner):
    known_utility = False

def function(): ...
"""


@pytest.fixture
def users_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The modules users_agents and users_mistake, which can be imported in this test."""
    (tmp_path / "users_agents.py").write_text(USERS)
    (tmp_path / "users_mistake.py").write_text("class Learner(:\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("users_agents", "users_mistake"):
        monkeypatch.delitem(sys.modules, name, raising=False)


@pytest.mark.usefixtures("users_module")
def test_a_users_algorithm_is_found_by_its_path() -> None:
    cls = agent_class("users_agents:Learner")
    assert find_algorithm("users_agents:Learner") is cls
    assert not is_peer("users_agents:Learner")
    assert directory_name("users_agents:Learner") == "Learner"
    assert directory_name("morl_baselines.pcn") == "morl_baselines.pcn"


@pytest.mark.usefixtures("users_module")
@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("no_such_module:A", "= 'no_such_module:A': 'no_such_module' cannot be imported: ModuleNotFoundError: "),
        ("users_mistake:A", "= 'users_mistake:A': 'users_mistake' cannot be imported: SyntaxError: invalid syntax"),
        ("users_agents:Lerner", "= 'users_agents:Lerner': 'users_agents' has no 'Lerner'; did you mean 'Learner'?"),
        (":Learner", "= ':Learner' must have the form package.module:name"),
        ("users_agents:function", "must be a subclass of algorithms.Agent; it is <function function"),
        ("users_agents:Partial", "= 'users_agents:Partial' does not define get_state, set_state"),
        ("users_agents:Front", "= 'users_agents:Front' does not define condition_names, conditions, policies"),
        ("users_agents:Unknown", "known_utility = False needs a subclass of algorithms.FrontAgent"),
        ("users_agents:WithoutConfig", "WithoutConfig': Config = <class 'dict'> must be a subclass of"),
    ],
)
def test_a_users_algorithm_that_cannot_be_used_is_refused_in_one_line(path: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        find_algorithm(path)
    assert str(caught.value).startswith(f"algorithm.name = {path!r}")
    assert "\n" not in str(caught.value)
