"""The paired measurements of ``scripts/benchmark.py --against COMMIT``, ``--threads COUNT`` and ``--device DEVICE``.

The script measures two trees with the same code, this file, which uses only interfaces that both have. Run as a
program, it measures one tree: ``PYTHONPATH=TREE python scripts/paired_benchmark.py NAME`` prints the result.

What is measured is the CPU time of the process, summed over its threads, because other programs on the machine change
it much less than the time on the clock. What more threads or a GPU gain is measured on the clock, by ``NAME THREADS
DEVICE``, where a GPU moves WORLDS worlds or trains SEEDS seeds side by side, by compiled updates. Speeds of training
are those within a run of RUN steps, after compilation and the first updates; ``run-...`` are whole runs.
"""

from __future__ import annotations

import io
import json
import os
import platform
import resource
import subprocess
import sys
import tarfile
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import partial
from itertools import product
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
from scipy.stats import quantile_test

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

Side = TypeVar("Side")

REPOSITORY = Path(__file__).resolve().parent.parent
ONE_WAYPOINT, STATIC_OBSTACLE, INTERSECTION, LEFT_TURN, ROUNDABOUT = (
    f"mo-deepdrive-{name}-v0" for name in ("one-waypoint", "static-obstacle", "intersection", "left-turn", "roundabout")
)
UTILITIES = {ONE_WAYPOINT: "one_waypoint_linear", INTERSECTION: "intersection_linear"}
ENVS, STEPS, WARM_UP = 256, 16, 3  # environments, steps per update, updates that are not counted
PCN_ENVS, PCN_STEPS = 16, 40_000
RUN = 3_000_000  # steps of the runs in which speeds are measured
WORLDS, SEEDS = 65_536, 10  # on a GPU
# Shipped experiments, with their numbers of environments and steps, and how many updates are measured.
SHIPPED = {
    "one_waypoint/a2c_linear": 150,
    "static_obstacle/a2c_linear": 40,
    "intersection/a2c_linear": 60,
    "one_waypoint/mo_ppo_linear": 30,
    "static_obstacle/mo_ppo_linear": 10,
    "intersection/mo_ppo_linear": 10,
    "left_turn/mo_ppo_linear": 10,
}
WHOLE_RUNS = ("a2c_linear", "mo_a2c_linear", "mo_ppo_linear", "conditioned", "pcn")  # of OneWaypoint
TRAIN = "{TREE}/scripts/train.py"
ONE_UPDATE = """
environment: {id: mo-deepdrive-one-waypoint-v0}
utility: {name: one_waypoint_linear}
algorithm: {name: mo_a2c, steps: 16, hidden: [64, 32]}
training: {total_timesteps: 4096, num_envs: 256}
evaluation: {episodes: 1, final_episodes: 1}
logging: {save_figures: false}
"""
# One thread, whatever the machine has.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"), "1"
)
THREADS = 1
SPINNING = {"GOMP_SPINCOUNT": "6000"}  # of idle threads, as commands set it


@dataclass(frozen=True)
class Place:
    """Where worlds or a training run whose time on the clock is measured.

    Attributes:
        threads: of the CPU.
        device: of the worlds, or of the training.
    """

    threads: int = THREADS
    device: str = "cpu"

    def __str__(self) -> str:
        if self.device != "cpu":
            return self.device
        return "1 thread" if self.threads == 1 else f"{self.threads} threads"


ONE_CORE = Place()


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let processes that are started within a ``with`` statement use one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# ------------------------------------------------------------------------------------------------ what one tree can do


def training(
    algorithm: str, env_id: str, hidden: list[int], updates: int, arguments: dict[str, Any], place: Place | None = None
) -> float:
    """Environment steps per CPU second of an actor-critic with the default settings; on the clock in a place."""
    if place is not None and place.device != "cpu":
        values: dict[str, Any] = {
            "environment": {"id": env_id, "arguments": arguments},
            "utility": {"name": UTILITIES[env_id]},
            "algorithm": {"name": algorithm, "steps": STEPS, "hidden": hidden},
            "training": {"total_timesteps": 1, "num_envs": ENVS, "device": place.device},
        }
        return _training_there(values, updates, place)
    import algorithms
    from mo_deepdrive.evaluation.env_adapter import make_env
    from mo_deepdrive.utilities import make_utility

    if place is not None:
        from algorithms.learning.threads import set_threads

        set_threads(place.threads)
    env: Any = make_env(env_id, ENVS, arguments)
    utility = make_utility(UTILITIES[env_id], env.unwrapped.objectives)
    agent = algorithms.ALGORITHMS[algorithm](env, utility, seed=0, steps=STEPS, hidden=hidden)
    return training_rate(agent, WARM_UP * ENVS * STEPS, updates * ENVS * STEPS, place)


