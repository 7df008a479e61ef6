"""The YAML files that come with the package, by name: ``one_waypoint/mo_ppo_nonlinear``, ``sweeps/one_waypoint``."""

from __future__ import annotations

from pathlib import Path

from mo_deepdrive.support.atomic_io import expand_home
from mo_deepdrive.support.names import nearest_few

_PACKAGE = Path(__file__).resolve().parent.parent
# Within the package where it is installed from a wheel, beside the package in a checkout.
CONFIGS = next((path for path in (_PACKAGE / "configs", _PACKAGE.parent / "configs") if path.is_dir()), _PACKAGE)


def config_names() -> list[str]:
    """The names of the shipped YAML files, in alphabetical order: their paths in ``configs/`` without the ending."""
    return sorted(path.relative_to(CONFIGS).with_suffix("").as_posix() for path in CONFIGS.rglob("*.yaml"))


def find_config(name: str | Path, beside: str | Path | None = None) -> Path:
    """The YAML file that a user names: a file, or the name of a shipped one.

    Args:
        name: a path, relative to the working directory; or, if there is no such file, a name of
            :func:`config_names` (also written as its path in a checkout, ``configs/NAME.yaml``).
        beside: a file that names the other one: ``name`` may be relative to its folder, too.
    """
    path = expand_home(name)
    candidates = [path]
    if beside is not None and (other := Path(beside).parent / path).absolute() != path.absolute():
        candidates.append(other)
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    wanted, names = path.as_posix().removeprefix("configs/").removesuffix(".yaml"), config_names()
    if wanted in names:
        return CONFIGS / f"{wanted}.yaml"
    if path.exists():
        return path  # what is wrong with it is said by who reads it
    places = f" (looked for {' and '.join(map(str, candidates))})" if len(candidates) > 1 else ""
    near = nearest_few(wanted, names)
    raise ValueError(f"config file {str(name)!r} does not exist{places}; the nearest names of shipped ones: {near}")
