"""NumPy arrays inside msgpack, as openpi's clients and the RoboMME challenge write them; never pickle.

An array is a map with bytes keys, `{b"__ndarray__": True, b"data": raw, b"dtype": "<f4", b"shape": [2, 3]}`, in C
order; a NumPy scalar is `{b"__npgeneric__": True, b"data": value, b"dtype": "<f4"}`. Records, objects and complex
numbers are refused both ways. All else is msgpack with its defaults.
"""

import math
from typing import Any

import numpy as np

from mme_vla.errors import UserError, missing_extra

REFUSED_KINDS = "VOc"  # records and raw bytes, Python objects, complex numbers
MOST_ITEMS = 2**17  # entries of one list or map: msgpack reserves room for as many as a message claims
MOST_TEXT = 2**20  # characters of one text

try:
    import msgpack
except ImportError as error:  # the extra is missing: say which
    raise missing_extra("Serving", "serve") from error


def pack(message: Any) -> bytes:
    """Encode a message.

    Raises:
        UserError: it holds something msgpack has no form for, such as an array of objects.
    """
    try:
        packed = msgpack.packb(message, default=_encode)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"This message cannot be encoded: {error}") from error
    assert isinstance(packed, bytes)
    return packed


def unpack(data: bytes | bytearray | memoryview) -> Any:
    """Decode a message. Arrays are read-only views on `data`: copy what is written to.

    Raises:
        UserError: it is no msgpack, it is cut short, or an array in it is not what it says.
    """
    try:
        return msgpack.unpackb(
            data,
            object_hook=_decode,
            max_array_len=MOST_ITEMS,
            max_map_len=MOST_ITEMS,
            max_str_len=MOST_TEXT,
            max_ext_len=0,
        )
    except UserError:
        raise
    except Exception as error:  # msgpack answers damage with many kinds of exception
        raise UserError(f"This is not a msgpack message ({type(error).__name__}: {error}).") from error


def _encode(value: Any) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic):
        raise TypeError(f"{type(value).__name__} has no form in msgpack; use numbers, text, lists, dicts and arrays")
    if value.dtype.kind in REFUSED_KINDS:
        raise ValueError(f"arrays of dtype {value.dtype} are not sent")
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": list(value.shape),
        }
    plain = value.item()
    if not isinstance(plain, bool | int | float | str | bytes):
        raise ValueError(f"a scalar of dtype {value.dtype} is not sent; make it a plain number")
    return {b"__npgeneric__": True, b"data": plain, b"dtype": value.dtype.str}


def _decode(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" in found:
        return _array(found)
    if b"__npgeneric__" in found:
        dtype, value = _dtype(found), found.get(b"data")
        if not isinstance(value, bool | int | float | str | bytes):
            raise UserError(f"A NumPy scalar of dtype {dtype} holds a {type(value).__name__}.")
        try:
            return dtype.type(value)
        except (ValueError, TypeError, OverflowError) as error:
            raise UserError(f"A NumPy scalar of dtype {dtype} holds {str(value)[:40]!r}: {error}") from None
    return found


def _array(found: dict[Any, Any]) -> np.ndarray:
    dtype, shape, data = _dtype(found), found.get(b"shape"), found.get(b"data")
    if not isinstance(shape, list) or len(shape) > 32 or not all(type(n) is int and n >= 0 for n in shape):
        raise UserError(f"An array's shape must be a list of at most 32 whole numbers, got {str(shape)[:80]}.")
    if not isinstance(data, bytes):
        raise UserError(f"An array's data must be bytes, got {type(data).__name__}.")
    needed = math.prod(shape) * dtype.itemsize
    if len(data) != needed:
        raise UserError(f"An array {dtype} {shape} takes {needed} bytes, but {len(data)} were sent.")
    try:
        return np.ndarray(tuple(shape), dtype, data)
    except ValueError as error:  # an empty array of impossible size
        raise UserError(f"An array cannot have the shape {shape}: {error}") from None


def _dtype(found: dict[Any, Any]) -> np.dtype:
    name = found.get(b"dtype")
    if not isinstance(name, str) or len(name) > 16:
        raise UserError(f"An array's dtype must be a short text such as '<f4', got {str(name)[:40]!r}.")
    try:
        dtype = np.dtype(name)
    except (TypeError, ValueError, SyntaxError):
        raise UserError(f"{name!r} is not a NumPy dtype.") from None
    if dtype.kind in REFUSED_KINDS or dtype.hasobject:
        raise UserError(f"Arrays of dtype {name!r} are refused: send numbers, truth values or text.")
    return dtype
