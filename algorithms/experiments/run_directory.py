"""A run's directory: what was asked, on which versions, how far it is, and everything that came of it."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from datetime import datetime
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

from algorithms.common.atomic_io import atomic_write, leftovers, write_json
from algorithms.common.yaml_io import dump, read_mapping
from algorithms.experiments.config import Experiment, make_experiment
from algorithms.zoo import find

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
    """Another process trains in the run's directory."""


class Run:
    """One training run and the directory that holds it.

    Made by :meth:`create` or :meth:`open`; a process that trains in it holds a lock until it ends.

    Attributes:
        path: the directory.
        experiment: what runs there.
    """

    def __init__(self, path: Path, experiment: Experiment):
        self.path = path
        self.experiment = experiment
        self._lock: Any = None
        self._opened = perf_counter()
        self._seconds_before = float(self.status.get("seconds", 0.0))

    @property
    def checkpoint(self) -> Path:
        """The latest checkpoint; training writes it, resuming and evaluating read it."""
        return self.path / "checkpoint.safetensors"

    @classmethod
    def create(cls, experiment: Experiment, path: str | Path) -> Run:
        """Make the directory, lock it, and write what determines the run.

        Raises:
            InUse: if another process is doing the same.
            ValueError: if the directory is there and not empty, or cannot be written.
        """
        try:
            return cls.make(experiment, Path(path))
        except OSError as error:
            raise ValueError(f"run directory {str(path)!r} cannot be written: {error}") from None

    @classmethod
    def make(cls, experiment: Experiment, path: Path) -> Run:
        """As :meth:`create`, but OSError if the directory cannot be written."""
        path.mkdir(parents=True, exist_ok=True)
        refusal = ValueError(f"run directory {str(path)!r} is not empty; choose another, or use --resume {path}")
        if _contents(path):
            raise refusal
        run = cls(path, experiment)
        run.lock()
        if _contents(path):  # another process was there first, and has left
            run.unlock()
            raise refusal
        write_json(path / "versions.json", versions())
        run.set_status("running", 0)
        # The last: a directory that has it is whole.
        atomic_write(path / "config.yaml", dump(experiment.to_dict()).encode())
        return run

    @classmethod
    def open(cls, path: str | Path, *, device: str | None = None) -> Run:
        """The run in an existing directory, or else a policy of the zoo, which has a run's config and its policy.

        Args:
            path: the directory, or the policy's name.
            device: instead of the one that it was trained on.

        Raises:
            ValueError: if there is neither, or its config.yaml is not valid.
        """
        path = Path(path)
        if not path.is_dir():
            try:
                path = find(str(path))
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
        """Hold the directory until this process ends, so that no two processes train in it.

        What an earlier process was writing when it was killed is removed.

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
        """As :func:`read_status`."""
        return read_status(self.path)

    def set_status(self, state: State, step: int, reason: str | None = None) -> None:
        """Write how far the run is; ``reason`` is why it failed."""
        write_json(
            self.path / "status.json",
            {
                "state": state,
                "step": step,
                "total_timesteps": self.experiment.training.total_timesteps,
                "seconds": round(self._seconds_before + perf_counter() - self._opened, 1),
                "updated": datetime.now().astimezone().isoformat(timespec="seconds"),
                **({} if reason is None else {"reason": reason}),
            },
        )

    @property
    def versions(self) -> dict[str, Any]:
        """What the run began with; empty where that is not known."""
        try:
            return json.loads((self.path / "versions.json").read_text())
        except (OSError, json.JSONDecodeError):
            return {}

    def changed_versions(self) -> list[str]:
        """What differs between the versions that the run began with and those of now, one line each."""
        then = self.versions
        now = versions()
        flat_then, flat_now = ({**each, **each.get("packages", {})} for each in (then, now))
        names = [name for name in flat_now if name not in ("packages", "dirty")]
        return [
            f"{name}: {flat_then.get(name)} then, {flat_now[name]} now"
            for name in names
            if flat_then.get(name) != flat_now[name]
        ]


def read_status(path: Path) -> dict[str, Any]:
    """Of a run's directory: state, step, total_timesteps, seconds (of work in all), updated, and reason where it
    failed; empty where there is none."""
    try:
        status = json.loads((path / "status.json").read_bytes())
    except (OSError, ValueError):
        return {}
    return status if isinstance(status, dict) else {}


def _contents(path: Path) -> list[str]:
    """What is in a run's directory, apart from what a process that was killed while it made one leaves behind."""
    found = {entry.name for entry in path.iterdir()}
    if "config.yaml" not in found:
        found -= {".lock", "versions.json", "status.json", *(leftover.name for leftover in leftovers(path))}
    return sorted(found)


def default_directory(root: str | Path, config: str | Path, experiment: Experiment) -> Path:
    """Make an empty directory of its own: ``root/<config's stem>/<algorithm>-seed<N>-<time>``.

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
    """Python, platform, packages, and the commit of the checkout that the code runs from (None outside of one)."""
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
