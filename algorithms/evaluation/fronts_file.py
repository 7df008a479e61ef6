"""The CSV file of the fronts that are evaluated during training."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.common.atomic_io import atomic_write
from algorithms.common.metrics_file import complete_rows, csv_line, format_number
from algorithms.evaluation.metrics import STEP, discounted_return_of

if TYPE_CHECKING:
    from pathlib import Path

    from algorithms.evaluation.front import Front


class FrontsFile:
    """A CSV file of every front evaluated during training: one row per policy, with step and discounted returns.

    Args:
        path: the file.
        after: as for :class:`algorithms.common.metrics_file.MetricsFile`.
    """

    def __init__(self, path: Path, after: int | None = None):
        self.path = path
        header, rows = complete_rows(path) if after is not None else ([STEP], [])
        self._has_header = len(header) > 1
        if self._has_header and after is not None:
            kept = [csv_line(row) for row in rows if int(row[0]) <= after]
            atomic_write(path, "".join([csv_line(header), *kept]).encode())

    def write(self, step: int, front: Front) -> None:
        """Append a front.

        Raises:
            OSError: if it cannot be written.
        """
        lines = [
            csv_line([str(step), str(policy), *map(format_number, returns)])
            for policy, returns in enumerate(front.discounted)
        ]
        if self._has_header:
            with self.path.open("a") as file:
                file.write("".join(lines))
        else:
            names = [discounted_return_of(name) for name in front.objectives]
            atomic_write(self.path, "".join([csv_line([STEP, "policy", *names]), *lines]).encode())
            self._has_header = True
