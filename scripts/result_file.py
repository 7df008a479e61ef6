"""The CSV file of a measurement, a row for each result, and checks of options that several scripts have.

@dataclass(frozen=True)
class Result:
seed: int
utility: Annotated[float, ".4f"]  # the format in the file

write_results(path, [Result(0, 0.5)])
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Mapping, Sequence
    from pathlib import Path


def _columns(kind: type) -> dict[str, tuple[type, str]]:
    """Type and format of the fields of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: get_args(hint) if get_origin(hint) is Annotated else (hint, "") for name, hint in hints.items()}


def write_results(path: Path | None, results: Sequence[Any], about: Mapping[str, Any] | None = None) -> None:
    """Write the results, all of one dataclass, atomically; without a path nothing is written.

    Args:
        path: of the file.
        results: one per row; the cell of None is empty.
        about: columns with the same value in every row.
    """
    if path is None or not results:
        return
    columns, about = _columns(type(results[0])), about or {}

    def cell(value: Any, form: str) -> str:
        return "" if value is None else format(value, form)

    rows = [[cell(getattr(result, name), form) for name, (_, form) in columns.items()] for result in results]
    atomic_write(path, csv_bytes([[*columns, *about], *([*row, *map(str, about.values())] for row in rows)]))


def check_least(parser: ArgumentParser, options: Namespace, least: int, *names: str) -> None:
    """Exit with a message unless the named options are at least ``least``; those that are None do not count."""
    for name in names:
        value = getattr(options, name)
        if value is not None and value < least:
            parser.error(f"--{name} {value} must be at least {least}")


def check_folder(parser: ArgumentParser, path: Path | None) -> None:
    """Exit with a message unless ``--output`` can be written, before any work is done."""
    if path is not None and not path.parent.is_dir():
        parser.error(f"--output {path}: there is no folder {path.parent}")
