"""Drive what a link of the page holds again, and print the returns by objective.

    mo-deepdrive replay 'https://.../#drive=eyJmb3JtYXQiOjEs....1f0a22c3'

LINK is what the page copies: scenario, seed and actions, with a checksum. In quotes, because a shell reads some of its
characters itself. The returns are those that the page has shown.
"""

from __future__ import annotations

from algorithms.runs import cli


def replay(options: cli.Options) -> int:
    """Print how the drive ended for each vehicle, and its undiscounted returns."""
    import mo_deepdrive
    from algorithms.runs.web import Link
    from mo_deepdrive.evaluation.metrics import name_and_unit, vehicle_name
    from mo_deepdrive.simulation.state import ENDS
    from mo_deepdrive.world.params import chosen_objectives

    link = Link.read(options.link)
    config, drives = link.replay()
    if link.version != mo_deepdrive.__version__:
        cli.warn(f"the link is of version {link.version}, this one is {mo_deepdrive.__version__}: returns may differ")
    vehicles = drives.returns.shape[1]
    rows = [["", *(vehicle_name(v) if vehicles > 1 else "return" for v in range(vehicles))]]
    for name, returns in zip(chosen_objectives(config), drives.returns[0].T.tolist(), strict=True):
        named, unit = name_and_unit(name)
        rows.append([f"{named} ({unit})" if unit else named, *(f"{value:.6g}" for value in returns)])
    rows.append(["end", *(ENDS[end] or "driving" for end in drives.ends[0])])
    rows.append(["driven for (s)", *(f"{length / config.decision_frequency:.1f}" for length in drives.lengths[0])])
    print(f"{link.id}, seed {link.seed}, driven by {link.driver}\n")
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for name, *cells in rows:
        print("  ".join((name.ljust(widths[0]), *map(str.rjust, cells, widths[1:]))))
    return 0


OPTIONS = (cli.option("link", "LINK", "the link, or what follows #drive= in it"),)
main = cli.Command("replay", __doc__, OPTIONS, replay)
