"""The extension of the documentation site can be imported, as docs/conf.py imports it."""

from __future__ import annotations

import sys

from tests.helpers.paths import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "docs" / "_ext"))
