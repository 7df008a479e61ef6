"""Measure speed and memory.

    python scripts/benchmark.py --quick --output benchmark.csv
    python scripts/benchmark.py --against main --output pairs.csv
    python scripts/benchmark.py --threads 2 --output threads.csv
    python scripts/benchmark.py --device cuda --output gpu.csv

Everything is measured in one run, each speed as the best of several repetitions, so that ratios are reliable on a
machine with other load. Other packages are measured where they are installed (``pip install highway-env`` for
mo-highway-fast-v0).

--against compares the working tree with a commit, in pairs of measurements of the CPU time of new processes, which
other programs change much less than the time on the clock. --threads and --device compare environments and training on
several threads, or on a GPU, with one thread of the CPU, in pairs of measurements of time on the clock; a GPU moves
65,536 worlds or trains ten seeds side by side: docs/benchmark.md.
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from itertools import product
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from argparse import Namespace

Side = TypeVar("Side")

REPOSITORY = Path(__file__).resolve().parent.parent
ONE_WAYPOINT, STATIC_OBSTACLE, INTERSECTION, LEFT_TURN, ROUNDABOUT = (
    f"mo-deepdrive-{name}-v0" for name in ("one-waypoint", "static-obstacle", "intersection", "left-turn", "roundabout")
)
UTILITIES = {ONE_WAYPOINT: "one_waypoint_linear", INTERSECTION: "intersection_linear"}
OTHERS = ("minecart-v0", "mo-highway-fast-v0")
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
SPINNING = {"GOMP_SPINCOUNT": "6000"}  # of idle threads, as commands set it
TRAIN = "{tree}/scripts/train.py"
ONE_UPDATE = """
environment: {id: mo-deepdrive-one-waypoint-v0}
utility: {name: one_waypoint_linear}
algorithm: {name: mo_a2c, steps: 16, hidden: [64, 32]}
training: {total_timesteps: 4096, num_envs: 256}
evaluation: {episodes: 1, final_episodes: 1}
logging: {save_figures: false}
"""
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
    """Where worlds or a training run, and by which clock their time is measured."""

    threads: int = 1
    device: str = "cpu"
    clock: Callable[[], float] = perf_counter

    @property
    def on_gpu(self) -> bool:
        """Whether worlds and learners are on a device."""
        return self.device != "cpu"

    def __str__(self) -> str:
        return self.device if self.on_gpu else f"{self.threads} thread{'' if self.threads == 1 else 's'}"

    def device_name(self) -> str:
        """The model of the device, or "cpu"."""
        if not self.on_gpu:
            return self.device
        import torch

        return torch.cuda.get_device_name(self.device)

    def now(self) -> float:
        """The time (s), when all that was begun on the device is done."""
        if self.on_gpu:
            import torch

            torch.cuda.synchronize(self.device)
        return self.clock()


ONE_CORE, CPU_TIME = Place(), Place(clock=process_time)

# ------------------------------------------------------------------------------------------------------- measurements


def training(place: Place, values: str | dict[str, Any], *overrides: str, steps: int = MEASURED) -> float:
    """Environment steps per second of an experiment, or a shipped one; on a GPU of SEEDS trainings side by side."""
    from algorithms.runs.build import build, build_trainee
    from algorithms.runs.config import load_experiment, make_experiment

    values = load_experiment(values, overrides).to_dict() if isinstance(values, str) else values
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


def process(place: Place, *arguments: str, outputs: Sequence[str] = ("warm-up", "run"), **variables: str) -> float:
    """CPU seconds (on the clock in a place) of ``python ARGUMENTS`` from start to end, the last of several times."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "run.yaml").write_text(ONE_UPDATE)
        for output in outputs:  # those before the last one fill caches
            names = {"tree": os.environ.get("PYTHONPATH", ""), "output": output}
            before, started = os.times(), perf_counter()
            _run([word.format(**names) if "{" in word else word for word in arguments], folder, **variables)
            after, seconds = os.times(), perf_counter() - started
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return used if place.clock is process_time else seconds


class CannotMeasureError(Exception):
    """A measurement cannot be run; the message says why."""


