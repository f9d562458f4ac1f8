"""Tables that never cut a figure: what does not fit the terminal becomes lines "name: value"."""

from __future__ import annotations

import os
from collections.abc import Iterator

from rich.console import Console, ConsoleDimensions, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

FILE_COLUMNS = 200  # of what is no terminal, such as a pipe, unless $COLUMNS says otherwise
PER_COLUMN = 3  # of the frame: a line and a blank on either side


class FittedConsole(Console):
    """As rich's, but for what is written to files and pipes, which are wide."""

    @property
    def size(self) -> ConsoleDimensions:
        """In characters."""
        size = super().size
        if self.is_terminal or "COLUMNS" in os.environ:
            return size
        return ConsoleDimensions(FILE_COLUMNS, size.height)

    @size.setter
    def size(self, size: tuple[int, int]) -> None:
        self._width, self._height = size


class FittedTable(Table):
    """Wraps cells between words only. Where a word does not fit a column, it is no table."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        widths = self._widths(console, options)
        if widths is None:
            yield from self._as_lines(console)
            return
        for column, width in zip(self.columns, widths, strict=True):
            column.width = width
        yield from super().__rich_console__(console, options)

    def _widths(self, console: Console, options: ConsoleOptions) -> list[int] | None:
        """Of each column's text, the widest columns narrowed first; None: they cannot all fit."""
        measured = [
            [
                Measurement.get(console, options.update(max_width=10_000), _text(console, cell))
                for cell in (column.header, *column.cells)
            ]
            for column in self.columns
        ]
        least = [max(one.minimum for one in column) for column in measured]
        widths = [max(one.maximum for one in column) for column in measured]
        free = options.max_width - PER_COLUMN * len(widths) - 1
        while sum(widths) > free:
            wide = max(range(len(widths)), key=lambda i: (widths[i] > least[i], widths[i]))
            if widths[wide] <= least[wide]:
                return None
            widths[wide] -= 1
        return widths

    def _as_lines(self, console: Console) -> Iterator[RenderableType]:
        if self.title is not None:
            yield Text.assemble(_text(console, self.title), style="italic")
        names = [_text(console, column.header).plain for column in self.columns]
        for row in zip(*(column.cells for column in self.columns), strict=True):
            first, *others = (_text(console, cell) for cell in row)
            yield Text.assemble(first, style="bold")
            for name, value in zip(names[1:], others, strict=True):
                if value.plain:
                    yield Text.assemble(f"  {name}: " if name else "  ", value)


def _text(console: Console, cell: RenderableType) -> Text:
    return cell if isinstance(cell, Text) else console.render_str(str(cell))
