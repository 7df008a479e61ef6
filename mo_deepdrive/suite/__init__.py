"""The suite: tasks that tell methods apart, with a floor and a ceiling each, and how a policy is scored on them.

from mo_deepdrive import suite
suite.load().tasks["K1"].title
suite.score(policy, "K1")
"""

from mo_deepdrive.suite.plans import planned
from mo_deepdrive.suite.results import (
    Row,
    Samples,
    check_of_suite,
    read_rows,
    read_samples,
    samples_of,
    write_rows,
    write_samples,
)
from mo_deepdrive.suite.scoring import check_policy, score
from mo_deepdrive.suite.tasks import Suite, Task, load

__all__ = [
    "Row",
    "Samples",
    "Suite",
    "Task",
    "check_of_suite",
    "check_policy",
    "load",
    "planned",
    "read_rows",
    "read_samples",
    "samples_of",
    "score",
    "write_rows",
    "write_samples",
]