def _run(arguments: Sequence[str], folder: str | None = None, **variables: str) -> str:
    """The last line that ``python ARGUMENTS`` prints, with these variables in its environment."""
    command, variables = [sys.executable, *arguments], {**os.environ, **variables}
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    printed = (done.returncode and done.stderr) or done.stdout
    last_line = (printed.strip().splitlines() or [""])[-1]
    if done.returncode:
        raise CannotMeasureError(last_line)
    return last_line


Case = Callable[[Place], float]


def _experiment(algorithm: str, env_id: str, hidden: list[int], **arguments: Any) -> dict[str, Any]:
    """An experiment with the default settings of an actor-critic."""
    return {
        "environment": {"id": env_id, "arguments": arguments},
        "utility": {"name": UTILITIES[env_id]},
        "algorithm": {"name": algorithm, "steps": 16, "hidden": hidden},
        "training": {"total_timesteps": 1, "num_envs": 256},
    }


def _short(env_id: str) -> str:
    return env_id.removeprefix("mo-deepdrive-").removesuffix("-v0")


def _placed_cases() -> Iterator[tuple[str, Case]]:
    for algorithm, hidden, actions in product(
        ("a2c", "mo_a2c", "ppo", "mo_ppo"), ([64, 32], [128, 64]), ("discrete", "continuous")
    ):
        name = f"{algorithm}-{hidden[0]}-{hidden[1]}-{actions}"
        yield name, partial(training, values=_experiment(algorithm, ONE_WAYPOINT, hidden, action_type=actions))
    for algorithm, hidden in (("a2c", [512] * 2), ("mo_ppo", [256] * 2), ("mo_ppo", [512] * 2), ("mocac", [128, 64])):
        name = f"{algorithm}-{hidden[0]}-{hidden[1]}-discrete"
        yield name, partial(training, values=_experiment(algorithm, ONE_WAYPOINT, hidden))
    for algorithm in ("a2c", "mo_ppo"):
        yield f"two-{algorithm}-128-64", partial(training, values=_experiment(algorithm, INTERSECTION, [128, 64]))
    for config in SHIPPED:
        yield config, partial(training, values=config)
    for env_id in (ONE_WAYPOINT, STATIC_OBSTACLE, INTERSECTION, LEFT_TURN):
        yield f"make_vec-{_short(env_id)}", partial(make_vec, env_id=env_id)
    yield "make_vec-roundabout-8", partial(make_vec, env_id=ROUNDABOUT, vehicles=8)


def _pcn(place: Place, *settings: str) -> float:
    return training(place, "one_waypoint/pcn", *(f"--algorithm.{setting}" for setting in settings), steps=40_000)


PLACED = dict(_placed_cases())  # what can be measured in a place
IN_SECONDS: dict[str, Case] = {
    "import": lambda place: process(place, "-c", "import mo_deepdrive"),
    "train-help": lambda place: process(place, TRAIN, "--help"),
    "train-one-update": lambda place: process(place, TRAIN, "--config", "run.yaml", "--output", "{output}"),
}
CASES: dict[str, Case] = {
    **PLACED,
    "pcn-collection": lambda place: _pcn(place, "gradient_steps=1", "batch_size=1"),
    "pcn": _pcn,
    "make": make,
    **IN_SECONDS,
}


def select(patterns: Sequence[str], cases: Mapping[str, Case] = CASES) -> list[str]:
    """The names of ``cases`` that match one of ``patterns`` (shell wildcards); all without patterns."""
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in cases):
            raise ValueError(f"{pattern!r} matches no measurement; known: {', '.join(cases)}")
    return [name for name in cases if not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)]


# ----------------------------------------------------------------------------------------------------------- overview

Row = dict[str, Any]  # of the table and of the file, by column


