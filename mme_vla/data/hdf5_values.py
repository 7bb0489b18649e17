"""Single values of an episode in an HDF5 file, each checked and refused under its own name."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from h5py import Empty, h5d, h5s

from mme_vla.errors import UserError, brief
from mme_vla.files import decoding

REMEDY = "Download or copy the file again."


@dataclass(frozen=True)
class EpisodeRef:
    """Where one recorded episode lies: `group` (episode_<index>) of `file`; `task` is taken from the file's name."""

    file: Path
    index: int
    task: str

    @property
    def group(self) -> str:
        return f"episode_{self.index}"


class StoredValues:
    """Reads the datasets below one episode's group.

    Raises:
        UserError: from every method, where a value is absent, damaged or of another form; it names the place.
    """

    def __init__(self, ref: EpisodeRef, group: Any) -> None:
        self.ref = ref
        self._group = group

    def _step(self, step: int, name: str) -> Any:
        return self._value(f"timestep_{step}/{name}")

    def _value(self, name: str) -> Any:
        place = f"{self.ref.file} {self.ref.group}/{name}"
        with decoding(place, "a dataset of HDF5", REMEDY):
            # An episode has thousands: opened as h5py's own objects, each takes more than twice as long.
            stored = h5d.open(self._group.id, name.encode())
            if stored.get_space().get_simple_extent_type() == h5s.NULL:
                return Empty(stored.dtype)
            found = np.empty(stored.shape, stored.dtype)
            stored.read(h5s.ALL, h5s.ALL, found)
            return found[()]

    def _numbers(self, step: int, name: str, least: int, finite: bool = True) -> np.ndarray:
        """A list of at least `least` numbers, finite unless told otherwise."""
        found = np.atleast_1d(np.asarray(self._step(step, name)))
        right = found.dtype.kind in "fiu" and found.ndim == 1 and len(found) >= least
        if not right or (finite and not np.isfinite(found).all()):
            raise UserError(
                f"{self.ref.file} {self.ref.group}/timestep_{step}/{name} holds {brief(found.tolist())}; expected at "
                f"least {least} {'finite ' if finite else ''}numbers. {REMEDY}"
            )
        return found

    def _flag(self, step: int, name: str) -> bool:
        found = np.asarray(self._step(step, name))
        if found.size != 1 or found.dtype.kind not in "biu":
            raise UserError(
                f"{self.ref.file} {self.ref.group}/timestep_{step}/{name} holds {brief(found.tolist())}; expected a "
                f"flag. {REMEDY}"
            )
        return bool(found.reshape(-1)[0])

    def _text(self, value: Any) -> str:
        if not isinstance(value, bytes | str):
            raise UserError(f"{self.ref.file} {self.ref.group} has {brief(value)} for a text. {REMEDY}")
        try:
            return value.decode("utf-8") if isinstance(value, bytes) else value.encode().decode()
        except UnicodeError:
            raise UserError(f"{self.ref.file} {self.ref.group} has a text that is not UTF-8. {REMEDY}") from None
