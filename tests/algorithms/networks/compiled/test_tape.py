"""The tape: gradients of chains and sums of operations, and what it leaves out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from algorithms.networks.compiled.tape import Tape, current_tape, recording


def scaled(tape: Tape, source: torch.Tensor, factor: float, calls: list[float]) -> torch.Tensor:
    """``factor * source`` on the tape."""
    output = factor * source.detach()

    def backward(by_outputs: Sequence[NDArray[Any]], gradients: Mapping[Any, NDArray[Any]]) -> NDArray[Any]:
        calls.append(factor)
        gradients[factor][...] += by_outputs[0] @ source.detach().numpy()
        return factor * by_outputs[0]

    tape.record(source, [output], backward)
    return output


def test_the_gradient_passes_through_chains_and_adds_up() -> None:
    tape, calls = Tape(), []
    x = torch.tensor([1.0, 2.0])
    two = scaled(tape, x, 2.0, calls)
    six = scaled(tape, two, 3.0, calls)
    scaled(tape, two, 5.0, calls)  # not part of the loss
    gradients = {factor: np.zeros(()) for factor in (2.0, 3.0, 5.0)}
    ones = np.ones(2)
    # The loss is the sum of six, twice, and of two.
    tape.add_gradients([(six, ones), (two, ones), (six, ones)], gradients)
    assert calls == [3.0, 2.0]
    # d/da of 2 * b a x + a x, and d/db of 2 * b a x, with a = 2, b = 3 and the sum of x equal to 3.
    assert gradients == {2.0: (2 * 3 + 1) * 3.0, 3.0: 2 * 2 * 3.0, 5.0: 0.0}


def test_a_tape_records_within_its_context_where_gradients_are_wanted() -> None:
    assert current_tape() is None
    with recording() as outer:
        assert current_tape() is outer
        with recording() as inner:
            assert current_tape() is inner
        with torch.no_grad():
            assert current_tape() is None
        assert current_tape() is outer
    assert current_tape() is None
