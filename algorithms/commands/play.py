"""Drive in a window or a browser: alone, as two people at one keyboard, or among trained policies or scripted drivers.

    mo-deepdrive play --env mo-deepdrive-one-waypoint-v1
    mo-deepdrive play --env mo-deepdrive-intersection-v1
    mo-deepdrive play --env mo-deepdrive-intersection-v1 --against RUN --vehicle 1 --record drive.mp4
    mo-deepdrive play --env mo-deepdrive-roundabout-v0 --against rule:balanced
    mo-deepdrive play --web

--web opens a page instead, which needs neither a display of this machine nor a network: the scenarios of the package,
policies that follow preferences, and links that keep a drive.

RUN, which drives all other vehicles, is the directory of a run, the name of a policy of the zoo (mo-deepdrive zoo lists
them), or in a roundabout a scripted driver: rule:hurried, rule:balanced or rule:careful.

Arrow keys: up accelerates, down brakes, left and right steer. With two people the arrow keys drive vehicle 0, and
W A S D drives vehicle 1. R restarts the episode; Escape or closing the window quits. Hard braking and fast turns can
exceed the harmful g-force, which ends the episode.
"""

from __future__ import annotations

import os
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.runs import cli
from algorithms.runs.config import find_environment
from algorithms.runs.run_directory import Run
from mo_deepdrive.support.extras import needed_for
from mo_deepdrive.world.config import is_ours
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AbstractContextManager

    from mo_deepdrive.envs.vector import DrivingVectorEnv
    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.play import EpisodeOutcome

ENVIRONMENT: dict[str, str] = {}  # SDL chooses the driver of the window


def open_environment(options: cli.Options) -> tuple[DrivingVectorEnv, Policy | None, list[int]]:
    """The environment that the options ask for, what drives the other vehicles, if any, and the user's vehicles."""
    from mo_deepdrive.play import KEYBOARD, make_play_env

    spec = find_environment(options.env, "--env")
    if not is_ours(spec):
        raise ValueError(f"--env = {options.env!r}: only this package's environments can be driven")
    if options.against is None:
        if options.stochastic or options.vehicle is not None:
            raise ValueError(f"{'--vehicle' if options.vehicle is not None else '--stochastic'} requires --against RUN")
        env = make_play_env(options.env)
        if env.vehicles > len(KEYBOARD):
            room = f"a keyboard has room for {len(KEYBOARD)} people; add --against RUN"
            raise ValueError(f"--env {options.env} has {env.vehicles} vehicles, and {room}")
        return env, None, list(range(env.vehicles))
    with needed_for("--against"):
        from mo_deepdrive.evaluation.metrics import vehicle_name

        policy, arguments, partners = _open_rivals(options, spec.id)
    vehicles = policy.env.vehicles
    if vehicles == 1:
        raise ValueError(f"--against {options.against}: {spec.id} has no other vehicle that the run could drive")
    free = [v for v in range(vehicles) if vehicle_name(v) in partners] or list(range(vehicles))
    seat = free[0] if options.vehicle is None else options.vehicle
    if seat not in range(vehicles):
        raise ValueError(f"--vehicle {seat} must be between 0 and {vehicles - 1}")
    if seat not in free:
        raise ValueError(f"--vehicle {seat}: RUN learnt to drive {vehicle_name(seat)} alone; drive vehicle {free[0]}")
    return make_play_env(spec.id, **arguments), policy, [seat]


def _open_rivals(options: cli.Options, env_id: str) -> tuple[Policy, dict[str, Any], dict[str, list[str]]]:
    """What drives the other vehicles, the arguments of its environment, and the partners that it learnt with."""
    from algorithms.driving.named_rules import is_rule
    from algorithms.runs.build import load_policy, open_driver
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env

    if is_rule(options.against):
        seat = 1 - options.vehicle if options.vehicle in (0, 1) else 1
        env = EnvAdapter(make_env(env_id, 1))
        return open_driver(options.against, min(seat, env.vehicles - 1), env, "discrete"), {}, {}
    run = Run.open(options.against, trust=options.trust)
    theirs = run.experiment.environment
    if find_environment(theirs.id).id != env_id:
        raise ValueError(f"--against {options.against}: the run drives in {theirs.id}, not in {env_id}")
    return load_policy(run), theirs.arguments, run.experiment.training.partners


