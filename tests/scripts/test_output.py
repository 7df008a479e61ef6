"""Commands in processes of their own: output that cannot be written, a notebook's backend, Ctrl-C at any time."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.helpers.script_runs import TIMEOUT, command, environment, status

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals and devices")]


def closed_pipe() -> int:
    reader, writer = os.pipe()
    os.close(reader)
    return writer


def full_disk() -> int:
    return os.open("/dev/full", os.O_WRONLY)


def closed_terminal() -> int:
    terminal, side = os.openpty()
    os.close(terminal)
    return side


def run(words: Sequence[str], output: int, cwd: Path, **variables: str) -> tuple[int, str]:
    """Exit code and standard error of a command whose standard output is ``output``."""
    done = subprocess.run(
        words,
        stdout=output,
        stderr=subprocess.PIPE,
        text=True,
        cwd=cwd,
        env={**environment(), **variables},
        timeout=TIMEOUT,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # which a shell's background job ignores
    )
    os.close(output)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("output", "said"),
    [
        (closed_pipe, ""),
        (full_disk, "warning: the output could not be written: [Errno 28] No space left on device\n"),
        (closed_terminal, "warning: the output could not be written: [Errno 5] Input/output error\n"),
    ],
)
def test_training_ends_as_usual_without_its_output_and_in_a_notebook(
    driving: Path, tmp_path: Path, output: Callable[[], int], said: str
) -> None:
    words = command("train", "--config", driving, "--output", "run")
    code, error = run(words, output(), tmp_path, MPLBACKEND="module://nothing.backend_inline")
    assert (code, error) == (0, said)
    assert status(tmp_path / "run")["state"] == "finished"
    assert {"evaluation.json", "curves.png", "video.mp4"} <= {path.name for path in (tmp_path / "run").iterdir()}


@pytest.mark.parametrize(
    ("words", "output", "code"),
    [(("zoo",), closed_pipe, 0), (("zoo",), full_disk, 1), (("sweep", "--help"), full_disk, 1)],
)
def test_output_that_is_the_result_must_be_written_unless_its_reader_has_had_enough(
    tmp_path: Path, words: tuple[str, ...], output: Callable[[], int], code: int
) -> None:
    found, error = run(command(*words), output(), tmp_path)
    assert found == code
    assert error == ("error: the output could not be written: [Errno 28] No space left on device\n" if code else "")


def test_a_run_whose_terminal_is_closed_goes_on(driving: Path, tmp_path: Path) -> None:
    terminal, side = os.openpty()
    words = command("train", "--config", driving, "--output", "run")
    with subprocess.Popen(words, stdin=side, stdout=side, stderr=side, cwd=tmp_path, env=environment()) as process:
        os.close(side)
        while not (tmp_path / "run" / "config.yaml").exists():
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGHUP)
        os.close(terminal)
        assert process.wait(TIMEOUT) == 0
    assert status(tmp_path / "run")["state"] == "finished"
