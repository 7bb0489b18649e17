"""NumPy arrays inside msgpack, as openpi's clients and the RoboMME challenge write them; never
pickle.

An array is a map with bytes keys,
`{b"__ndarray__": True, b"data": raw, b"dtype": "<f4", b"shape": [2, 3]}`, in C order; a NumPy
scalar is `{b"__npgeneric__": True, b"data": value, b"dtype": "<f4"}`. Records, objects and complex
numbers are refused both ways. All else is msgpack with its defaults.
"""

import math
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
        packed: bytes = msgpack.packb(message, default=encode)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"This message cannot be encoded: {error}") from error
    return packed


def unpack(data: bytes | bytearray | memoryview) -> Any:
    """Decode a message. Arrays are read-only views on `data`: copy what is written to."""
    check_size(data)
    try:
        return msgpack.unpackb(data, object_hook=_decode, max_str_len=MOST_TEXT, max_ext_len=0)
    except UserError:
        raise
    except Exception as error:  # msgpack raises many kinds of exception
        raise UserError(
            f"This is not a msgpack message ({type(error).__name__}: {error})."
        ) from error


def _sizes() -> tuple[tuple[int, int, int], ...]:
    """For each first byte of a value: bytes it takes at least, width of the length after it, values
    it announces.

    Where there is a width, the number written there counts bytes (values announced: 0) or entries
    of so many values.
    """
    sizes = [(1, 0, 0)] * 256
    for kind in range(16):
        sizes[0x80 + kind] = (1, 0, 2 * kind)
        sizes[0x90 + kind] = (1, 0, kind)
    for length in range(32):
        sizes[0xA0 + length] = (1 + length, 0, 0)
    # Bytes, extensions (which carry a type as well) and texts.
    for step, width in enumerate((1, 2, 4)):
        sizes[0xC4 + step] = (1 + width, width, 0)
        sizes[0xC7 + step] = (2 + width, width, 0)
        sizes[0xD9 + step] = (1 + width, width, 0)
    # Lists, and maps of two values an entry.
    for step, width in enumerate((2, 4)):
        sizes[0xDC + step] = (1 + width, width, 1)
        sizes[0xDE + step] = (1 + width, width, 2)
    # Floats, unsigned and signed integers, extensions of a fixed size.
    numbers = (4, 8, 1, 2, 4, 8, 1, 2, 4, 8, 2, 3, 5, 9, 17)
    for kind, size in enumerate(numbers, start=0xCA):
        sizes[kind] = (1 + size, 0, 0)
    return tuple(sizes)


_SIZES = _sizes()


def check_size(data: bytes | bytearray | memoryview, most: int = MOST_OBJECTS) -> None:
    """Count the values of a message without making any: an empty map takes one byte here and 64 in
    memory.

    A message that is cut short or malformed passes; `unpack` says what is wrong with it.
    """
    at = 0  # of the next value's first byte
    waiting = announced = 1  # values that are not read yet, and all so far
    while waiting and at < len(data):
        waiting -= 1
        taken, width, more = _SIZES[data[at]]
        if width:
            number = int.from_bytes(data[at + 1 : at + 1 + width], "big")
            if more:
                more *= number
            else:
                taken += number
        if more:
            waiting += more
            announced += more
            if announced > most:
                raise UserError(
                    f"The message holds more than {most} values; a frame takes about 130. Send"
                    " fewer."
                )
        at += taken


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
