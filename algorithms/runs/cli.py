"""What the commands share: how they are declared and run, the options of several, checks of values, and exit codes.

Nothing below ``algorithms/commands`` reads the command line or the environment: a command passes what it has read to
these functions.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from algorithms.runs.interrupts import INTERRUPTED, Stopped
from algorithms.runs.run_directory import Run, default_directory
from mo_deepdrive.evaluation.splits import EVALUATION_SEED_LIMIT, SPLITS, Split, check_episodes
from mo_deepdrive.support.atomic_io import expand_home, without_links
from mo_deepdrive.support.faults import Fault
from mo_deepdrive.support.names import nearest, printable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import NoReturn

    from algorithms.runs.config import Experiment

# Exit codes: an error while running, and invalid input (as argparse).
FAILED, INVALID_INPUT = 1, 2
# Variables that are set for a command unless the user has set them: videos are drawn in memory, and an idle thread
# sleeps after some 0.2 ms instead of spinning on a core that others need.
PROCESS_DEFAULTS = {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "GOMP_SPINCOUNT": "6000"}
# The episodes by which policies of a front are chosen, unless the user asks for others.
CHOICE_EPISODES = 20
CHOICE_SPLIT: Split = "validation"


# ----------------------------------------------------------------------------------------------- commands and options


Options = argparse.Namespace  # of a command line
Option = Callable[["argparse._ActionsContainer"], object]  # adds an option, an argument or several of them to a parser


def option(name: str, metavar: str | None, text: str, **settings: Any) -> Option:
    """An option with a value, or an argument if ``name`` has no dashes; ``settings`` are argparse's."""
    return lambda parser: parser.add_argument(name, metavar=metavar, help=text, **settings)


def one_of(*options: Option, required: bool = False) -> Option:
    """Options of which at most one can be given, or exactly one if it is ``required``."""

    def add(parser: argparse._ActionsContainer) -> None:
        group = parser.add_mutually_exclusive_group(required=required)
        for add_option in options:
            add_option(group)

    return add


def many(name: str, metavar: str, text: str, **settings: Any) -> Option:
    """An option with one or more values, which may be given again for further ones."""
    return option(name, metavar, text, nargs="+", action="extend", **settings)


def flag(name: str, text: str) -> Option:
    """An option without a value."""
    return lambda parser: parser.add_argument(name, action="store_true", help=text)


class Command(NamedTuple):
    """A command, called with the words of its command line; returns the exit code."""

    name: str  # after ``mo-deepdrive``
    description: str | None  # the docstring of its module, which ``--help`` prints as it is
    options: tuple[Option, ...]  # in the order of the help
    run: Callable[[argparse.Namespace], int]  # does it, and returns the exit code
    # Whether every key of an experiment is an option, too; they are in the attribute ``overrides``.
    takes_keys: bool = False
    # Exceptions that the user's input causes, which end the command with a line; others are errors of the program.
    errors_of_input: tuple[type[Exception], ...] = (ValueError, OSError)

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """The options in a command line."""
        parser = make_parser(self.description, self.name)
        for add_option in self.options:
            add_option(parser)
        options, rest = parser.parse_known_args(arguments)
        if rest and not self.takes_keys:
            parser.error(f"unrecognized arguments: {' '.join(rest)}")
        options.overrides = rest
        return options

    def __call__(self, arguments: Sequence[str]) -> int:
        """Run a command line."""
        options = self.parse(arguments)
        with exit_on_error(*self.errors_of_input):
            return self.run(options)


class CommandGroup(NamedTuple):
    """A command with actions, commands whose names begin with its own."""

    name: str
    description: str | None
    actions: tuple[Command, ...]

    def __call__(self, arguments: Sequence[str]) -> int:
        """Run the action that is the first word of a command line."""
        actions = {action.name.split()[-1]: action for action in self.actions}
        texts = {name: str(action.description).splitlines()[0] for name, action in actions.items()}
        name = first_word(make_parser(self.description, self.name), "action", texts, arguments)
        return actions[name](arguments[1:])


def first_word(parser: argparse.ArgumentParser, kind: str, texts: Mapping[str, str], arguments: Sequence[str]) -> str:
    """The command or action with which a command line begins; the help has a line for each."""
    lines = [f"  {name:12}{text}" for name, text in texts.items()]
    parser.epilog = "\n".join([f"{kind}s:", *lines, "", f"{kind.upper()} --help: its options"])
    parser.add_argument(kind, choices=texts, metavar=kind.upper(), help="one of those below")
    return str(getattr(parser.parse_args(arguments[:1]), kind))


CONFIG = option("--config", "FILE", "YAML file of the experiment, or the name of a shipped one")
RUN = option("run", "RUN", "directory of a run, or a name in the zoo")
RUNS = option("runs", "RUN", "run directories, or folders that hold some; or one sweep", nargs="+", type=Path)
RUN_OUTPUT = option("--output", "DIR", "directory of the run (default: runs/CONFIG/NAME)")
TRUST = flag("--trust", "allow the run's config.yaml to import and run code that it names by module")


def evaluation_options(episodes: int | None = None, split: Split | None = None) -> tuple[Option, Option]:
    """--episodes, and --split or --seed; without them ``episodes`` and ``split``, or those of the config."""
    text = f"episodes per policy (default: {episodes or 'as in the config'})"
    splits = f"split of scenario seeds (default: {split or 'as in the config'})"
    return (
        option("--episodes", "N", text, type=int, default=episodes),
        one_of(
            option("--split", None, splits, choices=SPLITS, default=split),
            option("--seed", "S", "seed of the first episode, instead of a split", type=int),
        ),
    )