def shipped(config: str, updates: int, place: Place | None = None) -> float:
    """As :func:`training`, of a shipped experiment."""
    from algorithms.runs.build import build
    from algorithms.runs.config import load_experiment

    where = place or ONE_CORE
    experiment = load_experiment(config, [f"--training.threads={where.threads}", f"--training.device={where.device}"])
    if where.device != "cpu":
        return _training_there(experiment.to_dict(), updates, where)
    agent: Any = build(experiment)
    steps = agent.env.num_envs * agent.config.steps
    return training_rate(agent, WARM_UP * steps, updates * steps, place)


def _training_there(values: dict[str, Any], updates: int, place: Place) -> float:
    """Environment steps per second of SEEDS trainings side by side, whose worlds and learners stay on a device."""
    from algorithms.runs.build import build_trainee
    from algorithms.runs.config import make_experiment

    values["training"] |= {"seeds": [*range(SEEDS)], "compiled": True}
    experiment = make_experiment(values)
    steps = experiment.training.num_envs * experiment.algorithm.config.steps
    return SEEDS * training_rate(build_trainee(experiment.of_seeds()), WARM_UP * steps, updates * steps, place)


def pcn(gradient_steps: int, batch_size: int) -> float:
    """Environment steps per CPU second of PCN on OneWaypoint, with the network and buffer of the shipped YAML file."""
    import algorithms
    from mo_deepdrive.evaluation.env_adapter import make_env

    env = make_env(ONE_WAYPOINT, PCN_ENVS, {"fixed_destination": True})
    settings = {"hidden": [64, 64], "learning_rate": 3e-3, "persistence": 0.95, "buffer_size": 100}
    agent = algorithms.ALGORITHMS["pcn"](
        env, seed=0, gradient_steps=gradient_steps, batch_size=batch_size, horizon_reduction=0, **settings
    )
    return training_rate(agent, 1, PCN_STEPS)


def training_rate(agent: Any, warm_up: int, steps: int, place: Place | None = None) -> float:
    """Environment steps per CPU second of ``steps`` after the first ``warm_up``; on the clock in a place."""
    clock = process_time if place is None else perf_counter
    _train_until(agent, warm_up)
    first, started = agent.step, clock()
    _train_until(agent, first + steps)
    return float((agent.step - first) / (clock() - started))


def _train_until(agent: Any, step: int) -> None:
    """Do a part of a run of RUN steps, whose length decides whether its gradient steps are compiled."""
    agent.train(RUN, after_update=lambda _: agent.step >= step)
    if agent.device.type != "cpu":
        import torch

        torch.cuda.synchronize(agent.device)


def make_vec(
    env_id: str, place: Place | None = None, num_envs: int = 1024, steps: int = 1500, **arguments: Any
) -> float:
    """Environment steps per CPU second of ``gymnasium.make_vec`` under random actions; on the clock in a place."""
    import gymnasium
    from gymnasium.vector import AutoresetMode

    import mo_deepdrive  # noqa: F401  (registers the ids)

    if place is not None and place.device != "cpu":
        return make_vec_on(place.device, env_id, **arguments)
    clock = process_time if place is None else perf_counter
    threads = 1 if place is None else place.threads
    env = gymnasium.make_vec(
        env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, threads=threads, **arguments
    )
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(0, 22, (100, *(env.action_space.shape or ())))
    for action in actions:
        env.step(action)
    started = clock()
    for i in range(steps):
        env.step(actions[i % len(actions)])
    return num_envs * steps / (clock() - started)


