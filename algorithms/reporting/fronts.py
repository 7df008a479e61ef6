"""The CSV file of the fronts that are evaluated during training."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.reporting.training_log import append, csv_line, format_number, rows_until, sync
from mo_deepdrive.evaluation.metrics import STEP, discounted_return_of
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from pathlib import Path

    from mo_deepdrive.evaluation.front import Front


class FrontsFile:
    """A CSV file of every front evaluated during training: one row per policy, with step and discounted returns.

    Args:
        path: the file.
        after: as for :class:`algorithms.reporting.training_log.MetricsFile`.

    Raises:
        ValueError: if there is a file to continue that is not one of fronts.
        OSError: if it cannot be written.
    """

    def __init__(self, path: Path, after: int | None = None):
        self.path = path
        header, rows = rows_until(path, after) if after is not None else ([STEP], [])
        self._has_header = len(header) > 1
        if after is not None and self._has_header:
            atomic_write(path, "".join(map(csv_line, [header, *rows])).encode())

    def write(self, step: int, front: Front) -> None:
        """Append a front.

        Raises:
            OSError: if it cannot be written.
        """
        rows = [
            [str(step), str(policy), *map(format_number, returns)] for policy, returns in enumerate(front.discounted)
        ]
        if self._has_header:
            append(self.path, "".join(map(csv_line, rows)))
        else:
            header = [STEP, "policy", *(discounted_return_of(name) for name in front.objectives)]
            atomic_write(self.path, "".join(map(csv_line, [header, *rows])).encode())
            self._has_header = True

    def sync(self) -> None:
        """As of :class:`algorithms.reporting.training_log.MetricsFile`.

        Raises:
            OSError: if it cannot be written.
        """
        if self._has_header:
            sync(self.path)
