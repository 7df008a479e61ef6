"""The curve of rllib_agents.py: arrivals and utilities on the validation split while the pair learns."""

import csv
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mo_deepdrive.learners.reporting.style import COLOURS, INK, figure_style, save_figure, surround

SERIES = {
    "both_arrive": ("both arrive", INK),
    "vehicle_0_arrives": ("vehicle 0 arrives", COLOURS[0]),
    "vehicle_1_arrives": ("vehicle 1 arrives", COLOURS[1]),
    "collisions": ("collisions", COLOURS[3]),
}


def main(source="runs/rllib/curve.csv", output="runs/rllib/curve.png"):
    """Draw sampled actions as lines and greedy ones as dots."""
    with Path(source).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with figure_style():
        figure = Figure(figsize=(6.4, 3.2))
        axes = figure.subplots()
        for column, (_, colour) in SERIES.items():
            for actions, line in (("sampled", "-"), ("greedy", ".")):
                points = [
                    (float(row["joint_steps"]) / 1e6, 100 * float(row[column]))
                    for row in rows
                    if row["actions"] == actions
                ]
                axes.plot(*zip(*points, strict=True), line, color=colour)
        axes.set(xlabel="joint steps (millions)", ylabel="episodes (%)", ylim=(-3, 103))
        handles = [Line2D([], [], color=colour, label=label) for label, colour in SERIES.values()]
        surround(figure, "RLlib's PPO at the intersection", ["lines: sampled actions; dots: greedy ones"], handles)
        save_figure(figure, output, dpi=100)


if __name__ == "__main__":
    main()
