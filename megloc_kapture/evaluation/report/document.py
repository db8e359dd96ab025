"""The document model of reports, and its renderers: plain text, JSON, CSV and HTML.

A :class:`Document` holds the sections of its text form and of its page, the data of its JSON file
and the tables of its CSV files. Tables and paragraphs may stand in both forms; nothing here knows
of results.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from markupsafe import Markup
from pydantic import BaseModel

from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import write_bytes, write_json

if TYPE_CHECKING:
    from jinja2 import Template

Row = TypeVar("Row")
Medium = Literal["text", "page"]
REPORT_HTML = "report.html"
_WIDTH = 92


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table.

    Parameters
    ----------
    text : its text; ``page``, where it is given, takes its place on the page.
    below, title : on the page only: a small second line, and what is shown on pointing at it.
    color : of a dot before the text; empty: none.
    style : CSS classes.
    """

    text: str
    page: str | Markup | None = None
    below: str = ""
    title: str = ""
    color: str = ""
    style: str = ""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table.

    Parameters
    ----------
    heading : on the page, with line ends; in text they are blanks.
    cells : from the top.
    kind : ``words`` stand to the left; ``count`` to the right; ``figures`` to the left in text and
        to the right on the page.
    medium : ``text`` or ``page`` where it stands in one of them only.
    text_heading : where the text has another.
    above : a second heading, over the first, in text only; may reach over the next columns.
    before : stands before the column in text.
    """

    heading: str
    cells: tuple[Cell, ...]
    kind: Literal["words", "count", "figures"] = "words"
    medium: Literal["both", "text", "page"] = "both"
    text_heading: str | None = None
    above: str = ""
    before: str = "  "


def column(
    heading: str, rows: Sequence[Row], cell_of: Callable[[Row], Cell | str | int], **options: Any
) -> Column:
    """A column with one cell per row; ``options`` as of :class:`Column`."""
    cells = (cell_of(row) for row in rows)
    return Column(
        heading, tuple(c if isinstance(c, Cell) else Cell(str(c)) for c in cells), **options
    )


class Block:
    """A part of a section; its template and its text form go by the name of its class."""

    __slots__ = ()

    @property
    def block(self) -> str:
        """``paragraph``, ``table`` ..."""
        return type(self).__name__.lower()


@dataclass(frozen=True, slots=True)
class Table(Block):
    """Columns of equally many cells.

    Parameters
    ----------
    styles : CSS class of each row; empty: none has one.
    rules : rows with a line above them in text.
    headed : whether the text has headings.
    tall : whether the page shows it in a box of its own to scroll in.
    footnote : below it, in text only.
    """

    columns: tuple[Column, ...]
    styles: tuple[str, ...] = ()
    rules: tuple[int, ...] = (0,)
    headed: bool = True
    tall: bool = False
    footnote: str = ""

    def headings(self, medium: Medium) -> list[Column]:
        """The columns of one medium."""
        return [own for own in self.columns if own.medium in ("both", medium)]

    def rows(self, medium: Medium) -> list[list[tuple[Column, Cell]]]:
        """The cells of one medium by row, each with its column."""
        columns = self.headings(medium)
        return [[(own, own.cells[i]) for own in columns] for i in range(len(self.columns[0].cells))]

    def style(self, row: int) -> str:
        """CSS class of a row."""
        return self.styles[row] if self.styles else ""


@dataclass(frozen=True, slots=True)
class Paragraph(Block):
    """A sentence or several; ``style`` is its CSS class, ``wrap`` whether text lines are broken."""

    text: str | Markup
    style: str = "soft"
    wrap: bool = True


@dataclass(frozen=True, slots=True)
class Items(Block):
    """Sentences, each with whether it stands out."""

    items: tuple[tuple[str, bool], ...]


@dataclass(frozen=True, slots=True)
class Heading(Block):
    """A heading within a section; on the page only."""

    text: str


@dataclass(frozen=True, slots=True)
class Figure(Block):
    """A drawing as an ``<svg>`` element, ``narrow`` or as wide as the page; on the page only."""

    svg: Markup
    narrow: bool = False


@dataclass(frozen=True, slots=True)
class Numbers(Block):
    """Large figures with their units and the lines below each; on the page only."""

    numbers: tuple[tuple[str, str, tuple[str, ...]], ...]


@dataclass(frozen=True, slots=True)
class Picture:
    """An ``<img>`` or ``<svg>`` element and what stands below it."""

    element: Markup
    caption: str | Markup = ""


@dataclass(frozen=True, slots=True)
class Pictures(Block):
    """An image in several pictures; on the page only.

    Parameters
    ----------
    name, facts : of the image; the facts stand on lines of their own below its name.
    main : a large picture, ``others`` small ones beside it.
    note : before ``panels``, pictures of equal rank side by side.
    """

    name: str
    facts: tuple[str, ...] = ()
    main: Picture | None = None
    others: tuple[Picture, ...] = ()
    note: str = ""
    panels: tuple[Picture, ...] = ()


@dataclass(frozen=True, slots=True)
class Card:
    """A picture of a query among :class:`Cards`.

    Parameters
    ----------
    name, facts : of the query; the facts stand on lines of their own.
    element : an ``<img>`` or ``<svg>``.
    role : a word above it; may be empty.
    condition, outcome : that the cards can be filtered by.
    sort : name of an order -> its value, of those that are known.
    """

    name: str
    element: Markup
    facts: tuple[str, ...]
    role: str
    condition: str
    outcome: str
    sort: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Cards(Block):
    """Pictures side by side, which a script can filter and sort; on the page only."""

    cards: tuple[Card, ...]

    def values(self, attribute: Literal["condition", "outcome"]) -> list[str]:
        """What the cards can be filtered by; empty where all are the same."""
        found = sorted({getattr(card, attribute) for card in self.cards})
        return found if len(found) > 1 else []

    def orders(self) -> list[str]:
        """Names of the orders that at least two cards have a value for."""
        names = dict.fromkeys(name for card in self.cards for name in card.sort)
        return [name for name in names if sum(name in card.sort for card in self.cards) > 1]


@dataclass(frozen=True, slots=True)
class Section:
    """Blocks that belong together: a card of the page; lines without a blank one in text.

    Parameters
    ----------
    heading : on the page; empty: it is no card.
    color : of a dot before the heading.
    beside : a second section to the right of this one.
    """

    blocks: tuple[Block, ...]
    heading: str = ""
    color: str = ""
    beside: Section | None = None


@dataclass(frozen=True, slots=True)
class Document:
    """A report.

    Parameters
    ----------
    name : of its JSON and text files, without suffix.
    title : of the page.
    text, page : its sections in the two forms.
    data : for JSON: mappings, sequences, models and numbers; what is infinite becomes null.
    tables : file name -> column -> values of a CSV table; None and what is infinite are empty.
    beside : file name -> content of further pages that are written beside this one.
    provenance : plain data, shown at the end of the page with the versions; its ``steps``, each
        with ``name``, ``on`` and ``why``, stand first.
    """

    name: str
    title: str
    text: tuple[Section, ...]
    page: tuple[Section, ...]
    data: Mapping[str, Any]
    tables: Mapping[str, Mapping[str, Sequence[object]]]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    beside: Mapping[str, str] = field(default_factory=dict)


def write_document(folder: Path | str, document: Document) -> dict[str, Path]:
    """Write all files of a report into ``folder``, each atomically; returns name -> path.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    # whatever is wrong with the page is found before anything is written
    texts = {**document.beside, REPORT_HTML: render_html(document)}
    json_name, text_name = f"{document.name}.json", f"{document.name}.txt"
    names = (json_name, text_name, *document.tables, *texts)
    paths = {name: Path(folder) / name for name in names}
    write_json(paths[json_name], plain(document.data))
    write_bytes(paths[text_name], render_text(document.text).encode("utf-8"))
    for name, columns in document.tables.items():
        rows = zip(*([_csv_cell(v) for v in values] for values in columns.values()), strict=True)
        write_csv_table(paths[name], list(columns), list(rows))
    for name, text in texts.items():
        write_bytes(paths[name], text.encode("utf-8"))
    return paths


