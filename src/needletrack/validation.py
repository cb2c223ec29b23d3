"""What pydantic finds wrong with a file, told to the person who wrote the file."""

import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo


@dataclass(frozen=True, slots=True)
class Complaint:
    """One wrong entry: its key as the models nest it, and one sentence with value, fault and remedy."""

    path: tuple[str | int, ...]
    message: str


def dotted(path: tuple[str | int, ...]) -> str:
    """`a.b[0]` for ("a", "b", 0)."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")


def model_of(annotation: Any) -> type[BaseModel] | None:
    """The model that an annotation holds, also inside an Optional, tuple or Annotated; else None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for argument in get_args(annotation) if (model := model_of(argument))), None)


def known_keys(model: type[BaseModel], below: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every key that a document of this model may have, tables included, parents first."""
    for name, field in model.model_fields.items():
        yield (*below, name)
        if (inner := model_of(field.annotation)) is not None:
            yield from known_keys(inner, (*below, name))


def nearest_key(model: type[BaseModel], wanted: tuple[str | int, ...]) -> tuple[str, ...] | None:
    """The known key which an unknown one most probably means; None where nothing resembles it."""
    last = str(wanted[-1])
    names = difflib.get_close_matches(last, {key[-1] for key in known_keys(model)}, n=1)
    text = dotted(wanted)
    return max(
        (key for key in known_keys(model) if key[-1] in names),
        key=lambda key: difflib.SequenceMatcher(None, ".".join(key), text).ratio(),
        default=None,
    )


def complaints(error: ValidationError, model: type[BaseModel]) -> list[Complaint]:
    """Everything that is wrong, in the order of the document."""
    return [_complaint(dict(entry), model) for entry in error.errors(include_url=False)]


def _complaint(entry: dict[str, Any], model: type[BaseModel]) -> Complaint:
    path: tuple[str | int, ...] = entry["loc"]
    key = _in_short(dotted(path))
    field, siblings = _look_up(model, path)
    if entry["type"] == "extra_forbidden":
        near = nearest_key(model, path)
        hint = f"did you mean {'.'.join(near)}?" if near else f"known here: {', '.join(siblings)}"
        return Complaint(path, f"unknown key {key}: {hint}")
    meaning = f" ({field.description.rstrip('.')})" if field and field.description else ""
    if entry["type"] == "missing":
        return Complaint(path, f"{key} is missing{meaning}")
    fault = entry["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if entry["type"] == "model_type":
        fault = "must be a table"
    if not path:
        return Complaint(path, fault)
    value = "" if isinstance(entry["input"], dict | BaseModel) else f" = {_shortened(entry['input'])}"
    return Complaint(path, f"{key}{value}: {fault}{meaning}")


def _look_up(model: type[BaseModel], path: tuple[str | int, ...]) -> tuple[FieldInfo | None, list[str]]:
    """The field at a path (None where unknown) and the names that stand beside it."""
    field: FieldInfo | None = None
    table: type[BaseModel] | None = model
    names = list(model.model_fields)
    for part in path:
        if isinstance(part, int):
            continue
        if table is None:
            break
        names = list(table.model_fields)
        field = table.model_fields.get(part)
        table = model_of(field.annotation) if field else None
    return field, names


def _shortened(value: object) -> str:
    return _in_short(repr(value))


def _in_short(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}..."
