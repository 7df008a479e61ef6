"""Signals are recorded, and a second SIGINT acts as before."""

from __future__ import annotations

import os
import signal
import time

import pytest

from algorithms.runs.interrupts import Interrupts

needs_signals = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")


@needs_signals
@pytest.mark.parametrize(("number", "times"), [(signal.SIGINT, 1), (signal.SIGTERM, 3)])
def test_signals_are_recorded(number: signal.Signals, times: int) -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with Interrupts() as interrupts:
        assert interrupts.received is None
        for _ in range(times):
            signal.raise_signal(number)
            assert interrupts.received == number
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before


@needs_signals
def test_the_second_sigint_acts_at_once() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores SIGINT
    try:
        with Interrupts():
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


@needs_signals
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_does_not_end_in_time_is_interrupted_unless_it_is_settled(number: signal.Signals) -> None:
    with Interrupts({number: 0.05}) as interrupts:
        signal.raise_signal(number)
        with pytest.raises(KeyboardInterrupt):
            time.sleep(30.0)
    assert interrupts.received == number
    with Interrupts({number: 0.05}) as interrupts:
        signal.raise_signal(number)
        interrupts.settle()
        time.sleep(0.1)
