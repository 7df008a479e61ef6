"""The directory of a run: its experiment, the versions it ran on, its progress and its results."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
from datetime import datetime
from importlib import metadata
from pathlib import Path
from time import perf_counter, process_time
from typing import IO, TYPE_CHECKING, Any, Literal

from algorithms.runs.config import Experiment, make_experiment
from algorithms.runs.interrupts import Moved
from algorithms.runs.registry import directory_name, find_trained_policy
from algorithms.runs.run_files import RESULTS, STATUS_FILE, record_files
from mo_deepdrive.support.atomic_io import (
    atomic_write,
    expand_home,
    is_temporary,
    leftovers,
    lock,
    own_path,
    read_json_object,
    write_json,
)
from mo_deepdrive.support.yaml import dump, read_mapping

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

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
# Entries of status.json: state, step and length of the training, seconds of work over all processes, their CPU seconds
# until the training ended, time of the last change; why it failed, what is missing in metrics.csv, the rows at the last
# checkpoints, the record of the files.
STATUS: dict[str, tuple[type, ...]] = {
    "state": (str,),
    "step": (int,),
    "total_timesteps": (int,),
    "seconds": (int, float),
    "cpu_seconds": (int, float),
    "updated": (str,),
    "reason": (str,),
    "metrics_gap": (str,),
    "logged": (list,),
    "files": (dict,),
}
METRICS_FILE, FRONTS_FILE, LOCK_FILE = "metrics.csv", "fronts.csv", ".lock"
# Modules in front of the ids of their environments that are imported in any case.
ALREADY_IMPORTED = ("gymnasium", "mo_deepdrive", "mo_gymnasium")


class InUse(ValueError):
    """Another process is training in the run's directory."""


