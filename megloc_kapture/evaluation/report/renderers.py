"""Renderers of documents: plain text, JSON, CSV and HTML."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from megloc_kapture.evaluation.provenance import package_versions
from megloc_kapture.evaluation.report.document import (
    Block,
    Document,
    Items,
    Paragraph,
    Section,
    Table,
)
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import write_bytes, write_json

if TYPE_CHECKING:
    from jinja2 import Template

REPORT_HTML = "report.html"
_WIDTH = 92


def write_document(folder: Path | str, document: Document) -> dict[str, Path]:
    """Write all files of a report into ``folder``, each atomically; returns name -> path.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    # whatever is wrong with the page is found before anything is written
    page = render_html(document)
    names = [
        *(f"{document.name}.json", f"{document.name}.txt"),
        *(*document.tables, *document.beside, REPORT_HTML),
    ]
    paths = {name: Path(folder) / name for name in names}
    write_json(paths[names[0]], plain(document.data))
    write_bytes(paths[names[1]], render_text(document.text).encode("utf-8"))
    for name, columns in document.tables.items():
        rows = zip(*([csv_cell(v) for v in values] for values in columns.values()), strict=True)
        write_csv_table(paths[name], list(columns), list(rows))
    for name, text in document.beside.items():
        write_bytes(paths[name], text.encode("utf-8"))
    write_bytes(paths[REPORT_HTML], page.encode("utf-8"))
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


def csv_cell(value: object) -> str:
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
    steps = provenance.pop("steps", [])
    return template("report.html").render(
        document=document,
        versions=package_versions(),
        steps=steps,
        provenance=json.dumps(provenance, indent=2, ensure_ascii=False) if provenance else "",
    )
