"""The commands: ``mo-deepdrive NAME`` or ``python -m mo_deepdrive NAME``.

Each module has ``main(arguments) -> int``, mostly a :class:`~algorithms.runs.cli.Command`, which runs a command line
and returns the exit code. A module is imported when its command is called. At its top it imports what parses the
command line, and nothing of an extra; what takes long to import, such as torch, is imported by the functions that need
it. So every ``--help`` is printed at once, and by the core install, too.
"""

COMMANDS = {
    "train": "train an agent from a YAML file, or resume a run",
    "keys": "the keys of YAML files, with type, default and description",
    "evaluate": "scores of a trained policy or front, and videos of it",
    "plot": "learning curves of runs or of a sweep",
    "table": "final scores of runs or of a sweep, with intervals",
    "choose": "choose a policy of a front by a preference",
    "explore": "a page to choose a policy of a front and watch its drive",
    "export": "the policy as an ONNX file, for other programs",
    "sweep": "train all runs of a grid or search: on this machine, Ray or Slurm",
    "suite": "tasks with a floor and a ceiling, and what a policy scores on them",
    "study": "train and compare learners on tasks, with tuning, and write the tables",
    "reproduce": "the paper's figures and claims, from scratch",
    "peers": "train an algorithm of another library",
    "play": "drive in a window or a browser, alone or against a trained policy",
    "replay": "drive what a link of the page holds again, and its returns",
    "web": "a page on which to drive in an environment of your own",
    "zoo": "list the trained policies that come with the package",
}
# What prints its result, so that output that is lost is an error; all else writes it to files.
PRINTING_COMMANDS = ("keys", "evaluate", "table", "choose", "replay", "suite", "zoo")
PRINTING_OPTIONS = {"-h", "--help", "--version", "--list", "--status", "--dry-run"}
