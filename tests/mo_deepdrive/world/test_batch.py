"""A pool of threads waits for all parts, whatever becomes of the first."""

from __future__ import annotations

import time

import pytest

from mo_deepdrive.world.batch import ThreadPool


def test_an_error_is_raised_after_all_parts_have_ended() -> None:
    pool, done = ThreadPool(), []

    def work(part: int) -> None:
        if part == 0:
            raise ValueError("the first part")
        time.sleep(0.2)
        done.append(part)

    with pytest.raises(ValueError, match="the first part"):
        pool.run(work, [0, 1, 2])
    assert sorted(done) == [1, 2]
    pool.close()
