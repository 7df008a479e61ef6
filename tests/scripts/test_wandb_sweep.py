"""The W&B sweep in configs/sweeps, run with the real `wandb` command against a local server."""

from __future__ import annotations

import gzip
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from algorithms.commands import train
from algorithms.reporting.training_log import read_metrics
from algorithms.runs.config import load_experiment
from mo_deepdrive.support.yaml import read_mapping
from tests.helpers.paths import REPOSITORY

pytestmark = [
    pytest.mark.processes,
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="needs POSIX commands and signals"),
]

DEFINITION = "configs/sweeps/wandb.yaml"
TIMEOUT = 240
SWEEP, SHORT, LONG = "sweep001", "short001", "long0001"
SMALL = {"training.num_envs": 8, "evaluation.episodes": 2, "evaluation.final_episodes": 2}
VALUES: dict[str, dict[str, Any]] = {
    SHORT: {
        **SMALL,
        "training.total_timesteps": 512,
        "algorithm.learning_rate": 5e-05,
        "algorithm.advantage": "utility_gradient",
        "algorithm.steps": 8,
    },
    LONG: {**SMALL, "training.total_timesteps": 2_000_000, "algorithm.learning_rate": 0.002},
}


class Server(ThreadingHTTPServer):
    """A fake of W&B's server with what a sweep and a sync need.

    It starts both runs of VALUES at once, stops the long one while it trains, and ends the agent when no run is left.

    Attributes:
        sweep: the request of `wandb sweep`.
        runs: uploaded data by entity, project and id: "config", "sweep", "rows".
    """

    daemon_threads = True

    def __init__(self, folder: Path):
        super().__init__(("127.0.0.1", 0), Handler)
        self.folder = folder
        self.sweep: dict[str, Any] = {}
        self.runs: dict[tuple[str, str, str], dict[str, Any]] = {}
        self._handed_out = False

    def answer(self, operation: str, given: dict[str, Any]) -> dict[str, Any]:
        """The response to a GraphQL operation.

        Raises:
            KeyError: for an unknown operation.
        """
        return {
            "Viewer": self._viewer,
            "UpsertSweep": self._upsert_sweep,
            "SweepWithRuns": self._sweep,
            "CreateAgent": lambda given: {"createAgent": {"agent": {"id": "agent"}}},
            "Heartbeat": self._heartbeat,
            "UpsertBucket": self._upsert_run,
            "RunResumeStatus": self._resume_status,
        }[operation](given)

    def _viewer(self, given: dict[str, Any]) -> dict[str, Any]:
        return {"viewer": {"id": "user", "username": "user", "entity": "user", "flags": "{}", "teams": {"edges": []}}}

    def _upsert_sweep(self, given: dict[str, Any]) -> dict[str, Any]:
        self.sweep = given
        project = {"id": "p", "name": given["projectName"], "entity": {"id": "e", "name": given["entityName"]}}
        return {"upsertSweep": {"sweep": {"name": SWEEP, "project": project}, "configValidationWarnings": []}}

    def _sweep(self, given: dict[str, Any]) -> dict[str, Any]:
        found = {"id": "s", "name": SWEEP, "state": "RUNNING", "config": self.sweep["config"], "runs": {"edges": []}}
        return {"project": {"sweep": found}}

    def _heartbeat(self, given: dict[str, Any]) -> dict[str, Any]:
        commands = self._commands(json.loads(given["runState"]))
        return {"agentHeartbeat": {"agent": {"id": "agent"}, "commands": json.dumps(commands)}}

    def _commands(self, running: dict[str, bool]) -> list[dict[str, Any]]:
        if not self._handed_out:
            self._handed_out = True
            program = yaml.safe_load(self.sweep["config"])["program"]
            return [
                {"type": "run", "run_id": each, "program": program, "args": {k: {"value": v} for k, v in args.items()}}
                for each, args in VALUES.items()
            ]
        long = directory_of(self.folder, LONG)
        if LONG in running and long is not None and last_step(long) > 0:
            return [{"type": "stop", "run_id": LONG}]
        return [] if running else [{"type": "exit"}]

    def _upsert_run(self, given: dict[str, Any]) -> dict[str, Any]:
        key = (given["entity"] or "user", given["project"], given["name"])
        new = key not in self.runs
        run = self.runs.setdefault(key, {"config": "{}", "sweep": None, "rows": []})
        run.update({name: given[name] for name in ("config", "sweep") if given[name]})
        project = {"id": "p", "name": key[1], "entity": {"id": "e", "name": key[0]}}
        bucket = {"id": "b", "name": key[2], "config": run["config"], "sweepName": run["sweep"], "project": project}
        return {"upsertBucket": {"bucket": {**bucket, "historyLineCount": len(run["rows"])}, "inserted": new}}

    def _resume_status(self, given: dict[str, Any]) -> dict[str, Any]:
        run = self.runs.get((given["entity"] or "user", given["project"], given["name"]))
        bucket = run and {
            "id": "b",
            "name": given["name"],
            "config": run["config"],
            "summaryMetrics": "{}",
            "historyLineCount": len(run["rows"]),
            "historyTail": json.dumps(run["rows"][-1:]),
            "logLineCount": 0,
            "eventsLineCount": 0,
            "eventsTail": "[]",
            "tags": [],
            "wandbConfig": '{"t": 1}',
        }
        return {"model": {"id": "p", "name": given["project"], "bucket": bucket}}

    def upload(self, key: tuple[str, str, str], files: dict[str, Any]) -> None:
        """Store uploaded lines of a run's history, from their offset on."""
        if chunk := files.get("wandb-history.jsonl"):
            self.runs[key]["rows"][chunk["offset"] :] = chunk["content"]


