"""The `data` section of a configuration → open datasets."""

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.config.sections import PathText, read_section
from mme_vla.data.consistency import have_other_units
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.embodiment.action_space import compare_names
from mme_vla.errors import listed, require

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Split:
    """Episode numbers, one ascending int64 array for every source."""

    train: list[np.ndarray]
    val: list[np.ndarray]


def split_episodes(
    sources: Sequence[EpisodeSource],
    val_fraction: float = 0.0,
    val_episodes: Sequence[int | str] | None = None,
) -> Split:
    """Split every source by episode.

    `val_episodes` holds out episodes by `<source name>/<number>`, or by number where there is one
    source; a source it names holds out exactly those. Of any other, episode e validates if the
    first eight bytes of SHA-256("<source name>/<e>"), read as a fraction of 2⁶⁴, are below
    `val_fraction`: the choice does not change when data are added, and needs no random numbers.
    """
    named: dict[str, list[int]] = {}
    for name in val_episodes or ():
        source_name, _, number = str(name).rpartition("/")
        require(
            number.isdigit() and (source_name or len(sources) == 1),
            f"val_episodes: {name!r} should read <source>/<episode>, such as {sources[0].name}/0;"
            " with several sources the name is needed.",
        )
        named.setdefault(source_name or sources[0].name, []).append(int(number))
    unknown = set(named) - {source.name for source in sources}
    require(
        not unknown,
        f"val_episodes names {', '.join(sorted(unknown))}, but the sources are"
        f" {', '.join(source.name for source in sources)}. Name episodes of these, or set"
        " data.val_episodes=[].",
    )
    require(0 <= val_fraction < 1, f"val_fraction={val_fraction} must lie in [0, 1).")
    split = Split([], [])
    for source in sources:
        held_out = held_out_in(source, named.get(source.name), val_fraction)
        episodes = np.arange(len(source))
        split.train.append(episodes[~held_out])
        split.val.append(episodes[held_out])
    require(
        any(map(len, split.train)),
        "The split leaves no episode to train on; lower val_fraction or shorten val_episodes.",
    )
    return split


def held_out_in(
    source: EpisodeSource, named: Sequence[int] | None, val_fraction: float
) -> np.ndarray:
    """Which episodes of one dataset are held out, bool [e]; see `split_episodes`.

    Args:
        named: the episodes that are held out; None where none of this dataset is named.
    """
    episodes = np.arange(len(source))
    if named is not None:
        wrong = [number for number in named if not 0 <= number < len(source)]
        require(
            not wrong,
            f"val_episodes names {wrong} of {source.name}, which has episodes"
            f" 0…{len(source) - 1}. Name others, or hold out a share: data.val_episodes=[]"
            " data.val_fraction=0.1",
        )
        return np.isin(episodes, named)
    held_out = np.zeros(len(source), bool)
    for episode in range(len(source)):
        digest = sha256(f"{source.name}/{episode}".encode()).digest()
        share = int.from_bytes(digest[:8], "big") / 2**64
        held_out[episode] = share < val_fraction
    return held_out


def default_val_episodes(sources: Sequence[EpisodeSource]) -> list[str]:
    """The episodes that are held out where none is named: number 3 of the embedded sample."""
    return [f"{source.name}/3" for source in sources if source.root.resolve() == SAMPLE]


@dataclass(frozen=True)
class SourceEntry:
    """An entry of `data.sources`: arguments of `EpisodeSource`."""

    root: PathText
    name: PathText | None = None
    exec_starts: PathText | None = None

    @property
    def short_name(self) -> str:
        """The dataset's name, as `EpisodeSource` gives it."""
        if self.name:
            return self.name
        return self.root if self.root == "sample" else Path(self.root).resolve().name


def listed_sources(
    entries: str | Mapping[str, Any] | Sequence[str | Mapping[str, Any]],
) -> list[SourceEntry]:
    """Read `data.sources`; one entry may stand without a list around it."""
    listed = [entries] if isinstance(entries, (str, Mapping)) else list(entries or [])
    require(listed, "data.sources is empty: name at least one dataset folder, or 'sample'.")
    sources = []
    for entry in listed:
        section = entry if isinstance(entry, Mapping) else {"root": entry}
        sources.append(read_section(SourceEntry, section, "data.sources"))
    return sources


