"""The directory of a run: its experiment, the versions it ran on, its progress and its results."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import platform
import shlex
import subprocess
from collections.abc import Mapping
from datetime import datetime
from importlib import metadata
from pathlib import Path
from pkgutil import resolve_name
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from algorithms.runs.config import Experiment, directory_name, make_experiment
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
    from collections.abc import Collection, Iterable, Sequence

    from filelock import BaseFileLock

State = Literal["running", "interrupted", "failed", "trained", "pruned", "finished"]
PACKAGES = (
    *("gymnasium", "matplotlib", "mo-deepdrive", "mo-gymnasium", "moocore", "numba", "numpy", "pettingzoo"),
    *("pydantic", "safetensors", "scipy", "tensorboard", "torch", "wandb"),
)
CONFIG_FILE, CHECKPOINT_FILE, VERSIONS_FILE = "config.yaml", "checkpoint.safetensors", "versions.json"
METRICS_FILE, FRONTS_FILE, LOCK_FILE, STATUS_FILE = "metrics.csv", "fronts.csv", ".lock", "status.json"
RESULTS = ("evaluation.json", "front.csv")  # of the final evaluation, which may be done again
RECORDED = (CONFIG_FILE, CHECKPOINT_FILE, METRICS_FILE, FRONTS_FILE, *RESULTS)


class InUse(ValueError):
    """Another process is training in the run's directory."""


class Run:
    """One training run and the directory ``path`` that holds it, made by :meth:`create` or :meth:`open`."""

    def __init__(self, path: Path, experiment: Experiment):
        self.path = path
        self.experiment = experiment
        self._lock: BaseFileLock | None = None
        self._clocks = perf_counter(), process_time()  # when status.json was last written

    @property
    def checkpoint(self) -> Path:
        """The file of the latest checkpoint."""
        return self.path / CHECKPOINT_FILE

    @classmethod
    def create(cls, experiment: Experiment, path: str | Path) -> Run:
        """Create and lock the directory of a new run; it may exist if it is empty."""
        run = cls(expand_home(path), experiment)
        run.path.mkdir(parents=True, exist_ok=True)
        _refuse_contents(run.path)
        run.lock()
        write_json(run.path / VERSIONS_FILE, versions())
        run.set_status("running", 0)
        run.write_config()  # last: a directory with a config.yaml is complete
        return run

    @classmethod
    def open(cls, path: str | Path, *, trust: bool = False, imports: Collection[str] | None = None) -> Run:
        """The run in an existing directory, or a policy of the zoo.

        A config.yaml that names code to import needs ``trust``; a run that drives in another one may import what the
        config of that one names, which are then ``imports``.
        """
        path = expand_home(path)
        if not path.is_dir():
            try:
                path = Path(resolve_name("algorithms.zoo:find")(str(path)))  # of a layer above this one
            except ValueError as error:
                raise ValueError(f"{str(path)!r} is not a run directory, and {error}") from None
        config = path / CONFIG_FILE
        if not config.is_file():
            raise ValueError(f"{str(path)!r} is not a run directory: it has no config.yaml")
        values = read_mapping(config)
        advice = "add --trust if you trust whoever made the run"
        if imports is not None:
            advice = "only code that the experiment itself names may be imported"
        for key, name in imported_paths(values).items() if not trust else ():
            if name not in (imports or ()):
                raise ValueError(f"{str(config)!r} has {key} = {name!r}, code that would be imported and run; {advice}")
        # This machine may not have the device that it was trained on.
        return cls(path, make_experiment(values, f"experiment {str(config)!r}", here=False))

    def write_config(self) -> None:
        """Write config.yaml."""
        atomic_write(self.path / CONFIG_FILE, dump(self.experiment.to_dict()).encode())

    def lock(self) -> None:
        """Lock the directory until this process ends, to train in it; what killed processes left is removed."""
        for entry in self.path.iterdir():
            own_path(self.path, entry.name)
        try:
            self._lock = lock(self.path / LOCK_FILE, wait=False)
        except BlockingIOError:
            raise InUse(f"run directory {str(self.path)!r} is in use by another process") from None
        for leftover in leftovers(self.path):
            leftover.unlink()

    def unlock(self) -> None:
        """Let other processes train in the directory."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    @property
    def status(self) -> dict[str, Any]:
        """The contents of status.json, as :meth:`set_status` writes them; empty if it is missing or broken."""
        return read_status(self.path)

    def set_status(self, state: State, step: int, reason: str | None = None) -> None:
        """Write status.json; seconds of work are sums over all processes, those of CPUs end with the training."""
        before, (wall, cpu) = self.status, self._clocks
        self._clocks = perf_counter(), process_time()
        used = round(before.get("cpu_seconds", 0.0) + self._clocks[1] - cpu, 3)
        status: dict[str, Any] = {
            "state": state,
            "step": step,
            "total_timesteps": self.experiment.training.total_timesteps,
            "seconds": round(before.get("seconds", 0.0) + self._clocks[0] - wall, 3),
            "cpu_seconds": before.get("cpu_seconds", used) if state == "finished" else used,
            "updated": datetime.now().astimezone().isoformat(timespec="seconds"),
            **({} if reason is None else {"reason": reason}),
            **({"files": file_hashes(self.path)} if state == "finished" else {}),
        }
        write_json(self.path / STATUS_FILE, status)

    def end(self, state: State, step: int, reason: str | None = None) -> None:
        """:meth:`set_status` after an error, which an unwritable disk, maybe its reason, does not hide."""
        with contextlib.suppress(OSError):
            self.set_status(state, step, reason)

    def record_results(self) -> None:
        """Record the final evaluation of a finished run again, after it was written anew."""
        status = self.status
        if "files" in status:
            status["files"] |= file_hashes(self.path, RESULTS)
            write_json(self.path / STATUS_FILE, status)

    @property
    def versions(self) -> dict[str, Any]:
        """The versions that the run was started with; empty if they are not known."""
        return read_json_object(self.path / VERSIONS_FILE)

    def changed_versions(self) -> list[str]:
        """The differences between the versions that the run was started with and the current ones, one line each."""
        then, now = ({**known, **known.get("packages", {})} for known in (self.versions, versions()))
        return [
            f"{name}: {then.get(name)} then, {version} now"
            for name, version in now.items()
            if name not in ("packages", "dirty") and then.get(name) != version
        ]


def is_run(path: Path) -> bool:
    """Whether a directory is that of a run, or has a policy of the zoo."""
    return (path / CONFIG_FILE).is_file()


def read_status(path: Path) -> dict[str, Any]:
    """The contents of a run's status.json, as :meth:`Run.set_status` writes them; empty if it is missing or broken."""
    return read_json_object(path / STATUS_FILE)


