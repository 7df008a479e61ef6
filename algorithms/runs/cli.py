"""What the commands share: argument definitions, validation and exit handling.

Nothing below ``algorithms/commands`` reads the command line or the environment: a command passes what it has read to
these functions.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs.interrupts import INTERRUPTED, Moved, Stopped
from algorithms.runs.run_directory import METRICS_FILE, Run, default_directory, read_status
from algorithms.runs.run_files import changed_files
from mo_deepdrive.evaluation.splits import EVALUATION_SEED_LIMIT, SPLITS, Split, check_episodes
from mo_deepdrive.support.atomic_io import expand_home, without_links
from mo_deepdrive.support.faults import Fault
from mo_deepdrive.support.names import nearest, printable, shortened

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, MutableMapping, Sequence
    from typing import NoReturn

    from algorithms.runs.config import Experiment

# Exit codes: an error while running, and invalid input (as argparse).
FAILED, INVALID_INPUT = 1, 2
SEEDS = range(EVALUATION_SEED_LIMIT)  # of evaluation episodes
# The episodes by which policies of a front are chosen, unless the user asks for others.
CHOICE_EPISODES = 20
CHOICE_SPLIT: Split = "validation"


# How a command is called: "mo-deepdrive {}", "python -m mo_deepdrive {}" or "python scripts/{}.py".
INSTALLED = "mo-deepdrive {}"
# Variables that are set for a command unless the user has set them: videos are drawn in memory, and an idle thread
# sleeps after some 0.2 ms instead of spinning on a core that others need. Not the user's choice is the backend of
# Matplotlib: figures are drawn into files, and that of a notebook, whose cell calls the command, may not be there.
PROCESS_DEFAULTS = {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "GOMP_SPINCOUNT": "6000"}


def prepare_process(environment: MutableMapping[str, str], path: list[str], defaults: Mapping[str, str]) -> None:
    """Set up the process of a command: its environment, and where a user's own modules are imported from.

    Args:
        environment: ``os.environ``.
        path: ``sys.path``; the working directory, where a user's own utility may be, is added to its end, so that no
            folder in it hides an installed package.
        defaults: variables of the environment that are set unless the user has set them.
    """
    for name, value in defaults.items():
        environment.setdefault(name, value)
    environment["MPLBACKEND"] = "agg"
    path.append(str(Path.cwd()))


def as_called(text: str, program: str) -> str:
    """``text`` with its commands, such as ``mo-deepdrive train``, as they are called in this process.

    Args:
        text: a message or a help text.
        program: how commands are called here, with ``{}`` for the name: see :data:`INSTALLED`.
    """
    return re.sub(r"\bmo-deepdrive ([a-z]+)\b", lambda found: program.format(found[1]), text)


def warn(message: str, program: str = INSTALLED) -> None:
    """Print a message to standard error, without the control characters of names in it, and with very long ones cut.

    Args:
        message: one that names commands as :func:`as_called` takes them.
        program: how commands are called.
    """
    print(printable(shortened(as_called(message, program))), file=sys.stderr)


class Parser(argparse.ArgumentParser):
    """Prints its errors as :func:`warn` does, and replaces ``~`` at the beginning of a value by the home directory.

    Shells do not replace it in ``--output=~/runs``. A ``~`` alone, which is null in YAML, stays the value of a key of
    the experiment, whose option has a dot.
    """

    def parse_known_args(  # type: ignore[override]  # argparse's own types are overloads
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """As argparse does, after replacing each ``~``."""
        given = list(sys.argv[1:] if args is None else args)  # noqa: TID251 (as argparse does)
        return super().parse_known_args([*map(self._expanded, ["", *given], given)], namespace)

    def _expanded(self, before: str, argument: str) -> str:
        option, equals, value = argument.partition("=") if argument.startswith("-") else (before, "", argument)
        if not value.startswith("~") or (value == "~" and option.startswith("--") and "." in option):
            return argument
        try:
            return f"{option}{equals}{expand_home(value)}" if equals else str(expand_home(value))
        except ValueError as error:
            self.error(str(error))

    def error(self, message: str) -> NoReturn:
        """End with the usage and ``message``."""
        super().error(printable(shortened(message)))


def make_parser(description: str | None, program: str = "", command: str = "") -> argparse.ArgumentParser:
    """A parser that prints ``description``, a docstring, as it is, and accepts no abbreviations.

    Args:
        description: the docstring of a command, whose examples are printed as :func:`as_called`; or of a script.
        program: how the command is called; empty for a script.
        command: its name.
    """
    return Parser(
        prog=program.format(command) or None,
        description=as_called(description or "", program) if program else description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


def add_training_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --seed, --device and --output, which :func:`parse_training_arguments` and :func:`new_runs` understand."""
    parser.add_argument("--seed", metavar="N", help="short for --training.seed")
    parser.add_argument("--device", metavar="D", help="short for --training.device")
    parser.add_argument("--output", metavar="DIR", help="directory of the run (default: runs/CONFIG/NAME)")


