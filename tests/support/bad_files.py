"""A good scenario file made bad: what every test of refusals does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from crash_coach_common.strict_yaml import ConfigError
from sim_pkg.env import make_env


def check_refused(folder: Path, good: str, old: str, new: str, message: str) -> None:
    """With ``old`` replaced by ``new``: one line that names the file and matches ``message``."""
    assert good.count(old) == 1
    path = folder / "bad.yaml"
    path.write_text(good.replace(old, new))
    with pytest.raises(ConfigError) as error:
        make_env(path, 1)
    text = str(error.value)
    assert re.search(message, text), text
    assert "bad.yaml" in text
    assert "\n" not in text
