"""A table of the algorithms of other libraries."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from algorithms.peers import PEERS


def peers_table() -> Table:
    """One row per peer: what it learns, the actions and numbers of objectives it takes, and whether it can run here.

    Below the table are the reasons why peers cannot run.
    """
    table = Table(box=SIMPLE_HEAD)
    table.add_column("name", no_wrap=True)
    for column in ("learns", "actions", "objectives", "runs here"):
        table.add_column(column, overflow="fold")
    reasons: dict[str, None] = {}
    for name, peer in PEERS.items():
        objectives = "any" if peer.objectives is None else "{} to {}".format(*peer.objectives)
        reason = peer.unavailable_reason()
        table.add_row(
            name,
            "a known utility" if peer.known_utility else "a front",
            ", ".join(peer.actions),
            objectives,
            "yes" if reason is None else "no",
        )
        reasons |= {reason: None} if reason is not None else {}
    table.caption, table.caption_justify = Text("\n".join(f"no: {reason}" for reason in reasons)), "left"
    return table
