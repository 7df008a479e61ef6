"""Signals are recorded, and a second SIGINT acts as before."""

from __future__ import annotations

import os
import signal
import time

import pytest

from algorithms.runs.interrupts import Interrupts

needs_signals = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")


@needs_signals
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_is_recorded(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with Interrupts() as interrupts:
        assert interrupts.received is None
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
def test_sigterm_may_be_repeated() -> None:
    """As it is where a batch system signals every process of a job, and a parent then its workers."""
    before = signal.getsignal(signal.SIGTERM)
    with Interrupts() as interrupts:
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
            assert interrupts.received == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before


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
