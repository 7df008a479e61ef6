"""Write a looping GIF of drivers side by side: the picture at the top of the README.

    python scripts/gif.py --output docs/images/scenarios.gif
    python scripts/gif.py one_waypoint_linear-ppo runs/mo_ppo_linear/mo_ppo-seed0 --output two.gif
    python scripts/gif.py rule:hurried --side 400 --output docs/images/roundabout.gif

A rule drives eight vehicles of the roundabout, the middle of which is shown. Each policy acts greedily. A short
episode is followed by further ones while they fit beside the longest.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # frames are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
sys.path.append(str(Path.cwd()))  # a user's own utility may be there

from typing import TYPE_CHECKING

from algorithms.driving.named_rules import is_rule, scripted_policy
from algorithms.reporting.videos import Frame, episode_frames, make_render_env, resized, write_video_grid
from algorithms.runs import cli
from algorithms.runs.build import load_policy
from algorithms.runs.config import find_environment
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.world.config import EnvironmentSettings
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Iterator, Sequence

    from mo_deepdrive.evaluation.policy import Policy

POLICIES = (
    "static_obstacle_nonlinear-mo_ppo",
    "intersection_nonlinear-mo_ppo",
    "left_turn_linear-mo_ppo",
    "rule:hurried",
)
OF_RULES = EnvironmentSettings(id=SCENARIOS["roundabout"].id, arguments={"vehicles": 8})
MARGIN = 0.2  # of a map with roads of segments, which is cut off on each side
HOLD = 6  # frames for which the last one of an episode is shown


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

    def shown(frame: Frame) -> Frame:
        """The map, which is the left square of a frame; of roads of segments its middle."""
        low, high = 0, len(frame)
        if scenario is not None and scenario.roads:
            low, high = round(MARGIN * len(frame)), round((1 - MARGIN) * len(frame))
        return resized(frame[low:high, low:high], side, side)

    title = environment.id if scenario is None else scenario.title
    return title, ([*map(shown, episode_frames(policy, env, i, greedy=True))] for i in range(seed, 2**31))


def clips(names: Sequence[str], seed: int, most: int, side: int, trust: bool) -> list[tuple[str, list[Frame]]]:
    """Titles and frames: the first episode of each policy, and further ones of it while they fit beside the longest."""
    titles, episodes = zip(*(open_policy(name, seed, side, trust) for name in names), strict=True)
    shown = [next(of_policy) for of_policy in episodes]
    length = min(max(map(len, shown)), most)
    for frames, further in zip(shown, episodes, strict=True):
        for episode in further:
            frames.extend([frames[-1]] * HOLD)
            if len(frames) + len(episode) > length:
                break
            frames.extend(episode)
    return [(title, frames[:length] + frames[-1:] * HOLD) for title, frames in zip(titles, shown, strict=True)]


def write(options: Namespace) -> int:
    """Let the policies drive, and write the GIF."""
    cli.check_file("--output", options.output, ".gif")
    if not 0 <= options.seed < 2**31:
        raise ValueError(f"--seed {options.seed} must be between 0 and {2**31 - 1}")
    cli.check_at_least(options, 1, "frames")
    cli.check_at_least(options, 16, "side")
    shown = clips(options.runs, options.seed, options.frames, options.side, options.trust)
    count = write_video_grid(shown, options.output, options.fps, hold=0.0)
    print(f"{options.output}: {count} frames, {options.output.stat().st_size / 1e6:.2f} MB")
    return 0


OPTIONS = (
    cli.option(
        "runs", "RUN", "run directories, names in the zoo, or rules of the roundabout", nargs="*", default=POLICIES
    ),
    cli.option("--output", "FILE", "the GIF", type=Path, required=True),
    cli.option("--seed", "S", "of the first episodes (default: %(default)s)", type=int, default=1_000_001),
    cli.option("--fps", "N", "frames per second (default: %(default)s)", type=int, default=10),
    cli.option("--frames", "N", "at most (default: %(default)s)", type=int, default=220),
    cli.option("--side", "PIXELS", "of each clip (default: %(default)s)", type=int, default=280),
    cli.TRUST,
)
main = cli.Command("", __doc__, OPTIONS, write)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
