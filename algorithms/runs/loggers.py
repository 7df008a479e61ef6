"""Logging of metrics to metrics.csv, TensorBoard and, optionally, Weights & Biases."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.reporting.run_records import flatten
from algorithms.reporting.tables import TABLE_METRICS
from algorithms.reporting.training_log import MetricsFile
from algorithms.runs.interrupts import Accessory
from mo_deepdrive.evaluation.metrics import split_name
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from algorithms.runs.config import WandbSettings

TENSORBOARD = "tensorboard"  # folder in a run's directory
RESULTS_SUFFIX = ".results"  # of TensorBoard's file with the results at the end


class WandbRun:
    """A run in Weights & Biases, offline where it cannot be reached; a resumed one continues with the stored id."""

    def __init__(self, directory: Path, settings: WandbSettings, config: dict[str, Any], say: Callable[[str], None]):
        import wandb

        id_file, project_file = directory / "wandb_id", directory / "wandb_project"
        stored = id_file.read_text().strip() if id_file.exists() else None
        options: dict[str, Any] = {
            **settings.model_dump(exclude={"mode"}),
            "config": config,
            "name": directory.name,
            "dir": str(directory),
            "id": stored,
            "resume": "allow" if stored else None,
            "settings": wandb.Settings(console="off", init_timeout=20.0),  # s, after which it is used offline
        }
        ours = wandb.setup().settings  # of the user's environment
        if ours.sweep_id:  # W&B's agent chooses them
            options |= {"entity": None, "project": None}
        elif project_file.exists():
            entity, _, project = project_file.read_text().strip().partition("/")
            options |= {"entity": entity or None, "project": project}
        # WANDB_MODE, which wandb reads itself, may say offline or disabled.
        mode: Any = "offline" if settings.mode == "offline" else ours.mode
        try:
            if mode == "online" and not wandb.login(prompt=False, verify=False):
                raise wandb.Error("no API key")
            self._run = wandb.init(mode=mode, **options)
        except wandb.Error as error:
            if mode != "online":
                raise
            wandb.teardown()  # frees the run's id
            say(f"Weights & Biases: {error}; logging offline, `wandb sync` uploads the run later")
            self._run = wandb.init(mode="offline", **options)
        self._run.define_metric("step")
        self._run.define_metric("*", step_metric="step")
        if mode != "disabled":  # then entity and project are placeholders
            atomic_write(project_file, f"{self._run.entity}/{self._run.project}\n".encode())
            atomic_write(id_file, f"{self._run.id}\n".encode())

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log a row."""
        self._run.log({**metrics, "step": step})

    def close(self, failed: bool) -> None:
        """Finish the run."""
        self._run.finish(exit_code=int(failed))


class TensorBoard:
    """A file of TensorBoard, which ignores what earlier files have after the step ``after``."""

    def __init__(self, directory: Path, suffix: str = "", after: int | None = None):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # from TensorBoard's dependencies
            from torch.utils.tensorboard import SummaryWriter
        purge_step = None if after is None else after + 1
        self.writer: Any = SummaryWriter(str(directory / TENSORBOARD), purge_step=purge_step, filename_suffix=suffix)

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log those of the metrics that are finite."""
        for name, value in metrics.items():
            if math.isfinite(value):
                self.writer.add_scalar(name, value, step)
        self.writer.flush()

    def close(self, failed: bool = False) -> None:
        """Close the file."""
        del failed  # TensorBoard does not show it
        self.writer.close()


class Logger:
    """Writes each row of metrics to metrics.csv, TensorBoard and, if ``wandb`` is given, Weights & Biases.

    An error of TensorBoard or Weights & Biases is one message and ends their part alone. ``after`` is the step of the
    checkpoint that a run resumes from: later rows are written again.
    """

    def __init__(
        self,
        directory: str | Path,
        *,
        after: int | None = None,
        wandb: WandbSettings | None = None,
        config: dict[str, Any] | None = None,
        say: Callable[[str], None] = print,
    ):
        directory = Path(directory)
        self._file = MetricsFile(directory / "metrics.csv", after)
        self._outputs: list[tuple[Accessory, TensorBoard | WandbRun]] = []
        with Accessory("TensorBoard is disabled", say) as accessory:
            self._outputs.append((accessory, TensorBoard(directory, after=after)))
        with Accessory("Weights & Biases is disabled", say) as accessory:
            if wandb is not None:
                self._outputs.append((accessory, WandbRun(directory, wandb, config or {}, say)))

    def _each(self, action: Callable[[TensorBoard | WandbRun], None]) -> None:
        """Do something with each output beside metrics.csv that has not failed yet."""
        for accessory, output in self._outputs:
            if accessory.works:
                with accessory:
                    action(output)

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log a row."""
        self._file.write(step, metrics)
        self._each(lambda output: output.log(step, metrics))

    def sync(self) -> None:
        """Make metrics.csv reach the disk, before a checkpoint."""
        self._file.sync()

    def __enter__(self) -> Logger:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._each(lambda output: output.close(failed=kind is not None))


def log_results(
    directory: Path, step: int, config: Mapping[str, Any], metrics: Mapping[str, float], video: Path | None = None
) -> None:
    """Show the results of a finished run in TensorBoard, in a file of their own, which replaces an earlier one.

    The keys of the config are hyperparameters, except those of logging; of the metrics, such as greedy/utility_esr,
    those of tables are shown, as final/...; the video, if there is such a file, becomes a GIF in the Images tab.
    """
    for earlier in (directory / TENSORBOARD).glob(f"*{RESULTS_SUFFIX}"):
        earlier.unlink()
    scores = {
        f"final/{name}": value
        for name, value in metrics.items()
        if split_name(name).metric in TABLE_METRICS and math.isfinite(value)
    }
    events = TensorBoard(directory, RESULTS_SUFFIX)
    try:
        from tensorboard.compat.proto.summary_pb2 import Summary
        from torch.utils.tensorboard.summary import hparams

        events.log(step, scores)
        settings = {
            key: value if isinstance(value, (bool, int, float)) else str(value)
            for key, value in flatten(config).items()
            if value is not None and not key.startswith("logging.")
        }
        summaries = [*hparams(settings, scores)]
        if video is not None and video.is_file():
            from algorithms.reporting.videos import video_as_gif

            gif, height, width = video_as_gif(video)
            image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
            summaries.append(Summary(value=[Summary.Value(tag="video", image=image)]))
        for summary in summaries:
            events.writer.file_writer.add_summary(summary, step)
    finally:
        events.close()