def plain(data: Any) -> Any:
    """Data for JSON: models as mappings, and None for numbers that are not finite."""
    if isinstance(data, BaseModel):
        return data.model_dump(mode="json")
    if isinstance(data, Mapping):
        return {key: plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [plain(value) for value in data]
    return None if isinstance(data, float) and not np.isfinite(data) else data


def _csv_cell(value: object) -> str:
    """Text of a value: of a float the shortest that reads back to it; empty for none, infinite."""
    if isinstance(value, float):
        return repr(float(value)) if np.isfinite(value) else ""
    return "" if value is None else str(value)


def render_text(sections: Sequence[Section]) -> str:
    """The sections with blank lines between them, ended by a newline."""
    parts = ["\n".join(line for block in s.blocks for line in _lines(block)) for s in sections]
    return "\n\n".join(parts) + "\n"


def _lines(block: Block) -> list[str]:
    if isinstance(block, Paragraph):
        return _wrapped(block.text) if block.wrap else [block.text]
    if isinstance(block, Items):
        return [line for text, _ in block.items for line in _wrapped(text)]
    if isinstance(block, Table):
        return _table_lines(block)
    raise TypeError(f"{block.block} has no text form")


def _table_lines(table: Table) -> list[str]:
    columns = table.headings("text")
    body = [[cell.text for _, cell in row] for row in table.rows("text")]
    head = [
        c.heading.replace("\n", " ") if c.text_heading is None else c.text_heading for c in columns
    ]
    sized = [head, *body] if table.headed else body
    widths = [max(len(line[i]) for line in sized) for i in range(len(columns))]

    def aligned(cells: Sequence[str]) -> str:
        # a heading above the others may reach over the next column
        padded = [
            (own.before if i else "")
            + (cell.rjust(width) if own.kind == "count" else cell.ljust(width))
            for i, (own, cell, width) in enumerate(zip(columns, cells, widths, strict=True))
        ]
        return "".join(padded).rstrip()

    lines = []
    if table.headed:
        above = [own.above for own in columns]
        lines = [aligned(above)] if any(above) else []
        lines.append(aligned(head))
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    for number, cells in enumerate(body):
        if table.headed and number in table.rules:
            lines.append(rule)
        lines.append(aligned(cells))
    return lines + ([table.footnote] if table.footnote else [])


def _wrapped(text: str) -> list[str]:
    """A sentence as lines that fit the tables."""
    return textwrap.wrap(text, width=_WIDTH, break_long_words=False, break_on_hyphens=False)


def template(name: str) -> Template:
    """A template of pages; what is put in is escaped, and what is forgotten an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only a page waits for it

    environment = Environment(
        loader=PackageLoader("megloc_kapture.evaluation.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(name)


def render_html(document: Document) -> str:
    """The page of a document; the same document gives the same text.

    It is self-contained: no link to the outside, no date, and no script but the gallery's own.
    """
    provenance = dict(document.provenance)
    return template("report.html").render(
        document=document,
        versions=package_versions(),
        steps=provenance.pop("steps", []),
        provenance=json.dumps(provenance, indent=2, ensure_ascii=False) if provenance else "",
    )
