"""An evaluation as files: the numbers that a run ends with, and the arrays of all episodes."""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import yaml

from mo_deepdrive.evaluation.metrics import (
    GREEDY,
    LENGTH,
    STEP,
    STOCHASTIC,
    SUCCESS,
    UTILITY,
    discounted_return_of,
    evaluation_prefix,
    return_of,
    vehicle_name,
)
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.support.atomic_io import atomic_folder, atomic_write, csv_bytes, own_path, write_json
from mo_deepdrive.utilities import make_utility

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.statistics import Estimate
    from mo_deepdrive.utilities import Utility

EVALUATION_FILE, EPISODES_FILE = "evaluation.json", "episodes.npz"
ARRAYS = ("returns", "discounted", "lengths", "succeeded", "ends", "largest")


@dataclass(frozen=True)
class Provenance:
    """How an evaluation was done.

    Attributes:
        env_id: the environment.
        seed: of the first episode; those of the others count up.
        gamma: discount of the discounted returns.
        greedy: whether actions were the most likely (or mean) ones; of a function, which evaluate cannot know, True.
        arguments: of the environment; of this package's all, of another's those that were given.
    """

    env_id: str
    seed: int
    gamma: float
    greedy: bool
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def split(self, episodes: int) -> str | None:
        """The split of which the first ``episodes`` scenarios were driven; None for another seed."""
        found = (name for name, seeds in SPLITS.items() if seeds.start == self.seed and episodes <= len(seeds))
        return next(found, None)


class Episodes(Protocol):
    """What files hold of an :class:`mo_deepdrive.evaluation.Evaluation`, which reads and writes them."""

    objectives: tuple[str, ...]
    utilities: tuple[Utility, ...]
    returns: NDArray[np.float64]
    discounted: NDArray[np.float64]
    lengths: NDArray[np.int64]
    succeeded: NDArray[np.bool_]
    ends: NDArray[Any]
    provenance: Provenance | None

    def episode_utilities(self, v: int = 0) -> NDArray[np.float64]:
        """(E,) utilities of the episodes of vehicle ``v``."""

    def estimates(self) -> dict[str, Estimate]:
        """Every metric with its interval."""

    def metrics(self) -> dict[str, float]:
        """Every metric."""


def write_evaluation(directory: Path, evaluations: Mapping[str, Episodes], about: Mapping[str, Any]) -> None:
    """Write evaluation.json and evaluation.csv (every metric) and episodes.csv (one row per episode and vehicle).

    Args:
        directory: an existing one.
        evaluations: one per policy.
        about: how the policies were evaluated: seed, gamma, step and so on.

    Raises:
        ValueError: if one of these files is a link.
        OSError: if a file cannot be written; each file is complete or unchanged.
    """
    columns = {policy: evaluation.estimates() for policy, evaluation in evaluations.items()}
    policies = {
        policy: {name: asdict(estimate) for name, estimate in estimates.items()}
        for policy, estimates in columns.items()
    }
    write_json(own_path(directory, EVALUATION_FILE), {**about, "policies": policies})
    rows: list[list[Any]] = [["policy", "metric", "value", "low", "high"]]
    for policy, estimates in columns.items():
        rows += [[policy, name, each.value, each.low, each.high] for name, each in estimates.items()]
    atomic_write(own_path(directory, "evaluation.csv"), csv_bytes(rows))
    atomic_write(own_path(directory, "episodes.csv"), csv_bytes(_episode_rows(evaluations, int(about["seed"]))))


def _episode_rows(evaluations: Mapping[str, Episodes], seed: int) -> list[list[Any]]:
    objectives = next(iter(evaluations.values())).objectives
    rows: list[list[Any]] = [
        [
            *("policy", "seed", "vehicle", SUCCESS, "end", LENGTH, UTILITY),
            *(return_of(objective) for objective in objectives),
            *(discounted_return_of(objective) for objective in objectives),
        ]
    ]
    for policy, evaluation in evaluations.items():
        episodes, vehicles, _ = evaluation.returns.shape
        for v in range(vehicles):
            utilities = evaluation.episode_utilities(v).tolist() if evaluation.utilities else [None] * episodes
            for e in range(episodes):
                how = [bool(evaluation.succeeded[e, v]), evaluation.ends[e, v], int(evaluation.lengths[e, v])]
                returns = [*evaluation.returns[e, v].tolist(), *evaluation.discounted[e, v].tolist()]
                rows.append([policy, seed + e, v, *how, utilities[e], *returns])
    return rows