class Run:
    """One training run and the directory that holds it.

    Made by :meth:`create` or :meth:`open`. A process that trains in it holds its lock until the process ends.

    Attributes:
        path: the directory.
        experiment: the experiment of the run.
        metrics_gap: what was missing in metrics.csv or fronts.csv when the run was resumed; None if nothing was.
        locked: False while it is being trained on a file system without locks.
    """

    def __init__(self, path: Path, experiment: Experiment):
        self.path = path
        self.experiment = experiment
        self.locked = True
        self._lock: IO[bytes] | None = None
        self._opened, self._cpu_opened = perf_counter(), process_time()
        self._read_status()

    def _read_status(self) -> None:
        """Take over from status.json what later states keep."""
        status = self.status
        self._seconds_before: float = status.get("seconds", 0.0)
        self._cpu_before: float = status.get("cpu_seconds", 0.0)
        self._logged = [entry for entry in status.get("logged", []) if isinstance(entry, dict)]
        self.metrics_gap: str | None = status.get("metrics_gap")

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
            return cls.make(experiment, expand_home(path))
        except OSError as error:
            raise ValueError(f"run directory {str(path)!r} cannot be written: {error}") from None

    @classmethod
    def make(cls, experiment: Experiment, path: Path) -> Run:
        """As :meth:`create`, but raises OSError if the directory cannot be written."""
        path.mkdir(parents=True, exist_ok=True)
        if _contents(path):
            raise _not_empty(path)
        run = cls(path, experiment)
        run.lock()
        if _contents(path):  # another process created a run before this one had the lock
            run.unlock()
            raise _not_empty(path)
        write_json(path / "versions.json", versions())
        run.set_status("running", 0)
        # Written last: a directory with a config.yaml is complete.
        atomic_write(path / "config.yaml", dump(experiment.to_dict()).encode())
        return run

    @classmethod
    def open(cls, path: str | Path, *, trust: bool = False, imports: Collection[str] | None = None) -> Run:
        """The run in an existing directory; or a policy of the zoo, which consists of a run's config and policy.

        Args:
            path: the directory, or the name of the policy.
            trust: allow a config.yaml that names code to import (:func:`imported_paths`).
            imports: for a run that drives in another one: what the config of that one names, which is allowed anyway.

        Raises:
            ValueError: if neither exists, its config.yaml is not valid, or it names code and is not trusted.
        """
        path = expand_home(path)
        if not path.is_dir():
            try:
                path = find_trained_policy(str(path))
            except ValueError as error:
                raise ValueError(f"{str(path)!r} is not a run directory, and {error}") from None
        config = path / "config.yaml"
        if not config.is_file():
            raise ValueError(f"{str(path)!r} is not a run directory: it has no config.yaml")
        values = read_mapping(config)
        for key, name in imported_paths(values).items() if not trust else ():
            if name in (imports or ()):
                continue
            advice = "add --trust if you trust whoever made the run"
            if imports is not None:
                advice = "a run that drives in another may import only what that one's own config names"
            raise ValueError(f"{str(config)!r} has {key} = {name!r}, code that would be imported and run; {advice}")
        # This machine may not have the device that it was trained on.
        return cls(path, make_experiment(values, f"experiment {str(config)!r}", here=False))

    def lock(self) -> None:
        """Lock the directory until this process ends, so that no two processes train in it.

        Temporary files of processes that were killed are removed.

        Raises:
            InUse: if another process holds it.
            ValueError: if there is a link in the directory.
            OSError: if the directory cannot be written.
        """
        for entry in self.path.iterdir():
            own_path(self.path, entry.name)
        self._lock = (self.path / LOCK_FILE).open("ab")
        try:
            self.locked = lock(self._lock, wait=False)
        except BlockingIOError:
            self.unlock()
            raise InUse(f"run directory {str(self.path)!r} is in use by another process") from None
        for leftover in leftovers(self.path):
            leftover.unlink()
        self._read_status()  # another process may have trained in it until now

    def unlock(self) -> None:
        """Let other processes train in the directory."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def check_place(self) -> None:
        """Check, before something is written, that the path still leads to the directory that was locked.

        Raises:
            Moved: if the directory was renamed or deleted, and perhaps another run was started at its path.
            OSError: if it cannot be looked up.
        """
        if self._lock is None:
            return
        try:
            here = os.path.samestat(os.fstat(self._lock.fileno()), (self.path / LOCK_FILE).stat())
        except (FileNotFoundError, NotADirectoryError):
            here = False
        if not here:
            raise Moved(
                f"run directory {str(self.path)!r} was renamed, deleted or replaced while the run was training; "
                "nothing was written to what is there now"
            )

    @property
    def status(self) -> dict[str, Any]:
        """The contents of status.json; see :func:`read_status`."""
        return read_status(self.path)

    def logged_rows(self, step: int, file: str) -> dict[str, Any] | None:
        """What :meth:`note_rows` noted of a file for the checkpoint of a step; None if nothing is known."""
        found = [entry.get(file) for entry in self._logged if entry.get("step") == step]
        return found[-1] if found and isinstance(found[-1], dict) else None

    def note_rows(self, step: int, files: Mapping[str, Mapping[str, Any]]) -> None:
        """Note the rows of metrics.csv and fronts.csv for a checkpoint that is about to be written.

        The next :meth:`set_status` writes the notes, with those of the checkpoint before: whichever of the two a crash
        leaves, its notes are there.

        Args:
            step: of the checkpoint.
            files: number and hash of the rows, by the name of the file.
        """
        self._logged = [*self._logged[-1:], {"step": step, **files}]

    def add_metrics_gap(self, gap: str) -> None:
        """Add to :attr:`metrics_gap`, which the next and all later :meth:`set_status` write."""
        if self.metrics_gap is None:
            self.metrics_gap = gap
        elif gap not in self.metrics_gap:  # noticed before, by a process that wrote no checkpoint
            self.metrics_gap += f"; {gap}"

    def set_status(self, state: State, step: int, reason: str | None = None) -> None:
        """Write status.json with the state of the run, its step, and the reason if it failed.

        A finished run also gets the record of its files (:mod:`algorithms.runs.run_files`).

        Raises:
            Moved: as :meth:`check_place`.
            OSError: if it cannot be written, or a file cannot be recorded.
        """
        self.check_place()
        used = round(self._cpu_before + process_time() - self._cpu_opened, 1)
        if state == "finished":  # what came after the training does not count
            used = self.status.get("cpu_seconds", used)
        write_json(
            self.path / STATUS_FILE,
            {
                "state": state,
                "step": step,
                "total_timesteps": self.experiment.training.total_timesteps,
                "seconds": round(self._seconds_before + perf_counter() - self._opened, 1),
                "cpu_seconds": used,
                "updated": datetime.now().astimezone().isoformat(timespec="seconds"),
                **({} if reason is None else {"reason": reason}),
                **({} if self.metrics_gap is None else {"metrics_gap": self.metrics_gap}),
                **({"logged": self._logged} if self._logged else {}),
                **({"files": record_files(self.path)} if state == "finished" else {}),
            },
        )

    def record_results(self) -> None:
        """Record the final evaluation of a finished run again, after it was written anew.

        Raises:
            OSError: if a file cannot be read or written.
        """
        status = self.status
        if status.get("state") == "finished" and "files" in status:
            found = record_files(self.path)
            status["files"] |= {name: found[name] for name in RESULTS if name in found}
            write_json(self.path / STATUS_FILE, status)

    @property
    def versions(self) -> dict[str, Any]:
        """The versions that the run was started with; empty if they are not known."""
        return read_json_object(self.path / "versions.json")

    def changed_versions(self) -> list[str]:
        """The differences between the versions that the run was started with and the current ones, one line each."""
        then, now = self.versions, versions()
        packages = then.get("packages")
        flat_then = {**then, **(packages if isinstance(packages, dict) else {})}
        flat_now = {**now, **now["packages"]}
        names = [name for name in flat_now if name not in ("packages", "dirty")]
        return [
            f"{name}: {flat_then.get(name)} then, {flat_now[name]} now"
            for name in names
            if flat_then.get(name) != flat_now[name]
        ]


def is_run(path: Path) -> bool:
    """Whether a directory is that of a run, or has a policy of the zoo."""
    return (path / "config.yaml").is_file()


def read_status(path: Path) -> dict[str, Any]:
    """The contents of a run's status.json; empty if it is missing or broken.

    Its keys are those of :data:`STATUS`; an entry of another type is left out.
    """
    status = read_json_object(path / STATUS_FILE)
    return {
        key: value
        for key, value in status.items()
        if isinstance(value, STATUS.get(key, object)) and not isinstance(value, bool)
    }


def imported_paths(values: Mapping[str, Any]) -> dict[str, str]:
    """What an experiment names to be imported: algorithm, network, utilities by dotted path, environment with module.

    Args:
        values: the sections of the experiment, which need not be valid.

    Returns:
        "package.module:name" by the key where it is.
    """
    algorithm, utility = _section(values, "algorithm"), _section(values, "utility")
    vehicles = _section(utility, "vehicles")
    found = {
        "environment.id": _section(values, "environment").get("id"),
        "algorithm.name": algorithm.get("name"),
        "algorithm.network": algorithm.get("network"),
        "utility.name": utility.get("name"),
        **{f"utility.vehicles.{name}.name": _section(vehicles, name).get("name") for name in vehicles},
    }
    paths = {key: name for key, name in found.items() if isinstance(name, str) and ":" in name}
    # As Gymnasium does, which would import the module "gymnasium:evil" of "gymnasium:evil:ID".
    if paths.get("environment.id", "").rpartition(":")[0] in ALREADY_IMPORTED:
        del paths["environment.id"]
    return paths


def resume_options(paths: Sequence[Path], values: Mapping[str, Any]) -> str:
    """The options with which the command train resumes a run, or runs side by side.

    Args:
        paths: the runs' directories.
        values: the sections of their experiment; --trust is needed where they name code to import.
    """
    return f"--resume {shlex.join(map(str, paths))}" + (" --trust" if imported_paths(values) else "")


def _not_empty(path: Path) -> ValueError:
    """The error for the directory of a new run that has something in it, perhaps another run."""
    try:
        resume = f", or use {resume_options([path], read_mapping(path / 'config.yaml'))}"
    except ValueError:  # no run, or one that cannot be resumed
        resume = ""
    return ValueError(f"run directory {str(path)!r} is not empty; choose another{resume}")


def _section(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = values.get(name)
    return section if isinstance(section, dict) else {}


def _contents(path: Path) -> list[str]:
    """The names in a run's directory, without those that a process leaves if it is killed while it creates a run."""
    entries = list(path.iterdir())  # once: another process may be renaming its files
    found = {entry.name for entry in entries}
    if "config.yaml" not in found:
        found -= {LOCK_FILE, "versions.json", STATUS_FILE, *(entry.name for entry in entries if is_temporary(entry))}
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
    name = f"{directory_name(experiment.algorithm.name)}-seed{experiment.training.seed}-{stamp}"
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
