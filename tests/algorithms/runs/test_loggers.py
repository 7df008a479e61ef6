"""Logging to metrics.csv, TensorBoard and Weights & Biases."""

from __future__ import annotations

import io
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from algorithms.reporting.training_log import read_metrics
from algorithms.reporting.videos import video_writer
from algorithms.runs.config import WandbSettings
from algorithms.runs.loggers import Logger, log_results


def scalars(directory: Path) -> dict[str, list[tuple[int, float]]]:
    """The curves in TensorBoard's files: steps and values by name."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(directory / "tensorboard")).Reload()
    return {name: [(e.step, e.value) for e in events.Scalars(name)] for name in events.Tags()["scalars"]}


def test_a_resumed_run_writes_rows_after_the_checkpoint_again(tmp_path: Path) -> None:
    with Logger(tmp_path) as logger:
        for step in (0, 10, 20, 30):
            logger.log(step, {"a": step})
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("40,4")  # torn by a crash
    with Logger(tmp_path, after=10) as logger:
        logger.log(20, {"a": -20, "b": 1})
    columns = read_metrics(tmp_path / "metrics.csv")
    np.testing.assert_array_equal(columns["step"], [0, 10, 20])
    np.testing.assert_array_equal(columns["a"], [0, 10, -20])
    assert scalars(tmp_path)["a"] == [(0, 0.0), (10, 10.0), (20, -20.0)]


def test_tensorboard_shows_hyperparameters_final_scores_and_the_video_of_a_finished_run_once(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams import metadata

    config = {
        "algorithm": {"name": "a2c", "learning_rate": 0.001, "hidden": [8, 4], "clip": None},
        "logging": {"interval": 10},
    }
    with video_writer(tmp_path / "video.mp4", fps=10) as write:
        for shade in range(40):
            write(np.full((64, 96, 3), 5 * shade, dtype=np.uint8))
    with Logger(tmp_path) as logger:
        logger.log(100, {"a": 1.0})
    scores = {"greedy/utility_esr": 2.5, "greedy/success": math.nan, "greedy/end/time_limit": 1.0}
    for _ in range(2):  # the end of a run may be repeated
        log_results(tmp_path, 100, config, scores, tmp_path / "video.mp4")
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert len(list((tmp_path / "tensorboard").glob("*.results"))) == 1
    assert scalars(tmp_path) == {"a": [(100, 1.0)], "final/greedy/utility_esr": [(100, 2.5)]}
    content = events.PluginTagToContent("hparams")
    started = metadata.parse_session_start_info_plugin_data(content[metadata.SESSION_START_INFO_TAG])
    values = {name: getattr(value, value.WhichOneof("kind")) for name, value in started.hparams.items()}
    assert values == {"algorithm.name": "a2c", "algorithm.learning_rate": 0.001, "algorithm.hidden": "[8, 4]"}
    experiment = metadata.parse_experiment_plugin_data(content[metadata.EXPERIMENT_TAG])
    assert [info.name.tag for info in experiment.metric_infos] == ["final/greedy/utility_esr"]
    (image,) = events.Images("video")
    assert (image.step, image.height, image.width) == (100, 64, 96)
    with Image.open(io.BytesIO(image.encoded_image_string)) as gif:
        assert gif.format == "GIF"
        assert 2 <= gif.n_frames <= 40  # type: ignore[attr-defined]


class FakeWandb:
    """The part of wandb that the logger uses; it records the calls."""

    Error = type("Error", (Exception,), {})

    def __init__(self, key: bool = True, refuses: tuple[str, ...] = (), mode: str = "online"):
        self.key, self.refuses, self.mode = key, refuses, mode
        self.sweep_id: str | None = None
        self.runs: list[dict[str, Any]] = []
        self.rows: list[dict[str, float]] = []

    def setup(self) -> Any:
        settings = SimpleNamespace(mode=self.mode, sweep_id=self.sweep_id)
        return SimpleNamespace(settings=settings)

    def login(self, **options: Any) -> bool:
        return self.key

    def Settings(self, **options: Any) -> dict[str, Any]:
        return options

    def teardown(self) -> None:
        return

    def init(self, **options: Any) -> Any:
        if options["mode"] in self.refuses:
            raise self.Error(f"{options['mode']} does not work")
        self.runs.append(options)
        return SimpleNamespace(
            id=options["id"] or "new-id",
            entity=options["entity"] or ("team" if self.sweep_id else ""),
            project=options["project"] or "elsewhere",
            define_metric=lambda *a, **k: None,
            log=lambda row: self.rows.append(row),
            finish=lambda exit_code: self.rows.append({"exit_code": exit_code}),
        )


class FullList(list):  # type: ignore[type-arg]
    """A list that refuses new rows."""

    def append(self, row: Any) -> None:
        raise ConnectionError("no server")


SETTINGS = WandbSettings(project="p", group="g", tags=["t"])


def log_with(fake: FakeWandb, path: Path, monkeypatch: pytest.MonkeyPatch, settings: Any = SETTINGS) -> list[str]:
    """Log one row with ``fake`` in place of W&B; the messages."""
    said: list[str] = []
    monkeypatch.setitem(sys.modules, "wandb", fake)
    after = 0 if (path / "metrics.csv").exists() else None
    with Logger(path, after=after, wandb=settings, config={"x": 1}, say=said.append) as logger:
        logger.log(5, {"a": 2.0})
    return said


def test_wandb_gets_the_rows_and_a_resumed_run_keeps_its_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeWandb()
    assert log_with(fake, tmp_path, monkeypatch) == []
    assert fake.rows == [{"a": 2.0, "step": 5}, {"exit_code": 0}]
    (first,) = fake.runs
    assert (first["mode"], first["project"], first["group"], first["tags"]) == ("online", "p", "g", ["t"])
    assert (first["config"], first["name"], first["id"], first["dir"]) == ({"x": 1}, tmp_path.name, None, str(tmp_path))
    log_with(fake, tmp_path, monkeypatch)
    assert (fake.runs[1]["id"], fake.runs[1]["resume"]) == ("new-id", "allow")


def test_a_run_of_a_sweep_is_resumed_in_the_sweeps_project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeWandb(mode="offline")
    fake.sweep_id = "s"
    assert log_with(fake, tmp_path, monkeypatch, WandbSettings(project="p", entity="e")) == []
    fake.sweep_id = None
    assert log_with(fake, tmp_path, monkeypatch, WandbSettings(project="p", entity="e")) == []
    places = [(run["entity"], run["project"], run["id"]) for run in fake.runs]
    assert places == [(None, None, None), ("team", "elsewhere", "new-id")]


@pytest.mark.parametrize(
    ("fake", "said"),
    [(FakeWandb(key=False), "no API key"), (FakeWandb(refuses=("online",)), "online does not work")],
)
def test_wandb_goes_offline_without_key_or_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake: FakeWandb, said: str
) -> None:
    (message,) = log_with(fake, tmp_path, monkeypatch)
    assert said in message
    assert [run["mode"] for run in fake.runs] == ["offline"]


def test_wandb_that_fails_during_training_is_disabled_with_one_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake, said = FakeWandb(), []
    monkeypatch.setitem(sys.modules, "wandb", fake)
    offline = WandbSettings(project="p", mode="offline")
    with Logger(tmp_path, wandb=offline, say=said.append) as logger:
        fake.rows = FullList()
        logger.log(0, {"a": 1})
        logger.log(1, {"a": 1})
    (message,) = said
    assert "Weights & Biases is disabled: no server" in message


@pytest.mark.slow
def test_the_real_wandb_stores_an_offline_run(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    with Logger(tmp_path, wandb=WandbSettings(project="p", mode="offline"), say=pytest.fail) as logger:
        logger.log(0, {"a": 1})
    assert (tmp_path / "wandb_id").read_text().strip()
    assert list((tmp_path / "wandb").glob("offline-run-*"))
