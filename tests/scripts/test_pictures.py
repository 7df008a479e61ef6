"""scripts/pictures.py draws what the pages show."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import Call

pytestmark = pytest.mark.slow


def test_pictures_of_data_and_of_drives_are_drawn(call: Call, tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    names = ["splits", "scale", "choice", "accrued", "conflicts"]
    code, out, error = call("pictures", *names, "--output", tmp_path / "images")
    assert code == 0, error
    made = [Path(line) for line in out.splitlines()]
    assert [path.stem for path in made] == names
    for path in made:
        with Image.open(path) as image:
            assert min(image.size) > 100


def test_the_pages_show_every_picture() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in (REPOSITORY / "docs").rglob("*.md"))
    for name in ("observation", "splits", "scale", "accrued", "choice"):
        assert f"images/{name}.png)" in text
