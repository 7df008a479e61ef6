"""Planned drives: the action sequences behind the planned ceilings, which can be replayed.

A file of ``data`` has those of a task: of each of the first scenarios of the test split one sequence, or one per hidden
preference. A planner knows the whole scenario, so that no policy can be expected to reach it everywhere.
"""

from __future__ import annotations

import functools
import json
from typing import TYPE_CHECKING, Any

from mo_deepdrive.evaluation.drives import Playback
from mo_deepdrive.evaluation.episodes import OUR_ENVS
from mo_deepdrive.suite.tasks import DATA, load
from mo_deepdrive.world.action_sequences import decode

if TYPE_CHECKING:
    from numpy.typing import NDArray


@functools.cache
def _sequences(task_id: str) -> tuple[str, list[list[str]]]:
    """The action type of a task's plans, and their texts by scenario and preference."""
    file = DATA / f"plans_{task_id.lower()}.json"
    if not file.is_file():
        raise ValueError(f"task {task_id!r} has no plans; its ceiling is {load().task(task_id).ceiling.kind}")
    plans = json.loads(file.read_text(encoding="utf-8"))
    return plans["action_type"], plans["actions"]


def planned_scenarios(task_id: str) -> int:
    """How many scenarios, the first of the test split, the plans of a task are for."""
    return len(_sequences(task_id)[1])


def planned_actions(task_id: str, scenario: int) -> list[NDArray[Any]]:
    """The planned actions in a scenario, counted from the first of the test split; one drive per preference."""
    action_type, texts = _sequences(task_id)
    return [decode(text, action_type) for text in texts[scenario]]


def planned(task_id: str, preference: int = 0, first: int = 0) -> Playback:
    """The policy that replays the plans of a task, of one hidden preference, in scenarios of the test split.

    They are those from the ``first`` of the split on, at most as many as are driven at a time. A ValueError if the task
    has no plans.
    """
    action_type, texts = _sequences(task_id)
    return Playback([decode(text[preference], action_type) for text in texts[first : first + OUR_ENVS]], action_type)
