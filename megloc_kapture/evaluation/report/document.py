"""The document model of reports: sections of paragraphs, lists, tables, figures and pictures.

A :class:`Document` holds the sections of its text form and of its page, the data of its JSON file
and the tables of its CSV files. Tables and paragraphs may stand in both forms; the
renderers (:mod:`.renderers`) know nothing of results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, TypeVar

from markupsafe import Markup

Row = TypeVar("Row")


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


@dataclass(frozen=True, slots=True)
class Table:
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
    block: ClassVar[str] = "table"

    def rows(self, medium: Literal["text", "page"]) -> list[list[tuple[Column, Cell]]]:
        """The cells of one medium by row, each with its column."""
        columns = [c for c in self.columns if c.medium in ("both", medium)]
        return [[(own, own.cells[i]) for own in columns] for i in range(len(self.columns[0].cells))]

    def headings(self, medium: Literal["text", "page"]) -> list[Column]:
        """The columns of one medium."""
        return [own for own in self.columns if own.medium in ("both", medium)]

    def style(self, row: int) -> str:
        """CSS class of a row."""
        return self.styles[row] if self.styles else ""


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A sentence or several; ``style`` is its CSS class, ``wrap`` whether text lines are broken."""

    text: str | Markup
    style: str = "soft"
    wrap: bool = True
    block: ClassVar[str] = "paragraph"


@dataclass(frozen=True, slots=True)
class Items:
    """Sentences, each with whether it stands out."""

    items: tuple[tuple[str, bool], ...]
    block: ClassVar[str] = "items"


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading within a section; on the page only."""

    text: str
    block: ClassVar[str] = "heading"


@dataclass(frozen=True, slots=True)
class Figure:
    """A drawing as an ``<svg>`` element, ``narrow`` or as wide as the page; on the page only."""

    svg: Markup
    narrow: bool = False
    block: ClassVar[str] = "figure"


@dataclass(frozen=True, slots=True)
class Numbers:
    """Large figures with their units and the lines below each; on the page only."""

    numbers: tuple[tuple[str, str, tuple[str, ...]], ...]
    block: ClassVar[str] = "numbers"


@dataclass(frozen=True, slots=True)
class Picture:
    """An ``<img>`` or ``<svg>`` element and what stands below it."""

    element: Markup
    caption: str | Markup = ""


@dataclass(frozen=True, slots=True)
class Pictures:
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
    block: ClassVar[str] = "pictures"


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
class Cards:
    """Pictures side by side, which a script can filter and sort; on the page only."""

    cards: tuple[Card, ...]
    block: ClassVar[str] = "cards"

    def values(self, attribute: Literal["condition", "outcome"]) -> list[str]:
        """What the cards can be filtered by; empty where all are the same."""
        found = sorted({getattr(card, attribute) for card in self.cards})
        return found if len(found) > 1 else []

    def orders(self) -> list[str]:
        """Names of the orders that at least two cards have a value for."""
        names = dict.fromkeys(name for card in self.cards for name in card.sort)
        return [name for name in names if sum(name in card.sort for card in self.cards) > 1]


Block = Paragraph | Items | Table | Heading | Figure | Numbers | Pictures | Cards


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
