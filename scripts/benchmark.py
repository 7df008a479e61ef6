"""Measure speed and memory.

    python scripts/benchmark.py --quick --output benchmark.csv
    python scripts/benchmark.py --against main --output pairs.csv
    python scripts/benchmark.py --threads 2 --output threads.csv
    python scripts/benchmark.py --device cuda --output gpu.csv

Everything is measured in one run, each speed as the best of several repetitions, so that ratios are reliable on a
machine with other load.

--against compares the working tree with a commit, in pairs of measurements of the CPU time of new processes, which
other programs change much less than the time on the clock. --threads and --device compare environments and training on
several threads, or on a GPU, with one thread of the CPU, in pairs of measurements of time on the clock; a GPU moves
65,536 worlds or trains ten seeds side by side: docs/scale.md#speed.
"""

# Both trees of a comparison run this file: it imports from the packages only what a measurement needs.

from __future__ import annotations

import io
import os
import platform
import re
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from itertools import product
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from argparse import Namespace

REPOSITORY = Path(__file__).resolve().parent.parent
ONE_WAYPOINT, STATIC_OBSTACLE, INTERSECTION, LEFT_TURN, ROUNDABOUT = (
    f"mo-deepdrive-{name}-v0" for name in ("one-waypoint", "static-obstacle", "intersection", "left-turn", "roundabout")
)
UTILITIES = {ONE_WAYPOINT: "one_waypoint_linear", INTERSECTION: "intersection_linear"}
RUN = 3_000_000  # steps of the runs in which speeds are measured: short ones are not compiled
WARM_UP, MEASURED = 3, 300_000  # updates that are not counted, and environment steps that are
WORLDS, SEEDS = 65_536, 10  # on a GPU
PAIRS = 10
COMPARISONS = "--against COMMIT, --threads COUNT and --device D"
SHIPPED = (
    *(f"{scenario}/a2c_linear" for scenario in ("one_waypoint", "static_obstacle", "intersection")),
    *(f"{scenario}/mo_ppo_linear" for scenario in ("one_waypoint", "static_obstacle", "intersection", "left_turn")),
)
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS")
FIRST_STEP = """
import sys
import gymnasium, mo_deepdrive
env = gymnasium.make_vec(sys.argv[1], num_envs=int(sys.argv[2]))
env.reset(seed=0)
env.step(env.action_space.sample())
if sys.platform == "linux":
    print(4096 * int(open("/proc/self/statm").read().split()[1]) / 1e6)
"""


@dataclass(frozen=True)
class Place:
    """Where worlds or a training run; their time is that on the clock, or of a tree's packages CPU time."""

    threads: int = 1
    device: str = "cpu"
    tree: Path | None = None

    @property
    def on_gpu(self) -> bool:
        """Whether worlds and learners are on a device."""
        return self.device != "cpu"

    def now(self) -> float:
        """The time (s), when all that was begun on the device is done."""
        if self.on_gpu:
            import torch

            torch.cuda.synchronize(self.device)
        return perf_counter() if self.tree is None else process_time()


ONE_CORE = Place()

# ------------------------------------------------------------------------------------------------------- measurements


def training(place: Place, values: str | dict[str, Any], steps: int = MEASURED) -> float:
    """Environment steps per second of an experiment, or a shipped one; on a GPU of SEEDS trainings side by side."""
    from algorithms.runs.build import build, build_trainee
    from algorithms.runs.config import load_experiment, make_experiment

    values = load_experiment(values).to_dict() if isinstance(values, str) else values
    where: dict[str, Any] = {"threads": place.threads, "device": place.device}
    if place.on_gpu:
        where |= {"seeds": [*range(SEEDS)], "compiled": True}
    experiment = make_experiment({**values, "training": {**values["training"], **where}})
    agent: Any = build_trainee(experiment.of_seeds()) if place.on_gpu else build(experiment)
    update = experiment.training.num_envs * getattr(experiment.algorithm.config, "steps", 1)

    def train_until(step: int) -> float:
        agent.train(RUN, after_update=lambda _: agent.step >= step)
        return place.now()

    started, first = train_until(WARM_UP * update), agent.step
    seconds = train_until(first + steps) - started
    return (SEEDS if place.on_gpu else 1) * float(agent.step - first) / seconds


