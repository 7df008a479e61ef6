"""Configuration of the documentation site: ``make docs`` builds it into docs/_build/html."""

from __future__ import annotations

import os
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS / "_ext"), str(DOCS.parent)]
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # frames are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
# For the kernels of the tutorials: the command mo-deepdrive, the files of docs/examples, and plain tables.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
os.environ["EXAMPLES"] = str(DOCS / "examples")
os.environ["COLUMNS"] = "90"
os.environ["TTY_COMPATIBLE"] = "0"  # no colours and progress bars of rich, which a kernel asks for
os.environ["OMP_NUM_THREADS"] = "1"  # threads that wait for each other are slow where other programs run

import algorithms.reporting.run_records  # noqa: E402, F401  (pydantic cannot make its models as autodoc imports modules)
import mo_deepdrive  # noqa: E402

project = "MO-DeepDrive"
author = "The mo-deepdrive developers"
copyright = f"2026, {author}"
release = version = mo_deepdrive.__version__

extensions = [
    "site_pages",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "_readme.md", "examples", "**.ipynb_checkpoints"]

# Markdown and notebooks
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_cache_path = str(DOCS / "_build" / "notebooks")
nb_execution_in_temp = True
nb_execution_timeout = 300  # s per cell; they take a few
nb_execution_raise_on_error = True
nb_merge_streams = True

# The reference
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_mock_imports = [
    *("h5py", "minari", "momaland", "morl_baselines", "numba.cuda", "numba_cuda", "optuna", "ray", "stable_baselines3"),
    "wandb",
]
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_attr_annotations = False  # the signature has the types
python_use_unqualified_type_names = True
nitpicky = True
nitpick_ignore_regex = [
    # Names of other libraries, whose inventories would have to be fetched, and of type parameters.
    (r"py:(class|obj|exc|data)", r"(?!mo_deepdrive\.|algorithms\.).*"),
    (r"py:class", r".*\.([A-Z]|Annotated|_\w+)"),
    # Attributes are listed by their classes, and are not targets.
    (r"py:attr", r".*"),
]

# Names in a section "Attributes" are cross-references of which many classes have a target.
suppress_warnings = ["ref.python"]

# The look
html_theme = "furo"
html_title = "MO-DeepDrive"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# Other sites, for `make linkcheck`
linkcheck_timeout = 20
linkcheck_retries = 2
