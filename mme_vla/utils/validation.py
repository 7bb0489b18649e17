"""Checks of values from outside with pydantic, whose mistakes become one paragraph.

Files, messages and command lines are checked once, where they come in. The code behind that trusts
the checked object.
"""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import PydanticSerializationError, to_json

from mme_vla.errors import UserError, brief, did_you_mean, listed

_TYPES = {
    "boolean": "true or false",
    "integer": "a whole number",
    "number": "a number",
    "string": "a text",
    "null": "null",
    "array": "a list",
    "object": "a section of keys",
}
_BOUNDS = {
    "exclusiveMinimum": " above {}",
    "minimum": ", {} or more",
    "maximum": " at most {}",
    "exclusiveMaximum": " below {}",
    "minLength": " of length {} or more",
    "maxLength": " of length {} or less",
    "pattern": " that is not empty",
}
"""Words for what a JSON schema allows."""
_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_FEW = 4  # entries of a list that are written out
_LARGE = (np.ndarray, list, tuple, Mapping)
_Schema = Mapping[str, Any]


class _OpenSchema(GenerateJsonSchema):
    """A JSON schema that allows anything where a type, such as a function, is none of JSON's."""

    ignored_warning_kinds = {"skipped-choice", "non-serializable-default"}  # noqa: RUF012

    def handle_invalid_for_json_schema(self, schema: Any, error_info: str) -> dict[str, Any]:
        return {}


def validated[T](
    kind: type[T], value: object, what: str, where: str = "", *, strict: bool = False
) -> T:
    """Check a value against a pydantic model, a dataclass or any other type pydantic knows.

    A validator of a field raises a `ValueError` whose text continues the name of the key. A text
    that ends with a full stop is the whole sentence; otherwise the value is added:
    `ValueError("must be an even number")` becomes "steps must be an even number, got 3." The
    message of a `UserError` stays as it is.

    Args:
        kind: the type.
        value: what came from outside.
        what: its name at the beginning of a sentence, such as "The request".
        where: the dotted key of `value` itself, which precedes the keys inside it.
        strict: read the value as JSON, refuse unknown keys, and convert no text to a number.

    Raises:
        UserError: the first value that does not fit, by its key, with what is allowed.
    """
    adapter: TypeAdapter[T] = _adapter(kind)  # type: ignore[arg-type]
    try:
        if strict:
            # Of JSON, lists and maps may become tuples and dataclasses in strict mode.
            text = to_json(value, inf_nan_mode="constants", fallback=brief)
            checked = adapter.validate_json(text, strict=True, extra="forbid")
        else:
            checked = adapter.validate_python(value)
    except PydanticSerializationError as error:  # half of a surrogate pair
        raise UserError(f"{what} holds a text that is not Unicode: {brief(str(error))}.") from None
    except ValidationError as error:
        root = adapter.json_schema(ref_template="{model}", schema_generator=_OpenSchema)
        raise _mistake(error, root, what, where) from None
    return checked


@lru_cache(maxsize=256)
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _mistake(error: ValidationError, root: _Schema, what: str, where: str) -> UserError:
    """What is wrong with one value, by the JSON schema of all."""
    errors = error.errors(include_url=False)
    # A misspelt key says more than the one that is missing for it.
    misspelt = [one for one in errors if one["type"] in _UNKNOWN]
    first = (misspelt or errors)[0]
    rule = first["type"]
    value = first["input"]
    problem = first.get("ctx", {}).get("error")
    if isinstance(problem, UserError):
        return problem
    path = list(first["loc"])
    name = path.pop() if rule in ("missing", *_UNKNOWN) else None
    key, schema = _place(root, path, where)
    alternatives = _alternatives(schema, root)
    if isinstance(name, str):  # a number is of an item that a short list lacks
        known: dict[str, _Schema] = {}
        for one in alternatives:
            known.update(one.get("properties", {}))
        if rule != "missing":
            return UserError(unknown_key(key, name, known))
        meaning = known.get(name, {}).get("description")
        lacking = f"the key {name!r}"
        if meaning:
            lacking += f" ({meaning})"
        return UserError(f"{key or what} lacks {lacking}; it has {listed(value) or 'none'}.")
    key = key or what
    quoted = described(value)
    if schema.get("writeOnly"):
        quoted = "(hidden)"
    if rule == "value_error":
        text = str(problem)
        if not text.endswith("."):
            text += f", got {quoted}."
        return UserError(f"{key} {text}")
    choices: list[Any] = []
    for one in alternatives:
        choices += one.get("enum", [])
    if choices and isinstance(value, str):
        return UserError(f"{key}={quoted}. {did_you_mean(value, map(str, choices))}")
    # Where the schema is open: pydantic's own "Input should be greater than 0".
    allowed = _words(schema, root)
    message, _, _ = first["msg"].partition(", unable to parse")
    expected = f"be {allowed}" if allowed else message.rpartition(" should ")[2]
    return UserError(f"{key}={quoted} must {expected}.")