def stepping(place: Place, step: Callable[[int], Any], count: int) -> float:
    """Calls of ``step`` with 0, 1, ... per second, after some that are not counted."""
    for i in range(max(10, count // 20)):
        step(i)
    started = place.now()
    for i in range(count):
        step(i)
    return count / (place.now() - started)


def make_vec(place: Place, env_id: str, num_envs: int = 1024, steps: int = 1500, **arguments: Any) -> float:
    """Environment steps per second of ``gymnasium.make_vec``, with autoreset, under random actions."""
    import gymnasium
    from gymnasium.vector import AutoresetMode

    import mo_deepdrive  # noqa: F401  (registers the ids)

    arguments |= {"device": place.device} if place.on_gpu else {"threads": place.threads}
    num_envs = WORLDS if place.on_gpu else num_envs
    env = gymnasium.make_vec(env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **arguments)
    env.reset(seed=0)
    actions: Any = np.random.default_rng(0).integers(0, 22, (100, *(env.action_space.shape or ())))
    if place.on_gpu:
        import torch

        actions = torch.as_tensor(actions, device=place.device)
    return num_envs * stepping(place, lambda i: env.step(actions[i % len(actions)]), steps)


def kernel(place: Place, env_id: str, num_envs: int = 1024, steps: int = 200) -> float:
    """Environment steps per second of the kernel alone (including the decoding of actions), without autoreset."""
    import gymnasium

    import mo_deepdrive  # noqa: F401  (registers the ids)

    env: Any = gymnasium.make_vec(env_id, num_envs=num_envs)
    env.reset(seed=0)
    batch = env.unwrapped.batch
    actions = np.random.default_rng(0).integers(0, 22, (10, num_envs, batch.scenario.vehicles))
    start = batch.state.copy()

    def step(i: int) -> None:
        if i % len(actions) == 0:
            batch.state[:] = start
        batch.step(actions[i % len(actions)])

    return num_envs * stepping(place, step, steps)


def make(place: Place, env_id: str = ONE_WAYPOINT, steps: int = 100_000) -> float:
    """Steps per second of ``mo_gymnasium.make`` under random actions."""
    import mo_gymnasium

    import mo_deepdrive  # noqa: F401  (registers the ids)

    env = mo_gymnasium.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]

    def step(i: int) -> None:
        _, _, terminated, truncated, _ = env.step(actions[i])
        if terminated or truncated:
            env.reset()

    return stepping(place, step, steps)


def parallel(place: Place, steps: int = 5000) -> float:
    """Joint steps per second of the PettingZoo parallel environment of the intersection under random actions."""
    import mo_deepdrive

    env = mo_deepdrive.parallel_env()
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(0, 22, (steps, len(env.possible_agents))).tolist()

    def step(i: int) -> None:
        joint = dict(zip(env.possible_agents, actions[i], strict=True))
        env.step({agent: joint[agent] for agent in env.agents})
        if not env.agents:
            env.reset()

    return stepping(place, step, steps)


def process(place: Place, code: str, *arguments: str, **variables: str) -> float:
    """Seconds that a new process of Python takes for ``code``, from its start to its end."""
    before, started = os.times(), perf_counter()
    run_python("-c", code, *arguments, **variables)
    after, seconds = os.times(), perf_counter() - started
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return seconds if place.tree is None else used


def run_python(*arguments: str, **variables: str) -> str:
    """The last line that ``python ARGUMENTS`` prints; if it fails, that line is a RuntimeError."""
    command, variables = [sys.executable, *arguments], {**os.environ, **variables}
    folder = tempfile.gettempdir()  # without packages, so that those of PYTHONPATH are found
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    *_, last_line = ["", *((done.returncode and done.stderr) or done.stdout).strip().splitlines()]
    if done.returncode:
        raise RuntimeError(last_line)
    return last_line


def experiment_of(algorithm: str, env_id: str, hidden: list[int], **arguments: Any) -> dict[str, Any]:
    """An experiment with the default settings of an actor-critic."""
    return {
        "environment": {"id": env_id, "arguments": arguments},
        "utility": {"name": UTILITIES[env_id]},
        "algorithm": {"name": algorithm, "steps": 16, "hidden": hidden},
        "training": {"total_timesteps": 1, "num_envs": 256},
    }


def short(env_id: str) -> str:
    """``one-waypoint`` of the environment's id."""
    return env_id.removeprefix("mo-deepdrive-").removesuffix("-v0")


Case = Callable[[Place], float]
PLACED: dict[str, Case] = {  # what can be measured in a place
    **{
        f"{name}-{hidden[0]}-{hidden[1]}-{actions}": partial(
            training, values=experiment_of(name, ONE_WAYPOINT, hidden, action_type=actions)
        )
        for name, hidden, actions in (
            *product(("a2c", "mo_a2c", "ppo", "mo_ppo"), ([64, 32], [128, 64]), ("discrete", "continuous")),
            *product(("a2c", "mo_ppo"), ([512, 512],), ("discrete",)),
            ("mo_ppo", [256, 256], "discrete"),
            ("mocac", [128, 64], "discrete"),
        )
    },
    **{
        f"two-{name}-128-64": partial(training, values=experiment_of(name, INTERSECTION, [128, 64]))
        for name in ("a2c", "mo_ppo")
    },
    **{config: partial(training, values=config) for config in SHIPPED},
    **{
        f"make_vec-{short(env_id)}": partial(make_vec, env_id=env_id)
        for env_id in (ONE_WAYPOINT, STATIC_OBSTACLE, INTERSECTION, LEFT_TURN)
    },
    "make_vec-roundabout-8": partial(make_vec, env_id=ROUNDABOUT, vehicles=8),
}
IN_SECONDS: dict[str, Case] = {"import": partial(process, code="import mo_deepdrive")}
CASES: dict[str, Case] = {
    **PLACED,
    "pcn": partial(training, values="one_waypoint/pcn", steps=40_000),
    "make": make,
    **IN_SECONDS,
}


def select(patterns: Sequence[str], cases: Mapping[str, Case]) -> list[str]:
    """The names of ``cases`` that match one of ``patterns`` (shell wildcards); all without patterns."""
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in cases):
            raise ValueError(f"{pattern!r} matches no measurement; known: {', '.join(cases)}")
    return [name for name in cases if not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)]


