"""Drive in a window: alone, two people at one keyboard, or against a trained policy.

    python scripts/play.py --env mo-deepdrive-one-waypoint-v0
    python scripts/play.py --env mo-deepdrive-intersection-v0
    python scripts/play.py --env mo-deepdrive-intersection-v0 --against RUN --vehicle 1 --record drive.mp4

RUN is the directory of a run, or the name of a policy of the zoo (scripts/evaluate.py --zoo lists them).

Arrow keys: up speeds up, down brakes, left and right steer. With two people they drive vehicle 0, and W A S D drives
vehicle 1. R starts the episode again, Escape or closing the window quits. Hard braking and fast bends can exceed the
harmful g-force, which ends the episode.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
sys.path.append(os.getcwd())  # where a user's own utility lives

import numpy as np
import pygame
import torch
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from algorithms.agent import Agent
from algorithms.driving import PICTURES, HumanPlayEnv, Outcome
from algorithms.experiments.config import find_environment, is_ours
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run
from algorithms.experiments.training import build
from algorithms.reporting.videos import make_render_env, video_writer
from mo_deepdrive.envs.vector import DrivingVectorEnv
from mo_deepdrive.objectives import INDEX, OBJECTIVES

# Of every person, in the order of algorithms.driving.Keys: accelerate, brake, left, right.
KEYBOARD = {
    "arrow keys": (pygame.K_UP, pygame.K_DOWN, pygame.K_LEFT, pygame.K_RIGHT),
    "W A S D": (pygame.K_w, pygame.K_s, pygame.K_a, pygame.K_d),
}
AGAIN = pygame.K_r
FASTEST = 1000
INVISIBLE = ("dummy", "offscreen")  # SDL's video drivers without a display


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--env", required=True, metavar="ID", help="one of this package's environments")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the first episode (default: a random one)")
    parser.add_argument("--fps", type=int, metavar="N", help="decisions per second (default: in real time)")
    parser.add_argument("--against", metavar="RUN", help="a run or policy of the zoo that drives the other vehicle")
    parser.add_argument("--vehicle", type=int, choices=(0, 1), help="the one that you drive against RUN (default: 0)")
    parser.add_argument("--stochastic", action="store_true", help="RUN's stochastic policy, not the greedy one")
    parser.add_argument("--record", metavar="FILE", help="write an MP4 of what was driven")
    return parser.parse_args(arguments)


def open_world(options: argparse.Namespace) -> tuple[DrivingVectorEnv, Agent | None]:
    """The world that the options ask for and the agent in it, if there is one.

    Raises:
        ValueError: for an environment or a run that is not there or does not fit.
    """
    spec = find_environment(options.env)
    if not is_ours(spec):
        raise ValueError(f"--env {options.env}: only this package's environments can be driven")
    if options.against is None:
        for name, given in (("--vehicle", options.vehicle is not None), ("--stochastic", options.stochastic)):
            if given:
                raise ValueError(f"{name} goes with --against RUN, which is missing")
        return make_render_env(options.env).unwrapped, None  # type: ignore[return-value]
    run = Run.open(options.against, device="cpu")
    theirs = run.experiment.environment
    if find_environment(theirs.id).id != spec.id:
        raise ValueError(f"--against {options.against}: the run drives in {theirs.id}, not in {spec.id}")
    agent = build(run.experiment, num_envs=1)
    if agent.env.vehicles == 1:
        raise ValueError(f"--against {options.against}: {spec.id} has no other vehicle that the run could drive")
    agent.load(run.checkpoint, policy_only=True)
    return make_render_env(theirs.id, theirs.arguments).unwrapped, agent  # type: ignore[return-value]


def key_table(codes: list[int]) -> dict[tuple[int, ...], NDArray[np.int8]]:
    """For every set of keys held down, by their codes, the action that says so."""
    rows = list(itertools.product((0, 1), repeat=len(codes)))[1:]
    return {tuple(itertools.compress(codes, row)): np.array(row, dtype=np.int8) for row in rows}


def say(console: Console, world: DrivingVectorEnv, outcome: Outcome) -> None:
    """Print how an episode ended."""
    table = Table(title=f"episode {outcome.episode}, seed {outcome.seed}", title_justify="left", box=SIMPLE_HEAD)
    table.add_column()
    table.add_column("end\n")
    table.add_column("time\ns", justify="right")
    for name in world.objectives:
        unit = OBJECTIVES[INDEX[name]].unit
        table.add_column(f"{name}\n{unit if unit != '1' else ''}", justify="right")
    for v, (end, seconds, returns) in enumerate(zip(outcome.ends, outcome.seconds, outcome.returns, strict=True)):
        table.add_row(f"vehicle_{v}", end, f"{seconds:.1f}", *(f"{value:.2f}" for value in returns))
    console.print(table)


def open_display() -> None:
    """Prepare to show a window.

    Raises:
        ValueError: if there is no display.
    """
    try:
        pygame.display.init()
        pygame.display.set_caption("MO-DeepDrive")
        driver = pygame.display.get_driver()
        # Without a display SDL may fall back on a window that nobody sees.
        problem = f"SDL has only {driver!r}" if driver in INVISIBLE and not os.environ.get("SDL_VIDEODRIVER") else ""
    except pygame.error as error:
        problem = f"SDL says {str(error)!r}"
    if problem:
        raise ValueError(
            f"no window can be opened ({problem}): driving needs a display; on Linux set DISPLAY or WAYLAND_DISPLAY, "
            "and if SDL_VIDEODRIVER is set, it must name a driver that has one"
        )


def drive(cockpit: HumanPlayEnv, seats: list[int], fps: int, console: Console) -> None:
    """Drive in a window until the user quits."""
    from gymnasium.utils.play import play  # it chooses a backend for matplotlib: not for who only imports this

    def tell(before: Any, after: Any, action: Any, reward: Any, terminated: bool, truncated: bool, info: Any) -> None:
        if "outcome" in info:
            say(console, cockpit.world, info["outcome"])

    keyboard = list(KEYBOARD.items())[: len(seats)]
    people = (f"vehicle {v}: {name}" for v, (name, _) in zip(seats, keyboard, strict=True))
    console.print("; ".join((*people, "R starts again, Escape quits")), highlight=False)
    codes = [*(code for _, keys in keyboard for code in keys), AGAIN]
    noop = np.zeros(len(codes), dtype=np.int8)
    play(cockpit, fps=fps * PICTURES, callback=tell, keys_to_action=key_table(codes), noop=noop)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    console = make_console()
    try:
        if options.seed is not None and not 0 <= options.seed < 2**31:
            raise ValueError(f"--seed {options.seed} must be between 0 and {2**31 - 1}")
        if options.fps is not None and not 1 <= options.fps <= FASTEST:
            raise ValueError(f"--fps {options.fps} must be between 1 and {FASTEST}")
        if options.record and not Path(options.record).absolute().parent.is_dir():
            raise ValueError(f"{str(Path(options.record).absolute().parent)!r} is no directory to write a video to")
        world, agent = open_world(options)
        open_display()
        rate = world.config.decision_frequency
        seats = list(range(world.vehicles)) if agent is None else [options.vehicle or 0]
        generator = torch.Generator().manual_seed(options.seed or 0) if options.stochastic else None
        with video_writer(options.record, rate) if options.record else nullcontext() as film:
            cockpit = HumanPlayEnv(world, seats, agent=agent, generator=generator, film=film)
            cockpit.reset(seed=options.seed)
            try:
                drive(cockpit, seats, options.fps or rate, console)
            except KeyboardInterrupt:
                return 130
            finally:
                cockpit.close()
    except (ValueError, OSError, pygame.error) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
