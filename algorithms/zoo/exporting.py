"""Export the policy of a run to the zoo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms import zoo
from algorithms.runs.build import load_policy
from mo_deepdrive.evaluation.front import EVALUATION_FILE, FRONT_FILE, Front
from mo_deepdrive.support.atomic_io import atomic_folder, atomic_write, write_json
from mo_deepdrive.support.yaml import dump

if TYPE_CHECKING:
    from collections.abc import Mapping

    from algorithms.runs.run_directory import Run

OF_FRONTS = (FRONT_FILE, EVALUATION_FILE)
FILES = {zoo.CONFIG, zoo.CHECKPOINT, zoo.ABOUT, *OF_FRONTS}


def export(run: Run, name: str, directory: str | Path | None = None, about: Mapping[str, Any] | None = None) -> Path:
    """Write the policy in a run's checkpoint to a folder, replacing one with the same name; returns the folder.

    A run that learns a front must be finished. ``directory`` is the parent of the folder, None for the zoo; ``about``
    is further content of about.json. If the policy cannot be written (OSError), an existing one is unchanged.
    """
    if not zoo.NAME.fullmatch(name):
        raise ValueError(f"name {name!r} must be lower-case letters, digits, '_' and '-'")
    target = (zoo.ZOO if directory is None else Path(directory)) / name
    if target.exists() and not (target.is_dir() and {path.name for path in target.iterdir()} <= FILES):
        raise ValueError(f"{str(target)!r} is not a policy; choose another name")
    training = run.experiment.training.model_copy(update={"device": "cpu"})  # which is on every machine
    experiment, agent = run.experiment.model_copy(update={"training": training}), load_policy(run)
    if not experiment.known_utility:
        Front.read(run.path)
    versions = {key: run.versions.get(key) for key in ("commit", "python", "packages")}
    with atomic_folder(target) as folder:
        atomic_write(folder / zoo.CONFIG, dump(experiment.to_dict()).encode())
        origin = {"seed": experiment.training.seed, "step": agent.step, **versions}
        write_json(folder / zoo.ABOUT, {**origin, **(about or {})})
        for file in () if experiment.known_utility else OF_FRONTS:
            atomic_write(folder / file, (run.path / file).read_bytes())
        agent.save_policy(folder / zoo.CHECKPOINT)
    return target