def parse_training_arguments(
    parser: argparse.ArgumentParser, arguments: Sequence[str]
) -> tuple[argparse.Namespace, list[str]]:
    """Parse a command line in which every key of the YAML file is an option.

    Args:
        parser: with the arguments of :func:`add_training_arguments`.
        arguments: the command line without the name of the command.

    Returns:
        The parser's options, and the overrides for :func:`algorithms.runs.config.load_experiment`.
    """
    options, overrides = parser.parse_known_args(arguments)
    overrides += [f"--{key}={value}" for key in ("seed", "device") if (value := getattr(options, key)) is not None]
    return options, overrides


def refuse_beside(
    parser: argparse.ArgumentParser, options: argparse.Namespace, option: str, *without_effect: str
) -> None:
    """End with an error if one of the options ``without_effect`` is given beside ``option``."""
    for name in without_effect:
        if getattr(options, name) != parser.get_default(name):
            parser.error(f"--{name.replace('_', '-')} has no effect beside {option}")


def new_runs(options: argparse.Namespace, experiments: Sequence[Experiment]) -> list[Run]:
    """Create the runs of ``--config`` in ``--output``, or in new directories under ``runs/``.

    Several are in folders of ``--output`` that are named by their seeds.

    Raises:
        ValueError: if a directory is not empty or cannot be written.
    """
    found = []
    for experiment in experiments:
        if options.output and len(experiments) > 1:
            path = Path(options.output) / f"seed-{experiment.training.seed}"
        else:
            path = options.output or default_directory("runs", options.config, experiment)
        found.append(Run.create(experiment, path))
    return found


def add_evaluation_arguments(
    parser: argparse.ArgumentParser,
    *,
    default_episodes: int | None = None,
    default_split: Split | None = None,
    video: str | None = None,
) -> None:
    """Add --episodes, --split, --seed and perhaps --video, which :func:`evaluation_arguments` checks.

    Args:
        parser: of the command.
        default_episodes: episodes without the option; the config's if None.
        default_split: split of scenario seeds without the option; the config's if None.
        video: help text of --video; None for a command that films nothing.
    """
    episodes, split = ("as in the config" if each is None else each for each in (default_episodes, default_split))
    help_text = f"episodes per policy (default: {episodes})"
    parser.add_argument("--episodes", type=int, default=default_episodes, metavar="N", help=help_text)
    scenarios = parser.add_mutually_exclusive_group()
    help_text = f"split of scenario seeds (default: {split})"
    scenarios.add_argument("--split", choices=SPLITS, default=default_split, help=help_text)
    scenarios.add_argument("--seed", type=int, metavar="S", help="seed of the first episode, instead of a split")
    if video is None:
        parser.set_defaults(video=None)
    else:
        parser.add_argument("--video", metavar="FILE", help=video)


def add_trust_argument(parser: argparse.ArgumentParser) -> None:
    """Add --trust, which is passed to :meth:`Run.open`."""
    help_text = "allow the run's config.yaml to import and run code that it names by module"
    parser.add_argument("--trust", action="store_true", help=help_text)


def warn_of_changes(run: Path, names: Sequence[str] | None = None) -> bool:
    """Print to standard error how the files of a finished run differ from what it wrote.

    Args:
        run: the run's directory; a run whose record is lost is not warned of.
        names: check these files alone; None for all.

    Returns:
        Whether there is a difference.
    """
    found = changed_files(run, names)
    gap = read_status(run).get("metrics_gap")
    if gap is not None and (names is None or METRICS_FILE in names):
        found.append(gap)
    for line in found:
        warn(f"warning: {run}: {line}")
    return bool(found)


