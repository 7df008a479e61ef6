"""A table of the policies of the zoo."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.table import Table

from algorithms.experiments.config import find_environment
from algorithms.experiments.run_directory import Run
from algorithms.zoo import find, names


def zoo_table() -> Table:
    """One row per policy: its name, and the scenario, utility and algorithm of its training.

    Raises:
        ValueError: if the config of a policy is not valid.
    """
    table = Table(title="policies of the zoo", title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    table.add_column("name", no_wrap=True)
    for column in ("scenario", "utility", "algorithm"):
        table.add_column(column)
    for name in names():
        experiment = Run.open(find(name), device="cpu").experiment
        scenario = find_environment(experiment.environment.id).kwargs.get("scenario", experiment.environment.id)
        settings = experiment.utility
        utilities = [] if settings is None else [settings.name, *(each.name for each in settings.vehicles.values())]
        utility = ", ".join(dict.fromkeys(utilities)) or "all: a front"
        table.add_row(name, scenario, utility, experiment.algorithm["name"])
    return table
