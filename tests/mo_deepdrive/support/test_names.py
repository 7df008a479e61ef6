"""Hints for names that are unknown."""

from __future__ import annotations

from mo_deepdrive.support.names import nearest


def test_a_name_in_another_case_is_the_nearest() -> None:
    assert nearest("Reinforce", ["REINFORCE", "Reinforced"]) == "did you mean 'REINFORCE'? known: REINFORCE, Reinforced"
    assert nearest("reinforced", ["REINFORCE"]) == "known: REINFORCE"