# ----------------------------------------------------------------------------------------------------------- overview

Row = dict[str, Any]  # of the table and of the file, by column


def overview(repetitions: int) -> list[Row]:
    """Speed and memory of the working tree, and the speed of an environment of MO-Gymnasium."""
    rows: list[Row] = []

    def add(name: str, value: float, unit: str = "steps/s", goal: str = "") -> float:
        rows.append({"measurement": name, "value": value, "unit": unit, "goal": goal})
        return value

    def best(run: Callable[..., float], *arguments: Any, place: Place = ONE_CORE) -> float:
        return max(run(place, *arguments) for _ in range(repetitions))

    for title, env_id, goal in (
        ("OneWaypoint", ONE_WAYPOINT, "4.0 M"),
        ("StaticObstacle", STATIC_OBSTACLE, "3.0 M"),
        ("Intersection", INTERSECTION, "1.5 M"),
        ("LeftTurn", LEFT_TURN, "1.2 M"),
    ):
        add(f"{title}, kernel alone, N = 1024", best(kernel, env_id))
        add(f"{title}, make_vec, N = 1024, 1 thread", best(make_vec, env_id), goal=goal)
        one, two = (best(make_vec, env_id, 4096, 100, place=Place(threads)) for threads in (1, 2))
        add(f"{title}, make_vec, N = 4096, 2 threads", two)
        add(f"{title}, 2 threads / 1 thread, N = 4096", two / one, "x", "1.8")
    single = add("OneWaypoint, mo_gymnasium.make", best(make, ONE_WAYPOINT, 5000), goal="60 k")
    add("LeftTurn, mo_gymnasium.make", best(make, LEFT_TURN, 5000), goal="40 k")
    minecart = add("minecart-v0, mo_gymnasium.make", best(make, "minecart-v0", 300))
    add("OneWaypoint / minecart-v0, single", single / minecart, "x")
    add("Intersection, parallel_env", best(parallel), "joint steps/s", "25 k")
    for algorithm, goal in (("a2c", "400 k"), ("mo_a2c", "300 k"), ("mo_ppo", "")):
        speed = best(training, experiment_of(algorithm, ONE_WAYPOINT, [64, 32]))
        add(f"{algorithm} training, 256 x 16, 1 thread", speed, goal=goal)
    for algorithm, hidden in product(("a2c", "mo_a2c", "mo_ppo"), ([64, 32], [128, 64])):
        speed = best(training, experiment_of(algorithm, INTERSECTION, hidden))
        add(f"independent {algorithm} training, {hidden}, 256 x 16, 1 thread", speed, "joint steps/s")
    with tempfile.TemporaryDirectory() as cache:
        for state, goal in (("cold", "< 20"), ("warm", "< 1.5")):
            seconds = process(ONE_CORE, FIRST_STEP, ONE_WAYPOINT, "1", NUMBA_CACHE_DIR=cache)
            add(f"import and first step, {state} cache", seconds, "s", goal)
    for env_id in (ONE_WAYPOINT, INTERSECTION) if sys.platform == "linux" else ():
        small, large = (float(run_python("-c", FIRST_STEP, env_id, count)) for count in ("1", "4096"))
        add(f"{short(env_id)}, 4096 environments, growth of resident memory", large - small, "MB")
        add(f"{short(env_id)}, 4096 environments, resident memory of the process", large, "MB", "< 300")
    return rows


