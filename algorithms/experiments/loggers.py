"""Logging of metrics to metrics.csv, TensorBoard and, optionally, Weights & Biases."""

from __future__ import annotations

import math
import urllib.error
import urllib.request
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.common.metrics_file import MetricsFile
from algorithms.reporting.seed_tables import TABLE_METRICS
from mo_deepdrive.atomic_io import atomic_write
from mo_deepdrive.evaluation.metrics import split_name
from mo_deepdrive.extras import MissingExtraError, needed_for

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from types import TracebackType

    from algorithms.experiments.config import WandbSettings

TENSORBOARD = "tensorboard"  # folder in a run's directory
RESULTS_SUFFIX = ".results"  # of TensorBoard's file with the results at the end
CONNECTION_TIMEOUT = 20.0  # s after which W&B is used offline


class WandbRun:
    """A Weights & Biases run that never stops training: after the first error, which is printed, it is disabled.

    Args:
        directory: for offline data, the run's id and its project; a resumed run continues with the stored id.
        settings: project, group and so on.
        config: the configuration shown with the run.
        name: name of the run.
        say: prints messages.
    """

    def __init__(
        self, directory: Path, settings: WandbSettings, config: dict[str, Any], name: str, say: Callable[[str], None]
    ):
        self._say = say
        self._run: Any = None
        try:
            self._run = self._start(directory, settings, config, name)
        except MissingExtraError as error:
            say(f"warning: Weights & Biases is disabled: {error}")
        except Exception as error:  # training does not depend on an external service
            say(f"warning: Weights & Biases is disabled: {type(error).__name__}: {error}")

    def _start(self, directory: Path, settings: WandbSettings, config: dict[str, Any], name: str) -> Any:
        with needed_for("logging.wandb"):
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
            offline_reason = self._offline_reason(wandb)
            if offline_reason is None:
                try:
                    run = wandb.init(mode=mode, **options)
                except wandb.Error as error:
                    wandb.teardown()  # frees the run's id
                    offline_reason = str(error)
            if offline_reason is not None:
                self._say(f"Weights & Biases: {offline_reason}; logging offline, `wandb sync` uploads the run later")
                run = wandb.init(mode="offline", **options)
        else:
            run = wandb.init(mode=mode, **options)
        run.define_metric("step")
        run.define_metric("*", step_metric="step")
        if mode != "disabled":  # then entity and project are placeholders
            atomic_write(project_file, f"{run.entity}/{run.project}\n".encode())
            atomic_write(id_file, f"{run.id}\n".encode())
        return run

    def _place(self, wandb: Any, settings: WandbSettings, project_file: Path) -> tuple[str | None, str | None]:
        """Entity and project; None if W&B chooses them, as under the agent of a sweep."""
        if wandb.setup().settings.sweep_id:
            return None, None
        if project_file.exists():
            entity, _, project = project_file.read_text().strip().partition("/")
            return entity or None, project
        return settings.entity, settings.project

    def _offline_reason(self, wandb: Any) -> str | None:
        """Why a run cannot be online; None if it can."""
        if not wandb.login(prompt=False, verify=False):
            return "no API key"
        try:
            urllib.request.urlopen(wandb.setup().settings.base_url, timeout=CONNECTION_TIMEOUT).close()
        except urllib.error.HTTPError:
            return None  # there is a connection
        except OSError as error:
            return f"no connection ({error})"
        return None

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log a row."""
        if self._run is None:
            return
        try:
            self._run.log({**metrics, "step": step})
        except Exception as error:
            self._say(f"warning: Weights & Biases is disabled from here on: {type(error).__name__}: {error}")
            self._run = None

    def close(self, failed: bool) -> None:
        """Finish the run."""
        if self._run is None:
            return
        try:
            self._run.finish(exit_code=int(failed))
        except Exception as error:
            self._say(f"warning: Weights & Biases could not finish the run: {type(error).__name__}: {error}")
        self._run = None


class Logger:
    """Writes each row of metrics to metrics.csv, TensorBoard and, if ``wandb`` is given, Weights & Biases.

    Use it as a context manager. Its files are metrics.csv and tensorboard/ in ``directory``.

    Args:
        directory: the run's directory.
        after: step of the checkpoint that a run resumes from: later rows are dropped, since they are written again.
            None for a new run.
        noted: what :meth:`sync` returned when that checkpoint was written; None if it is not known.
        wandb: settings of Weights & Biases; None to leave it out.
        config: the configuration shown in W&B.
        name: the run's name in W&B.
        say: prints messages.

    Attributes:
        gap: what is missing in metrics.csv up to that checkpoint; None if nothing is.

    Raises:
        ValueError: if there is a metrics.csv to continue that is broken.
        OSError: if the files cannot be written.
    """

    def __init__(
        self,
        directory: str | Path,
        *,
        after: int | None = None,
        noted: Mapping[str, Any] | None = None,
        wandb: WandbSettings | None = None,
        config: dict[str, Any] | None = None,
        name: str = "run",
        say: Callable[[str], None] = print,
    ):
        directory = Path(directory)
        self._file = MetricsFile(directory / "metrics.csv", after, noted)
        self.gap = self._file.gap
        purge = None if after is None else after + 1
        self._board = _summary_writer(directory, purge_step=purge)
        self._wandb = None if wandb is None else WandbRun(directory, wandb, config or {}, name, say)

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log a row.

        Raises:
            OSError: if it cannot be written.
        """
        self._file.write(step, metrics)
        for name, value in metrics.items():
            if math.isfinite(value):
                self._board.add_scalar(name, value, step)
        if self._wandb is not None:
            self._wandb.log(step, metrics)

    def sync(self) -> dict[str, Any]:
        """Make metrics.csv reach the disk, before a checkpoint; returns its number of rows and their hash.

        Raises:
            OSError: if it cannot be written.
        """
        return self._file.sync()

    def close(self, failed: bool = False) -> None:
        """Flush and close all outputs; ``failed`` marks the W&B run as failed."""
        self._board.close()
        if self._wandb is not None:
            self._wandb.close(failed)

    def __enter__(self) -> Logger:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(failed=kind is not None)


