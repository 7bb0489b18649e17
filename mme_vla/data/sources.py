"""The `data` section of a configuration → open datasets."""

from collections.abc import Mapping, Sequence
from typing import Any

from mme_vla.data.episodes import EpisodeSource
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.errors import UserError, did_you_mean

_KEYS = ("root", "name", "exec_starts")


def open_sources(
    entries: str | Mapping[str, Any] | Sequence[str | Mapping[str, Any]], robot: Embodiment = ROBOMME_JOINT
) -> list[EpisodeSource]:
    """Open the datasets of `data.sources`: folders, `sample`, or mappings with root, name and exec_starts.

    `robot` says which columns hold its pictures, states and actions.

    Raises:
        UserError: no source, an unknown key, two sources of one name, or a dataset that cannot be used.
    """
    listed = [entries] if isinstance(entries, (str, Mapping)) else list(entries or [])
    if not listed:
        raise UserError("data.sources is empty: name at least one dataset folder, or 'sample'.")
    sources = []
    for entry in listed:
        options = {"root": entry} if isinstance(entry, str) else dict(entry)
        for key in options:
            if key not in _KEYS:
                raise UserError(f"Unknown key {key!r} of a data source. {did_you_mean(str(key), _KEYS)}")
        if not options.get("root"):
            raise UserError("A data source needs its dataset folder: root=<folder>, or 'sample'.")
        sources.append(EpisodeSource(**options, robot=robot))
    names = [source.name for source in sources]
    if len(set(names)) < len(names):
        raise UserError(f"Two data sources have the same name ({', '.join(names)}); give one a `name` of its own.")
    return sources
