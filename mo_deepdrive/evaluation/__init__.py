"""What is measured: metrics, evaluation, statistics, fronts.

``from mo_deepdrive.evaluation import evaluate`` imports what it names; the package itself imports nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mo_deepdrive.evaluation.episodes import evaluate
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.evaluation.minari_dataset import record_dataset

__all__ = ["Evaluation", "evaluate", "record_dataset"]

# The module of every name that can be imported from here.
_MODULES = {
    "Evaluation": "mo_deepdrive.evaluation.evaluation",
    "evaluate": "mo_deepdrive.evaluation.episodes",
    "record_dataset": "mo_deepdrive.evaluation.minari_dataset",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    """The public names, including those that have not been imported yet."""
    return sorted({*globals(), *__all__})
