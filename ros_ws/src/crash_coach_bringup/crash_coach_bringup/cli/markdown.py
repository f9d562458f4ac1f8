"""Tables in Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable


def table(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table; bars and line breaks in cells do not break it."""
    lines = ["| " + " | ".join(columns) + " |"]
    lines.append("|" + "---|" * lines[0].count(" | ") + "---|")
    for row in rows:
        cells = (re.sub(r"\s+", " ", str(cell)).replace("|", "\\|") for cell in row)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