def print_outcome(
    title: str, objectives: Sequence[str], ends: Sequence[str], seconds: Sequence[float], returns: Any
) -> None:
    """Print how an episode ended for each of V vehicles, after what time, and with which returns (V, d)."""
    units = [OBJECTIVES[INDEX[name]].unit for name in objectives]
    rows = [["", "end", "length", *objectives], ["", "", "s", *("" if unit == "1" else unit for unit in units)]]
    for v, (end, time, values) in enumerate(zip(ends, seconds, returns, strict=True)):
        rows.append([f"vehicle_{v}", end, f"{time:.1f}", *(f"{value:.6g}" for value in values)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(2, ["-" * width for width in widths])
    print(f"\n{title}")
    for name, end, *numbers in rows:
        cells = (number.rjust(width) for number, width in zip(numbers, widths[2:], strict=True))
        print("  ".join((name.ljust(widths[0]), end.ljust(widths[1]), *cells)).rstrip())


def serve(port: int) -> int:
    """Open the page in a browser, and serve it on this machine alone until Ctrl-C."""
    from functools import partial
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
    from tempfile import TemporaryDirectory
    from webbrowser import open_new_tab

    from algorithms.reporting.page.page import write_site

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            """Print nothing for every file."""

    with TemporaryDirectory() as folder:
        write_site(folder)
        with ThreadingHTTPServer(("127.0.0.1", port), partial(Quiet, directory=folder)) as server:
            address = f"http://127.0.0.1:{server.server_port}/"
            print(f"{address} (Ctrl-C ends it)", flush=True)
            open_new_tab(address)
            with suppress(KeyboardInterrupt):
                server.serve_forever()
    return 0


def play(options: cli.Options) -> int:
    """Open the window or the page, and drive until it is closed."""
    if options.web:
        if options.env is not None or options.against is not None:
            raise ValueError("--web has a menu of all scenarios and rivals; omit --env and --against")
        if not 0 <= options.port < 2**16:
            raise ValueError(f"--port {options.port} must be between 0 and {2**16 - 1}")
        return serve(options.port)
    if options.env is None:
        raise ValueError("--env ID or --web is required")
    from mo_deepdrive.drawing.quiet_pygame import pygame
    from mo_deepdrive.play import HumanPlayEnv, describe_controls, open_display, play_in_window

    for name, low, high in (("seed", 0, 2**31 - 1), ("fps", 1, 1000)):
        value = getattr(options, name)
        if value is not None and not low <= value <= high:
            raise ValueError(f"--{name} {value} must be between {low} and {high}")
    cli.check_file("--record", options.record, ".mp4")
    generator: torch.Generator | None = None
    recorder: AbstractContextManager[Callable[[Any], None] | None] = nullcontext()
    try:
        env, policy, seats = open_environment(options)
        # Only a user who sets SDL_VIDEODRIVER can want a window without a display.
        open_display(allow_invisible=bool(os.environ.get("SDL_VIDEODRIVER")))
        rate = env.config.decision_frequency
        if policy is not None and options.stochastic:
            import torch

            generator = torch.Generator().manual_seed(options.seed or 0)
        if options.record:
            with needed_for("--record"):
                from algorithms.reporting.videos import video_seconds, video_writer
            recorder = video_writer(options.record, rate)
        with recorder as on_frame:
            human_env = HumanPlayEnv(env, seats, policy=policy, generator=generator, on_frame=on_frame)
            human_env.reset(seed=options.seed)
            print(describe_controls(seats))

            def show(o: EpisodeOutcome) -> None:
                print_outcome(f"episode {o.episode}, seed {o.seed}", env.objectives, o.ends, o.seconds, o.returns)

            try:
                play_in_window(human_env, options.fps or rate, show)
            finally:
                human_env.close()
    except pygame.error as error:
        raise OSError(str(error)) from None
    if options.record and Path(options.record).is_file():
        print(f"video: {options.record}: {video_seconds(options.record):.1f} s")
    return 0


OPTIONS = (
    cli.option("--env", "ID", "one of this package's environments"),
    cli.flag("--web", "drive on a page in the browser"),
    cli.option("--port", "N", "of --web (default: any free one)", type=int, default=0),
    cli.option("--seed", "S", "seed of the first episode (default: random)", type=int),
    cli.option("--fps", "N", "decisions per second (default: real time)", type=int),
    cli.option("--against", "RUN", "what drives the other vehicles"),
    cli.option("--vehicle", "V", "the vehicle you drive against RUN (default: one it did not learn, or 0)", type=int),
    cli.flag("--stochastic", "sample RUN's actions instead of the greedy ones"),
    cli.option("--record", "FILE", "write an MP4 of the session"),
    cli.TRUST,
)
main = cli.Command("play", __doc__, OPTIONS, play)
