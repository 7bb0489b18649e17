"""NumPy arrays inside msgpack, as openpi's clients and the RoboMME challenge write them; never
pickle.

An array is a map with bytes keys,
`{b"__ndarray__": True, b"data": raw, b"dtype": "<f4", b"shape": [2, 3]}`, in C order; a NumPy
scalar is `{b"__npgeneric__": True, b"data": value, b"dtype": "<f4"}`. Records, objects and complex
numbers are refused both ways. All else is msgpack with its defaults.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from mme_vla.errors import UserError, missing_extra

REFUSED_KINDS = "VOc"  # records and raw bytes, Python objects, complex numbers
# values of a message, whatever holds them; a frame with all its cameras takes about 130
MOST_OBJECTS = 2**20
MOST_TEXT = 2**20  # characters of one text

try:
    import msgpack
except ImportError as error:  # the extra is missing: say which
    raise missing_extra("Serving", "serve") from error


def pack(message: Any) -> bytes:
    try:
        packed = msgpack.packb(message, default=encode)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"This message cannot be encoded: {error}") from error
    assert isinstance(packed, bytes)
    return packed


def unpack(
    data: bytes | bytearray | memoryview, read_map: Callable[[dict[Any, Any]], Any] | None = None
) -> Any:
    """Decode a message. Arrays are read-only views on `data`: copy what is written to.

    Args:
        read_map: makes of each map what it stands for; by default an array or a scalar where its
            keys say so.
    """
    read_map = read_map or _decode
    total = 1

    # An empty map takes one byte in a message and 64 in memory.
    def count(more: int) -> None:
        nonlocal total
        total += more
        if total > MOST_OBJECTS:
            raise UserError(
                f"The message holds more than {MOST_OBJECTS} values; a frame takes about 130. Send"
                " fewer."
            )

    def take_map(fields: dict[Any, Any]) -> Any:
        count(2 * len(fields))
        return read_map(fields)

    def take_list(values: list[Any]) -> list[Any]:
        count(len(values))
        return values

    try:
        return msgpack.unpackb(
            data,
            object_hook=take_map,
            list_hook=take_list,
            max_str_len=MOST_TEXT,
            max_array_len=MOST_OBJECTS,
            max_map_len=MOST_OBJECTS,
            max_ext_len=0,
        )
    except UserError:
        raise
    except Exception as error:  # msgpack raises many kinds of exception
        raise UserError(
            f"This is not a msgpack message that is read here ({type(error).__name__}: {error})."
        ) from error


def encode(value: Any) -> dict[bytes, Any]:
    """An array or a NumPy scalar as a map; raises TypeError or ValueError for all else."""
    if not isinstance(value, np.ndarray | np.generic):
        raise TypeError(
            f"{type(value).__name__} has no form in msgpack; use numbers, text, lists, dicts and"
            " arrays"
        )
    if value.dtype.kind in REFUSED_KINDS:
        raise ValueError(f"arrays of dtype {value.dtype} are not sent")
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": list(value.shape),
        }
    scalar = value.item()
    if not isinstance(scalar, bool | int | float | str | bytes):
        raise ValueError(f"a scalar of dtype {value.dtype} is not sent; make it a plain number")
    return {b"__npgeneric__": True, b"data": scalar, b"dtype": value.dtype.str}


def _decode(fields: dict[Any, Any]) -> Any:
    if b"__ndarray__" in fields:
        return read_array(fields)
    if b"__npgeneric__" in fields:
        dtype = _dtype(fields)
        value = fields.get(b"data")
        if not isinstance(value, bool | int | float | str | bytes):
            raise UserError(f"A NumPy scalar of dtype {dtype} holds a {type(value).__name__}.")
        try:
            return dtype.type(value)
        except (ValueError, TypeError, OverflowError) as error:
            raise UserError(
                f"A NumPy scalar of dtype {dtype} holds {str(value)[:40]!r}: {error}"
            ) from None
    return fields


def read_array(fields: dict[Any, Any]) -> np.ndarray:
    """The array of a map with bytes keys; a view on its data."""
    dtype = _dtype(fields)
    shape: Any = fields.get(b"shape")
    data: Any = fields.get(b"data")
    if (
        not isinstance(shape, list)
        or len(shape) > 32
        or not all(type(n) is int and n >= 0 for n in shape)
    ):
        raise UserError(
            f"An array's shape must be a list of at most 32 whole numbers, got {str(shape)[:80]}."
        )
    if not isinstance(data, bytes):
        raise UserError(f"An array's data must be bytes, got {type(data).__name__}.")
    needed = math.prod(shape) * dtype.itemsize
    if len(data) != needed:
        raise UserError(
            f"An array {dtype} {shape} takes {needed} bytes, but {len(data)} were sent."
        )
    try:
        return np.ndarray(tuple(shape), dtype, data)
    except ValueError as error:  # an empty array of impossible size
        raise UserError(f"An array cannot have the shape {shape}: {error}") from None


def _dtype(fields: dict[Any, Any]) -> np.dtype:
    name = fields.get(b"dtype")
    if not isinstance(name, str) or len(name) > 16:
        raise UserError(
            f"An array's dtype must be a short text such as '<f4', got {str(name)[:40]!r}."
        )
    try:
        dtype = np.dtype(name)
    except (TypeError, ValueError, SyntaxError):
        raise UserError(f"{name!r} is not a NumPy dtype.") from None
    if dtype.kind in REFUSED_KINDS or dtype.hasobject:
        raise UserError(
            f"Arrays of dtype {name!r} are refused: send numbers, truth values or text."
        )
    return dtype