# --------------------------------------------------------------------------------------------------------------- pairs


def git(*arguments: str) -> bytes:
    """What git prints; nothing if it fails."""
    return subprocess.run(["git", "-C", str(REPOSITORY), *arguments], capture_output=True, check=False).stdout


def revision(commit: str) -> str:
    """The full hash of ``commit``."""
    full = git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}").decode().strip()
    if not full:
        raise ValueError(f"{commit!r} is not a commit of {REPOSITORY}")
    return full


def working_tree() -> str:
    """The hash of the checked-out commit, with "-dirty" if files differ from it; "unknown" outside a repository."""
    return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*").decode().strip() or "unknown"


def machine() -> str:
    """The model of the processor and the number of its threads."""
    info = Path("/proc/cpuinfo")
    model = re.search(r"^model name\s*: (.*)$", info.read_text(encoding="utf-8") if info.exists() else "", re.MULTILINE)
    return f"{model[1] if model else platform.processor() or platform.machine()}, {os.cpu_count()} CPUs"


def measure_apart(place: Place, name: str) -> float:
    """A measurement in a new process."""
    # Idle threads spin as long as commands let them.
    variables = {**dict.fromkeys(THREADS, str(place.threads)), "GOMP_SPINCOUNT": "6000"}
    variables["PYTHONPATH"] = str(place.tree or REPOSITORY)
    where = str(place.threads), place.device, str(place.tree or "")
    return float(run_python(__file__, "--measure", name, *where, **variables))


def compare(
    old: Place,
    new: Place,
    names: Sequence[str],
    pairs: int,
    measure: Callable[[Place, str], float] = measure_apart,
) -> list[Row]:
    """Measure two places by turns, in changing order; the first pair fills caches and is not counted."""
    from rich.progress import track

    values: dict[tuple[str, Place], list[float]] = {(name, place): [] for name in names for place in (old, new)}
    problems: dict[str, str] = {}
    for pair, name in track(list(product(range(-1, pairs), names))):
        for place in () if name in problems else (old, new)[:: 1 if pair % 2 == 0 else -1]:
            try:
                value = measure(place, name)
            except RuntimeError as error:
                problems[name] = f"the {'old' if place == old else 'new'} side cannot run it: {error}"
                break
            if pair >= 0:
                values[name, place].append(value)
    return [comparison(name, values[name, old], values[name, new], problems.get(name, "")) for name in names]


def comparison(name: str, old: Sequence[float], new: Sequence[float], problem: str = "") -> Row:
    """Medians of both sides and of the speedup in pairs; of six or more its 95% interval (Conover 1999)."""
    from scipy.stats import quantile_test

    seconds = name in IN_SECONDS
    row: Row = {"measurement": name, "unit": "s" if seconds else "steps/s"}
    row |= dict.fromkeys(("old", "new", "speedup", "low", "high"))
    if not problem:
        ratios = [before / after if seconds else after / before for before, after in zip(old, new, strict=True)]
        row |= {"old": float(np.median(old)), "new": float(np.median(new)), "speedup": float(np.median(ratios))}
        interval = quantile_test(ratios, p=0.5).confidence_interval(0.95)
        if not np.isnan(interval.low):
            row |= {"low": float(interval.low), "high": float(interval.high)}
    return {**row, "pairs": 0 if problem else len(old), "problem": problem}


