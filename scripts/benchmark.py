"""Measure speed and memory.

    python scripts/benchmark.py --quick --output benchmark.csv
    python scripts/benchmark.py --against main --output pairs.csv
    python scripts/benchmark.py --threads 2 --output threads.csv
    python scripts/benchmark.py --device cuda --output gpu.csv

Everything is measured in one run, each speed as the best of several repetitions, so that ratios are reliable on a
machine with other load. Other packages are measured where they are installed (``pip install highway-env`` for
mo-highway-fast-v0; the extra ``[peers]`` for morl-baselines' PCN).

--against compares the working tree with a commit, in pairs of measurements of CPU time. --threads and --device compare
environments and training on several threads, or on a GPU, with one thread of the CPU, in pairs of measurements of time
on the clock: docs/benchmark.md.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium
import mo_gymnasium
import numpy as np
import paired_benchmark
from gymnasium.vector import AutoresetMode
from paired_benchmark import ONE_CORE, training
from result_file import check_folder, write_results
from rich.console import Console
from rich.progress import track
from rich.table import Table

import mo_deepdrive
from algorithms.learning.threads import set_threads
from algorithms.peers import PEERS
from algorithms.peers.running import prepare
from algorithms.runs.build import build
from algorithms.runs.cli import make_parser
from algorithms.runs.config import load_experiment
from algorithms.runs.report import evaluate_front
from mo_deepdrive.evaluation.pareto import hypervolume
from mo_deepdrive.support.machine import available_cores, check_device
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Callable, Mapping, Sequence

IDS = {scenario.title: scenario.id for scenario in SCENARIOS.values()}
OTHERS = ("minecart-v0", "mo-highway-fast-v0")
STEPS_PER_REPETITION = 100
PAIRS = 10
COMPARISONS = "--against COMMIT, --threads COUNT and --device D"
CONFIGS = Path(__file__).resolve().parent.parent / "configs"
DEEP_SEA = CONFIGS / "deep_sea_treasure"
DEEP_SEA_POINT = (0.0, -25.0)  # the reference point of morl-baselines

FIRST_STEP = """
import mo_deepdrive, mo_gymnasium
env = mo_gymnasium.make("mo-deepdrive-one-waypoint-v0")
env.reset(seed=0)
env.step(0)
"""

MEMORY = r"""
import re
import gymnasium, mo_deepdrive
def resident():
    return int(re.search(r"VmRSS:\s+(\d+)", open("/proc/self/status").read()).group(1)) / 1024
def grown(count):
    env = gymnasium.make_vec("mo-deepdrive-{name}-v0", num_envs=count)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        env.step(env.action_space.sample())
    return env
