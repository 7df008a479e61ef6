"""The suite: tasks with a floor and a ceiling, and what a policy scores on them.

mo-deepdrive suite list
mo-deepdrive suite score policy.py --tasks K1 K5 --output scores.csv
mo-deepdrive suite verify scores.csv --scenarios 20260101        # again, and on scenarios that follow from a number
mo-deepdrive suite run --learner suite/ppo                       # train a learner on the core tasks
mo-deepdrive suite run --learner my_package.my_module:MyAgent mo_ppo --tasks K1 K3 --seeds 5 --algorithm.gamma=0.98
mo-deepdrive suite table                                         # the reference results
mo-deepdrive suite table runs/studies/suite-ppo/results.csv --figure scores.png

Where a learner of the reference study is trained, all beside it are tuned by its rule. A key of an experiment, such as
--algorithm.gamma=0.98, is for every learner that has the setting.
"""

from __future__ import annotations

import secrets
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.commands.study import STUDY_OPTIONS, write_tables
from algorithms.commands.sweep import ENVIRONMENT as ENVIRONMENT
from algorithms.commands.sweep import run_command
from algorithms.runs.cli import TRUST, Command, CommandGroup, Options, check_at_least, check_file, flag, many, option
from algorithms.runs.config import parse_overrides
from algorithms.runs.console import make_console, print_line
from algorithms.studies import ALL, CORE, REFERENCE

if TYPE_CHECKING:
    from algorithms.studies.plan import StudyPlan


def suite_list(_options: Options) -> int:
    """Print the tasks."""
    from algorithms.reporting.tables import make_table
    from algorithms.studies.plan import PUBLISHED
    from algorithms.studies.suite_tables import Scoreboard
    from mo_deepdrive import suite

    board = Scoreboard(suite.read_rows(PUBLISHED) if PUBLISHED.is_file() else [])
    rows = [["task", "track", "title", "steps", "minutes", "floor", "ceiling", "", "what it tests"]]
    for name, task in suite.load().tasks.items():
        track = task.track if task.counted else "(not counted)"
        minutes = board.minutes(name)
        about = f"{task.steps / 1e6:g} M", "" if minutes is None else f"{minutes:.1f}"
        bounds = f"{task.floor.value:.4g}", f"{task.ceiling.value:.4g}", task.ceiling.kind
        tests = f"{task.tests}; u = {task.formula}" if task.formula else task.tests
        rows.append([f"{name}{' *' if task.core else ''}", track, task.title, *about, *bounds, tests])
    version = suite.load().version
    caption = f"version {version}; * of the core subset; minutes of one core, the median of published runs"
    make_console().print(make_table(rows, 9, title="The suite", caption=caption))
    return 0


def suite_score(options: Options) -> int:
    """Score policies."""
    from algorithms.reporting.tables import print_rows
    from algorithms.runs.progress import compilation_noted
    from algorithms.runs.suite_entries import is_own_code, open_entry
    from algorithms.studies.plan import selected_tasks
    from mo_deepdrive import suite
    from mo_deepdrive.evaluation.statistics import Estimate

    check_file("--output", options.output, ".csv")
    check_at_least(options, 1, "episodes")
    wanted = selected_tasks(options.tasks or ())
    entries = [open_entry(source, trust=options.trust) for source in options.policies]
    if options.learner:
        seeds = [k if is_own_code(entry.source) else entry.seed for k, entry in enumerate(entries)]
        entries = [entry._replace(learner=options.learner, seed=k) for entry, k in zip(entries, seeds, strict=True)]
    pairs = [(entry, task_id) for entry in entries for task_id in (wanted or entry.tasks or selected_tasks([ALL]))]
    runs = Counter((task_id, entry.learner, entry.seed) for entry, task_id in pairs)
    if options.output and (twice := [run for run, count in runs.items() if count > 1]):
        same = "two policies are {1!r} with seed {2} on {0}".format(*twice[0])
        raise ValueError(f"--output {options.output!r}: {same}; a file for each")
    console, rows, samples = make_console(), [], suite.Samples()
    with compilation_noted(lambda text: print_line(console, text)):
        policies = [entry.policy(task_id) for entry, task_id in pairs]
        for (entry, task_id), policy in zip(pairs, policies, strict=True):
            with console.status(f"{entry.source} on {task_id}"):
                how = {"episodes": options.episodes, "perturbed": not options.no_perturbations, "samples": samples}
                scores = entry.score(policy, task_id, **how)
            table = [["column", "policy", "value, 95% interval", "normalised"]]
            for row in scores:
                value = "" if row.value is None else Estimate(row.value, row.low, row.high).text()
                normalised = "" if row.normalised is None else f"{row.normalised:.3f}"
                table.append([row.column, row.policy, value, normalised])
            print_rows(console, table, f"{task_id}: {suite.load().task(task_id).title}; {entry.source}", 2)
            rows += scores
            if options.output:
                suite.write_rows(options.output, rows)
                suite.write_samples(options.output, samples)
    if options.output:
        print(f"written: {options.output}")
    return 0