# -------------------------------------------------------------------------------------------------------- command line


def show(rows: Sequence[Row], output: Path | None, about: Row) -> None:
    """Print a table, and write it to a CSV file with what it is about in further columns."""
    from rich.console import Console
    from rich.table import Table

    from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes

    table = Table(*rows[0], caption=", ".join(f"{name} {value}" for name, value in about.items()))
    for column in table.columns[1:]:
        column.no_wrap = True
    for row in rows:
        table.add_row(*(f"{value:,.6g}" if isinstance(value, float) else str(value or "") for value in row.values()))
    Console().print(table)
    if output is not None:
        lines = ((row | about).values() for row in rows)
        cells = [[f"{cell:.6g}" if isinstance(cell, float) else cell for cell in line] for line in lines]
        atomic_write(output, csv_bytes([[*rows[0], *about], *cells]))


def compare_trees(options: Namespace) -> tuple[list[Row], Row]:
    """Compare the working tree with a commit: the rows, and what they are about."""
    names, commit = select(options.only, CASES), revision(options.against)
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(git("archive", "--format=tar", commit))) as archive:
            archive.extractall(folder, filter="data")
        rows = compare(Place(tree=Path(folder)), Place(tree=REPOSITORY), names, options.pairs or PAIRS)
    return rows, {"old_commit": commit, "new_commit": working_tree(), "threads": 1, "machine": machine()}


def compare_places(options: Namespace) -> tuple[list[Row], Row]:
    """Compare several threads, or a device, with one thread: the rows, and what they are about."""
    from mo_deepdrive.support.machine import available_cores, check_device

    names = select(options.only, PLACED)
    if options.device is not None:
        check_device("--device", options.device)
        place = Place(device=options.device)
    elif 2 <= options.threads <= available_cores():
        place = Place(options.threads)
    else:
        raise ValueError(f"--threads {options.threads} must be from 2 to {available_cores()}, the number of cores")
    rows = compare(ONE_CORE, place, names, options.pairs or PAIRS)
    device = place.device
    if place.on_gpu:
        import torch

        device = torch.cuda.get_device_name(device)
    return rows, {"commit": working_tree(), "threads": place.threads, "device": device, "machine": machine()}


def run(options: Namespace) -> int:
    """Measure what the options ask for."""
    from algorithms.learning.threads import set_threads
    from algorithms.runs.cli import check_at_least, check_file

    check_file("--output", options.output)
    check_at_least(options, 1, "pairs")
    comparisons = [option for option in (options.against, options.threads, options.device) if option is not None]
    if len(comparisons) > 1:
        raise ValueError(f"{COMPARISONS} are comparisons of their own; make one at a time")
    if not comparisons and (options.only or options.pairs is not None):
        raise ValueError(f"--only and --pairs are for {COMPARISONS}")
    if not comparisons:
        set_threads(1)
        show(overview(3 if options.quick else 15), options.output, {})
        return 0
    rows, about = compare_places(options) if options.against is None else compare_trees(options)
    show(rows, options.output, about)
    return 0


def main(arguments: Sequence[str]) -> int:
    """Run the command line, or in a process of :func:`measure_apart` one measurement."""
    if arguments[:1] == ["--measure"]:
        name, threads, device, tree = arguments[1:]
        place = Place(int(threads), device, Path(tree) if tree else None)
        if place.tree is None:
            from algorithms.learning.threads import set_threads

            set_threads(place.threads)
        print(CASES[name](place))
        return 0
    from algorithms.runs import cli

    only = "measurements that are compared, such as a2c-64-32-discrete 'mo_*'"
    options = (
        cli.flag("--quick", "fewer repetitions"),
        cli.option("--output", "FILE", "also write the table as CSV", type=Path),
        cli.option("--against", "COMMIT", "compare the working tree with this commit"),
        cli.option("--threads", "COUNT", "compare so many threads with one", type=int),
        cli.option("--device", "D", "compare environments and training there, such as on cuda, with one thread"),
        cli.option("--pairs", "N", f"of each measurement that is compared (default: {PAIRS})", type=int),
        cli.option("--only", "NAME", only, nargs="+", default=[]),
    )
    return cli.Command("", __doc__, options, run)(arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
