"""The pages of the environments, from SCENARIOS, LAYOUT, OBJECTIVES, the action sets, EnvConfig and the docstrings."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Any

import gymnasium
import moocore
import numpy as np
from scipy.stats import spearmanr

import mo_deepdrive
from algorithms.experiments.key_listing import model_keys
from mo_deepdrive import reference_fronts
from mo_deepdrive.actions import ACTION_TYPES, CONTINUOUS, SPEED_CHANGES, action_names
from mo_deepdrive.config import EnvConfig
from mo_deepdrive.envs import spaces
from mo_deepdrive.objectives import INDEX, OBJECTIVES
from mo_deepdrive.observation import layout
from mo_deepdrive.scenarios import SCENARIOS, Scenario
from mo_deepdrive.simulation.state import ENDS
from site_pages.films import film_caption
from site_pages.markdown import number, sections, table
from site_pages.results import conflicts_of_drivers, results_text

GAMMAS = (reference_fronts.GAMMA, 1.0)


def pages() -> dict[str, str]:
    """The text of every page by its path in docs."""
    found = {f"environments/{name}.md": page(scenario) for name, scenario in SCENARIOS.items()}
    return {"environments/index.md": index(), **found}


def index() -> str:
    """The page that lists the environments."""
    rows = [
        [
            f"[{scenario.title}]({name}.md)",
            f"`{scenario.id}`",
            scenario.vehicles,
            len(layout(scenario)),
            ", ".join(scenario.objectives),
        ]
        for name, scenario in SCENARIOS.items()
    ]
    pictures = "\n".join(
        f"```{{figure}} ../_pictures/{name}.gif\n:width: 240px\n:target: {name}.html\n:alt: {scenario.title}\n\n"
        f"{scenario.title}\n```\n"
        for name, scenario in SCENARIOS.items()
    )
    return (
        "# Environments\n\n"
        "Every objective is to be maximised; observations and objectives are per vehicle. What the environments have\n"
        "in common, dynamics and departures from the published code: [simulator](../simulator.md). The APIs:\n"
        "[interfaces](../interfaces.md).\n\n"
        + table(["environment", "id", "vehicles", "observation", "objectives"], rows)
        + f"\n::::{{container}} gallery\n{pictures}::::\n"
        + "\n```{toctree}\n:hidden:\n\n"
        + "\n".join(SCENARIOS)
        + "\n```\n"
    )


def page(scenario: Scenario) -> str:
    """The page of one environment."""
    config = EnvConfig(scenario=scenario.name)
    doc = sections(environment_class(scenario))
    parts = [
        f"# {scenario.title}",
        f"```{{figure}} ../_pictures/{scenario.name}.gif\n:width: 360px\n:alt: {scenario.title}\n\n"
        f"{film_caption(scenario)}\n```",
        doc["Description"],
        f'```python\nimport mo_gymnasium\n\nenv = mo_gymnasium.make("mo_deepdrive:{scenario.id}")\n```',
        "## Spaces",
        spaces_table(scenario, config),
        "## Actions",
        actions_text(),
        "## Observation",
        "Float32, in SI units. Learners divide each entry by its scale.",
        observation_table(scenario, config),
        "What the entries mean:" if "Observation Space" in doc else "",
        _only_table(doc.get("Observation Space", "")),
        "## Objectives",
        "The reward of a decision is the magnitude times the sign, so that every objective is maximised. The scale is\n"
        "the nominal magnitude of the return of an episode, by which learners divide.",
        objectives_table(scenario, config),
        "## Starting state",
        doc["Starting State"],
        "## How episodes end",
        doc["Episode End"],
        f'The reasons that `info["end"]` can name anywhere: {", ".join(f"`{end}`" for end in ENDS if end)}.',
        "## Arguments",
        "Keyword arguments of `make` (those that name another environment have no effect here):",
        arguments_table(),
        "## Best-known front",
        front_text(scenario),
        "## Which objectives conflict",
        conflicts_text(scenario),
        "## Learning results",
        results_text(scenario),
        "## Version history",
        doc["Version History"],
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def environment_class(scenario: Scenario) -> type[Any]:
    """The class that ``gymnasium.make`` makes for a scenario."""
    found: type[Any] = resolve_name(str(gymnasium.spec(scenario.id).entry_point))
    return found


def _only_table(text: str) -> str:
    """The table of a section."""
    return "\n".join(line for line in text.splitlines() if line.startswith("|"))


def spaces_table(scenario: Scenario, config: EnvConfig) -> str:
    """Id, version and spaces of an environment."""
    observation, reward = spaces.observation_space(config), spaces.reward_space(config)
    action = ", ".join(
        f"`{spaces.action_space(config.model_copy(update={'action_type': kind}))}` (`{kind}`)" for kind in ACTION_TYPES
    )
    rows: list[list[object]] = [
        ["id", f"`{scenario.id}`"],
        ["vehicles", scenario.vehicles],
        ["action space", action],
        ["observation space", f"`Box({observation.shape}, {observation.dtype})`"],
        ["reward space", f"`Box({reward.shape}, {reward.dtype})`"],
        ["decisions per second", config.decision_frequency],
        ["longest episode", f"{config.max_decisions} decisions ({number(config.time_limit)} s)"],
    ]
    return table(["", ""], rows)


def actions_text() -> str:
    """The action sets."""
    changes = ", ".join(SPEED_CHANGES.values())
    parts = []
    for kind in ACTION_TYPES:
        names = action_names(kind)
        if kind == CONTINUOUS:
            parts.append(f"- `{kind}`: {', '.join(names)}.")
        else:
            groups = list(dict.fromkeys(name.rpartition(", ")[0] for name in names[1:]))
            parts.append(f"- `{kind}`: 0 is {names[0]}; then, for each of {', '.join(groups)}: {changes}.")
    return "\n".join(parts)


def observation_table(scenario: Scenario, config: EnvConfig) -> str:
    """One row per entry of LAYOUT."""
    space = spaces.observation_space(config)
    rows = [
        [i, f"`{entry.name}`", entry.unit, number(space.low[i]), number(space.high[i]), number(entry.scale)]
        for i, entry in enumerate(layout(scenario))
    ]
    return table(["index", "name", "unit", "low", "high", "scale"], rows)


def objectives_table(scenario: Scenario, config: EnvConfig) -> str:
    """One row per objective of a scenario."""
    space = spaces.reward_space(config)
    rows = []
    for i, name in enumerate(scenario.objectives):
        row = OBJECTIVES[INDEX[name]]
        sign = "+" if row.sign > 0 else "-"
        low, high = number(space.low[i]), number(space.high[i])
        rows.append([f"`{name}`", row.description, row.unit, sign, low, high, number(row.scale)])
    return table(["objective", "magnitude", "unit", "sign", "lowest reward", "highest reward", "scale"], rows)


def arguments_table() -> str:
    """One row per keyword argument."""
    rows = [
        [f"`{key.name}`", _python(key.type), f"`{_python(key.default)}`", _python(key.description)]
        for key in model_keys(EnvConfig)
        if key.name != "scenario"
    ]
    return table(["argument", "type", "default", "meaning"], rows)


def _python(text: str) -> str:
    """JSON's constants as Python's."""
    for name, value in {"null": "None", "true": "True", "false": "False"}.items():
        text = text.replace(name, value)
    return text


def fronts(scenario: Scenario) -> list[str]:
    """The action types for which a best-known front is shipped."""
    found = []
    for kind in ACTION_TYPES:
        try:
            reference_fronts.shipped(scenario.name, kind)
        except ValueError:
            continue
        found.append(kind)
    return found


def front_text(scenario: Scenario) -> str:
    """Size and ranges of the best-known fronts, the picture of the first, and which objectives conflict on it."""
    kinds = fronts(scenario)
    if not kinds:
        return "None is shipped for this environment ([fronts](../fronts.md))."
    rows = []
    for kind in kinds:
        for gamma in GAMMAS:
            front = mo_deepdrive.reference_front(scenario.name, kind, gamma)
            point = mo_deepdrive.reference_point(scenario.name, kind, gamma)
            volume = moocore.hypervolume(front, ref=point.values, maximise=True)
            ranges = [
                f"{low:.3g} to {high:.3g}" for low, high in zip(front.min(axis=0), front.max(axis=0), strict=True)
            ]
            rows.append([f"`{kind}`", gamma, len(front), f"{volume:.0f}", *ranges])
    required = reference_fronts.front_config(scenario.name, kinds[0])
    arguments = ", ".join(
        f"`{name}={getattr(required, name)}`"
        for name in EnvConfig.model_fields
        if name not in ("scenario", "action_type") and getattr(required, name) != EnvConfig.model_fields[name].default
    )
    return (
        f"With {arguments}: number of policies, hypervolume from the\n[agreed reference point](../fronts.md), and the"
        " range of the returns discounted with gamma.\n\n"
        + table(["actions", "gamma", "policies", "hypervolume", *scenario.objectives], rows)
        + f"\n```{{image}} ../_pictures/{scenario.name}_front.png\n:alt: returns of the best-known policies, two"
        " objectives at a time\n:class: figure\n```\n"
    )


def conflicts_text(scenario: Scenario) -> str:
    """Which objectives conflict on the best-known front, and over the drivers of docs/results."""
    parts = [conflict_text(scenario, kind) for kind in fronts(scenario)[:1]] + conflicts_of_drivers(scenario)
    return "\n\n".join(parts) or "Not measured for this environment."


def conflict_text(scenario: Scenario, kind: str) -> str:
    """Spearman's rank correlations of the objectives over a best-known front."""
    front = mo_deepdrive.reference_front(scenario.name, kind, 1.0)
    names = [name for name, column in zip(scenario.objectives, front.T, strict=True) if np.ptp(column) > 0]
    same = [name for name in scenario.objectives if name not in names]
    columns = front[:, [scenario.objectives.index(name) for name in names]]
    correlations = np.atleast_2d(spearmanr(columns).statistic)
    rows = [[f"`{name}`", *(f"{value:.2f}" for value in row)] for name, row in zip(names, correlations, strict=True)]
    return (
        f"Spearman's rank correlation of the undiscounted returns over the best-known front (`{kind}`). Where it is\n"
        "negative, policies with more of one objective tend to have less of the other.\n\n"
        + table(["", *(f"`{name}`" for name in names)], rows)
        + (f"\nThe same for all policies: {', '.join(f'`{name}`' for name in same)}.\n" if same else "")
    )