def overview(repetitions: int) -> list[Row]:
    """Speed and memory of the working tree, and of what else is installed."""
    import gymnasium

    from mo_deepdrive.support.machine import available_cores

    rows: list[Row] = []

    def add(name: str, value: float, unit: str = "steps/s", goal: str = "") -> float:
        rows.append({"measurement": name, "value": value, "unit": unit, "goal": goal})
        return value

    def best(run: Callable[..., float], *arguments: Any, place: Place = ONE_CORE, **settings: Any) -> float:
        return max(run(place, *arguments, **settings) for _ in range(repetitions))

    for title, env_id, goal in (
        ("OneWaypoint", ONE_WAYPOINT, "4.0 M"),
        ("StaticObstacle", STATIC_OBSTACLE, "3.0 M"),
        ("Intersection", INTERSECTION, "1.5 M"),
        ("LeftTurn", LEFT_TURN, "1.2 M"),
    ):
        add(f"{title}, kernel alone, N = 1024", best(kernel, env_id))
        add(f"{title}, make_vec, N = 1024, 1 thread", best(make_vec, env_id), goal=goal)
        if available_cores() > 1:
            one, two = (best(make_vec, env_id, 4096, 100, place=Place(threads)) for threads in (1, 2))
            add(f"{title}, make_vec, N = 4096, 2 threads", two)
            add(f"{title}, 2 threads / 1 thread, N = 4096", two / one, "x", "1.8")
    single = add("OneWaypoint, mo_gymnasium.make", best(make, ONE_WAYPOINT, 5000), goal="60 k")
    add("LeftTurn, mo_gymnasium.make", best(make, LEFT_TURN, 5000), goal="40 k")
    for other in OTHERS:
        try:
            speed = best(make, other, 300)
        except (gymnasium.error.Error, ImportError):  # it is not installed
            continue
        add(f"OneWaypoint / {other}, single", single / add(f"{other}, mo_gymnasium.make", speed), "x")
    add("Intersection, parallel_env", best(parallel), "joint steps/s", "25 k")
    for algorithm, goal in (("a2c", "400 k"), ("mo_a2c", "300 k"), ("mo_ppo", "")):
        speed = best(training, _experiment(algorithm, ONE_WAYPOINT, [64, 32]))
        add(f"{algorithm} training, 256 x 16, 1 thread", speed, goal=goal)
    for algorithm, hidden in product(("a2c", "mo_a2c", "mo_ppo"), ([64, 32], [128, 64])):
        speed = best(training, _experiment(algorithm, INTERSECTION, hidden))
        add(f"independent {algorithm} training, {hidden}, 256 x 16, 1 thread", speed, "joint steps/s")
    first_step = ("-c", FIRST_STEP, ONE_WAYPOINT, "1")
    with tempfile.TemporaryDirectory() as cache:
        for state, goal in (("cold", "< 20"), ("warm", "< 1.5")):
            seconds = process(ONE_CORE, *first_step, outputs=["run"], NUMBA_CACHE_DIR=cache)
            add(f"import and first step, {state} cache", seconds, "s", goal)
    for env_id in (ONE_WAYPOINT, INTERSECTION) if sys.platform == "linux" else ():
        small, large = (float(_run(["-c", FIRST_STEP, env_id, count])) for count in ("1", "4096"))
        add(f"{_short(env_id)}, 4096 environments, growth of resident memory", large - small, "MB")
        add(f"{_short(env_id)}, 4096 environments, resident memory of the process", large, "MB", "< 300")
    return rows


# --------------------------------------------------------------------------------------------------------------- pairs


def revision(commit: str) -> str:
    """The full hash of ``commit``."""
    full = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}").decode().strip()
    if not full:
        raise ValueError(f"{commit!r} is not a commit of {REPOSITORY}")
    return full


def working_tree() -> str:
    """The hash of the checked-out commit, with "-dirty" if files differ from it; "unknown" outside a repository."""
    return _git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*").decode().strip() or "unknown"


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """A temporary folder with the files of ``commit``."""
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(_git("archive", "--format=tar", commit))) as archive:
            archive.extractall(folder, filter="data")
        yield Path(folder)


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", "-C", str(REPOSITORY), *arguments], capture_output=True, check=False).stdout


def machine() -> str:
    """The model of the processor and the number of its threads."""
    info = Path("/proc/cpuinfo")
    model = re.search(r"^model name\s*: (.*)$", info.read_text(encoding="utf-8") if info.exists() else "", re.MULTILINE)
    return f"{model[1] if model else platform.processor() or platform.machine()}, {os.cpu_count()} CPUs"


def measure_apart(side: Path | Place, name: str) -> float:
    """A measurement in a new process: of the packages in a tree in CPU time, or on the clock in a place."""
    place, tree = (side, REPOSITORY) if isinstance(side, Place) else (ONE_CORE, side)
    threads = str(place.threads)
    where = (threads, place.device) if isinstance(side, Place) else ("", "")
    variables = {**dict.fromkeys(THREADS, threads), **SPINNING, "PYTHONPATH": str(tree)}
    return float(_run([__file__, "--measure", name, *where], **variables))