def suite_verify(options: Options) -> int:
    """Score an entry again, on the scenarios of the test split and on fresh ones; 0 if everything agrees, else 1."""
    from algorithms.reporting.tables import print_rows
    from algorithms.runs.suite_entries import disagreement, fresh_seed, is_own_code, open_entry, recorded_rows
    from mo_deepdrive import suite

    wanted = options.tasks or ()
    for task_id in wanted:
        suite.load().task(task_id)
    recorded = [row for row in recorded_rows(options.entry, trust=options.trust) if not wanted or row.task in wanted]
    if not recorded:
        raise ValueError(f"{options.entry!r} has no scores of {', '.join(wanted)}")
    pairs = dict.fromkeys((row.source, row.task) for row in recorded)
    code = [source for source, _ in pairs if is_own_code(source)]
    if code and not options.trust:  # before anything of it is imported
        raise ValueError(f"{options.entry!r} names code to run, {code[0]!r}; --trust runs it")
    number = secrets.randbelow(10**8) if options.scenarios is None else options.scenarios
    opened = {source: open_entry(source, trust=options.trust) for source, _ in pairs}
    policies = {(source, task_id): opened[source].policy(task_id) for source, task_id in pairs}
    console, faults = make_console(), []
    table = [["policy", "task", "column", "scenarios", "recorded", "found", "verdict"]]
    for (source, task_id), policy in policies.items():
        first = fresh_seed(number, suite.load().task(task_id).episodes)
        for scenarios, start in (("test split", None), (f"fresh: {number}", first)):
            with console.status(f"{source} on {task_id}"):
                scored = opened[source].score(policy, task_id, first_episode=start)
            again = {(row.policy, row.column): row for row in scored}
            for claim in (row for row in recorded if (row.source, row.task) == (source, task_id)):
                rescored = again.get((claim.policy, claim.column))
                wrong = disagreement(claim, rescored, fresh=start is not None)
                value = "" if rescored is None or rescored.value is None else f"{rescored.value:.4f}"
                verdict = "differs" if wrong else "agrees" if start is not None else "reproduced"
                column = f"{claim.column} ({claim.policy})"
                table.append([source, task_id, column, scenarios, f"{claim.value:.4f}", value, verdict])
                if wrong:
                    faults.append(f"{source} on {task_id}, {column}, {scenarios}: {wrong}")
    print_rows(console, table, options.entry, 4)
    for fault in faults:
        print(fault)
    return 1 if faults else 0


def suite_run(options: Options) -> int:
    """Train learners on tasks of the suite, and score them."""
    from algorithms.studies.manifest import short_names
    from algorithms.studies.plan import plan_of

    overrides = dict(parse_overrides(options.overrides))
    name = "-".join(["suite", *short_names(options.learner).values()]).replace("/", "-")

    def make_plan() -> StudyPlan:
        return plan_of(options.learner, options.tasks or [CORE], options.seeds, overrides)

    return run_command(options, options.output or Path("runs") / "studies" / name, make_plan, write_tables)


