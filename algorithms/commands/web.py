"""A page on which to drive, with worlds of your own as WebAssembly.

    mo-deepdrive web build --env mo-deepdrive-left-turn-v1 --arguments '{traffic: dense}' --output page
    mo-deepdrive web build --env my_scenarios:mo-deepdrive-chicane-v0 --policy RUN --output page

The folder is a site without a server: any web server shows it, such as python -m http.server. Besides the worlds that
come with the package it has the environment of --env, first in the menu, with the policies that learnt to drive there.
Linking needs wasm-ld, which Debian's lld has, or the extra web. Environments may have objectives of their own, if Numba
compiles them without Python: numbers alone, no arrays, texts or errors.
"""

from __future__ import annotations

from pathlib import Path

from algorithms.runs import cli
from mo_deepdrive.support.yaml import read_value


def build(options: cli.Options) -> int:
    """Compile the world, and write the page with it."""
    from algorithms.reporting.page.page import write_site
    from algorithms.runs import web
    from algorithms.runs.build import load_policy
    from algorithms.runs.run_directory import Run
    from mo_deepdrive.device.wasm import compile_module

    arguments = read_value(options.arguments)
    if not isinstance(arguments, dict):
        raise ValueError(f"--arguments {options.arguments!r} must be a mapping")
    cli.check_directory("--output", options.output)
    config = web.configuration("--env", options.env, arguments)
    if config.action_type == "continuous":
        raise ValueError("--arguments: action_type = 'continuous' cannot be driven with keys; take 'discrete'")
    module, folder = compile_module(config), Path(options.output)
    facts = web.world_facts(config, options.env, arguments)
    write_site(folder)
    for number, each in enumerate(options.policy or ()):
        run = Run.open(each, trust=options.trust)
        agent = load_policy(run)
        if (agent.env.observation_size, agent.env.vehicles) != (len(facts["observations"]), facts["vehicles"]):
            raise ValueError(f"--policy {each}: it learnt in {run.experiment.environment.id}, and sees something else")
        facts["policies"] += web.write_policies(folder, agent, f"own-policy-{number}", Path(each).name)
    web.write_world(folder, "own", facts, module)
    print(f"{folder / 'index.html'}: {len(module) / 1000:.0f} kB of {options.env}; see it with a web server, such as")
    print(f"python -m http.server --directory {folder}")
    return 0


OPTIONS = (
    cli.option("--env", "ID", "one of this package's environments, or module:ID of your own", required=True),
    cli.option("--arguments", "YAML", "arguments of the environment, such as '{vehicles: 6}'", default="{}"),
    cli.many("--policy", "RUN", "a run that learnt to drive there, or a name in the zoo"),
    cli.option("--output", "DIR", "where the page is written", required=True),
    cli.TRUST,
)
main = cli.CommandGroup("web", __doc__, (cli.Command("web build", __doc__, OPTIONS, build),))
