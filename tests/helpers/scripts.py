"""Loading the scripts of the repository as modules."""

from __future__ import annotations

import importlib.util
from typing import Any

from tests.helpers.paths import REPOSITORY


def load_script(name: str) -> Any:
    """``scripts/NAME.py`` as a module; its function ``main`` takes the arguments of the command line."""
    spec = importlib.util.spec_from_file_location(f"{name}_script", REPOSITORY / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
