"""Metrics on disk: metrics.csv and TensorBoard always, Weights & Biases when asked."""

from __future__ import annotations

import math
import urllib.error
import urllib.request
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from algorithms.common.atomic_io import atomic_write
from algorithms.common.metrics_file import MetricsFile
from algorithms.experiments.config import WandbSettings

CONNECTION_TIMEOUT = 20.0  # s, after which W&B's online mode gives way to offline


class WandbRun:
    """A Weights & Biases run that never stops training: what fails is said once and left out from there.

    Args:
        directory: where offline data, the run's id and its project go; a resumed run continues those that it finds.
        settings: project and so on.
        config: shown beside the run.
        name: of the run.
        say: takes messages.
    """

    def __init__(
        self, directory: Path, settings: WandbSettings, config: dict[str, Any], name: str, say: Callable[[str], None]
    ):
        self._say = say
        self._run: Any = None
        try:
            self._run = self._start(directory, settings, config, name)
        except Exception as error:  # whatever a foreign service does, training goes on
            say(f"warning: Weights & Biases is left out: {type(error).__name__}: {error}")

    def _start(self, directory: Path, settings: WandbSettings, config: dict[str, Any], name: str) -> Any:
        import wandb

        id_file, project_file = directory / "wandb_id", directory / "wandb_project"
        stored = id_file.read_text().strip() if id_file.exists() else None
        entity, project = self._place(wandb, settings, project_file)
        options: dict[str, Any] = {
            "project": project,
            "entity": entity,
            "group": settings.group,
            "tags": settings.tags,
            "config": config,
            "name": name,
            "dir": str(directory),
            "id": stored,
            "resume": "allow" if stored else None,
            "settings": wandb.Settings(console="off", init_timeout=CONNECTION_TIMEOUT),
        }
        # WANDB_MODE, which wandb reads itself, may say offline or disabled.
        mode: Any = "offline" if settings.mode == "offline" else wandb.setup().settings.mode
        if mode == "online":
            obstacle = self._obstacle(wandb)
            if obstacle is None:
                try:
                    run = wandb.init(mode=mode, **options)
                except wandb.Error as error:
                    wandb.teardown()  # frees the run's id
                    obstacle = str(error)
            if obstacle is not None:
                self._say(f"Weights & Biases: {obstacle}; the run is kept offline, `wandb sync` uploads it later")
                run = wandb.init(mode="offline", **options)
        else:
            run = wandb.init(mode=mode, **options)
        run.define_metric("step")
        run.define_metric("*", step_metric="step")
        if mode != "disabled":  # where entity and project are dummies
            atomic_write(project_file, f"{run.entity}/{run.project}\n".encode())
            atomic_write(id_file, f"{run.id}\n".encode())
        return run

    def _place(self, wandb: Any, settings: WandbSettings, project_file: Path) -> tuple[str | None, str | None]:
        """Entity and project; None for what W&B knows itself, as it does under a sweep's agent."""
        if wandb.setup().settings.sweep_id:
            return None, None
        if project_file.exists():
            entity, _, project = project_file.read_text().strip().partition("/")
            return entity or None, project
        return settings.entity, settings.project

    def _obstacle(self, wandb: Any) -> str | None:
        """Why a run cannot be online, if so."""
        if not wandb.login(prompt=False, verify=False):
            return "no API key"
        try:
            urllib.request.urlopen(wandb.setup().settings.base_url, timeout=CONNECTION_TIMEOUT).close()
        except urllib.error.HTTPError:
            return None  # somebody answered
        except OSError as error:
            return f"no connection ({error})"
        return None

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Send a row."""
        if self._run is None:
            return
        try:
            self._run.log({**metrics, "step": step})
        except Exception as error:
            self._say(f"warning: Weights & Biases is left out from here: {type(error).__name__}: {error}")
            self._run = None

    def close(self, failed: bool) -> None:
        """Finish the run."""
        if self._run is None:
            return
        try:
            self._run.finish(exit_code=int(failed))
        except Exception as error:
            self._say(f"warning: Weights & Biases did not finish: {type(error).__name__}: {error}")
        self._run = None


class Logger:
    """Writes each row of metrics to metrics.csv, TensorBoard and, when asked, Weights & Biases.

    Use it as a context manager. Its files are metrics.csv and tensorboard/ in ``directory``.

    Args:
        directory: the run's.
        after: step of the checkpoint that a run resumes from: later rows are dropped, since it writes them again.
            None for a new run.
        wandb: settings; None for without.
        config, name: shown in W&B.
        say: takes messages.

    Raises:
        OSError: if the files cannot be written.
    """

    def __init__(
        self,
        directory: str | Path,
        *,
        after: int | None = None,
        wandb: WandbSettings | None = None,
        config: dict[str, Any] | None = None,
        name: str = "run",
        say: Callable[[str], None] = print,
    ):
        directory = Path(directory)
        self._file = MetricsFile(directory / "metrics.csv", after)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of TensorBoard's dependencies
            from torch.utils.tensorboard import SummaryWriter
        purge = None if after is None else after + 1
        self._board = SummaryWriter(str(directory / "tensorboard"), purge_step=purge)
        self._wandb = None if wandb is None else WandbRun(directory, wandb, config or {}, name, say)

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Write a row.

        Raises:
            OSError: if it cannot be written.
        """
        self._file.write(step, metrics)
        for name, value in metrics.items():
            if math.isfinite(value):
                self._board.add_scalar(name, value, step)
        if self._wandb is not None:
            self._wandb.log(step, metrics)

    def close(self, failed: bool = False) -> None:
        """Flush and close everything."""
        self._board.close()
        if self._wandb is not None:
            self._wandb.close(failed)

    def __enter__(self) -> Logger:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(failed=kind is not None)
