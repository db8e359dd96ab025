"""HTML pages: self-contained, no script, no link to the outside, no date."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from megloc_kapture.evaluation import comparison_text, sentences, tables, without_truth_text
from megloc_kapture.evaluation.provenance import package_versions


def render_page(template: str, *, provenance: Mapping[str, Any] | None, **content: Any) -> str:
    """One of our templates, filled; the same content gives the same text.

    Parameters
    ----------
    template : its file name.
    provenance : plain JSON data, shown at the end with the versions; its ``steps``, each with
        ``name``, ``on`` and ``why``, stand first.
    content : what the template shows.
    """
    environment = Environment(
        loader=PackageLoader("megloc_kapture.evaluation"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    told = dict(provenance or {})
    steps = told.pop("steps", [])
    return environment.get_template(template).render(
        **content,
        format=tables,
        spread=comparison_text.format_spread,
        said=sentences,
        unknown=without_truth_text,
        infinity=math.inf,
        versions=package_versions(),
        steps=steps,
        provenance=json.dumps(told, indent=2, ensure_ascii=False) if told else "",
    )
