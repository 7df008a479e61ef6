"""Tables: which runs share a row and what it is called, what is compared, and that a terminal shows everything."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from algorithms.reporting.tables import (
    comparison_table,
    evaluation_table,
    group_runs,
    print_rows,
    print_runs,
    scores_table,
    tidy_scores,
)
from algorithms.runs.config import make_experiment
from mo_deepdrive.evaluation.evaluation import Evaluation
from mo_deepdrive.evaluation.statistics import Estimate
from mo_deepdrive.support.yaml import dump
from mo_deepdrive.utilities import Utility

ONE = "mo-deepdrive-one-waypoint-v0"
OBJECTIVES = ("distance", "jerk")

# ---------------------------------------------------------------------------------------------------- scores over seeds


def make_run(
    path: Path,
    seed: int,
    algorithm: str = "mo_a2c",
    scores: dict[str, float | Estimate] | None = None,
    **sections: dict[str, Any],
) -> None:
    """A run directory with the final ``scores`` of the greedy policy; sections of the config have other keys."""
    config = make_experiment(
        {
            "environment": {"id": ONE},
            "utility": {"name": "one_waypoint_linear"},
            "algorithm": {"name": algorithm},
            "training": {"total_timesteps": 1000, "num_envs": 2, "seed": seed},
        }
    ).to_dict()
    for name, values in sections.items():
        config[name] |= values
    path.mkdir()
    (path / "config.yaml").write_text(dump(config))
    given = {"success": 0.1 * seed} if scores is None else scores
    estimates = {name: vars(score if isinstance(score, Estimate) else Estimate(score)) for name, score in given.items()}
    (path / "evaluation.json").write_text(json.dumps({"policies": {"greedy": estimates}}))


def columns_of(rows: list[list[str]], r: int = 1) -> dict[str, str]:
    """The cells of a row by the names of their columns."""
    return dict(zip(rows[0], rows[r], strict=True))


def test_runs_that_differ_in_their_seed_share_a_row_and_others_name_what_differs(tmp_path: Path) -> None:
    make_run(tmp_path / "a", 0)
    make_run(tmp_path / "b", 1, training={"device": "cuda:7"})
    make_run(tmp_path / "c", 2, training={"threads": 4})
    make_run(tmp_path / "d", 0, training={"num_envs": 4})
    make_run(tmp_path / "e", 0, "ppo")
    groups = group_runs([tmp_path], pytest.fail)
    assert [group.seeds for group in groups] == [[0, 1, 2], [0], [0]]
    assert groups[0].scores["greedy", "", "success"] == pytest.approx([0.0, 0.1, 0.2])  # type: ignore[index]
    header, *rows = scores_table(groups)
    assert [row[header.index("settings")] for row in rows] == ["training.num_envs=2", "training.num_envs=4", ""]


def make_pair(folder: Path, ppo: dict[str, Any], mo_ppo: dict[str, Any]) -> None:
    """Two runs of PPO and two of MO-PPO, whose configs have other keys as given."""
    for name, sections in (("ppo", ppo), ("mo_ppo", mo_ppo)):
        for seed in range(2):
            make_run(folder / f"{name}-{seed}", seed, name, {"utility_esr": 1.0 + seed}, **sections)


@pytest.mark.parametrize(
    ("ppo", "mo_ppo", "column", "labels"),
    [
        (
            {"utility": {"arguments": {"weights": [100, 1, 0, 0]}}},
            {"utility": {"arguments": {"weights": [1, 1, 0, 0]}}},
            "utility",
            ["one_waypoint_linear weights=[1, 1, 0, 0]", "one_waypoint_linear weights=[100, 1, 0, 0]"],
        ),
        (
            {"environment": {"id": "theirs-v0", "arguments": {"size": 8, "wind": 1}}},
            {"environment": {"id": "theirs-v0", "arguments": {"size": 9, "wind": 1}}},
            "environment",
            ["theirs-v0 size=8", "theirs-v0 size=9"],
        ),
        ({"evaluation": {"split": "validation"}}, {"evaluation": {"split": "test"}}, "environment", [ONE, ONE]),
    ],
)
def test_runs_of_different_tasks_are_not_compared(
    tmp_path: Path, ppo: dict[str, Any], mo_ppo: dict[str, Any], column: str, labels: list[str]
) -> None:
    make_pair(tmp_path, ppo, mo_ppo)
    groups = group_runs([tmp_path], pytest.fail)
    assert [group.task[column] for group in groups] == labels
    assert len(comparison_table(groups)) == 1


def test_a_comparison_after_different_numbers_of_steps_says_so(tmp_path: Path) -> None:
    make_pair(tmp_path, {"training": {"total_timesteps": 5000}}, {})
    found = columns_of(comparison_table(group_runs([tmp_path], pytest.fail)))
    assert (found["difference"], found["steps"]) == ("mo_ppo - ppo", "1000 against 5000")


def test_where_only_some_seeds_have_arrivals_the_others_have_none(tmp_path: Path) -> None:
    # Another library's environment whose episodes have no info["end"]: only a success tells that it reports them.
    for seed in range(5):
        held = evaluation(10, ends=False)
        held.succeeded[:] = seed == 3
        make_run(tmp_path / str(seed), seed, scores=dict(held.estimates()))
    rows = scores_table(group_runs([tmp_path], pytest.fail))
    assert float(columns_of(rows)["success"].split()[0]) == pytest.approx(0.2)


def test_scores_have_the_digits_that_the_episodes_of_one_run_support(tmp_path: Path) -> None:
    for seed in range(3):
        utility = 10.0 + 0.001 * seed
        make_run(tmp_path / str(seed), seed, scores={"utility_esr": Estimate(utility, utility - 0.6, utility + 0.6)})
    (group,) = group_runs([tmp_path], pytest.fail)
    assert columns_of(scores_table([group]))["utility_esr"] == "10.0 [10.0, 10.0]"
    group.widths.clear()
    assert columns_of(scores_table([group]))["utility_esr"] == "10.0010 [10.0000, 10.0020]"


@pytest.mark.parametrize(("seeds", "noted"), [(1, False), (2, True), (3, False)])
def test_two_seeds_have_no_interval_and_the_table_says_so(tmp_path: Path, seeds: int, noted: bool) -> None:
    for algorithm in ("a2c", "mo_a2c"):
        for seed in range(seeds):
            make_run(tmp_path / f"{algorithm}{seed}", seed, algorithm, {"utility_esr": 1.0 + seed})
    console = Console(width=200, record=True)
    groups = print_runs([tmp_path], console, pytest.fail)
    text = console.export_text()
    assert ("Fewer than 3 seeds have no interval." in text) is noted
    assert ("(with three seeds: from the lowest to the highest)" in text) is (seeds == 3)
    header, row, *_ = tidy_scores(groups)
    ends = [row[header.index(name)] for name in ("mean", "low", "high", "n")]
    assert ends == ([2.0, 1.0, 3.0, 3] if seeds == 3 else [0.5 + 0.5 * seeds, None, None, seeds])
    if noted:
        assert columns_of(comparison_table(groups))["p"] == "1.000"


# ------------------------------------------------------------------------------------------------ evaluation of a run


def evaluation(episodes: int = 50, vehicles: int = 1, ends: bool = True) -> Evaluation:
    generator = np.random.default_rng(1)
    shape = (episodes, vehicles)
    returns = generator.normal([3.0, -100.0], [1.0, 20.0], (*shape, 2))
    return Evaluation(
        objectives=OBJECTIVES,
        utilities=(Utility("square", OBJECTIVES, lambda returns: returns[..., 0] ** 2),) * vehicles,
        returns=returns,
        discounted=0.5 * returns,
        lengths=np.full(shape, 10),
        succeeded=np.arange(episodes * vehicles).reshape(shape) % 4 == 0 if ends else np.zeros(shape, dtype=np.bool_),
        ends=np.full(shape, "circling" if ends else None, dtype=object),
        largest=np.abs(returns),
    )


def test_ends_that_occurred_have_a_row_with_the_rate_of_every_policy() -> None:
    held, other = evaluation(), evaluation()
    assert {"end/collision", "end/off_lane", "end/time_limit"} <= set(held.estimates()), "the files have them"
    held.ends[0], other.ends[:] = "harmful_jerk", "time_limit"
    table = evaluation_table({"greedy": held, "stochastic": other}, "a title")
    names, *columns = (list(map(str, column.cells)) for column in table.columns)
    cells = {name: texts for name, *texts in zip(names, *columns, strict=True) if name.startswith("end/")}
    assert set(cells) == {"end/time_limit", "end/circling", "end/harmful_jerk"}
    never, always = "0.000 [0.000, 0.071]", "1.000 [0.929, 1.000]"
    assert cells["end/time_limit"] == [never, always]
    assert cells["end/harmful_jerk"][1] == never


# --------------------------------------------------------------------------------------------------------- a terminal

LABELS = ("algorithm", "policy", "vehicle", "seeds")
METRICS = tuple(f"return/objective_{i}" for i in range(9))
ROWS = [
    [*LABELS, *METRICS],
    *(
        [algorithm, "greedy", f"vehicle_{v}", "0 1 2 3 4", *(f"-{v}{i}.25 [-{v}{i}.50, -{v}{i}.00]" for i in range(9))]
        for algorithm in ("a2c", "mo_ppo")
        for v in range(2)
    ),
]


def printed(rows: list[list[str]], labels: int, width: int, rest: str | None = None) -> list[str]:
    console = Console(width=width, file=io.StringIO())
    print_rows(console, rows, "a title", labels, rest=rest)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [60, 80, 100, 120])
def test_nothing_is_cut_off_however_many_keys_a_cell_has(width: int) -> None:
    keys = [f"learning_rate_of_the_{i}th_network" for i in range(8)]
    rows = [[*keys, *METRICS], *([f"0.000{r}{i}" for i in range(8)] + ROWS[1][4:] for r in range(3))]
    joined = ", ".join(f"{name}={value}" for name, value in zip(keys, rows[1], strict=False))
    lines = printed(rows, 8, width)
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    text = "".join(line.split("  ")[1].strip() if line.startswith("  ") else "" for line in lines)
    assert "".join(joined.split()) in "".join(text.split())
    assert all(any(cell in line for line in lines) for cell in ROWS[1][4:])


def test_with_another_place_for_all_columns_the_rest_is_named() -> None:
    lines = printed(ROWS, 4, 100, "--output FILE.csv writes every column")
    shown = [name for name in METRICS if name in lines[2]]
    note = " ".join(" ".join(lines).split())
    assert 0 < len(shown) < len(METRICS)
    assert f"not shown: {', '.join(METRICS[len(shown) :])}; --output FILE.csv writes every column" in note
    assert "not shown" not in "".join(printed(ROWS, 4, 1000, "--output FILE.csv"))
