"""Draw learning curves: runs that differ in their seed alone become one curve with a 95% interval.

python scripts/plot.py runs/mo_a2c_linear/* runs/a2c_linear/* --output comparison.png
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from algorithms.plots import load_groups, plot


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="directories of runs")
    parser.add_argument("--output", default="curves.png", metavar="FILE", help="the image (default: curves.png)")
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    try:
        groups = load_groups(options.runs)
        plot(groups, options.output)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for group in groups:
        print(f"{group.label}: {len(group.runs)} seed{'' if len(group.runs) == 1 else 's'}")
    print(Path(options.output))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
