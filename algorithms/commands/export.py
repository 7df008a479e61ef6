"""Write a trained policy as an ONNX file, which other programs run without this package.

    mo-deepdrive export RUN --output policy.onnx
    mo-deepdrive export left_turn_front-conditioned_mo_ppo --policy 12 --output gentle.onnx

RUN is the directory of a run, or the name of a policy of the zoo. The file takes observations as the environment gives
them, and what else the policy depends on; it gives the greedy action as the environment takes it, and logits, or mean
and standard deviation. Of a front the file takes the condition, too; --policy exports one policy of front.csv instead.
docs/use_with.md#onnx describes inputs and outputs. Where onnxruntime is installed the file is checked in 1,000 states.
"""

from __future__ import annotations

from pathlib import Path

from algorithms.runs import cli
from algorithms.runs.run_directory import Run


def export(options: cli.Options) -> int:
    """Write the file, and check it."""
    from algorithms.runs.build import load_policy
    from algorithms.runs.onnx_export import CHECKED_STATES, export_onnx
    from mo_deepdrive.evaluation.front import Front

    cli.check_file("--output", options.output, ".onnx")
    run, condition = Run.open(options.run, trust=options.trust), None
    if options.policy is not None:
        cli.check_front(run, options.run)
        conditions = Front.read(run.path).conditions
        condition = conditions[cli.policy_index(options.policy, len(conditions))]
    exported = export_onnx(load_policy(run, partners=False), run.experiment, options.output, condition)
    print(f"inputs: {', '.join(exported.inputs)}\noutputs: {', '.join(exported.outputs)}")
    if exported.difference is None:
        print("not checked: onnxruntime is not installed")
    else:
        print(f"checked in {CHECKED_STATES:,} states: differs by at most {exported.difference:.1e}")
    print(f"written: {options.output}")
    return 0


OPTIONS = (
    cli.RUN,
    cli.option("--output", "FILE", "the file, which ends in .onnx", required=True, type=Path),
    cli.option("--policy", "K", "of a front: export this policy of front.csv", type=int),
    cli.TRUST,
)
main = cli.Command("export", __doc__, OPTIONS, export)