small = grown(1)
before = resident()
large = grown(4096)
print(resident() - before, resident())
"""


@dataclass
class Measurement:
    """One measurement.

    Attributes:
        measurement: what was measured.
        value: in ``unit``.
        unit: of the value.
        goal: the value to be reached, as text.
    """

    measurement: str
    value: Annotated[float, ".6g"]
    unit: str
    goal: str = ""


def best(run: Callable[[], int], repetitions: int) -> float:
    """Units per second of the fastest of ``repetitions`` calls of ``run``, which returns the number of units."""
    fastest = 0.0
    for _ in range(repetitions):
        started = time.perf_counter()
        units = run()
        fastest = max(fastest, units / (time.perf_counter() - started))
    return fastest


def vector_rate(env_id: str, num_envs: int, threads: int, repetitions: int) -> float:
    """Environment steps per second of the native vector environment under random actions, including autoreset."""
    env = gymnasium.make_vec(env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, threads=threads)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    shape: tuple[int, ...] = (STEPS_PER_REPETITION, *(env.action_space.shape or ()))
    actions = rng.integers(0, 22, shape)

    def run() -> int:
        for action in actions:
            env.step(action)
        return num_envs * len(actions)

    run()
    return best(run, repetitions)


def kernel_rate(env_id: str, num_envs: int, repetitions: int) -> float:
    """Environment steps per second of the kernel alone (including the decoding of actions), without autoreset."""
    env = gymnasium.make_vec(env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    env.reset(seed=0)
    batch = env.unwrapped.batch  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    actions = rng.integers(0, 22, (10, num_envs, batch.scenario.vehicles))
    start = batch.state.copy()
    fastest = 0.0
    for _ in range(10 * repetitions):
        batch.state[:] = start
        started = time.perf_counter()
        for action in actions:
            batch.step(action)
        fastest = max(fastest, num_envs * len(actions) / (time.perf_counter() - started))
    return fastest


def single_rate(env_id: str, repetitions: int, steps: int) -> float | None:
    """Steps per second of ``mo_gymnasium.make(env_id)`` under random actions; None if it is not installed."""
    try:
        env = mo_gymnasium.make(env_id)
    except (gymnasium.error.Error, ImportError):
        return None
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]

    def run() -> int:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return len(actions)

    run()
    return best(run, repetitions)


def parallel_rate(repetitions: int, steps: int) -> float:
    """Joint steps per second of the PettingZoo parallel environment of the intersection under random actions."""
    env = mo_deepdrive.parallel_env()
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    choices = rng.integers(0, 22, (steps, len(env.possible_agents))).tolist()
    joint = [dict(zip(env.possible_agents, choice, strict=True)) for choice in choices]

    def run() -> int:
        for actions in joint:
            if len(env.agents) < len(actions):
                actions = {agent: actions[agent] for agent in env.agents}
            env.step(actions)
            if not env.agents:
                env.reset()
        return steps

    run()
    return best(run, repetitions)


def our_pcn() -> tuple[float, float]:
    """Seconds of training PCN on Deep Sea Treasure with its YAML file, and the hypervolume of its front."""
    experiment = load_experiment(DEEP_SEA / "pcn.yaml")
    agent = build(experiment)
    started = time.perf_counter()
    agent.train(experiment.training.total_timesteps)
    seconds = time.perf_counter() - started
    settings = experiment.evaluation
    front = evaluate_front(agent, experiment, episodes=settings.final_episodes, seed=settings.final_seed)
    return seconds, hypervolume(front.discounted, DEEP_SEA_POINT)


def peer_pcn() -> tuple[float, float] | None:
    """The same for morl-baselines' PCN with the arguments of its example; None if it is not installed."""
    experiment = load_experiment(DEEP_SEA / "morl_baselines_pcn.yaml")
    peer = PEERS[experiment.algorithm.name]
    if peer.unavailable_reason() is not None:
        return None
    task = prepare(experiment, lambda _step, _metrics: None)
    with contextlib.redirect_stdout(io.StringIO()):
        started = time.perf_counter()
        policies: Any = peer.train(task)
        seconds = time.perf_counter() - started
    settings = experiment.evaluation
    front = evaluate_front(policies, experiment, episodes=settings.final_episodes, seed=settings.final_seed)
    return seconds, hypervolume(front.discounted, DEEP_SEA_POINT)


def deep_sea_rows() -> list[Measurement]:
    """PCN on Deep Sea Treasure, this project's and morl-baselines'."""
    name = "deep-sea-treasure-v0"
    known = mo_gymnasium.make(name).unwrapped.pareto_front(0.99)  # type: ignore[attr-defined]
    best_known = f"{hypervolume(known, DEEP_SEA_POINT):.2f}"
    seconds, found = our_pcn()
    rows = [
        Measurement(f"{name}, pcn, as its YAML", seconds, "s"),
        Measurement(f"{name}, pcn, hypervolume", found, "", best_known),
    ]
    theirs = peer_pcn()
    if theirs is not None:
        rows.append(Measurement(f"{name}, morl-baselines' PCN, 100,000 steps", theirs[0], "s"))
        rows.append(Measurement(f"{name}, morl-baselines' PCN, hypervolume", theirs[1], "", best_known))
        rows.append(Measurement(f"{name}, time of pcn / morl-baselines' PCN", seconds / theirs[0], "x", "< 0.2"))
    return rows


def first_step_seconds() -> tuple[float, float]:
    """Seconds of a fresh interpreter from start to the first step: with a cold compilation cache, then a warm one."""
    seconds = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        for _ in range(2):
            started = time.perf_counter()
            subprocess.run([sys.executable, "-c", FIRST_STEP], check=True, env=environment)
            seconds.append(time.perf_counter() - started)
    return seconds[0], seconds[1]


