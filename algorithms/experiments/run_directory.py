"""The directory of a run: its experiment, the versions it ran on, its progress and its results."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import datetime
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

from algorithms.common.atomic_io import atomic_write, leftovers, read_json_object, write_json
from algorithms.common.yaml_io import dump, read_mapping
from algorithms.experiments.config import Experiment, make_experiment
from algorithms.experiments.registry import find_trained_policy
from algorithms.experiments.run_files import record_files

if os.name == "posix":
    import fcntl

State = Literal["running", "interrupted", "failed", "trained", "pruned", "finished"]
PACKAGES = (
    "gymnasium",
    "matplotlib",
    "mo-deepdrive",
    "mo-gymnasium",
    "moocore",
    "numba",
    "numpy",
    "pettingzoo",
    "pydantic",
    "safetensors",
    "scipy",
    "tensorboard",
    "torch",
    "wandb",
)


class InUse(ValueError):
    """Another process is training in the run's directory."""


class Run:
    """One training run and the directory that holds it.

    Made by :meth:`create` or :meth:`open`. A process that trains in it holds its lock until the process ends.

    Attributes:
        path: the directory.
        experiment: the experiment of the run.
    """

    def __init__(self, path: Path, experiment: Experiment):
        self.path = path
        self.experiment = experiment
        self._lock: Any = None
        self._opened = perf_counter()
        self._seconds_before = float(self.status.get("seconds", 0.0))

    @property
    def checkpoint(self) -> Path:
        """The file of the latest checkpoint."""
        return self.path / "checkpoint.safetensors"

    @classmethod
    def create(cls, experiment: Experiment, path: str | Path) -> Run:
        """Create and lock the directory of a new run, with its config.yaml.

        Args:
            experiment: the experiment of the run.
            path: the directory; it may exist if it is empty.

        Raises:
            InUse: if another process is doing the same.
            ValueError: if the directory is not empty or cannot be written.
        """
        try:
            return cls.make(experiment, Path(path))
        except OSError as error:
            raise ValueError(f"run directory {str(path)!r} cannot be written: {error}") from None

    @classmethod
    def make(cls, experiment: Experiment, path: Path) -> Run:
        """As :meth:`create`, but raises OSError if the directory cannot be written."""
        path.mkdir(parents=True, exist_ok=True)
        refusal = ValueError(f"run directory {str(path)!r} is not empty; choose another, or use --resume {path}")
        if _contents(path):
            raise refusal
        run = cls(path, experiment)
        run.lock()
        if _contents(path):  # another process created a run before this one had the lock
            run.unlock()
            raise refusal
        write_json(path / "versions.json", versions())
        run.set_status("running", 0)
        # Written last: a directory with a config.yaml is complete.
        atomic_write(path / "config.yaml", dump(experiment.to_dict()).encode())
        return run

    @classmethod
    def open(cls, path: str | Path, *, device: str | None = None) -> Run:
        """The run in an existing directory; or a policy of the zoo, which consists of a run's config and policy.

        Args:
            path: the directory, or the name of the policy.
            device: replaces the device of the experiment if it is not None.

        Raises:
            ValueError: if neither exists, or its config.yaml is not valid.
        """
        path = Path(path)
        if not path.is_dir():
            try:
                path = find_trained_policy(str(path))
            except ValueError as error:
                raise ValueError(f"{str(path)!r} is not a run directory, and {error}") from None
        config = path / "config.yaml"
        if not config.is_file():
            raise ValueError(f"{str(path)!r} is not a run directory: it has no config.yaml")
        values = read_mapping(config)
        if device is not None and isinstance(values.get("training"), dict):
            values["training"]["device"] = device
        return cls(path, make_experiment(values, f"experiment {str(config)!r}"))

    def lock(self) -> None:
        """Lock the directory until this process ends, so that no two processes train in it.

        Temporary files of processes that were killed are removed.

        Raises:
            InUse: if another process holds it.
        """
        if os.name != "posix":
            return
        self._lock = (self.path / ".lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.unlock()
            raise InUse(f"run directory {str(self.path)!r} is in use by another process") from None
        for leftover in leftovers(self.path):
            leftover.unlink()

    def unlock(self) -> None:
        """Let other processes train in the directory."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    @property
    def status(self) -> dict[str, Any]:
        """The contents of status.json; see :func:`read_status`."""
        return read_status(self.path)

    def set_status(self, state: State, step: int, reason: str | None = None) -> None:
        """Write status.json with the state of the run, its step, and the reason if it failed.

        A finished run also gets the record of its files (:mod:`algorithms.experiments.run_files`).

        Raises:
            OSError: if it cannot be written, or a file cannot be recorded.
        """
        write_json(
            self.path / "status.json",
            {
                "state": state,
                "step": step,
                "total_timesteps": self.experiment.training.total_timesteps,
                "seconds": round(self._seconds_before + perf_counter() - self._opened, 1),
                "updated": datetime.now().astimezone().isoformat(timespec="seconds"),
                **({} if reason is None else {"reason": reason}),
                **({"files": record_files(self.path)} if state == "finished" else {}),
            },
        )

    @property
    def versions(self) -> dict[str, Any]:
        """The versions that the run was started with; empty if they are not known."""
        return read_json_object(self.path / "versions.json")

    def changed_versions(self) -> list[str]:
        """The differences between the versions that the run was started with and the current ones, one line each."""
        flat_then, flat_now = ({**each, **each.get("packages", {})} for each in (self.versions, versions()))
        names = [name for name in flat_now if name not in ("packages", "dirty")]
        return [
            f"{name}: {flat_then.get(name)} then, {flat_now[name]} now"
            for name in names
            if flat_then.get(name) != flat_now[name]
        ]


def read_status(path: Path) -> dict[str, Any]:
    """The contents of a run's status.json; empty if it is missing or broken.

    Its keys are state, step, total_timesteps, seconds (of work, over all processes), updated, reason if the run
    failed, and files if it is finished.
    """
    return read_json_object(path / "status.json")


def _contents(path: Path) -> list[str]:
    """The names in a run's directory, without those that a process leaves if it is killed while it creates a run."""
    found = {entry.name for entry in path.iterdir()}
    if "config.yaml" not in found:
        found -= {".lock", "versions.json", "status.json", *(leftover.name for leftover in leftovers(path))}
    return sorted(found)


def default_directory(root: str | Path, config: str | Path, experiment: Experiment) -> Path:
    """Make a new, empty directory: ``root/<config's stem>/<algorithm>-seed<N>-<time>``.

    Args:
        root: the directory of all runs.
        config: the file that the experiment comes from.
        experiment: its algorithm and seed are part of the name.

    Raises:
        ValueError: if it cannot be made.
    """
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{experiment.algorithm['name']}-seed{experiment.training.seed}-{stamp}"
    path = Path(root) / Path(config).stem / name
    number = 1
    while True:
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            number += 1
            path = path.with_name(f"{name}-{number}")
        except OSError as error:
            raise ValueError(f"run directory {str(path)!r} cannot be made: {error}") from None


def versions() -> dict[str, Any]:
    """Versions of Python, platform and packages, and the commit of the repository (None outside of a checkout)."""
    packages: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            packages[name] = None
    commit = _git("rev-parse", "HEAD")
    changes = _git("status", "--porcelain")
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "commit": commit,
        "dirty": None if commit is None or changes is None else bool(changes),
        "packages": packages,
    }


def _git(*arguments: str) -> str | None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