def make_vec_on(device: str, env_id: str, num_envs: int = WORLDS, steps: int = 1000, **arguments: Any) -> float:
    """Environment steps per second of ``gymnasium.make_vec`` with random actions that are made on the device, too."""
    import gymnasium
    import torch
    from gymnasium.vector import AutoresetMode

    env = gymnasium.make_vec(
        env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, device=device, **arguments
    )
    env.reset(seed=0)
    generator = torch.Generator(device).manual_seed(0)
    elapsed = 0.0
    for count in (100, steps):  # the last ones are measured
        torch.cuda.synchronize(device)
        started = perf_counter()
        for _ in range(count):
            actions = torch.randint(0, 22, env.action_space.shape or (), generator=generator, device=device)
            env.step(actions)
        torch.cuda.synchronize(device)
        elapsed = perf_counter() - started
    return num_envs * steps / elapsed


def make(steps: int = 100_000) -> float:
    """Steps per CPU second of ``mo_gymnasium.make`` under random actions."""
    import mo_gymnasium

    import mo_deepdrive  # noqa: F401  (registers the ids)

    env = mo_gymnasium.make(ONE_WAYPOINT)
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(0, 22, steps).tolist()
    started = process_time()
    for i, action in enumerate([*actions[:1000], *actions]):
        if i == 1000:
            started = process_time()
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return steps / (process_time() - started)


def start_up(*arguments: str, outputs: Sequence[str] = ("warm-up", "run")) -> float:
    """CPU seconds of ``python ARGUMENTS`` from start to end; {TREE} and {OUTPUT} are replaced.

    Args:
        *arguments: of Python.
        outputs: of several starts, of which the last one is measured; those before it fill caches.
    """
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "run.yaml").write_text(ONE_UPDATE)
        for output in outputs:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            places = {"TREE": os.environ["PYTHONPATH"], "OUTPUT": output}
            command = [sys.executable, *(each.format(**places) for each in arguments)]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            if done.returncode != 0:
                raise RuntimeError(last_line(done.stderr or done.stdout))
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def whole_run(config: str, steps: int = RUN) -> float:
    """CPU seconds of a training of a shipped experiment, from the start of Python to the final evaluation."""
    options = f"--training.total_timesteps={steps}", "--logging.save_figures=false"
    # The first round of a comparison has filled the caches.
    return start_up(TRAIN, "--config", config, *options, "--output", "{OUTPUT}", outputs=["run"])


@dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes:
        run: measures it.
        unit: of the result; a lower number of seconds is better, a higher rate.
    """

    run: Callable[..., float]
    unit: str = "steps/s"

    def speedup(self, old: float, new: float) -> float:
        """How many times as fast the new tree is."""
        return old / new if self.unit == "s" else new / old


def _training_cases() -> Iterator[tuple[str, Case]]:
    updates = {"a2c": 150, "mo_a2c": 150, "ppo": 30, "mo_ppo": 30}
    for algorithm, hidden, action_type in product(updates, ([64, 32], [128, 64]), ("discrete", "continuous")):
        name = "-".join([algorithm, *map(str, hidden), action_type])
        arguments = {"action_type": action_type}
        yield name, Case(partial(training, algorithm, ONE_WAYPOINT, hidden, updates[algorithm], arguments))
    for algorithm, width, count in (("a2c", 512, 20), ("mo_ppo", 256, 15), ("mo_ppo", 512, 8)):
        name = f"{algorithm}-{width}-{width}-discrete"
        yield name, Case(partial(training, algorithm, ONE_WAYPOINT, [width, width], count, {}))
    yield "mocac-128-64-discrete", Case(partial(training, "mocac", ONE_WAYPOINT, [128, 64], 30, {}))
    for algorithm, count in (("a2c", 60), ("mo_ppo", 12)):
        yield f"two-{algorithm}-128-64", Case(partial(training, algorithm, INTERSECTION, [128, 64], count, {}))
    for config, count in SHIPPED.items():
        yield config, Case(partial(shipped, config, count))


# What can be measured in a place.
PLACED: dict[str, Case] = {
    **dict(_training_cases()),
    "make_vec-one-waypoint": Case(partial(make_vec, ONE_WAYPOINT)),
    "make_vec-static-obstacle": Case(partial(make_vec, STATIC_OBSTACLE)),
    "make_vec-intersection": Case(partial(make_vec, INTERSECTION)),
    "make_vec-left-turn": Case(partial(make_vec, LEFT_TURN)),
    "make_vec-roundabout-8": Case(partial(make_vec, ROUNDABOUT, vehicles=8)),
}
CASES: dict[str, Case] = {
    **PLACED,
    "pcn-collection": Case(partial(pcn, gradient_steps=1, batch_size=1)),
    "pcn": Case(partial(pcn, gradient_steps=400, batch_size=256)),
    "make": Case(make),
    "import": Case(partial(start_up, "-c", "import mo_deepdrive"), "s"),
    "train-help": Case(partial(start_up, TRAIN, "--help"), "s"),
    "train-one-update": Case(partial(start_up, TRAIN, "--config", "run.yaml", "--output", "{OUTPUT}"), "s"),
    **{f"run-{name}": Case(partial(whole_run, f"one_waypoint/{name}"), "s") for name in WHOLE_RUNS},
    "run-mappo_worst_off": Case(partial(whole_run, "intersection/mappo_worst_off"), "s"),
}


def select(patterns: Sequence[str], cases: Mapping[str, Case] = CASES) -> list[str]:
    """The names of ``cases`` that match one of ``patterns`` (shell wildcards); all without patterns."""
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in cases):
            raise ValueError(f"{pattern!r} matches no measurement; known: {', '.join(cases)}")
    return [name for name in cases if not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)]


# ----------------------------------------------------------------------------------------------------------- two trees


class CannotMeasureError(Exception):
    """A tree cannot run a measurement; the message says why."""


def revision(commit: str, repository: Path = REPOSITORY) -> str:
    """The full hash of ``commit``."""
    done = _git(repository, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}")
    if done.returncode != 0:
        raise ValueError(f"{commit!r} is not a commit of {repository}")
    return done.stdout.decode().strip()


def working_tree(repository: Path = REPOSITORY) -> str:
    """The hash of the checked-out commit, with "-dirty" if files differ from it; "unknown" outside a repository."""
    done = _git(repository, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    return done.stdout.decode().strip() or "unknown"


@contextmanager
def checkout(commit: str, repository: Path = REPOSITORY) -> Iterator[Path]:
    """A temporary folder with the files of ``commit``."""
    done = _git(repository, "archive", "--format=tar", commit)
    done.check_returncode()
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
            archive.extractall(folder, filter="data")
        yield Path(folder)


def _git(repository: Path, *arguments: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(["git", "-C", str(repository), *arguments], capture_output=True, check=False)


def machine() -> str:
    """The model of the processor and the number of its threads."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else platform.processor() or platform.machine()}, {os.cpu_count()} CPUs"


def device_name(device: str) -> str:
    """The model of a GPU, or ``cpu``."""
    import torch

    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def last_line(text: str) -> str:
    """The last line of an error message."""
    return (text.strip().splitlines() or ["no message"])[-1]


def measure(tree: Path, name: str) -> float:
    """The result of a measurement in a new process that imports the packages of ``tree``."""
    return _measured(ONE_THREAD | {"PYTHONPATH": str(tree)}, name)


def measure_in(place: Place, name: str) -> float:
    """As :func:`measure`, of the working tree in ``place``, in time on the clock."""
    threads = dict.fromkeys(ONE_THREAD, str(place.threads))
    return _measured(threads | SPINNING | {"PYTHONPATH": str(REPOSITORY)}, name, str(place.threads), place.device)


