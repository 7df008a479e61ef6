"""List the keys of YAML files: type, default and what they do.

    mo-deepdrive keys                                          # of every algorithm, of sweeps and studies
    mo-deepdrive keys --algorithm mo_ppo                       # of an experiment with this algorithm
    mo-deepdrive keys --config one_waypoint/mo_ppo_nonlinear   # and what the file sets

On the command line of train every key of an experiment is an option: --section.key=value.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

from algorithms.runs import cli
from algorithms.runs.config import load_experiment
from algorithms.runs.key_listing import Key, differing_values, experiment_keys, model_keys
from algorithms.runs.registry import agent_class, algorithm_names, find_algorithm
from algorithms.studies.settings import Learner, Study, StudyTask, SweepSettings

if TYPE_CHECKING:
    from argparse import Namespace

    from mo_deepdrive.world.config import Settings


def key_sections(algorithm: str | None = None, env_id: str | None = None) -> dict[str, list[Key]]:
    """The keys to list, by title.

    Args:
        algorithm: of the experiment; None for those of every algorithm, of sweeps and studies.
        env_id: of the experiment; None for one of this package's environments.
    """
    keys = {name: experiment_keys(name, env_id) for name in ([algorithm] if algorithm else algorithm_names())}
    first = next(iter(keys.values()))
    sections = {"experiment": [key for key in first if not _is_hyperparameter(key)]}
    for name, its_keys in keys.items():
        equations = "" if find_algorithm(name).is_peer else f"; equations: help({agent_class(name).__module__!r})"
        sections[f"hyperparameters of {name}{equations}"] = [key for key in its_keys if _is_hyperparameter(key)]
    others: dict[str, type[Settings]] = {
        "sweep": SweepSettings,
        "study": Study,
        "task of a study": StudyTask,
        "learner of a study": Learner,
    }
    return sections if algorithm else {**sections, **{title: model_keys(model) for title, model in others.items()}}


def _is_hyperparameter(key: Key) -> bool:
    return key.name.startswith("algorithm.") and key.name != "algorithm.name"


def list_keys(options: Namespace) -> int:
    """Print the keys of one algorithm, of an experiment's, or of all."""
    from algorithms.runs.console import make_console, print_line

    console = make_console()
    values: dict[str, Any] = {}
    name, env_id = options.algorithm, None
    if options.config is not None:
        experiment = load_experiment(options.config)
        values, name, env_id = experiment.to_dict(), experiment.algorithm.name, experiment.environment.id
    elif name is not None:
        find_algorithm(name, "--algorithm")
    for title, keys in key_sections(name, env_id).items():
        console.print(f"{title}\n", style="bold", markup=False, highlight=False)
        set_here = differing_values(values, keys)
        for key in keys:
            line, *description = key.text().splitlines()
            here = f"; here {set_here[key.name]}" if key.name in set_here else ""
            for text in (line + here, *description):
                wrapped = textwrap.fill(text, console.width, subsequent_indent="    ", break_on_hyphens=False)
                print_line(console, wrapped)
        console.print()
    return 0


ALGORITHM = cli.option("--algorithm", "NAME", "an algorithm, another library's, or your own: package.module:Class")
main = cli.Command("keys", __doc__, (cli.OneOf((cli.CONFIG, ALGORITHM)),), list_keys)
