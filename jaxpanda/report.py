"""Results as sections of text, tables and figures: on a terminal, and as one self-contained page.

A stage's summary is written once, as `Section`s (`jaxpanda.summaries`); `to_terminal` and `to_html` are the
two ways to read it. The page needs no network: figures are SVG inside it.
"""

import dataclasses
import io
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .errors import printable
from .files import write_text

_PIPED_WIDTH = 200
"""Columns of text that goes to a file or a pipe; a terminal knows its own width."""


_HALF, _WIDE = 5.0, 8.0
"""Width up to which a figure takes half of a wide page, and beyond which a phone shows a part of it [inches]."""
_NARROW = 28
"""Width from which a column of a table may be broken into lines on a terminal."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of ready-made text under column heads; the first column names the row."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    shades: Sequence[Sequence[float | None]] | None = None
    """On a page, how strongly each cell is coloured: 0 to 1, or below 0 for the other colour."""
    more: str = ""
    less: str = ""
    """What the one colour means, and the other: the legend."""
    folded: bool = False
    """On a page, whether its caption stands alone until it is opened."""

    def style(self, row: int, column: int) -> str:
        """CSS of a cell, in the page's colours."""
        shade = None if self.shades is None else self.shades[row][column]
        if not shade:
            return ""
        strength = min(abs(shade), 1.0)
        ink = "; color: #fff" if strength > 0.65 else ""
        return f"background: rgba(var(--{'more' if shade > 0 else 'less'}), {0.85 * strength:.2f}){ink}"


@dataclasses.dataclass(frozen=True)
class Listing:
    """Lines as they stand in a file, each with a kind ("add", "cut", "note" or none); perhaps folded away."""

    lines: Sequence[tuple[str, str]]
    caption: str = ""
    folded: bool = False


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure drawn when it is needed: `draw` gets a matplotlib figure of `size` [inches]."""

    draw: Callable
    caption: str
    size: tuple[float, float] = (9.0, 5.0)
    """[inches]; two of five inches or less stand side by side on a wide page."""
    layout: str | None = "constrained"
    """Of matplotlib; None, which takes half the time, where `draw` leaves room itself."""


@dataclasses.dataclass(frozen=True)
class Section:
    """A heading with sentences, figures, tables and listings."""

    heading: str
    sentences: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    listings: Sequence[Listing] = ()
    tone: str = ""
    """On a page: "good", "bad" or "unsure" puts the section's first sentence on a banner."""
    figures_first: bool = False
    """On a page, figures stand above the tables."""


def number(value: float | int | None, digits: int = 4) -> str:
    """A number as people read it; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}g}"


def estimate(value: float | None, std: float | None) -> str:
    """A number with four digits, or as many more as its deviation leaves it: of a clock of Unix, the seconds."""
    digits = 4
    if value and std and math.isfinite(value) and math.isfinite(std):
        digits = max(digits, 2 + math.floor(math.log10(abs(value))) - math.floor(math.log10(std)))
    return number(value, min(digits, 12))


def to_terminal(sections: Sequence[Section], width: int | None = None) -> None:
    """Print sections on standard output, without their figures.

    Args:
        sections: what to print.
        width: of the lines, between whose words sentences are broken; without it that of the terminal or in
            `COLUMNS`, and on a file or pipe a sentence is a line. A table that is wider is continued below.
    """
    import rich.table
    from rich.console import Console
    from rich.markup import escape

    wrapped = width is not None or sys.stdout.isatty() or "COLUMNS" in os.environ
    console = Console(highlight=False, width=width if wrapped else _PIPED_WIDTH)
    for section in sections:
        section = _printable(section)
        console.print(f"\n[bold]{escape(section.heading)}[/bold]")
        for sentence in section.sentences:
            console.print(escape(sentence), soft_wrap=not wrapped)
        for table in (part for whole in section.tables for part in _fitting(whole, console.width)):
            drawn = rich.table.Table(title=escape(table.caption) or None, title_justify="left")
            for i, (column, wide) in enumerate(zip(table.columns, _widths(table), strict=True)):
                whole = i > 0 and wide < _NARROW  # what gives way to the others is broken between words
                drawn.add_column(escape(column), justify="left" if i == 0 else "right", no_wrap=whole)
            for row in table.rows:
                drawn.add_row(*(escape(cell) for cell in row))
            console.print(drawn)


def _widths(table: Table) -> list[int]:
    """Of the columns, with the lines between them."""
    return [max(map(len, column)) + len(" │ ") for column in zip(table.columns, *table.rows, strict=True)]


def _fitting(table: Table, width: int) -> list[Table]:
    """The table in parts that are no wider than `width`, each with the column that names the rows."""
    widths = _widths(table)
    room = width - min(widths[0], _NARROW) - 1
    groups, used = [[]], 0
    for i, wide in enumerate(widths[1:], 1):
        if groups[-1] and used + wide > room:
            groups.append([])
            used = 0
        groups[-1].append(i)
        used += wide
    return [
        Table(
            [table.columns[i] for i in (0, *group)],
            [[row[i] for i in (0, *group)] for row in table.rows],
            table.caption if group is groups[0] else "",
        )
        for group in groups
    ]


def _printable(section: Section) -> Section:
    """The section with nothing in its text that steers a terminal: names of files may have anything."""
    tables = [
        dataclasses.replace(
            table,
            columns=[printable(column) for column in table.columns],
            rows=[[printable(cell) for cell in row] for row in table.rows],
            caption=printable(table.caption),
        )
        for table in section.tables
    ]
    sentences = ["\n".join(map(printable, sentence.split("\n"))) for sentence in section.sentences]
    return dataclasses.replace(
        section, heading=printable(section.heading), sentences=sentences, tables=tables
    )


def to_html(title: str, sections: Sequence[Section], path: str | Path) -> None:
    """Write sections as one self-contained page."""
    import jinja2

    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxpanda"), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    drawn = [
        (section, [(_svg(figure), figure.caption, _breadth(figure)) for figure in section.figures])
        for section in sections
    ]
    write_text(path, pages.get_template("report.html.j2").render(title=title, sections=drawn))


def _breadth(figure: Figure) -> str:
    """How a page has a figure: half as wide, as wide as the screen, or on a phone wider than that."""
    width = figure.size[0]
    return "half" if width <= _HALF else "wide" if width > _WIDE else "whole"


def _svg(figure: Figure) -> str:
    """The figure as an SVG element; drawn without pyplot, so no global state and no display."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as Canvas
    from matplotlib.text import Text

    style: Any = {
        "svg.fonttype": "none",
        "font.size": 8,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "lines.linewidth": 0.9,
        "text.parse_math": False,  # a file's name may have dollar signs
    }
    with matplotlib.rc_context(style):
        canvas = Canvas(figsize=figure.size, layout=figure.layout)  # pyright: ignore[reportArgumentType]
        FigureCanvasSVG(canvas)
        figure.draw(canvas)
        for text in canvas.findobj(Text):
            text.set_text("\n".join(map(printable, text.get_text().split("\n"))))  # pyright: ignore
        buffer = io.StringIO()
        canvas.savefig(
            buffer,
            format="svg",
            transparent=True,
            metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")),
        )
    text = buffer.getvalue()
    return text[text.index("<svg") :]