def imported_paths(values: Mapping[str, Any]) -> dict[str, str]:
    """What an experiment, which need not be valid, names to be imported: "package.module:name" by its key."""
    vehicles = entry_in(values, "utility", "vehicles")
    places = (
        *(("environment", "id"), ("algorithm", "name"), ("algorithm", "network"), ("utility", "name")),
        *(("utility", "vehicles", vehicle, "name") for vehicle in (vehicles if isinstance(vehicles, dict) else ())),
    )
    names = {".".join(map(str, place)): entry_in(values, *place) for place in places}
    paths = {key: name for key, name in names.items() if isinstance(name, str) and ":" in name}
    # These modules are imported in any case. Split as Gymnasium does: "gymnasium:evil:ID" is of "gymnasium:evil".
    if paths.get("environment.id", "").rpartition(":")[0] in ("gymnasium", "mo_deepdrive", "mo_gymnasium"):
        del paths["environment.id"]
    return paths


def entry_in(values: Any, *names: str, absent: Any = None) -> Any:
    """What is in nested sections under these names; ``absent`` where there is nothing."""
    for name in names:
        values = values.get(name, absent) if isinstance(values, Mapping) else absent
    return values


def resume_options(paths: Sequence[Path], values: Mapping[str, Any]) -> str:
    """The options with which the command train resumes runs of these sections, which may name code to import."""
    return f"--resume {shlex.join(map(str, paths))}" + (" --trust" if imported_paths(values) else "")


def _refuse_contents(path: Path) -> None:
    """Refuse a directory for a new run that has more in it than a killed process left of a new run."""
    names = {entry.name for entry in path.iterdir()}
    started = {LOCK_FILE, VERSIONS_FILE, STATUS_FILE}
    if CONFIG_FILE not in names and all(name in started or is_temporary(Path(name)) for name in names):
        return
    try:
        resume = f", or use {resume_options([path], read_mapping(path / CONFIG_FILE))}"
    except ValueError:  # no run, or one that cannot be resumed
        resume = ""
    raise ValueError(f"run directory {str(path)!r} is not empty; choose another{resume}")


def default_directory(root: str | Path, config: str | Path, experiment: Experiment) -> Path:
    """Make a new, empty directory: ``root/<config's stem>/<algorithm>-seed<N>-<time>``."""
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{directory_name(experiment.algorithm.name)}-seed{experiment.training.seed}-{stamp}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    path = next(path for name in names if not (path := Path(root) / Path(config).stem / name).exists())
    path.mkdir(parents=True)
    return path


def versions() -> dict[str, Any]:
    """Versions of Python, platform and packages, and the commit of the repository (None outside of a checkout)."""
    commit, changes = _git("rev-parse", "HEAD"), _git("status", "--porcelain")
    packages: dict[str, str | None] = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            packages[name] = metadata.version(name)
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "commit": commit,
        "dirty": None if commit is None or changes is None else bool(changes),
        "packages": packages,
    }


def _git(*arguments: str) -> str | None:
    root = Path(__file__).resolve().parents[2]
    command = ["git", "-C", str(root), *arguments]
    if (root / ".git").exists():
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    return None


# ------------------------------------------------------------------------------------------- the files of finished runs


def file_hashes(run: Path, names: Iterable[str] = RECORDED) -> dict[str, str]:
    """The SHA-256 hashes of files in a run's directory, so that what is changed is noticed."""
    return {name: hashlib.sha256((run / name).read_bytes()).hexdigest() for name in names if (run / name).is_file()}


def changed_files(run: Path, names: Sequence[str] | None = None) -> list[str]:
    """What does not match the record of a finished run, one line per file; of ``names``, or of all recorded files."""
    status = read_status(run)
    if not status and (run / STATUS_FILE).exists():
        return [f"{STATUS_FILE}: cannot be read"]
    recorded = status.get("files", {}) if status.get("state") == "finished" else {}
    now = file_hashes(run, recorded)
    return [
        f"{name}: {'changed since the run finished' if name in now else 'missing'}"
        for name, sha256 in recorded.items()
        if (names is None or name in names) and now.get(name) != sha256
    ]


def diverged(run: Path) -> list[str]:
    """A line if a number in the checkpoint of a run is not finite."""
    from safetensors import SafetensorError  # an extra, which not every command needs
    from safetensors.numpy import load_file

    try:
        tensors = load_file(run / CHECKPOINT_FILE)
    except (OSError, SafetensorError):  # missing or broken, as changed_files says
        return []
    wrong = [name for name, array in tensors.items() if array.dtype.kind == "f" and not np.isfinite(array).all()]
    return [f"{CHECKPOINT_FILE}: {wrong[0]!r} is not finite"] if wrong else []
