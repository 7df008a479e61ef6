"""Draw the pictures that explain: of the documentation's pages, and what conflicts.

    python scripts/pictures.py --output docs/images
    python scripts/pictures.py ends splits --output docs/images

What they show is driven in the environments, or read from the package's data and docs/results.
"""

from __future__ import annotations

import csv
import sys
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

from algorithms.driving.controls import forward
from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.reporting import style
from algorithms.reporting.videos import CAPTION_PIXELS, caption_strip, make_render_env, write_video_grid
from algorithms.runs import cli
from mo_deepdrive import suite
from mo_deepdrive.evaluation.drives import record_scenes
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.episodes import as_policy
from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.splits import FIRST_TRAINING_SEED, SPLITS
from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH, MAP_CENTRE, WIDTH
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.gif import recorded

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.drives import Drive, Scene

    Floats = NDArray[np.float64]

RESULTS = Path(__file__).parents[1] / "docs" / "results"
ROAD, CAR, OTHER = style.GRID, style.COLOURS[0], style.FAINT
# Where episodes end so, with which arguments; drives are found at random.
ENDING: tuple[tuple[str, dict[str, Any], tuple[str, ...]], ...] = (
    ("one_waypoint", {}, ("arrived", "time_limit", "circling", "backwards", "harmful_g_force")),
    ("static_obstacle", {}, ("collision",)),
    ("left_turn", {"end_on_lane_violation": True}, ("off_lane",)),
    ("left_turn", {}, ("skipped_waypoint",)),
)
DRIVERS = 256
APPROACH, STAMPED = 40, 10  # frames of the film of LeftTurn that are left out, and that show an end at least
CHOICES = {  # which algorithm when: question, then answers with algorithms
    "Is the utility known?": {
        "linear": "PPO",
        "non-linear in an\nepisode's return": "MO-PPO\nMOCAC",
        "rules first,\nthen a utility": "rulebook PPO",
        "of a team": "MAPPO",
        "no": "conditioned MO-PPO\nPCN (fixed scenario)",
    }
}


def outline(pose: Floats) -> Floats:
    """The corners (4, 2) of a car at (x, y, heading)."""
    x, y, heading = pose
    ahead = forward(heading)
    side = np.array([-ahead[1], ahead[0]])
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2 * [LENGTH, WIDTH]
    return np.asarray([x, y] + corners @ np.stack([ahead, side]))


def draw_map(axes: Axes, scene: Scene, box: tuple[float, float, float]) -> None:
    """Lanes, bicycles and destination of a scene in a square (left, bottom, side)."""
    left, bottom, side = box
    if scene.lanes:
        x, y = np.broadcast_to(MAP_CENTRE, 2).tolist()
        axes.axvspan(x - LANE_WIDTH, x + LANE_WIDTH, color=ROAD, linewidth=0)
        axes.axhspan(y - LANE_WIDTH, y + LANE_WIDTH, color=ROAD, linewidth=0)
    for ends in scene.obstacles:
        axes.plot(*ends.T, color=style.INK, linewidth=3)
    axes.plot(*scene.routes[0][-1], "*", color=style.INK, markersize=10)
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), aspect="equal", xticks=[], yticks=[])


def draw_car(axes: Axes, pose: Floats, colour: str, alpha: float = 1.0) -> None:
    """A car as a rectangle."""
    if np.isfinite(pose).all():
        axes.add_patch(Polygon(outline(pose), color=colour, alpha=alpha, linewidth=0))


def rows_of(name: str) -> list[dict[str, str]]:
    """The rows of a table of docs/results."""
    with (RESULTS / name).open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


# ------------------------------------------------------------------------------------------------------------ pictures


