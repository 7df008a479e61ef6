"""Write a trained policy as an ONNX file, which other programs run without this package.

    mo-deepdrive export RUN --output policy.onnx
    mo-deepdrive export left_turn_front-conditioned_mo_ppo --policy 12 --output gentle.onnx

RUN is the directory of a run, or the name of a policy of the zoo. The file takes observations as the environment gives
them, and what else the policy depends on; it gives the greedy action as the environment takes it, and logits, or mean
and standard deviation. Of a front the file takes the condition, too; --policy exports one policy of front.csv instead.
docs/onnx.md describes inputs and outputs. Where onnxruntime is installed the file is checked in 1,000 states.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs.cli import (
    INSTALLED,
    add_trust_argument,
    check_file,
    exit_on_error,
    make_parser,
    warn_of_changes,
)
from algorithms.runs.run_directory import Run

if TYPE_CHECKING:
    from argparse import Namespace


def parse_arguments(arguments: list[str], program: str) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, program, "export")
    parser.add_argument("run", metavar="RUN", help="directory of a run, or a name in the zoo")
    parser.add_argument("--output", required=True, type=Path, metavar="FILE", help="the file, which ends in .onnx")
    parser.add_argument("--policy", type=int, metavar="K", help="of a front: export this policy of front.csv")
    add_trust_argument(parser)
    return parser.parse_args(arguments)


def main(arguments: list[str], program: str = INSTALLED) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    options = parse_arguments(arguments, program)

    from algorithms.runs.build import load_policy
    from algorithms.runs.onnx_export import CHECKED_STATES, export_onnx
    from mo_deepdrive.evaluation.front import Front

    with exit_on_error(ValueError, OSError, program=program):
        check_file("--output", options.output, ".onnx")
        run = Run.open(options.run, trust=options.trust)
        condition = None
        if options.policy is not None:
            if run.experiment.known_utility:
                raise ValueError(f"--policy {options.policy}: {options.run!r} learnt one policy, not a front")
            conditions = Front.read(run.path).conditions
            if not 0 <= options.policy < len(conditions):
                raise ValueError(
                    f"--policy {options.policy} must be from 0 to {len(conditions) - 1}, a policy of front.csv"
                )
            condition = conditions[options.policy]
        warn_of_changes(run.path, ("config.yaml", "checkpoint.safetensors"))
        exported = export_onnx(load_policy(run, partners=False), run.experiment, options.output, condition)
    print(f"inputs: {', '.join(exported.inputs)}\noutputs: {', '.join(exported.outputs)}")
    if exported.difference is None:
        print("not checked: onnxruntime is not installed")
    else:
        print(f"checked in {CHECKED_STATES:,} states: differs by at most {exported.difference:.1e}")
    print(f"written: {options.output}")
    return 0