def measure(name: str, place: Place, tree: Path) -> float:
    """A measurement in this process, of the packages in ``tree``."""
    if place.clock is perf_counter:
        from algorithms.learning.threads import set_threads

        set_threads(place.threads)
    result = CASES[name](place)
    for module_name, module in [*sys.modules.items()]:
        file = getattr(module, "__file__", None)
        ours = module_name.partition(".")[0] in ("mo_deepdrive", "algorithms")
        # An installed package answers for modules that the tree lacks.
        if ours and file is not None and not Path(file).is_relative_to(tree):
            raise ImportError(f"{tree} has no module {module_name}")
    return result


def compare(
    old: Side,
    new: Side,
    names: Sequence[str],
    pairs: int,
    measure: Callable[[Side, str], float],
    progress: Callable[[Sequence[Any]], Iterable[Any]] = iter,
) -> list[Row]:
    """Measure two trees or places by turns, in changing order; the first pair fills caches and is not counted."""
    values: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in names}
    problems: dict[str, str] = {}
    for pair, name in progress(list(product(range(-1, pairs), names))):
        sides = (("old", old, values[name][0]), ("new", new, values[name][1]))
        for title, side, measured in () if name in problems else sides[:: 1 if pair % 2 == 0 else -1]:
            try:
                value = measure(side, name)
            except CannotMeasureError as error:
                problems[name] = f"the {title} side cannot run it: {error}"
                break
            if pair >= 0:
                measured.append(value)
    return [comparison(name, *values[name], problems.get(name, "")) for name in names]


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


def show(rows: Sequence[Row], output: Path | None, about: Row, caption: str = "") -> None:
    """Print a table, and write it to a CSV file with what it is about in further columns."""
    from rich.console import Console
    from rich.table import Table

    from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes

    table = Table(*rows[0], caption=caption)
    for column in table.columns[1:]:
        column.no_wrap = True
    for row in rows:
        table.add_row(*(f"{value:,.6g}" if isinstance(value, float) else str(value or "") for value in row.values()))
    Console().print(table)
    if output is not None:
        lines = ((row | about).values() for row in rows)
        cells = [[f"{cell:.6g}" if isinstance(cell, float) else cell for cell in line] for line in lines]
        atomic_write(output, csv_bytes([[*rows[0], *about], *cells]))


def compare_as_asked(options: Namespace) -> None:
    """Make the comparison that the options ask for, and show it."""
    from rich.progress import track

    from mo_deepdrive.support.machine import available_cores, check_device

    pairs = PAIRS if options.pairs is None else options.pairs
    tree = working_tree()
    if options.against is not None:
        names, commit = select(options.only), revision(options.against)
        with checkout(commit) as old:
            rows = compare(old, REPOSITORY, names, pairs, measure_apart, track)
        about = {"old_commit": commit, "new_commit": tree, "threads": 1, "machine": machine()}
        caption = f"old: {commit:.12}, new: {tree:.12}; CPU time, one thread; {machine()}"
    else:
        names = select(options.only, PLACED)
        if options.device is not None:
            check_device("--device", options.device)
            place = Place(device=options.device)
        elif 2 <= options.threads <= available_cores():
            place = Place(options.threads)
        else:
            raise ValueError(f"--threads {options.threads} must be from 2 to {available_cores()}, the number of cores")
        rows = compare(ONE_CORE, place, names, pairs, measure_apart, track)
        about = {"commit": tree, "threads": place.threads, "device": place.device_name(), "machine": machine()}
        caption = f"old: {ONE_CORE}, new: {place}; {tree:.12}; time on the clock; {machine()}"
    show(rows, options.output, about, caption)


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
    if comparisons:
        compare_as_asked(options)
    else:
        set_threads(1)
        show(overview(3 if options.quick else 15), options.output, {})
    return 0


def main(arguments: Sequence[str]) -> int:
    """Run the command line, or in a process of :func:`measure_apart` one measurement."""
    if arguments[:1] == ["--measure"]:
        name, threads, device = arguments[1:]
        place = Place(int(threads), device) if threads else CPU_TIME
        print(measure(name, place, Path(os.environ["PYTHONPATH"])))
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