def observation(path: Path) -> None:
    """What the vehicle of LeftTurn observes, on the car."""
    env_id, seeds = SCENARIOS["left_turn"].ids, [SPLITS["validation"].start]
    (scene,) = record_scenes(GapDriver(GapRule(5.0)), [*env_id][-1], {}, seeds=seeds, drives=1)
    (drive,) = scene.drives
    left, bottom, side = scene.box(3.0)
    inside = np.abs(drive.cars[..., :2] - [left + side / 2, bottom + side / 2]).max(axis=-1) < 0.4 * side  # (T + 1, C)
    moment = int(inside.any(axis=1).argmax())
    pose, route, cars = drive.readings[moment, 0, :3], scene.routes[0], drive.cars[moment][inside[moment]]
    front = pose[:2] + LENGTH / 2 * forward(pose[2])
    with style.figure_style({"axes.grid": False, "axes.spines.left": False, "axes.spines.bottom": False}):
        figure = Figure(figsize=(5.6, 5.6), layout="constrained")
        axes = figure.subplots()
        draw_map(axes, scene, (left, bottom, side))
        draw_car(axes, pose, CAR)
        for car in cars:
            draw_car(axes, car, style.COLOURS[1])
        axes.plot(*route.T, "o", color=style.INK, markersize=4)
        marks = dict(zip(("next waypoint", "the one after"), map(tuple, route[:2]), strict=False))
        for (name, place), colour in zip(marks.items(), style.COLOURS[2:4], strict=False):
            axes.annotate("", place, tuple(front), arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.6})
            axes.annotate(
                f"{name}:\nangle, distance", place, (8, 0), textcoords="offset points", color=colour, va="center"
            )
        if len(cars):
            nearest = tuple(min(cars, key=lambda car: float(np.hypot(*(car[:2] - front))))[:2])
            said = "oncoming car: speed,\ndistance to the crossing"
            axes.annotate(said, nearest, (12, 0), textcoords="offset points", color=style.COLOURS[1], va="center")
        own = "own car: velocity, acceleration,\nspeed, held steer, throttle, brake,\ndistances to the lane lines"
        axes.annotate(own, tuple(pose[:2]), (-16, 0), textcoords="offset points", color=CAR, ha="right", va="center")
        style.save_figure(figure, path, dpi=110)


