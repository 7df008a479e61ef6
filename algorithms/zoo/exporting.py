"""Export the policy of a run to the zoo."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms import zoo
from algorithms.runs.build import load_policy
from mo_deepdrive.evaluation.front import EVALUATION_FILE, FRONT_FILE, Front
from mo_deepdrive.support.atomic_io import atomic_write, write_json
from mo_deepdrive.support.yaml import dump

if TYPE_CHECKING:
    from collections.abc import Mapping

    from algorithms.runs.run_directory import Run

FILES = {zoo.CONFIG, zoo.CHECKPOINT, zoo.ABOUT, FRONT_FILE, EVALUATION_FILE}


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
    parent = zoo.ZOO if directory is None else Path(directory)
    target = parent / name
    if target.exists() and not (target.is_dir() and {path.name for path in target.iterdir()} <= FILES):
        raise ValueError(f"{str(target)!r} is not a policy; choose another name")
    # On every machine there is a CPU.
    training = run.experiment.training.model_copy(update={"device": "cpu"})
    experiment = run.experiment.model_copy(update={"training": training})
    agent = load_policy(run)
    if not experiment.known_utility:
        Front.read(run.path)
    versions = {name: run.versions.get(name) for name in ("commit", "python", "packages")}
    origin = {"seed": experiment.training.seed, "step": agent.step, **versions}
    staged = Path(tempfile.mkdtemp(prefix=f".{name}.", suffix=".tmp", dir=parent))
    try:
        staged.chmod(0o755)
        atomic_write(staged / zoo.CONFIG, dump(experiment.to_dict()).encode())
        write_json(staged / zoo.ABOUT, {**origin, **(about or {})})
        if not experiment.known_utility:
            for file in (FRONT_FILE, EVALUATION_FILE):
                atomic_write(staged / file, (run.path / file).read_bytes())
        agent.save_policy(staged / zoo.CHECKPOINT)
        _replace(target, staged)
    except BaseException:
        shutil.rmtree(staged, ignore_errors=True)
        raise
    return target


def _replace(target: Path, staged: Path) -> None:
    """Move the folder ``staged`` to ``target``, replacing an existing folder."""
    if not target.exists():
        staged.replace(target)
        return
    aside = staged.with_suffix(".old")  # a non-empty folder cannot be replaced atomically
    target.replace(aside)
    try:
        staged.replace(target)
    except BaseException:
        aside.replace(target)
        raise
    shutil.rmtree(aside, ignore_errors=True)
