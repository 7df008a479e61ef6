"""The suite: tasks that tell methods apart, with a floor and a ceiling each, and how a policy is scored on them.

from mo_deepdrive import suite
suite.load().tasks["K1"].title
suite.score(policy, "K1")
"""

from mo_deepdrive.suite.plans import planned
from mo_deepdrive.suite.results import Row, check_of_suite, read_rows, write_rows
from mo_deepdrive.suite.scoring import check_policy, score
from mo_deepdrive.suite.tasks import Suite, Task, load

__all__ = [
    "Row",
    "Suite",
    "Task",
    "check_of_suite",
    "check_policy",
    "load",
    "planned",
    "read_rows",
    "score",
    "write_rows",
]
