"""Draw for tasks of the suite two drives in one scenario that the task and another judge rank differently.

    python scripts/task_pictures.py --output docs/images/suite
    python scripts/task_pictures.py K4 U2 --output docs/images/suite

Rules of the task's scenario are drawn at random; shown are two that arrive, about which task and judge differ most.
Dots are a second apart.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from algorithms.reporting import style
from algorithms.runs import cli
from mo_deepdrive import suite
from mo_deepdrive.evaluation.drives import record_scenes
from mo_deepdrive.evaluation.metrics import label, name_and_unit
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.simulation.state import LANE_WIDTH, MAP_CENTRE
from mo_deepdrive.suite.scorers import SCORERS
from scripts.bounds.rule_search import FOLLOWING, SEEING, setting_of

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.drives import Scene
    from mo_deepdrive.suite import Task

    Floats = NDArray[np.float64]
    Judge = Callable[[Floats], Floats]  # of returns (..., d)

RULES, SCENARIOS = 64, 4
COLOURS = ("#0072b2", "#d55e00")
SPENT = (0.0, 25.0)  # s, of a task that charges some before


def judges(task: Task) -> list[dict[str, Judge]]:
    """Pairs of judges by name: the task under different circumstances, or beside the objectives that it weighs."""
    objectives = task.objectives()
    time = objectives.index("time")
    if task.preferences is not None:
        weights = task.hidden_weights()
        dear = {name: weights[weights[:, objectives.index(name)].argmax()] for name in ("time", "jerk")}
        return [{f"where {name} is dear": partial(np.inner, prices) for name, prices in dear.items()}]
    if task.config().spent:
        utility, second = task.make_utility(), np.eye(len(objectives))[time]

        def late(seconds: float, returns: Floats) -> Floats:
            return np.asarray(utility(returns - seconds * second))

        return [{f"after {seconds:g} s were spent": partial(late, seconds) for seconds in SPENT}]

    def by_score(returns: Floats) -> Floats:
        scorer = SCORERS[task.score]
        parts = scorer.part(task, returns.reshape(-1, len(objectives)))
        return scorer.score(task, parts).reshape(returns.shape[:-1])

    own: dict[str, Judge] = {"by the task": by_score if task.rulebook else task.make_utility()}
    compared = [name for name in objectives if name in ("time", "g_force", "jerk", "energy", "right_of_way")]
    alone = {name: partial(np.inner, np.eye(len(objectives))[objectives.index(name)]) for name in compared}
    return [{**own, f"by {name_and_unit(name)[0]} alone": judge} for name, judge in alone.items()]


def contrariness(returns: Floats, arrived: NDArray[np.bool_], pair: Iterable[Judge]) -> tuple[float, tuple[int, ...]]:
    """By how much two judges rank two of the rules with returns (K, E, d) in opposite orders: which, and where."""
    by_judge = [np.where(arrived, judge(returns), np.nan) for judge in pair]
    gaps = [(worth[:, None] - worth[None]) / max(np.nanstd(worth), 1e-9) for worth in by_judge]  # (K, K, E)
    contrary = np.nan_to_num(np.minimum(gaps[0], -gaps[1]), nan=-np.inf)
    place = np.unravel_index(contrary.argmax(), contrary.shape)
    return float(contrary[place]), tuple(int(index) for index in place)


def draw(name: str, folder: Path) -> None:
    """Draw the picture of a task."""
    task = suite.load().task(name)
    setting, config = setting_of(task), task.config()
    arguments = {key: value for key, value in setting.arguments.items() if key != "spent"}
    setting = replace(setting, arguments=arguments, partners=setting.partners[-1:])
    family = SEEING.get(config.scenario, FOLLOWING)
    low, high = family.points()
    rules = family.rules(np.random.default_rng(0).uniform(low, high, (RULES, len(low))))
    driven = [met[0] for met in setting.drive(family, rules, SCENARIOS, "validation")]
    returns = np.stack([evaluation.returns[:, task.vehicle] for evaluation in driven])
    objectives = list(task.objectives())
    arrived = returns[..., objectives.index("destination")] > 0.0
    pairs = [(contrariness(returns, arrived, by_name.values()), by_name) for by_name in judges(task)]
    (_, (*pair, scenario)), by_name = max(pairs, key=lambda contrary: contrary[0])
    policy = setting.driver(family, rules[pair], np.arange(2))
    seed = SPLITS["validation"].start + scenario
    (scene,) = record_scenes(policy, setting.env_id, arguments, seeds=[seed], drives=2)
    shown = returns[pair, scenario]
    costs = [k for k, key in enumerate(objectives) if key not in ("distance", "destination") and np.ptp(shown[:, k])]
    numbers = {label(objectives[k]): 0.0 - shown[:, k] for k in costs}
    with style.figure_style({"axes.grid": False}):
        figure = Figure(figsize=(7.2, 3.0), layout="constrained")
        plan, text = figure.subplots(1, 2, width_ratios=(1, 1.3))
        draw_scene(plan, scene, task.vehicle)
        text.set_axis_off()
        lines: list[tuple[str, Any, bool]] = [(key, values, False) for key, values in numbers.items()]
        lines += [(f"judged {key}", judge(shown), True) for key, judge in by_name.items()]
        for row, (key, values, judged) in enumerate([("", ("first", "second"), False), *lines]):
            y = 0.95 - row / (len(lines) + 1)
            text.text(0.0, y, key, transform=text.transAxes, va="top")
            for k, value in enumerate(values):
                best = judged and value == max(values)
                about: dict[str, Any] = {"color": COLOURS[k], "fontweight": "bold" if best else "normal", "ha": "right"}
                shown_as = value if isinstance(value, str) else f"{value:.2f}"
                text.text(0.8 + 0.2 * k, y, shown_as, transform=text.transAxes, va="top", **about)
        style.save_figure(figure, folder / f"{name}.png", dpi=80)


def draw_scene(axes: Any, scene: Scene, vehicle: int) -> None:
    """The map with the two drives of a vehicle, and those of others faintly."""
    left, bottom, side = scene.box(3.0)
    points = side / 100.0  # m per percent of the side
    for road in scene.roads:
        axes.plot(*road.line.T, color=style.GRID, linewidth=road.width / points * 1.6, solid_capstyle="butt")
    if scene.lanes:
        for span, centre in zip((axes.axvspan, axes.axhspan), np.broadcast_to(MAP_CENTRE, 2), strict=True):
            span(centre - LANE_WIDTH, centre + LANE_WIDTH, color=style.GRID, linewidth=0)
    for ends in scene.obstacles:
        axes.plot(*ends.T, color=style.INK, linewidth=3)
    for drive, colour in zip(scene.drives, COLOURS, strict=True):
        others = np.delete(drive.readings, vehicle, axis=1)[..., :2]
        for other in np.moveaxis(np.concatenate([drive.cars[..., :2], others], axis=1), 1, 0):
            axes.plot(*other.T, color=colour, linewidth=0.8, alpha=0.25)
        track = drive.readings[:, vehicle, :2]
        axes.plot(*track.T, color=colour, linewidth=1.2)
        axes.plot(*track[:: scene.decision_frequency].T, ".", color=colour, markersize=5)
    axes.plot(*scene.routes[vehicle][-1], "*", color=style.INK, markersize=9)
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), aspect="equal", xticks=[], yticks=[])


def write(options: Namespace) -> int:
    """Draw the pictures."""
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.tasks or [name for name, task in suite.load().tasks.items() if task.counted]:
        draw(name, options.output)
        print(options.output / f"{name}.png")
    return 0


OPTIONS = (
    cli.option("tasks", "TASK", "all that count by default", nargs="*"),
    cli.option("--output", "FOLDER", "for NAME.png", type=Path, required=True),
)
main = cli.Command("", __doc__, OPTIONS, write)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
