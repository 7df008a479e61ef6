"""Runs of peers: train a peer, and evaluate its policies like those of our own algorithms."""

from __future__ import annotations

import contextlib
import random  # noqa: TID251  (the libraries draw from the global generators)
from functools import partial
from importlib import metadata
from time import perf_counter, process_time
from typing import TYPE_CHECKING

import mo_gymnasium
import numpy as np
import torch

from algorithms.learning.threads import set_threads
from algorithms.peers import PEERS
from algorithms.peers.peer_task import PeerTask, Recorder
from algorithms.reporting.fronts import FrontsFile
from algorithms.reporting.run_records import final_metrics
from algorithms.runs.build import make_environment, make_utilities
from algorithms.runs.console import open_log
from algorithms.runs.loggers import Logger
from algorithms.runs.report import report_run, show_results
from algorithms.runs.run_directory import FRONTS_FILE, METRICS_FILE
from algorithms.runs.suite_entries import score_run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.front import Front, check_reference_point
from mo_deepdrive.evaluation.metrics import EVALUATION

if TYPE_CHECKING:
    from rich.console import Console

    from algorithms.agent import Log
    from algorithms.runs.config import Experiment
    from algorithms.runs.run_directory import Run


def prepare(experiment: Experiment, log: Log) -> PeerTask:
    """The task of the peer in an experiment, which calls ``log(step, metrics)`` during training."""
    name = experiment.algorithm.name
    peer, settings, training = PEERS[name], experiment.environment, experiment.training
    reason = peer.unavailable_reason()
    if reason is not None:
        raise ValueError(f"algorithm {name!r} cannot run here: {reason}; see docs/use_with.md#morl-baselines")
    for key, given in (("partners", training.partners), ("guides", training.guides)):
        if given:
            raise ValueError(f"training.{key}: algorithm {name!r} cannot train with {key}")
    env = EnvAdapter(make_environment(settings, training.num_envs))
    point = experiment.evaluation.reference_point
    utility = make_utilities(experiment.utility, env)[0] if experiment.utility is not None else None
    if utility is None:
        check_reference_point(point, env.objectives)
    task = PeerTask(
        make_single_env=partial(mo_gymnasium.make, settings.id, **settings.arguments),
        env=env,
        config=experiment.algorithm.config,
        utility=utility,
        steps=training.total_timesteps,
        seed=training.seed,
        device=training.device,
        reference_point=None if point is None else np.array(point),
        # It logs a hundred rows of metrics.
        recorder=Recorder(env.objectives, utility, max(1, training.total_timesteps // 100), log),
    )
    peer.check(name, task)
    return task


def run_peer(run: Run, console: Console) -> None:
    """Train a peer, evaluate its policies on unmodified environments and our seeds, and write all results.

    Its output goes to ``peer.log``, the recorder's metrics to ``metrics.csv``. A run that was interrupted begins anew.
    Peers use the global random generators of this process, which are seeded.
    """
    experiment, seed = run.experiment, run.experiment.training.seed
    peer = PEERS[experiment.algorithm.name]
    set_threads(experiment.training.threads)
    # The libraries draw from the global generators whatever seed they are given.
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002  (the libraries use the legacy generator)
    torch.manual_seed(seed)  # noqa: TID251
    with Logger(
        run.path,
        after=-1 if (run.path / METRICS_FILE).exists() else None,
        wandb=experiment.logging.wandb,
        config=experiment.to_dict(),
    ) as logger:
        task = prepare(experiment, logger.log)
        with open_log(run.path / "peer.log") as file, contextlib.redirect_stdout(file):
            started, used = perf_counter(), process_time()
            policies = peer.train(task)
            seconds, used = perf_counter() - started, process_time() - used
        steps = task.recorder.steps
        run.set_status("trained", steps)
        console.print(f"{steps:,} steps in {seconds:,.1f} s; evaluating {len(policies):,} policies")
        about = {
            "wall_clock": seconds,
            "cpu_time": used,
            "package": peer.package,
            "version": metadata.version(peer.package),
            "evaluated_policies": len(policies),
        }
        report_run(run, policies, console, about)
        if not peer.known_utility:
            FrontsFile(run.path / FRONTS_FILE).write_front(steps, Front.read(run.path))
        logger.log(steps, {EVALUATION + name: value for name, value in final_metrics(run.path).items()})
        if experiment.evaluation.task is not None:
            every = [policies.at(np.array([k])) for k in range(len(policies))]
            score_run(run, every[0] if peer.known_utility else every)
    show_results(run, steps, console)
    run.set_status("finished", steps)