def ends(path: Path) -> None:
    """One drive for every end of an episode, found among drives at random."""
    found: dict[str, tuple[Scene, Drive]] = {}
    generator = np.random.default_rng(0)
    for scenario, changes, reasons in ENDING:
        actions = generator.uniform([-0.35, -0.4, -1.0], [0.35, 0.8, -1.0], (DRIVERS, 3)).astype(np.float32)
        actions[:, 1] **= 3  # mostly gentle
        actions[0] = [0.0, 0.0, 1.0]  # stands still
        env_id, seeds = [*SCENARIOS[scenario].ids][-1], [SPLITS["validation"].start]
        arguments = {"action_type": "continuous", **changes}
        (scene,) = record_scenes(lambda *_, a=actions: a, env_id, arguments, seeds=seeds, drives=DRIVERS)
        for drive in scene.drives:
            if drive.ends[0] in reasons:
                found.setdefault(drive.ends[0], (scene, drive))
    with style.figure_style({"axes.grid": False, "axes.spines.left": False, "axes.spines.bottom": False}):
        figure = Figure(figsize=(7.6, 4.2), layout="constrained")
        panels = figure.subplots(2, -(-len(found) // 2)).flat
        for (reason, (scene, drive)), axes in zip(found.items(), panels, strict=False):
            track = drive.readings[:, 0, :3]
            track = track[np.isfinite(track[:, 0])]
            points = np.concatenate([track[:, :2], scene.routes[0][-1:]])
            side = max(float(np.ptp(points, axis=0).max()), 8.0) + 6.0
            draw_map(axes, scene, (*(points.min(axis=0) + points.max(axis=0) - side) / 2, side))
            for car in drive.cars[len(track) - 1] if drive.cars.size else ():
                draw_car(axes, car, style.COLOURS[1])
            axes.plot(*track[:, :2].T, color=CAR, linewidth=1.2)
            draw_car(axes, track[0], CAR, 0.3)
            draw_car(axes, track[-1], CAR)
            axes.set_title(reason, fontsize=10, family="monospace")
        for axes in panels:
            axes.set_visible(False)
        style.save_figure(figure, path, dpi=100)


def splits(path: Path) -> None:
    """The three splits of scenario seeds, and what each is for."""
    test, validation = SPLITS["test"], SPLITS["validation"]
    rows = [
        ("training", f"from 2³² = {FIRST_TRAINING_SEED:,} on", "learning", style.COLOURS[0]),
        (
            "validation",
            f"{validation.start:,} to {validation.stop - 1:,}",
            "curves, and whatever is chosen",
            style.COLOURS[4],
        ),
        ("test", f"{test.start:,} to {test.stop - 1:,}", "final scores, by which nothing is chosen", style.COLOURS[2]),
    ]
    with style.figure_style({"axes.grid": False}):
        figure = Figure(figsize=(7.2, 1.7), layout="constrained")
        axes = figure.subplots()
        for y, (name, seeds, use, colour) in enumerate(reversed(rows)):
            axes.barh(y, 1.0, left=0.0, height=0.72, color=colour, alpha=0.25)
            for x, words, weight in ((0.02, name, "bold"), (0.2, f"seeds {seeds}", "normal"), (0.56, use, "normal")):
                axes.text(x, y, words, va="center", fontweight=weight)
        axes.set_axis_off()
        axes.set_xlim(0.0, 1.0)
        style.save_figure(figure, path, dpi=110)


def scale(path: Path) -> None:
    """Floor and ceiling of the core tasks, and what each of them is."""
    tasks = {name: task for name, task in suite.load().tasks.items() if task.core}
    with style.figure_style({"axes.grid": False}):
        figure = Figure(figsize=(7.2, 0.62 * len(tasks) + 0.8), layout="constrained")
        axes = figure.subplots()
        for y, task in enumerate(reversed(tasks.values())):
            axes.plot([0, 1], [y, y], color=style.FAINT, linewidth=5, solid_capstyle="butt", zorder=1)
            axes.plot([0, 1], [y, y], "|", color=style.INK, markersize=15, zorder=2)
            axes.text(0, y + 0.24, f"{task.floor.value:g}", ha="center", va="bottom")
            axes.text(1, y + 0.24, f"{task.ceiling.value:g}", ha="center", va="bottom")
            if task.rule is not None:
                at = (task.rule.value - task.floor.value) / (task.ceiling.value - task.floor.value)
                axes.plot(at, y, "D", color=style.COLOURS[1], zorder=3)
        axes.plot([], [], "D", color=style.COLOURS[1], label="the best rule that sees what the task tests")
        axes.set(
            yticks=range(len(tasks)), yticklabels=[*reversed(tasks)], ylim=(-0.5, len(tasks) - 0.2), xlim=(-0.1, 1.1)
        )
        axes.set_xticks(
            [0, 1],
            ["0: floor, the best that is\nblind to what is tested", "1: ceiling, planned\nor best known"],
        )
        axes.spines[["left", "bottom"]].set_visible(False)
        axes.tick_params(length=0)
        figure.legend(loc="outside upper center", frameon=False)
        style.save_figure(figure, path, dpi=110)


def accrued(path: Path) -> None:
    """One drive of OneWaypoint after different times spent, of which only the accrued reward tells."""
    steady = np.array([0.0, 0.15, -1.0], dtype=np.float32)

    def straight(observations: Any, *_: Any) -> Any:
        actions = np.tile(steady, (len(observations), 1))
        actions[:, 0] = np.clip(-0.2 * observations[:, 0], -1.0, 1.0)
        return actions

    arguments = {"action_type": "continuous"}
    seeds = [SPLITS["validation"].start]
    (scene,) = record_scenes(straight, "mo-deepdrive-one-waypoint-v1", arguments, seeds=seeds, drives=1)
    seconds = np.arange(len(scene.drives[0].readings)) / scene.decision_frequency
    deadline = 40.0
    with style.figure_style():
        figure = Figure(figsize=(6.4, 3.0), layout="constrained")
        axes = figure.subplots()
        for spent, colour in ((0.0, style.COLOURS[2]), (deadline - 0.6 * seconds[-1], style.COLOURS[1])):
            kept = spent + seconds[-1] <= deadline
            axes.plot(seconds, -(spent + seconds), color=colour, linewidth=2.2)
            said = "arrives in time" if kept else "the same drive arrives too late"
            axes.plot(seconds[-1], -(spent + seconds[-1]), "*", color=colour, markersize=13, clip_on=False)
            y = -spent + (5.0 if spent else -8.0)
            axes.text(0.0, y, f"{spent:.0f} s were spent before: {said}", color=colour, va="center")
        axes.axhline(-deadline, color=style.INK, linewidth=1, linestyle="--")
        axes.text(0.0, -deadline - 1.5, f"deadline of K3, {deadline:.0f} s: 10 destination [time <= 40]", va="top")
        axes.set(
            xlabel="seconds driven; both cars observe the same", ylabel="accrued reward in time (s)", ylim=(-49, 2)
        )
        style.save_figure(figure, path, dpi=110)


def choice(path: Path) -> None:
    """Which algorithm for which utility."""
    ((question, answers),) = CHOICES.items()
    with style.figure_style({"axes.grid": False}):
        figure = Figure(figsize=(7.6, 2.5), layout="constrained")
        axes = figure.subplots()
        box = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": style.DIM}
        axes.text(0.5, 1.0, question, ha="center", va="center", fontweight="bold", bbox=box)
        for k, (answer, names) in enumerate(answers.items()):
            x = (k + 0.5) / len(answers)
            axes.annotate("", (x, 0.62), (0.5, 0.9), arrowprops={"arrowstyle": "-", "color": style.FAINT})
            axes.text(x, 0.52, answer, ha="center", va="center", color=style.DIM)
            shade = {**box, "facecolor": style.COLOURS[5 if answer == "no" else 0], "alpha": 0.18}
            axes.text(x, 0.2, names, ha="center", va="center", fontweight="bold", fontsize=9, bbox=shade)
        axes.set(xlim=(-0.02, 1.02), ylim=(0.0, 1.12))
        axes.set_axis_off()
        style.save_figure(figure, path, dpi=110)


def conflicts(path: Path) -> None:
    """Rank correlations of returns, a triangle per scenario: which objectives conflict."""
    groups = [(name, list(rows)) for name, rows in groupby(rows_of("conflicts.csv"), key=lambda row: row["population"])]
    with style.figure_style({"axes.grid": False, "axes.spines.left": False, "axes.spines.bottom": False}):
        figure = Figure(figsize=(7.6, 9.2))
        panels = figure.subplots(-(-len(groups) // 2), 2).flat
        for (population, rows), axes in zip(groups, panels, strict=False):
            names = list(dict.fromkeys(row[which] for row in rows for which in ("first", "second")))
            values = np.full((len(names), len(names)), np.nan)
            for row in rows:
                values[names.index(row["second"]), names.index(row["first"])] = float(row["spearman"])
            axes.imshow(values[1:, :-1], cmap="RdBu", vmin=-1, vmax=1)
            for (y, x), value in np.ndenumerate(values[1:, :-1]):
                if np.isfinite(value):
                    colour = "white" if abs(value) > 0.6 else style.INK
                    axes.text(
                        x,
                        y,
                        f"{value:+.2f}",
                        ha="center",
                        va="center",
                        fontsize=7 if len(names) > 6 else 8,
                        color=colour,
                    )
            plain = [name_and_unit(name)[0] for name in names]
            axes.set_xticks(range(len(names) - 1), plain[:-1], rotation=35, ha="right", rotation_mode="anchor")
            axes.set_yticks(range(len(names) - 1), plain[1:])
            axes.tick_params(length=0)
            axes.set_title(f"{population}: {rows[0]['drivers']} drivers", fontsize=9.5)
        for axes in panels:
            axes.set_visible(False)
        notes = [
            "Spearman's rank correlation of the drivers' mean returns, all maximised; red: more of one costs the other"
        ]
        style.surround(figure, "Which objectives conflict", notes)
        style.save_figure(figure, path, dpi=100)


def thumbnails(path: Path) -> None:
    """Small pictures of the scenarios, from the beginning of the films on their pages."""
    path.mkdir(exist_ok=True)
    for film in ("one_waypoint", "static_obstacle", "left_turn", "intersection", "roundabout"):
        with Image.open(path.parent / f"{film}.gif") as frames:
            frames.seek(frames.n_frames // 8)
            frame = frames.convert("RGB")
        first = frame.crop((0, CAPTION_PIXELS, frame.height - CAPTION_PIXELS, frame.height))  # of several side by side
        first.resize((120, 120), Image.Resampling.LANCZOS).save(path / f"{film}.png")


def left_turn(path: Path) -> None:
    """A film of LeftTurn: three fixed rules on one scenario, from where they differ, and how they end."""
    adapter = EnvAdapter(make_render_env(SCENARIOS["left_turn"].id), keep_ended=True)
    tracks = []
    for gap, name in ((0.0, "goes at once"), (3.0, "waits for 3 s"), (9.0, "waits for 9 s")):
        driven = recorded(as_policy(GapDriver(GapRule(gap)), adapter), adapter, 1_000_004, 320)
        frames, last = driven.maps[APPROACH:], driven.maps[-1].copy()
        last[-CAPTION_PIXELS:] = caption_strip(f"{driven.end} after {(len(driven.maps) - 1) / 10:.1f} s", last.shape[1])
        tracks.append((name, [*frames[:-1], *[last] * STAMPED]))
    write_video_grid(tracks, path, 10, hold=1.0)


PICTURES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "observation": ("observation.png", observation),
    "ends": ("ends.png", ends),
    "splits": ("splits.png", splits),
    "scale": ("scale.png", scale),
    "accrued": ("accrued.png", accrued),
    "choice": ("choice.png", choice),
    "conflicts": ("../results/conflicts.png", conflicts),
    "left_turn": ("left_turn.gif", left_turn),
    "thumbnails": ("thumbnails", thumbnails),
}


def write(options: Namespace) -> int:
    """Draw the pictures."""
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.pictures or PICTURES:
        file, draw = PICTURES[name]
        draw(options.output / file)
        print(options.output / file)
    return 0


OPTIONS = (
    cli.option("pictures", "PICTURE", f"{', '.join(PICTURES)}; all by default", nargs="*"),
    cli.option("--output", "FOLDER", "docs/images, beside which is docs/results", type=Path, required=True),
)
main = cli.Command("", __doc__, OPTIONS, write)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