def evaluation_arguments(options: argparse.Namespace, experiment: Experiment) -> tuple[int, int]:
    """The number of episodes and the seed of an evaluation, from the command line or else the experiment.

    Args:
        options: with the arguments of :func:`add_evaluation_arguments`, whose --video is checked too.
        experiment: the experiment to evaluate.

    Returns:
        Number of episodes per policy, and seed of the first episode.

    Raises:
        ValueError: if one is out of range, or the directory of --video does not exist.
    """
    settings = experiment.evaluation
    episodes = settings.final_episodes if options.episodes is None else options.episodes
    if episodes < 1:
        raise ValueError(f"--episodes {episodes} must be at least 1")
    seed = options.seed
    if seed is None:
        split = options.split or settings.split
        check_episodes("--episodes", episodes, split)
        seed = SPLITS[split].start
    elif seed not in SEEDS:
        raise ValueError(f"--seed {seed} must be between {SEEDS.start} and {SEEDS.stop - 1}")
    if options.video:
        from algorithms.reporting.videos import check_renderable  # with the packages that render

        check_file("--video", options.video, ".mp4")
        try:
            check_renderable(experiment.environment.id, experiment.environment.arguments)
        except ValueError as error:
            raise ValueError(f"--video {options.video!r}: {error}") from None
    return episodes, seed


def check_file(option: str, path: str | Path | None, *endings: str) -> None:
    """Check, before any work, that an option's file can be written.

    Args:
        option: its name, for the message.
        path: its value; None if it was not given.
        endings: of which its name must have one; none for any name.

    Raises:
        ValueError: if its directory does not exist, it is a directory, or its name ends otherwise.
    """
    if not path:
        return
    if endings and not str(path).lower().endswith(endings):
        raise ValueError(f"{option} {str(path)!r} must end in {' or '.join(endings)}")
    if Path(path).is_dir():
        raise ValueError(f"{option} {str(path)!r} is a directory; it must be a file")
    if not (parent := without_links(path).parent).is_dir():
        raise ValueError(f"{option} {str(path)!r}: {str(parent)!r} is not a directory")


def check_directory(option: str, path: str | Path | None) -> None:
    """Check, before any work, that an option's directory exists or can be made with its parents.

    Args:
        option: its name, for the message.
        path: its value; None if it was not given.

    Raises:
        ValueError: if it or one of its parents is a file.
    """
    if not path:
        return
    whole = Path(path).absolute()
    existing = next(each for each in (whole, *whole.parents) if each.exists())
    if not existing.is_dir():
        raise ValueError(f"{option} {str(path)!r}: {str(existing)!r} is not a directory")


def named_numbers(option: str, pairs: Sequence[str], names: Sequence[str]) -> dict[str, float]:
    """Parse ``["distance=1", "jerk=0.1"]`` as a mapping.

    Args:
        option: the option of these values, for messages.
        pairs: its values.
        names: the known names.

    Raises:
        ValueError: for an unknown or repeated name, or a value that is not a finite number.
    """
    numbers: dict[str, float] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if name not in names:
            raise ValueError(f"{option} {pair!r}: unknown objective {name!r}; {nearest(name, names)}")
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not equals or not math.isfinite(number):
            raise ValueError(f"{option} {pair!r} must be of the form {name}=NUMBER")
        if name in numbers:
            raise ValueError(f"{option} names {name!r} twice")
        numbers[name] = number
    return numbers


@contextlib.contextmanager
def exit_on_error(*invalid_input: type[Exception], hint: str = "", program: str = INSTALLED) -> Iterator[None]:
    """End a command with a message on standard error and an exit code, instead of a traceback.

    The code is 2 for the given exceptions, 1 for :class:`~algorithms.runs.interrupts.Stopped` and
    :class:`~mo_deepdrive.support.faults.Fault`, and 130 for Ctrl-C. Other exceptions are errors of the program and are
    not caught.

    Args:
        invalid_input: exceptions that the user's input causes in this context, such as ValueError.
        hint: a line to print after Ctrl-C and Stopped, such as how to resume.
        program: how commands are called, for those that the message names.

    Raises:
        SystemExit: with the exit code.
    """
    try:
        yield
    except Fault as error:
        warn(f"error: {error}", program)
        raise SystemExit(FAILED) from None
    except invalid_input as error:
        warn(f"error: {error}", program)
        raise SystemExit(INVALID_INPUT) from None
    except Stopped as error:
        shown = [hint] if hint and not isinstance(error, Moved) else []
        warn("\n".join([f"error: {error}", *shown]), program)
        raise SystemExit(FAILED) from None
    except KeyboardInterrupt:
        warn("interrupted" + (f"; {hint}" if hint else ""), program)
        raise SystemExit(INTERRUPTED) from None
