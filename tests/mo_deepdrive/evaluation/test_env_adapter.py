"""Copies of other libraries' environments."""

from __future__ import annotations

import pytest

from mo_deepdrive import machine
from mo_deepdrive.evaluation import env_adapter


def test_copies_that_cannot_fit_into_memory_are_refused_after_the_first_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    peaks = iter((0, machine.GIB))
    monkeypatch.setattr(env_adapter, "COPIES_MEASURED", 4)
    monkeypatch.setattr(env_adapter, "peak_memory", lambda: next(peaks))
    monkeypatch.setattr(machine, "available_memory", lambda: 2.0 * machine.GIB)
    with pytest.raises(ValueError, match=r"num_envs = 16 takes at least 3\.0 GiB of memory; 2\.0 GiB are available"):
        env_adapter.make_env("deep-sea-treasure-v0", 16)
