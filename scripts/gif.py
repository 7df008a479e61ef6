"""Write a looping GIF of drives side by side: the picture at the top of the README.

    python scripts/gif.py --output docs/images/preferences.gif
    python scripts/gif.py one_waypoint_linear-ppo runs/mo_ppo_linear/mo_ppo-seed0 --output two.gif
    python scripts/gif.py rule:hurried --side 400 --output docs/images/roundabout.gif

Of a run of conditioned MO-PPO there is a drive for every --preference, on the same scenario, with its returns growing
below it; without a RUN, the run and the preferences of the README. Other runs, and rules, which drive eight vehicles of
the roundabout, the middle of which is shown, are side by side. Each policy acts greedily. A short episode is followed
by further ones while they fit beside the longest.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # frames are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
sys.path.append(str(Path.cwd()))  # a user's own utility may be there

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont

from algorithms.driving.named_rules import is_rule, scripted_policy
from algorithms.reporting.videos import (
    BACKGROUND,
    INK,
    Frame,
    episode_frames,
    make_render_env,
    rendered,
    resized,
    write_video_grid,
)
from algorithms.runs import cli
from algorithms.runs.build import load_policy
from algorithms.runs.config import find_environment
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.policy import drive
from mo_deepdrive.world.config import EnvironmentSettings
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.cross_play import conditioned_drivers

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import Policy

SEED = 1_000_022
RUN = "left_turn_front-conditioned_mo_ppo"
PREFERENCES = [["in a hurry", "time=5"], ["wants comfort", "g_force=5", "jerk=5"]]
OF_RULES = EnvironmentSettings(id=SCENARIOS["roundabout"].id, arguments={"vehicles": 8})
MARGIN = 0.2  # of a map with roads of segments, which is cut off on each side
HOLD = 6  # frames for which the last one of an episode is shown
PAUSE = 20  # the same, of drives with their returns
ROW, FONT = 25, 16  # pixels, of a bar with its text
GAIN, COST = "#1B6FA8", "#9C5F00"  # colours of bars, on which INK can be read


class Drive(NamedTuple):
    """One episode: the map (T + 1) and the returns until then (T + 1, d), and why it ended."""

    maps: list[Frame]
    returns: NDArray[np.float64]
    end: str


def shown(frame: Frame, side: int, roads: bool) -> Frame:
    """The map, which is the left square of a frame; of roads of segments its middle."""
    low, high = (round(MARGIN * len(frame)), round((1 - MARGIN) * len(frame))) if roads else (0, len(frame))
    return resized(frame[low:high, low:high], side, side)


def open_policy(name: str, seed: int, side: int, trust: bool) -> tuple[str, Iterator[list[Frame]]]:
    """Load a policy: the title of its scenario, and the frames of one greedy episode after the other."""
    policy: Policy
    if is_rule(name):
        environment = OF_RULES
        policy = scripted_policy(name, 0, EnvAdapter(make_env(environment.id, 1, environment.arguments)), "discrete")
    else:
        run = Run.open(name, trust=trust)
        if not run.experiment.known_utility:
            raise ValueError(f"{name!r} is a front of policies; choose one with mo-deepdrive choose --video instead")
        environment, policy = run.experiment.environment, load_policy(run)
    env = make_render_env(environment.id, environment.arguments)
    scenario = SCENARIOS.get(find_environment(environment.id).kwargs.get("scenario", ""))
    title, roads = (environment.id, False) if scenario is None else (scenario.title, scenario.roads)
    return title, (
        [shown(frame, side, roads) for frame in episode_frames(policy, env, i, greedy=True)] for i in range(seed, 2**31)
    )


def clips(names: Sequence[str], seed: int, most: int, side: int, trust: bool) -> list[tuple[str, list[Frame]]]:
    """Titles and frames: the first episode of each policy, and further ones of it while they fit beside the longest."""
    titles, episodes = zip(*(open_policy(name, seed, side, trust) for name in names), strict=True)
    first = [next(of_policy) for of_policy in episodes]
    length = min(max(map(len, first)), most)
    for frames, further in zip(first, episodes, strict=True):
        for episode in further:
            frames.extend([frames[-1]] * HOLD)
            if len(frames) + len(episode) > length:
                break
            frames.extend(episode)
    return [(title, frames[:length] + frames[-1:] * HOLD) for title, frames in zip(titles, first, strict=True)]


# ----------------------------------------------------------------------------------------------- under preferences


def recorded(policy: Policy, adapter: EnvAdapter, seed: int, side: int) -> Drive:
    """The first episode in the scenario of a seed, in an environment of :func:`make_render_env`."""
    env, end = adapter.vector_env, ""
    observations = adapter.reset(seed)
    maps, rewards = [shown(rendered(env), side, roads=False)], [np.zeros(len(adapter.objectives))]
    for decision in drive(policy, adapter, observations):
        maps.append(shown(rendered(env), side, roads=False))
        rewards.append(decision.step.rewards[0, 0])
        end = end if decision.step.ends is None else str(np.ravel(decision.step.ends[0])[0])
    return Drive(maps, np.cumsum(rewards, axis=0), end.replace("_", " "))


def preferred_drives(
    run: Run, preferences: Sequence[Sequence[str]], seed: int, side: int
) -> tuple[Sequence[str], dict[str, Drive]]:
    """The objectives, and the drive in the scenario of a seed under each preference, by its name."""
    env = make_render_env(run.experiment.environment.id, run.experiment.environment.arguments)
    adapter = EnvAdapter(env, keep_ended=True)
    policies = conditioned_drivers(run, preferences)
    drives = {name: recorded(policy, adapter, seed, side) for name, policy in policies.items()}
    env.close()
    return adapter.objectives, drives


def with_returns(drives: Sequence[Drive], objectives: Sequence[str], fps: int) -> Iterator[list[Frame]]:
    """The frames of each drive with bars of its returns below the map, on the same scale for all of them."""
    most = np.max([np.abs(each.returns).max(axis=0) for each in drives], axis=0)
    rows = [k for k in range(len(objectives)) if most[k] > 0.0]
    length = max(len(each.maps) for each in drives) + PAUSE
    for each in drives:
        last = len(each.maps) - 1
        frames = []
        for t in range(length):
            now = min(t, last)
            clock = f"{now / fps:.1f} s" if now < last else f"{each.end} after {now / fps:.1f} s"
            shares = {objectives[k]: (each.returns[now, k], abs(each.returns[now, k]) / most[k]) for k in rows}
            frames.append(np.vstack([each.maps[now], _bars(clock, shares, each.maps[0].shape[1])]))
        yield frames


def _bars(clock: str, shares: dict[str, tuple[float, float]], width: int) -> Frame:
    """The clock, and a row per objective: its name, a bar, and its return with the unit."""
    image = Image.new("RGB", (width, ROW * (len(shares) + 1) + ROW // 3), BACKGROUND)
    draw = ImageDraw.Draw(image)
    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", FONT)
    draw.text((10, ROW // 2 + 2), clock, INK, font, anchor="lm")
    for row, (objective, (value, share)) in enumerate(shares.items(), 1):
        (name, unit), top = name_and_unit(objective), ROW * row
        colour = GAIN if OBJECTIVES[INDEX[objective]].sign > 0 else COST
        draw.rectangle((10, top + 3, 10 + share * (width - 20), top + ROW - 3), fill=colour, outline=None)
        text, middle = f"{value + 0.0:.3g} {unit}".strip(), top + ROW // 2
        for where, words, anchor in ((14, name, "lm"), (width - 14, text, "rm")):
            draw.text((where, middle), words, INK, font, anchor=anchor)
    return np.asarray(image)


def write(options: Namespace) -> int:
    """Let the policies drive, and write the GIF."""
    cli.check_file("--output", options.output, ".gif")
    if not 0 <= options.seed < 2**31:
        raise ValueError(f"--seed {options.seed} must be between 0 and {2**31 - 1}")
    cli.check_at_least(options, 1, "frames")
    cli.check_at_least(options, 16, "side")
    preferences = options.preference or ([] if options.runs else PREFERENCES)
    if preferences and len(options.runs) > 1:
        raise ValueError("--preference needs one RUN")
    if preferences:
        run = Run.open((options.runs or [RUN])[0], trust=options.trust)
        objectives, drives = preferred_drives(run, preferences, options.seed, options.side)
        frames = with_returns([*drives.values()], objectives, options.fps)
        tracks = [*zip(drives, (each[: options.frames] for each in frames), strict=True)]
    else:
        tracks = clips(options.runs, options.seed, options.frames, options.side, options.trust)
    count = write_video_grid(tracks, options.output, options.fps, hold=0.0)
    print(f"{options.output}: {count} frames, {options.output.stat().st_size / 1e6:.2f} MB")
    return 0


PREFERENCE = "a drive of a RUN of conditioned MO-PPO: its name, and weights of objectives"
OPTIONS = (
    cli.option("runs", "RUN", "run directories, names in the zoo, or rules of the roundabout", nargs="*"),
    cli.option("--preference", "NAME", PREFERENCE, nargs="+", action="append", default=[]),
    cli.option("--output", "FILE", "the GIF", type=Path, required=True),
    cli.option("--seed", "S", "of the first episodes (default: %(default)s)", type=int, default=SEED),
    cli.option("--fps", "N", "frames per second (default: %(default)s)", type=int, default=10),
    cli.option("--frames", "N", "at most (default: %(default)s)", type=int, default=220),
    cli.option("--side", "PIXELS", "of each clip (default: %(default)s)", type=int, default=300),
    cli.TRUST,
)
main = cli.Command("", __doc__, OPTIONS, write)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