def _measured(environment: Mapping[str, str], *arguments: str) -> float:
    done = subprocess.run(
        [sys.executable, str(Path(__file__).resolve()), *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise CannotMeasureError(last_line(done.stderr))
    return float(json.loads(last_line(done.stdout)))


@dataclass
class Pairs:
    """A measurement of both sides, two trees or two places, in pairs.

    Attributes:
        name: of the measurement.
        old, new: one value per pair, in the unit of the case.
        problem: why a side cannot run it; empty if both can.
    """

    name: str
    old: list[float] = field(default_factory=list)
    new: list[float] = field(default_factory=list)
    problem: str = ""

    def row(self) -> Row:
        """The medians of the values and of the speed-up of each pair."""
        case = CASES[self.name]
        if self.problem:
            return Row(self.name, case.unit, problem=self.problem)
        speedups = [case.speedup(old, new) for old, new in zip(self.old, self.new, strict=True)]
        low, high = median_interval(speedups)
        old, new, speedup = (float(np.median(values)) for values in (self.old, self.new, speedups))
        return Row(self.name, case.unit, old, new, speedup, low, high, len(speedups))


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        measurement: its name.
        unit: of ``old`` and ``new``.
        old, new: medians.
        speedup: median over the pairs of how many times as fast the new tree is.
        low, high: its 95% interval; None for fewer than six pairs.
        pairs: their number.
        problem: why there are no numbers.
    """

    measurement: str
    unit: str
    old: Annotated[float | None, ".6g"] = None
    new: Annotated[float | None, ".6g"] = None
    speedup: Annotated[float | None, ".6g"] = None
    low: Annotated[float | None, ".6g"] = None
    high: Annotated[float | None, ".6g"] = None
    pairs: int = 0
    problem: str = ""

    def cells(self) -> list[str]:
        """The cells of the printed table: measurement, old, new, unit, speed-up with its interval."""
        if self.old is None or self.new is None:
            return [self.measurement, "", "", self.unit, self.problem]
        old, new = (f"{value:,.0f}" if value >= 1000 else f"{value:.2f}" for value in (self.old, self.new))
        interval = "" if self.low is None else f" [{self.low:.3f}, {self.high:.3f}]"
        return [self.measurement, old, new, self.unit, f"{self.speedup:.3f}{interval}"]


def median_interval(values: Sequence[float]) -> tuple[float | None, float | None]:
    """A 95% interval of the median from order statistics (Conover 1999); None for fewer than six values."""
    interval = quantile_test(values, p=0.5).confidence_interval(0.95)
    return (None, None) if np.isnan(interval.low) else (float(interval.low), float(interval.high))


def compare(
    old: Side,
    new: Side,
    names: Sequence[str],
    pairs: int,
    measure: Callable[[Side, str], float],
    *,
    progress: Callable[[Sequence[Any]], Any] = iter,
) -> list[Row]:
    """Measure two trees or two places, in alternation.

    Every measurement runs once on each side first, which fills the caches of the compiler and is not counted. Then each
    pair measures one side and the other right after it; which one is first changes from pair to pair.

    Args:
        old: one side.
        new: the other.
        names: of :data:`CASES`.
        pairs: of each measurement.
        measure: called as ``measure(side, name)``.
        progress: wraps the sequence of all pairs, to show how far they are.
    """
    results = {name: Pairs(name) for name in names}
    for pair, name in progress(list(product(range(-1, pairs), names))):
        result = results[name]
        if result.problem:
            continue
        sides = (("old", old, result.old), ("new", new, result.new))
        for title, side, values in sides[:: 1 if pair % 2 == 0 else -1]:
            try:
                value = measure(side, name)
            except CannotMeasureError as error:
                result.problem = f"the {title} side cannot run it: {error}"
                break
            if pair >= 0:
                values.append(value)
    return [result.row() for result in results.values()]


def main(name: str, tree: Path, place: Place | None = None) -> None:
    """Print the result of one measurement of the packages in ``tree``; in a place on the clock."""
    run = CASES[name].run
    result = run() if place is None else run(place=place)
    for module_name, module in [*sys.modules.items()]:
        file = getattr(module, "__file__", None)
        ours = module_name.partition(".")[0] in ("mo_deepdrive", "algorithms")
        # An installed package answers for modules that the tree lacks.
        if ours and file is not None and not Path(file).is_relative_to(tree):
            raise ImportError(f"{tree} has no module {module_name}")
    print(json.dumps(result))


if __name__ == "__main__":
    measured, *where = sys.argv[1:] or [""]
    if measured not in (PLACED if where else CASES) or len(where) not in (0, 2) or not os.environ.get("PYTHONPATH"):
        sys.exit(f"{__doc__}\nNAME is one of: {', '.join(CASES)}.")
    chosen = Place(int(where[0]), where[1]) if where else None
    main(measured, Path(os.environ["PYTHONPATH"]), chosen)
