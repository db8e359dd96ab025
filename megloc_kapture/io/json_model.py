"""Pydantic models kept as JSON files, with errors that name the file and the field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.text import read_text

ModelT = TypeVar("ModelT", bound=BaseModel)


def read_json_model(path: Path | str, model: type[ModelT]) -> ModelT:
    """Read one JSON file as ``model``.

    Raises
    ------
    DataError : the file cannot be read, is not JSON (names the line; NaN and infinity are not
        JSON), or does not fit the model (names the field).
    """
    text = read_text(path)
    try:
        content = json.loads(text, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        raise DataError(f"not JSON: {error.msg}", path=path, line=error.lineno) from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"not JSON: {error}", path=path) from error
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise DataError(first_problem(error), path=path) from error


def write_json_model(path: Path | str, model: BaseModel) -> None:
    """Write ``model`` as indented JSON, atomically; the same model gives the same bytes."""
    write_json(path, model.model_dump(mode="json"))


def write_json(path: Path | str, content: Any) -> None:
    """Write plain JSON data, indented and atomically.

    Raises
    ------
    ValueError : ``content`` holds NaN or infinity, which JSON does not know.
    OutputError : the file cannot be written.
    """
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    write_bytes(path, f"{text}\n".encode())


def first_problem(error: ValidationError) -> str:
    """The first problem of a validation in one line: ``field: what is wrong``."""
    problem = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in problem["loc"])
    message = problem["msg"].removeprefix("Value error, ")
    more = error.error_count() - 1
    tail = f" (and {more} more)" if more else ""
    return f"{field}: {message}{tail}" if field else f"{message}{tail}"


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number in JSON")