class Parser(argparse.ArgumentParser):
    """Prints its errors as :func:`warn` does, and expands ``--output=~/runs``, which shells do not."""

    def parse_known_args(  # type: ignore[override]  # argparse's own types are overloads
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """As argparse does, after replacing each ``~/`` at the beginning of a value."""
        words = list(sys.argv[1:] if args is None else args)  # noqa: TID251 (as argparse does)
        for number, word in enumerate(words):
            option, equals, value = word.partition("=") if word.startswith("-") else ("", "", word)
            if value.startswith("~/"):
                try:
                    words[number] = f"{option}{equals}{expand_home(value)}"
                except ValueError as error:
                    self.error(str(error))
        return super().parse_known_args(words, namespace)

    def error(self, message: str) -> NoReturn:
        """End with the usage and ``message``."""
        super().error(printable(message))


def make_parser(description: str | None, command: str = "") -> argparse.ArgumentParser:
    """A parser of a command, or of a script, that prints a docstring as it is and accepts no abbreviations."""
    return Parser(
        prog=f"mo-deepdrive {command}" if command else None,
        description=description or "",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


# -------------------------------------------------------------------------------------------------------------- values


def new_runs(options: argparse.Namespace, experiments: Sequence[Experiment]) -> list[Run]:
    """Create the runs of ``--config`` in ``--output``, several in folders of it; or in new ones under ``runs/``."""
    runs = []
    for experiment in experiments:
        path = options.output or default_directory("runs", options.config, experiment)
        if options.output and len(experiments) > 1:
            path = Path(options.output) / f"seed-{experiment.training.seed}"
        runs.append(Run.create(experiment, path))
    return runs


def evaluation_arguments(options: argparse.Namespace, experiment: Experiment) -> tuple[int, int]:
    """The number of episodes per policy and the seed of the first one, from the command line or else the experiment."""
    settings, seed = experiment.evaluation, options.seed
    check_at_least(options, 1, "episodes")
    episodes = options.episodes or settings.final_episodes
    if seed is None:
        split = options.split or settings.split
        check_episodes("--episodes", episodes, split)
        seed = SPLITS[split].start
    elif not 0 <= seed < EVALUATION_SEED_LIMIT:
        raise ValueError(f"--seed {seed} must be between 0 and {EVALUATION_SEED_LIMIT - 1}")
    if video := getattr(options, "video", None):
        from algorithms.reporting.videos import check_renderable  # with the packages that render

        check_file("--video", video, ".mp4")
        try:
            check_renderable(experiment.environment.id, experiment.environment.arguments)
        except ValueError as error:
            raise ValueError(f"--video {video!r}: {error}") from None
    return episodes, seed


def check_front(run: Run, name: str) -> None:
    """Refuse, with a ValueError, a run whose algorithm learns one policy, by the name that the user gave it."""
    if run.experiment.known_utility:
        raise ValueError(f"{name!r} learnt one policy, not a front: mo-deepdrive evaluate shows it")


def policy_index(option: int, count: int) -> int:
    """The value of --policy, one of the ``count`` rows of a front.csv; a ValueError if it is not."""
    if not 0 <= option < count:
        raise ValueError(f"--policy {option} must be from 0 to {count - 1}, a policy of front.csv")
    return option


def check_file(option: str, path: str | Path | None, *endings: str) -> None:
    """Check, before any work, that the file of an option can be written; nothing if it was not given."""
    if not path:
        return
    if endings and not str(path).lower().endswith(endings):
        raise ValueError(f"{option} {str(path)!r} must end in {' or '.join(endings)}")
    if Path(path).is_dir():
        raise ValueError(f"{option} {str(path)!r} is a directory; it must be a file")
    if not (parent := without_links(path).parent).is_dir():
        raise ValueError(f"{option} {str(path)!r}: {str(parent)!r} is not a directory")


def check_directory(option: str, path: str | Path | None) -> None:
    """Check, before any work, that the directory of an option exists or can be made; nothing if it was not given."""
    if not path:
        return
    whole = Path(path).absolute()
    existing = next(folder for folder in (whole, *whole.parents) if folder.exists())
    if not existing.is_dir():
        raise ValueError(f"{option} {str(path)!r}: {str(existing)!r} is not a directory")


def check_at_least(options: argparse.Namespace, least: int, *names: str) -> None:
    """Refuse, with a ValueError, options below ``least``; those that are None were not given."""
    for name in names:
        value = getattr(options, name)
        if value is not None and value < least:
            raise ValueError(f"--{name} {value} must be at least {least}")


def named_numbers(option: str, pairs: Sequence[str], names: Sequence[str]) -> dict[str, float]:
    """Parse ``["distance=1", "jerk=0.1"]``, values of an ``option``, as a mapping."""
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


# ---------------------------------------------------------------------------------------------------------- exit codes


def warn(message: str) -> None:
    """Print to standard error, without the control characters of names in the message, and with very long ones cut."""
    print(printable(message), file=sys.stderr)


@contextlib.contextmanager
def exit_on_error(*errors_of_input: type[Exception], hint: str = "") -> Iterator[None]:
    """End a command with a message on standard error and an exit code, instead of a traceback.

    The code is 2 for ``errors_of_input``, which the user's input causes in this context, 1 for Stopped and Fault, and
    130 for Ctrl-C. Others are errors of the program, and not caught. After Ctrl-C and Stopped the ``hint`` is printed,
    such as how to resume.
    """
    try:
        yield
        return
    except Fault as error:
        message, code = f"error: {error}", FAILED
    except errors_of_input as error:
        message, code = f"error: {error}", INVALID_INPUT
    except Stopped as error:
        message, code = "\n".join([f"error: {error}", *([hint] if hint else [])]), FAILED
    except KeyboardInterrupt:
        message, code = "interrupted" + (f"; {hint}" if hint else ""), INTERRUPTED
    warn(message)
    raise SystemExit(code)
