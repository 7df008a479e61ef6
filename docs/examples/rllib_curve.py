"""The curve of rllib_agents.py: arrivals and utilities on the validation split while the pair learns."""

import csv
from pathlib import Path

from matplotlib.figure import Figure

SERIES = {
    "both_arrive": ("both arrive", "#000000"),
    "vehicle_0_arrives": ("vehicle 0 arrives", "#0072B2"),
    "vehicle_1_arrives": ("vehicle 1 arrives", "#D55E00"),
    "collisions": ("collisions", "#CC79A7"),
}


def main(source="runs/rllib/curve.csv", output="runs/rllib/curve.png"):
    """Draw sampled actions as lines and greedy ones as dots."""
    with Path(source).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    for column, (label, colour) in SERIES.items():
        for actions, style in (("sampled", "-"), ("greedy", ".")):
            points = [
                (float(row["joint_steps"]) / 1e6, 100 * float(row[column])) for row in rows if row["actions"] == actions
            ]
            axes.plot(*zip(*points, strict=True), style, color=colour, label=label if actions == "sampled" else None)
    axes.set(xlabel="joint steps (millions)", ylabel="episodes (%)", ylim=(-3, 103))
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, title="lines: sampled\ndots: greedy")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(output, dpi=100)


if __name__ == "__main__":
    main()