def suite_table(options: Options) -> int:
    """Print the tables of the suite, and write them if asked to."""
    from algorithms.reporting.tables import FORMATS, markdown, print_rows, write_table
    from algorithms.studies.plan import PUBLISHED
    from algorithms.studies.suite_tables import MEANS_NOTE, NOTE, Scoreboard, read_results
    from mo_deepdrive.support.atomic_io import atomic_write

    check_file("--figure", options.figure)
    check_file("--output", options.output, *FORMATS)
    if options.published and options.results is None:
        raise ValueError("--published puts results of yours beside the reference results: name their CSV")
    results, samples = read_results(options.results or PUBLISHED)
    learners: set[str] = set()  # those of the user, beside the reference results
    if options.published:
        learners, (reference, of_reference) = {row.learner for row in results}, read_results(PUBLISHED)
        if both := learners & {row.learner for row in reference}:
            raise ValueError(
                f"{str(options.results)!r} has the learner {min(both)!r}, as the reference results; rename"
            )
        results, samples = [*results, *reference], {**samples, **of_reference}
    console, board = make_console(), Scoreboard(results, samples)
    tables = board.task_tables(options.baseline)
    scores, differences = board.comparison(options.baseline, learners)
    tables += [("Scores", scores), ("Differences", differences)] if options.published or options.baseline else []
    says = "\n".join(f"{name}: {' '.join(board.sentences(name))}" for name in board.tasks)
    for title, rows in tables:
        print_rows(console, rows, title, 1)
    console.print(says, NOTE, sep="\n\n", highlight=False, markup=False)
    written: list[Path] = []
    if options.figure is not None:
        board.draw(options.figure)
        written.append(options.figure)
    if options.output is not None and options.output.suffix == ".md":
        text = "\n".join(f"## {title}\n\n{markdown(rows, 1, NOTE)}" for title, rows in tables) + f"\n{says}\n"
        atomic_write(options.output, text.encode())
        written.append(options.output)
    elif options.output is not None:
        for ending, rows in (("", scores), ("-differences", differences)):
            written.append(options.output.with_stem(options.output.stem + ending))
            write_table(written[-1], rows, 1, MEANS_NOTE)
    for path in written:
        print_line(console, f"written: {path}")
    return 0


POLICY = "a run, a policy of the zoo, policy.py, policy.py:name or package.module:name; a class is made of a task's id"
LEARNER = (
    "YAML file with an algorithm, the name of a shipped one, an own package.module:Class, or a learner of the "
    f"reference study ({REFERENCE}), which is tuned as there, as are all beside it"
)
SCORE_OPTIONS = (
    option("policies", "POLICY", POLICY, nargs="+"),
    many("--tasks", "TASK", f"their ids, {CORE}, or {ALL} that count (default: those of a run; {ALL} for others)"),
    option("--episodes", "N", "instead of those of a task", type=int),
    flag("--no-perturbations", "leave out the columns of generalisation"),
    option("--learner", "NAME", "label of all, of which functions and classes are the seeds 0, 1, 2 ..."),
    option("--output", "CSV", "also write the rows, from which suite verify reads them"),
    TRUST,
)
VERIFY_OPTIONS = (
    option("entry", "ENTRY", "a CSV of suite score, or a run that was scored as a task"),
    many("--tasks", "TASK", "verify these alone"),
    option("--scenarios", "NUMBER", "from which fresh scenarios follow (default: drawn)", type=int),
    TRUST,
)
RUN_OPTIONS = (
    many("--learner", "L", LEARNER, required=True),
    many("--tasks", "TASK", f"their ids, {CORE} (the default), or {ALL} that count"),
    option("--seeds", "N", "seeds of each task (default: %(default)s)", type=int, default=10),
    *STUDY_OPTIONS,
)
TABLE_OPTIONS = (
    option("results", "RESULTS.csv", "of a study (default: the reference results)", nargs="?", type=Path),
    option("--figure", "FILE.png", "draw the scores with their intervals", type=Path),
    flag("--published", "beside the reference results"),
    option("--baseline", "LEARNER", "whom the others are compared with, task by task and over the tasks of all"),
    option("--output", "FILE", "write the tables (.md), or scores and differences (.tex, .csv)", type=Path),
)
ACTIONS = (
    Command("suite list", "the tasks, with what each tests, its floor and its ceiling", (), suite_list),
    Command("suite score", "score policies, trained here or by any library", SCORE_OPTIONS, suite_score),
    Command("suite verify", "score an entry again, and compare", VERIFY_OPTIONS, suite_verify),
    Command(
        "suite run",
        "train learners on tasks of the suite, with the help that all learners get",
        RUN_OPTIONS,
        suite_run,
        takes_keys=True,
    ),
    Command("suite table", "normalised scores per task and learner, and their differences", TABLE_OPTIONS, suite_table),
)
main = CommandGroup("suite", __doc__, ACTIONS)