def memory_megabytes(scenario: str) -> tuple[float, float]:
    """Growth and total of resident memory (MB) with 4096 environments; Linux only, since it reads /proc."""
    code = MEMORY.replace("{name}", scenario)
    output = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    growth, total = output.split()
    return float(growth), float(total)


def measure(repetitions: int, updates: int, with_threads: bool) -> list[Measurement]:
    """All measurements."""
    rows: list[Measurement] = []
    targets = {"OneWaypoint": "4.0 M", "StaticObstacle": "3.0 M", "Intersection": "1.5 M", "LeftTurn": "1.2 M"}
    for title, env_id in IDS.items():
        rows.append(Measurement(f"{title}, kernel alone, N = 1024", kernel_rate(env_id, 1024, repetitions), "steps/s"))
        rate = vector_rate(env_id, 1024, 1, repetitions)
        rows.append(Measurement(f"{title}, make_vec, N = 1024, 1 thread", rate, "steps/s", targets[title]))
        if with_threads:
            one = vector_rate(env_id, 4096, 1, repetitions)
            two = vector_rate(env_id, 4096, 2, repetitions)
            rows.append(Measurement(f"{title}, make_vec, N = 4096, 2 threads", two, "steps/s"))
            rows.append(Measurement(f"{title}, 2 threads / 1 thread, N = 4096", two / one, "x", "1.8"))
    ours = single_rate(IDS["OneWaypoint"], repetitions, 5000)
    assert ours is not None
    rows.append(Measurement("OneWaypoint, mo_gymnasium.make", ours, "steps/s", "60 k"))
    left_turn = single_rate(IDS["LeftTurn"], repetitions, 5000)
    assert left_turn is not None
    rows.append(Measurement("LeftTurn, mo_gymnasium.make", left_turn, "steps/s", "40 k"))
    for peer in OTHERS:
        rate_of_peer = single_rate(peer, max(1, repetitions // 3), 300)
        if rate_of_peer is not None:
            rows.append(Measurement(f"{peer}, mo_gymnasium.make", rate_of_peer, "steps/s"))
            rows.append(Measurement(f"OneWaypoint / {peer}, single", ours / rate_of_peer, "x"))
    rows.append(Measurement("Intersection, parallel_env", parallel_rate(repetitions, 5000), "joint steps/s", "25 k"))
    for algorithm, target in (("a2c", "400 k"), ("mo_a2c", "300 k"), ("mo_ppo", "")):
        rate = training(algorithm, IDS["OneWaypoint"], [64, 32], updates, {}, ONE_CORE)
        rows.append(Measurement(f"{algorithm} training, 256 x 16, 1 thread", rate, "steps/s", target))
    for algorithm, target in (("a2c", "150 k"), ("mo_a2c", ""), ("mo_ppo", "")):
        for hidden in ([64, 32], [128, 64]):
            rate = training(algorithm, IDS["Intersection"], hidden, updates // 2, {}, ONE_CORE)
            what = f"independent {algorithm} training, {hidden}, 256 x 16, 1 thread"
            rows.append(Measurement(what, rate, "joint steps/s", target))
    rows += deep_sea_rows()
    cold, warm = first_step_seconds()
    rows.append(Measurement("import and first step, cold cache", cold, "s", "< 20"))
    rows.append(Measurement("import and first step, warm cache", warm, "s", "< 1.5"))
    for scenario in ("one-waypoint", "intersection"):
        growth, total = memory_megabytes(scenario)
        rows.append(Measurement(f"{scenario}, 4096 environments, growth of resident memory", growth, "MB"))
        rows.append(Measurement(f"{scenario}, 4096 environments, resident memory of the process", total, "MB", "< 300"))
    return rows


def compare_trees(commit: str, names: Sequence[str], pairs: int, output: Path | None) -> None:
    """Compare the working tree with ``commit``, a hash; print the table and write it to ``output``."""
    with paired_benchmark.checkout(commit) as old:
        measure, new = paired_benchmark.measure, paired_benchmark.REPOSITORY
        rows = paired_benchmark.compare(old, new, names, pairs, measure, progress=track)
    about = {"old_commit": commit, "new_commit": paired_benchmark.working_tree()}
    caption = f"old: {commit:.12}, new: {about['new_commit']:.12}; CPU time, one thread"
    print_comparison(rows, ("old", "new"), caption, about | {"threads": paired_benchmark.THREADS}, output)


def compare_places(place: paired_benchmark.Place, names: Sequence[str], pairs: int, output: Path | None) -> None:
    """Compare ``place`` with one thread; print the table and write it to ``output``."""
    one, measure = paired_benchmark.ONE_CORE, paired_benchmark.measure_in
    rows = paired_benchmark.compare(one, place, names, pairs, measure, progress=track)
    commit = paired_benchmark.working_tree()
    about = {"commit": commit, "threads": place.threads, "device": paired_benchmark.device_name(place.device)}
    print_comparison(rows, (str(one), str(place)), f"{commit:.12}; time on the clock", about, output)


def print_comparison(
    rows: Sequence[paired_benchmark.Row],
    sides: tuple[str, str],
    caption: str,
    about: Mapping[str, Any],
    output: Path | None,
) -> None:
    """Print the table of a comparison, and write it to ``output`` with what it is ``about``."""
    machine = paired_benchmark.machine()
    table = Table("measurement", *sides, "unit", "speed-up [95% interval]", caption=f"{caption}; {machine}")
    table.columns[0].no_wrap = True
    for row in rows:
        table.add_row(*row.cells())
    Console().print(table)
    write_results(output, rows, {**about, "machine": machine})


def chosen_place(threads: int | None, device: str | None) -> paired_benchmark.Place:
    """What is compared with one thread: ``device``, or ``threads`` of the CPU."""
    if device is not None:
        check_device("--device", device)
        return paired_benchmark.Place(device=device)
    cores = available_cores()
    if threads is None or not 2 <= threads <= cores:
        raise ValueError(f"--threads {threads} must be from 2 to {cores}, the number of cores")
    return paired_benchmark.Place(threads=threads)


def compare(parser: ArgumentParser, arguments: Namespace) -> None:
    """Make the comparison that the arguments ask for."""
    pairs = PAIRS if arguments.pairs is None else arguments.pairs
    if sum(each is not None for each in (arguments.against, arguments.threads, arguments.device)) > 1:
        parser.error(f"{COMPARISONS} are comparisons of their own; make one at a time")
    if pairs < 1:
        parser.error(f"--pairs {pairs} must be at least 1")
    try:
        if arguments.against is not None:
            names = paired_benchmark.select(arguments.only)
            compare_trees(paired_benchmark.revision(arguments.against), names, pairs, arguments.output)
            return
        names = paired_benchmark.select(arguments.only, paired_benchmark.PLACED)
        place = chosen_place(arguments.threads, arguments.device)
    except ValueError as error:
        parser.error(str(error))
    compare_places(place, names, pairs, arguments.output)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument("--output", type=Path, help="also write the table as CSV")
    parser.add_argument("--against", metavar="COMMIT", help="compare the working tree with this commit")
    parser.add_argument("--threads", type=int, help="compare so many threads with one")
    parser.add_argument(
        "--device", metavar="D", help="compare environments and training there, such as on cuda, with one thread"
    )
    parser.add_argument("--pairs", type=int, help=f"of each measurement that is compared (default: {PAIRS})")
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        metavar="NAME",
        help="measurements that are compared, such as a2c-64-32-discrete 'mo_*'",
    )
    arguments = parser.parse_args(argv)
    check_folder(parser, arguments.output)
    if any(each is not None for each in (arguments.against, arguments.threads, arguments.device)):
        compare(parser, arguments)
        return
    if arguments.only or arguments.pairs is not None:
        parser.error(f"--only and --pairs are for {COMPARISONS}")
    set_threads(1)
    repetitions = 3 if arguments.quick else 15
    rows = measure(repetitions, 100 if arguments.quick else 750, with_threads=available_cores() > 1)
    table = Table("measurement", "value", "unit", "goal")
    for row in rows:
        value = f"{row.value:,.0f}" if row.value >= 1000 else f"{row.value:.2f}"
        table.add_row(row.measurement, value, row.unit, row.goal)
    Console().print(table)
    write_results(arguments.output, rows)


if __name__ == "__main__":
    main()
