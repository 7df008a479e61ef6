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
    """Write the policy in a run's checkpoint to a folder, replacing an existing policy with the same name.

    Args:
        run: a trained run; if the algorithm learns a front, a finished one.
        name: of the policy: lower-case letters, digits, "_" and "-".
        directory: parent of the folder; None for the zoo.
        about: additional content of about.json, such as how the run was chosen.

    Returns:
        The folder.

    Raises:
        ValueError: for an invalid name, a checkpoint or front that is missing or broken, or a folder that is not a
            policy.
        OSError: if the policy cannot be written; an existing policy is then unchanged.
    """
    if not zoo.NAME.fullmatch(name):
        raise ValueError(f"name {name!r} must be lower-case letters, digits, '_' and '-'")
    target = (zoo.ZOO if directory is None else Path(directory)) / name
    if target.exists() and not (target.is_dir() and {path.name for path in target.iterdir()} <= FILES):
        raise ValueError(f"{str(target)!r} is not a policy; choose another name")
    # On every machine there is a CPU.
    training = run.experiment.training.model_copy(update={"device": "cpu"})
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