def open_sources(
    entries: str | Mapping[str, Any] | Sequence[str | Mapping[str, Any]],
    robot: Embodiment = ROBOMME_JOINT,
) -> list[EpisodeSource]:
    """Open the datasets of `data.sources`: folders, `sample`, or mappings with root, name and
    exec_starts.

    `robot` says which columns hold its images, states and actions.

    Raises:
        UserError: two have one name, or the same names of numbers in another order.
    """
    sources = []
    for entry in listed_sources(entries):
        sources.append(EpisodeSource(entry.root, entry.exec_starts, entry.name, robot=robot))
    names = [source.name for source in sources]
    require(
        len(set(names)) == len(names),
        f"Two data sources have the same name ({', '.join(names)}); give one a `name` of its own.",
    )
    # They are trained on together. Other rates are a warning: they may be meant.
    first = sources[0]
    for second in sources[1:]:
        for kind, first_names, second_names in (
            ("state", first.state_names, second.state_names),
            ("action", first.action_names, second.action_names),
        ):
            compare_names(
                first_names,
                second_names,
                kind,
                f"the source {first.name}",
                f"the source {second.name}",
                "Trained together, one number would mean two things: bring one dataset's columns"
                " into the other's order.",
            )
        if first.fps != second.fps:
            log.warning(
                "The source %s has %g frames per second, %s has %g: one step of a chunk is another"
                " time in each.",
                first.name,
                first.fps,
                second.name,
                second.fps,
            )
    compare_episodes(sources)
    return sources


def compare_episodes(sources: Sequence[EpisodeSource]) -> None:
    """Compare the episodes of one or several datasets with each other, and the actions of each with
    its states. What is found is a warning, since it may be meant.
    """
    findings: dict[str, list[str]] = defaultdict(list)
    places_by_digest: dict[bytes, str] = {}
    switches: dict[int, dict[tuple[float, float], str]] = defaultdict(dict)
    first: tuple[str, np.ndarray] | None = None
    for source in sources:
        relative = list(source.robot.action.relative)
        second = max(round(source.fps), 2)
        for episode in range(len(source)):
            place = f"{source.name}/{episode}"
            states, actions = source.states(episode), source.actions(episode)
            original = places_by_digest.setdefault(
                sha256(states.tobytes() + actions.tobytes()).digest(), place
            )
            if original != place:
                findings[
                    "Episodes hold the same states and actions, so what is held out of one may be"
                    " trained on in the other; delete one"
                ].append(f"{place} as {original}")
            if relative and len(states) >= 4 * second:
                # Errors by how many frames after an action a state is looked for, ten a second.
                acted = actions[second : -2 * second, relative]
                errors = {}
                for lag in range(-second, 2 * second + 1, max(second // 10, 1)):
                    reached = states[second + lag :, relative][: len(acted)]
                    errors[lag] = float(np.abs(acted - reached).mean())
                best = min(errors, key=lambda lag: errors[lag])
                if 2 * errors[best] < min(errors[lag] for lag in errors if -1 <= lag <= second):
                    findings[
                        "Actions fit other states than those of the second after them, by which a"
                        " robot follows: record both with one clock"
                    ].append(f"{place} those {best:+} frames away")
            numbers = np.concatenate([states, actions], axis=1)
            low, high = numbers.min(axis=0), numbers.max(axis=0)
            sizes = np.maximum(np.abs(low), np.abs(high))
            first = first or (place, sizes)
            if have_other_units(sizes, first[1]):
                findings[
                    f"States and actions have other units than in episode {first[0]} (degrees and"
                    " radians differ by 57): convert one"
                ].append(place)
            is_switch = ((numbers == low) | (numbers == high)).all(axis=0) & (low < high)
            for d in np.flatnonzero(is_switch & (low % 1 == 0) & (high % 1 == 0)).tolist():
                switches[d].setdefault((low[d].item(), high[d].item()), place)
    for d, places in switches.items():
        if len(places) > 1:
            width = sources[0].robot.state.width
            name = f"{d + 1} of the state" if d < width else f"{d - width + 1} of the action"
            pairs = [f"{low:g} or {high:g} in {place}" for (low, high), place in places.items()]
            findings["One command means two things: bring it to one scale"].append(
                f"number {name} is {' and '.join(pairs)}"
            )
    for problem, where in findings.items():
        log.warning("%s: %s.", problem, listed(where))