class Handler(BaseHTTPRequestHandler):
    """Passes HTTP requests to the server."""

    protocol_version = "HTTP/1.1"
    server: Server

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers["Content-Encoding"] == "gzip":
            body = gzip.decompress(body)
        reply: dict[str, Any] = {}
        if self.path == "/graphql":
            request = json.loads(body)
            operation = re.findall(r"(?:query|mutation)\s+(\w+)", request["query"])[0]
            try:
                reply = {"data": self.server.answer(operation, request.get("variables") or {})}
            except KeyError as error:
                reply = {"errors": [{"message": f"{operation}: {error}"}]}
        elif upload := re.fullmatch(r"/files/([^/]+)/([^/]+)/([^/]+)/file_stream", self.path):
            entity, project, name = upload.groups()
            self.server.upload((entity, project, name), json.loads(body).get("files") or {})
        content = json.dumps(reply).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: Any) -> None:
        return


@dataclass(frozen=True)
class Sweep:
    """A finished sweep.

    Attributes:
        folder: working directory of its commands.
        server: that they connected to.
        output: of the agent and its runs.
    """

    folder: Path
    server: Server
    output: str

    def run(self, run_id: str) -> Path:
        """The directory of a run."""
        found = directory_of(self.folder, run_id)
        assert found is not None, self.output
        return found


def directory_of(folder: Path, run_id: str) -> Path | None:
    """The directory of the run with W&B's id ``run_id``; None before it exists."""
    files = folder.glob("runs/mo_a2c_linear/*/wandb_id")
    return next((file.parent for file in files if file.read_text().strip() == run_id), None)


def last_step(run: Path) -> int:
    """The last step that a run has logged; -1 before, and while a resumed run cuts its metrics back."""
    steps = read_metrics(run / "metrics.csv")["step"] if (run / "metrics.csv").exists() else ()
    return int(steps[-1]) if len(steps) else -1


