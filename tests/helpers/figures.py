"""Figures as they are drawn, so that tests can look at lines, colours and labels instead of pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

if TYPE_CHECKING:
    import pytest


def saved_figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """A list that every figure is added to when it is saved; nothing is written."""
    found: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: found.append(figure))
    return found


def curves(axis: Any) -> list[tuple[str, str]]:
    """The colour and line style of every line of a panel."""
    return [(line.get_color(), line.get_linestyle()) for line in axis.lines]


def legend(figure: Figure) -> dict[str, str]:
    """The colours of a figure's legend, by label and in its order."""
    (found,) = figure.legends
    return {
        text.get_text(): line.get_color()  # type: ignore[attr-defined]
        for text, line in zip(found.get_texts(), found.legend_handles, strict=True)
    }