def unknown_key(section: str, key: object, known: Iterable[str]) -> str:
    """The message for a key that a section cannot have."""
    name = brief(key, quote=False)
    if section:
        name = f"{section}.{name}"
    return f"Unknown key {name}. {did_you_mean(str(key), known)}"


def _place(root: _Schema, path: Iterable[int | str], where: str) -> tuple[str, _Schema]:
    """The dotted name of a value, with the numbers of list entries in brackets, and its schema."""
    key = where
    schema = root
    for part in path:
        if part == "[key]":
            return key, {}  # the key itself is mistaken
        inner: list[Any] = []
        for one in _alternatives(schema, root):
            if isinstance(part, int):  # an item, or the key of a map
                inner += [*one.get("prefixItems", ())[part : part + 1], one.get("items")]
            inner += [one.get("properties", {}).get(part), one.get("additionalProperties")]
        inner = [one for one in inner if isinstance(one, Mapping)]
        if isinstance(part, int):
            key += f"[{part}]"
        elif inner or "properties" in schema:  # a key, also by a second name of it
            name = brief(part, quote=False)
            key = f"{key}.{name}" if key else name
        else:
            continue  # pydantic's name of an alternative
        schema = inner[0] if inner else {}
    return key, schema


def _alternatives(schema: _Schema, root: _Schema) -> list[_Schema]:
    """What a value may be, without references."""
    definitions = root.get("$defs", {})
    schema = definitions.get(schema.get("$ref"), schema)
    return [definitions.get(one.get("$ref"), one) for one in schema.get("anyOf", [schema])]


def _words(schema: _Schema, root: _Schema) -> str:
    """What a schema allows, in words; empty where it allows anything."""
    alternatives = []
    for one in _alternatives(schema, root):
        words = _TYPES.get(one.get("type", ""), "")
        if "enum" in one or "const" in one:
            words = " or ".join(map(str, one.get("enum") or [one["const"]]))
        elif "prefixItems" in one:
            items = [_words(item, root) for item in one["prefixItems"]]
            words = f"a list of {len(items)} values: {', '.join(items)}"
        elif one.get("type") == "array":
            if "maxItems" in one:
                words += f" of {one.get('minItems', 0)} to {one['maxItems']} values"
            elif "minItems" in one:
                words += f" of {one['minItems']} or more values"
            if one.get("items"):
                words += f", each {_words(one['items'], root)}"
        elif "minimum" in one and "maximum" in one:
            words += f" from {one['minimum']} to {one['maximum']}"
        else:
            bounds = [text.format(one[key]) for key, text in _BOUNDS.items() if key in one]
            words += " and".join(bounds)
        alternatives.append(words)
    return " or ".join(alternatives)


def described(value: object) -> str:
    """A value for a message: arrays by dtype and shape, long lists by length, all else as `brief`.

    >>> described([np.zeros((2, 3), np.uint8)])
    'a list of 1 value, the first: uint8 [2, 3]'
    """
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {list(value.shape)}"
    if isinstance(value, list | tuple):
        if len(value) <= _FEW and not any(isinstance(item, _LARGE) for item in value):
            return brief(value)
        count = "1 value" if len(value) == 1 else f"{len(value)} values"
        first = "a list" if isinstance(value[0], list | tuple) else described(value[0])
        return f"a list of {count}, the first: {first}"
    if isinstance(value, Mapping):
        return f"a map of {listed(value, 4) or 'nothing'}"
    return brief(value)