def save_as_run(evaluation: Episodes, directory: str | Path, *, name: str, seed: int, steps: int, greedy: bool) -> Path:
    """Write what tables, curves and comparisons read of a run, and the episodes; see :meth:`Evaluation.save`."""
    about = evaluation.provenance
    if about is None:
        raise ValueError("the evaluation does not know its environment: save what evaluate returned")
    for argument, value in (("seed", seed), ("steps", steps)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
            raise ValueError(f"{argument} = {value!r} must be an integer of at least 0")
    if not (isinstance(name, str) and name.strip() and name.isprintable()):
        raise ValueError(f"name = {name!r} must be the label of the algorithm")
    target, episodes = Path(directory), len(evaluation.returns)
    if os.path.lexists(target):
        raise ValueError(f"directory {str(target)!r} exists; choose another")
    utilities = [{"name": each.name, "arguments": _plain(each.arguments or {})} for each in evaluation.utilities]
    own = {vehicle_name(v): each for v, each in enumerate(utilities) if each != utilities[0]}
    config = {
        "environment": {"id": about.env_id, "arguments": _plain(about.arguments)},
        "utility": {**utilities[0], "vehicles": own} if utilities else None,
        "algorithm": {"name": name},
        "training": {"total_timesteps": int(steps), "seed": int(seed)},
        "evaluation": {
            "final_episodes": episodes,
            "split": about.split(episodes),
            "gamma": about.gamma,
            "reference_point": None,
        },
    }
    policy = GREEDY if greedy else STOCHASTIC
    curve = {evaluation_prefix(policy) + metric: value for metric, value in evaluation.metrics().items()}
    rows: list[list[Any]] = [[STEP, *curve], [int(steps), *curve.values()]]
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_folder(target) as staged:
        write_evaluation(
            staged,
            {policy: evaluation},
            {"step": int(steps), "episodes": episodes, "seed": about.seed, "gamma": about.gamma},
        )
        atomic_write(staged / "metrics.csv", csv_bytes(rows))
        atomic_write(staged / EPISODES_FILE, _episodes_bytes(evaluation))
        atomic_write(staged / "config.yaml", yaml.safe_dump(config, sort_keys=False).encode())
    return target


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` as text files hold them, with lists in place of arrays and tuples."""
    plain: dict[str, Any] = json.loads(json.dumps(dict(values), default=_plain_value))
    return plain


def _plain_value(value: Any) -> Any:
    """What JSON does not know: NumPy's values, and as text any object that an environment takes."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else repr(value)


def _episodes_bytes(evaluation: Episodes) -> bytes:
    """The arrays, with reasons as text, and the rest as JSON: an .npz file without pickled objects."""
    arrays = {name: getattr(evaluation, name) for name in ARRAYS}
    arrays["ends"] = np.array([["" if end is None else str(end) for end in ends] for ends in evaluation.ends])
    about = {
        "objectives": evaluation.objectives,
        "utilities": [[each.name, each.arguments] for each in evaluation.utilities],
        "provenance": None if evaluation.provenance is None else asdict(evaluation.provenance),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.array(json.dumps(about, default=_plain_value)), **arrays)
    return buffer.getvalue()


def read_episodes(directory: str | Path, utilities: Sequence[Utility] | None) -> dict[str, Any]:
    """The fields of an Evaluation that was saved; see :meth:`Evaluation.load`."""
    path = Path(directory) / EPISODES_FILE
    if not path.is_file():
        raise ValueError(f"{str(directory)!r} has no {EPISODES_FILE}; Evaluation.save writes it")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ARRAYS}
            about = json.loads(str(file["about"]))
        objectives, provenance = tuple(about["objectives"]), Provenance(**about["provenance"])
        known = [(str(name), arguments) for name, arguments in about["utilities"]]
        e, v, d = arrays["returns"].shape
        shapes = {name: (e, v, d) if name in ("returns", "discounted", "largest") else (e, v) for name in ARRAYS}
        if any(arrays[name].shape != shape for name, shape in shapes.items()) or len(objectives) != d:
            raise ValueError("its arrays do not fit together")
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{str(path)!r} is not a saved evaluation: {error}") from None
    if utilities is None:
        cost_sign = provenance.arguments.get("cost_sign", "maximise")
        utilities = [_utility(name, objectives, cost_sign, arguments) for name, arguments in known]
    elif len(utilities) != v:
        raise ValueError(f"{len(utilities)} utilities are given for {v} vehicles")
    ends = np.where(arrays["ends"] == "", None, arrays["ends"].astype(object))
    return {
        **arrays,
        "ends": ends,
        "objectives": objectives,
        "utilities": tuple(utilities),
        "provenance": provenance,
    }


def _utility(name: str, objectives: Sequence[str], cost_sign: str, arguments: Mapping[str, Any] | None) -> Utility:
    """A utility by what was saved of it; nothing is imported that a file names."""
    try:
        if ":" in name or arguments is None:
            raise ValueError("it is a function that is not in this package")
        return make_utility(name, objectives, cost_sign=cost_sign, **arguments)
    except (ValueError, TypeError) as error:
        raise ValueError(f"utility {name!r} cannot be loaded: {error}; give utilities=[...]") from None
