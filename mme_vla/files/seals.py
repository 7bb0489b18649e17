"""A checksum inside a JSON object, for files that grow line by line or lie alone."""

import json
import zlib
from collections.abc import Mapping
from typing import Any

from mme_vla.errors import UserError, brief

SEAL = "crc32"


def plain(value: Any) -> Any:
    """`value` as JSON gives it back: tuples are lists, keys are texts."""
    return json.loads(json.dumps(value))


def sealed(values: Mapping[str, Any]) -> dict[str, Any]:
    """`values` and, under `crc32`, a checksum of them that does not depend on the order of keys."""
    return {**values, SEAL: _sum(values)}


def unsealed(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """`values` without their seal; those that were written without one, by hand or long ago, are taken as they are.

    Raises:
        UserError: the seal is not that of these values.
    """
    inner = {key: value for key, value in values.items() if key != SEAL}
    if SEAL in values and values[SEAL] != _sum(inner):
        raise UserError(
            f"{source} is not what was written: its {SEAL} is {brief(values[SEAL], 20)}, that of its content "
            f"{_sum(inner)!r}. It is damaged; if you changed it on purpose, take {SEAL} out."
        )
    return inner


def _sum(values: Mapping[str, Any]) -> str:
    # ASCII, so that half characters, which no encoding of text takes, count as well.
    return f"{zlib.crc32(json.dumps(values, sort_keys=True, separators=(',', ':')).encode('ascii')):08x}"