def log_results(
    directory: Path, step: int, config: Mapping[str, Any], metrics: Mapping[str, float], video: Path | None = None
) -> None:
    """Show the results of a finished run in TensorBoard: hyperparameters, final scores and the video.

    They are in a file of their own, which replaces that of an earlier call: a run has one entry in the HParams tab.

    Args:
        directory: the run's directory.
        step: of the trained policy.
        config: the experiment; its keys are hyperparameters, except those of logging.
        metrics: of the final evaluation, such as greedy/utility_esr; those of tables are shown, as final/...
        video: an MP4, which becomes a GIF in the Images tab; left out if there is no such file.

    Raises:
        OSError: if something cannot be read or written.
    """
    for earlier in (directory / TENSORBOARD).glob(f"*{RESULTS_SUFFIX}"):
        earlier.unlink()
    scores = {
        f"final/{name}": value
        for name, value in metrics.items()
        if split_name(name).metric in TABLE_METRICS and math.isfinite(value)
    }
    board = _summary_writer(directory, filename_suffix=RESULTS_SUFFIX)
    try:
        from tensorboard.compat.proto.summary_pb2 import Summary
        from torch.utils.tensorboard.summary import hparams

        for name, value in scores.items():
            board.add_scalar(name, value, step)
        for summary in hparams(_flattened({key: value for key, value in config.items() if key != "logging"}), scores):
            board.file_writer.add_summary(summary)
        if video is not None and video.is_file():
            from algorithms.reporting.animated_gif import video_as_gif

            gif, height, width = video_as_gif(video)
            image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
            board.file_writer.add_summary(Summary(value=[Summary.Value(tag="video", image=image)]), step)
    finally:
        board.close()


def _summary_writer(directory: Path, **options: Any) -> Any:
    """TensorBoard's writer for a run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # from TensorBoard's dependencies
        from torch.utils.tensorboard import SummaryWriter
    return SummaryWriter(str(directory / TENSORBOARD), **options)


def _flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested keys as dotted ones with the values that HParams takes; without those that are None."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, dict):
            flat |= _flattened(value, f"{prefix}{key}.")
        elif value is not None:
            flat[prefix + key] = value if isinstance(value, (bool, int, float, str)) else str(value)
    return flat
