"""Drive what a link of the page holds again, and print the returns by objective.

    mo-deepdrive replay 'https://.../#drive=eyJmb3JtYXQiOjEs....1f0a22c3'

LINK is what the page copies: scenario, seed and actions, with a checksum. In quotes, because a shell reads some of its
characters itself. The returns are those that the page has shown.
"""

from __future__ import annotations

from algorithms.commands.play import print_outcome
from algorithms.runs import cli


def replay(options: cli.Options) -> int:
    """Print how the drive ended for each vehicle, and its undiscounted returns."""
    import mo_deepdrive
    from algorithms.runs.web import Link

    link = Link.read(options.link)
    evaluation, frequency = link.replay()
    if link.version != mo_deepdrive.__version__:
        cli.warn(f"the link is of version {link.version}, this one is {mo_deepdrive.__version__}: returns may differ")
    seconds = (evaluation.lengths[0] / frequency).tolist()
    title = f"{link.id}, seed {link.seed}, driven by {link.driver}"
    print_outcome(title, evaluation.objectives, evaluation.ends[0], seconds, evaluation.returns[0])
    return 0


OPTIONS = (cli.option("link", "LINK", "the link, or what follows #drive= in it"),)
main = cli.Command("replay", __doc__, OPTIONS, replay)