def environment(folder: Path, server: Server, **variables: str) -> dict[str, str]:
    """Environment variables: W&B is ``server``, `mo-deepdrive` runs in this interpreter."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("WANDB_")}
    return {
        **kept,
        "PATH": os.pathsep.join([str(folder / "bin"), os.environ["PATH"]]),
        "PYTHONPATH": str(REPOSITORY),
        "WANDB_BASE_URL": f"http://127.0.0.1:{server.server_port}",
        "WANDB_API_KEY": "0123456789" * 4,
        "WANDB_CACHE_DIR": str(folder / "wandb"),
        "WANDB_CONFIG_DIR": str(folder / "wandb"),
        "WANDB_ERROR_REPORTING": "false",
        **variables,
    }


def call(folder: Path, server: Server, *arguments: str, **variables: str) -> str:
    """Run `wandb` in ``folder``; returns its output."""
    done = subprocess.run(
        [sys.executable, "-m", "wandb", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=folder,
        env=environment(folder, server, **variables),
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sweep]:
    """The sweep in configs/sweeps, created in another project and run by the agent that `wandb sweep` prints."""
    folder = tmp_path_factory.mktemp("sweep")
    for name in ("wandb", "bin"):
        (folder / name).mkdir()
    program = folder / "bin" / "mo-deepdrive"  # as pip installs it
    program.write_text(f"#!{sys.executable}\nimport sys\nfrom mo_deepdrive_command import main\nsys.exit(main())\n")
    program.chmod(0o755)
    with Server(folder) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            made = call(folder, server, "sweep", "--entity=team", "--project=elsewhere", str(REPOSITORY / DEFINITION))
            agents = re.findall(r"wandb agent ([\w/-]+)", made)
            assert agents == [f"team/elsewhere/{SWEEP}"], made
            yield Sweep(folder, server, call(folder, server, "agent", *agents, WANDB_MODE="offline"))
        finally:
            server.shutdown()


def value_at(values: dict[str, Any], key: str) -> Any:
    return reduce(lambda section, name: section[name], key.split("."), values)


def state(run: Path) -> str:
    return json.loads((run / "status.json").read_text())["state"]


def test_the_command_is_the_installed_one_and_every_value_is_valid_for_the_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    definition = yaml.safe_load((REPOSITORY / DEFINITION).read_text())
    environment, program, command, *words, given = definition["command"]
    assert (environment, program, command, given) == ("${env}", "${program}", "train", "${args}")
    options = train.main.parse(words)
    assert definition["program"] == "mo-deepdrive"
    monkeypatch.chdir(tmp_path)  # an installed package has no checkout
    for key, parameter in definition["parameters"].items():
        for value in parameter.get("values") or [parameter["min"], parameter["max"]]:
            experiment = load_experiment(options.config, [*options.overrides, f"--{key}={value}"])
            assert value_at(experiment.to_dict(), key) == value
    assert experiment.logging.wandb is not None
    assert experiment.logging.wandb.project == definition["project"]


@pytest.mark.slow
def test_runs_have_the_values_and_ids_from_the_agent(sweep: Sweep) -> None:
    for run_id, values in VALUES.items():
        config = read_mapping(sweep.run(run_id) / "config.yaml")
        assert {key: value_at(config, key) for key in values} == values
        assert (config["training"]["seed"], config["logging"]["save_figures"]) == (100, False)
    assert len(list(sweep.folder.glob("runs/*/*"))) == len(VALUES)
    assert state(sweep.run(SHORT)) == "finished"
    assert "when running a sweep" not in sweep.output  # W&B's warning about ignored arguments


@pytest.mark.slow
def test_the_metric_of_the_sweep_is_logged(sweep: Sweep) -> None:
    sent = yaml.safe_load(sweep.server.sweep["config"])
    assert sent == yaml.safe_load((REPOSITORY / DEFINITION).read_text())
    columns = read_metrics(sweep.run(SHORT) / "metrics.csv")
    assert np.isfinite(columns[sent["metric"]["name"]]).sum() > 1


def interrupt_after(step: int, run: Path, sweep: Sweep) -> int:
    """Resume a run outside the sweep and interrupt it after ``step``; returns the exit code."""
    process = subprocess.Popen(
        [str(sweep.folder / "bin" / "mo-deepdrive"), "train", "--resume", str(run)],
        cwd=sweep.folder,
        env=environment(sweep.folder, sweep.server, WANDB_MODE="offline"),
    )
    try:
        deadline = time.monotonic() + TIMEOUT
        while process.poll() is None and time.monotonic() < deadline:
            if last_step(run) > step:
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        return process.wait(TIMEOUT)
    finally:
        process.kill()


@pytest.mark.slow
def test_a_stopped_run_can_be_resumed_and_both_parts_are_synced_as_one_run(sweep: Sweep) -> None:
    run = sweep.run(LONG)
    before = read_metrics(run / "metrics.csv")["step"]
    assert state(run) == "interrupted"
    assert interrupt_after(int(before[-1]), run, sweep) == 130
    steps = read_metrics(run / "metrics.csv")["step"]
    np.testing.assert_array_equal(steps[: len(before)], before)
    assert len(list(run.glob("wandb/offline-run-*"))) == 2
    assert (run / "wandb_id").read_text().strip() == LONG
    call(sweep.folder, sweep.server, "sync", str(run / "wandb"))
    assert list(sweep.server.runs) == [("team", "elsewhere", LONG)]
    (uploaded,) = sweep.server.runs.values()
    rows = [json.loads(row) for row in uploaded["rows"]]
    np.testing.assert_array_equal([row["step"] for row in rows], steps)
    assert [row["_step"] for row in rows] == list(range(len(rows)))
    assert uploaded["sweep"] == SWEEP
    config = json.loads(uploaded["config"])
    assert {key: config[key]["value"] for key in VALUES[LONG]} == VALUES[LONG]
    assert config["algorithm"]["value"]["learning_rate"] == VALUES[LONG]["algorithm.learning_rate"]
