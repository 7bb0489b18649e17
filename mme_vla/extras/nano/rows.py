"""Rows of the board of nanoMME: a folder `<row>/<training seed>` for each training, checked once
when it is read.

A folder holds `config.yaml`, `run.json`, `trained.json` and `episodes.jsonl` (or
`episodes.jsonl.xz`). Each file names what it is of. Files of different trainings, scenes or
settings are one error. `scenes.json` beside the rows says which scenes of the split can be built: a
row has the first so many of these of each task, by default of all.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from omegaconf import OmegaConf

from mme_vla.config.sections import NonNegative, NonNegativeInt, read_section
from mme_vla.envs.metadata import episodes
from mme_vla.errors import brief, listed, require
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, read_records
from mme_vla.evaluation.store import RECORDS, RUN_FILE, files_below, find_records, read_run
from mme_vla.policy.saving import composition_digest
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.training_identity import TrainingIdentity
from mme_vla.utils import decoding, read_json, read_text

CONFIG, TRAINED = "config.yaml", "trained.json"
FILES = (CONFIG, RUN_FILE, TRAINED)
SCENES = "scenes.json"
CHOICES = "multi_choice"
"""The action space of the benchmark's own table; rows of another one have a table of their own."""
_SETTINGS = {
    "model": "model",
    "split": "split",
    "max_steps": "max_steps",
    "checkpoint": "checkpoint",
    "seed": "model_seed",
}
"""Setting of `run.json` → field of its records."""


@dataclass(frozen=True)
class Trained:
    """What `trained.json` holds; a row without a training, as of random choices, has no numbers.

    row: name of the row.
    kind: floors and ceilings bracket the policies.
    trained: whether there was a training.
    seed, recipe, data, weights: its `TrainingIdentity`.
    demonstrations: their number for each task.
    budget: memory tokens.
    parameters: learned ones.
    update_s: CPU seconds of one update, with its share of validation and checkpoints.
    update_flops: of one update.
    cpu_minutes: of a training that was not interrupted.
    """

    row: str
    kind: Literal["policy", "floor", "ceiling"]
    trained: bool
    seed: int = 0
    recipe: str | None = None
    data: str | None = None
    weights: str | None = None
    demonstrations: Mapping[str, NonNegativeInt] | None = None
    budget: NonNegativeInt | None = None
    parameters: NonNegativeInt | None = None
    update_s: NonNegative | None = None
    update_flops: NonNegative | None = None
    cpu_minutes: NonNegative | None = None

    @property
    def identity(self) -> TrainingIdentity | None:
        """What its records say of the training."""
        if not self.trained:
            return None
        return TrainingIdentity(self.seed, self.recipe, self.data, self.weights)


@dataclass(frozen=True)
class _Limits:
    """Settings of `run.json` that are rules of the board: of an evaluation `max_actions`, of a run
    of `play` `max_choices`.
    """

    max_actions: int | None = None
    max_choices: int | None = None
    only_possible: bool = False


@dataclass(frozen=True)
class Training:
    """One training and its episodes, numbered from 0 within each task.

    rules: action space and limits of an episode.
    is_local: whether it is the user's.
    """

    folder: Path
    facts: Trained
    records: Sequence[EpisodeRecord]
    rules: str
    is_local: bool = False

    @property
    def action_space(self) -> str:
        """Of its records, as the benchmark calls it."""
        return self.records[0].action_space

    @property
    def table(self) -> str:
        """Name of the table that it belongs to, and of that table's folder: its split, and any
        other action space.
        """
        return table_of(self.records[0].split, self.action_space)

    @property
    def scenes(self) -> dict[EpisodeKey, tuple[str, int, str, int]]:
        """Split, seed, difficulty and step limit of each episode."""
        return {r.key: (r.split, r.seed, r.difficulty, r.max_steps) for r in self.records}


def table_of(split: str, action_space: str) -> str:
    """Name of the table of a split: rows of other actions than choices have their own."""
    return split if action_space == CHOICES else f"{split}-{action_space}"


def rules_text(action_space: str, max_choices: int | None, only_possible: bool) -> str:
    """What rows of one board have the same, beside their scenes."""
    return f"action_space={action_space}, max_choices={max_choices}, only_possible={only_possible}"


def read_rows(folders: Iterable[Path], local: Iterable[Path] = ()) -> dict[str, list[Training]]:
    """The trainings of each row in or below folders, by the row's name, in the order of their
    seeds.

    local: folders of the user, whose rows are called `<name> (yours)` where the others have the
        name.

    Raises:
        UserError: a folder that does not keep the schema, two trainings with the same weights or
            different recipes in one row, or rows of different scenes.
    """
    trainings = [read_training(place) for place in _places(folders)]
    names = {training.facts.row for training in trainings}
    trainings += [replace(read_training(place), is_local=True) for place in _places(local)]
    rows: dict[str, list[Training]] = {}
    for training in sorted(trainings, key=lambda training: training.facts.seed):
        name = training.facts.row
        if training.is_local and name in names:
            name = f"{name} (yours)"
        row = rows.setdefault(name, [])
        # Trainings of a row are of one recipe, and none is another one. Their digests of the data
        # may differ: demonstrations recorded on another processor end otherwise here and there.
        for earlier in row:
            both = f"{earlier.folder} and {training.folder}"
            first, second = earlier.facts, training.facts
            for fact in ("kind", "recipe", "demonstrations", "budget", "parameters"):
                values = getattr(first, fact), getattr(second, fact)
                require(
                    values[0] == values[1],
                    f"{both} are trainings of the row {first.row}, but {fact} is {values[0]} and"
                    f" {values[1]}. Give them different names of rows.",
                )
            require(
                first.seed != second.seed and first.weights != second.weights,
                f"{both} have the same seed or weights: they are one training.",
            )
        row.append(training)
        require(
            training.rules == trainings[0].rules,
            f"{training.folder} has {training.rules}, but {trainings[0].folder}"
            f" {trainings[0].rules}. Rows of one board have the same.",
        )
        scenes, expected = training.scenes, trainings[0].scenes
        differing = []
        for key in sorted(scenes | expected):
            if scenes.get(key) != expected.get(key):
                differing.append(f"{key.task} {key.episode}")
        require(
            not differing,
            f"{training.folder} and {trainings[0].folder} have different scenes or step limits:"
            f" {listed(differing)}. Rows of one board have the same.",
        )
    return rows


def _places(folders: Iterable[Path]) -> list[Path]:
    """The folders of trainings in or below folders."""
    places: set[Path] = set()
    for folder in folders:
        require(
            folder.is_dir(),
            f"rows={folder}: there is no such folder. Name one that holds <row>/<training seed>.",
        )
        names = (RUN_FILE, TRAINED, "episodes*.jsonl", "episodes*.jsonl.xz")
        below = {path.parent for path in files_below(folder, *names)}
        require(
            below, f"rows={folder} holds no row: no {TRAINED}, {RUN_FILE} or {RECORDS} below it."
        )
        places |= below
    return sorted(places)


def read_training(folder: Path) -> Training:
    """Read one folder.

    Raises:
        UserError: a file is missing or damaged, an episode is there twice, missing or of another
            split, or the files are not of one training.
    """
    for name in FILES:
        require(
            (folder / name).is_file(),
            f"{folder} lacks {name}. A training's folder holds {listed(FILES)} and "
            f"{RECORDS} or {RECORDS}.xz.",
        )
    facts = read_section(Trained, read_json(folder / TRAINED), f"{folder / TRAINED}", others=True)
    run = read_run(folder)
    text = read_text(folder / CONFIG, "a composed configuration")
    with decoding(folder / CONFIG, "a composed configuration", "Copy it again."):
        config: Any = OmegaConf.to_container(OmegaConf.create(text))
    require(
        isinstance(config, Mapping),
        f"{folder / CONFIG} must hold sections of keys, not {brief(config)}.",
    )
    every: list[EpisodeRecord] = []
    for file in find_records([folder]):
        every += read_records(file)
    records = _ended(every)
    require(records, f"{folder} lacks {RECORDS}, or it has no episode.")
    _check_identity(folder, facts, run["settings"], config, records)
    counts = Counter(record.key for record in records)
    twice = [f"{key.task} {key.episode}" for key, count in counts.items() if count > 1]
    require(not twice, f"{folder} has episodes twice: {listed(twice)}. Keep one record of each.")
    where = f"{folder / RUN_FILE}: settings"
    limits = read_section(_Limits, run["settings"], where, others=True)
    max_choices = limits.max_choices if limits.max_actions is None else limits.max_actions
    rules = rules_text(records[0].action_space, max_choices, limits.only_possible)
    return Training(folder, facts, _numbered(folder, records), rules)


def _ended(records: Sequence[EpisodeRecord]) -> list[EpisodeRecord]:
    """The records without the errors of episodes that were repeated, of which the last stays where
    all are errors.
    """
    newest_errors: dict[EpisodeKey, EpisodeRecord] = {}
    without_error: set[EpisodeKey] = set()
    for record in records:
        if record.outcome == "error":
            newest_errors[record.key] = record
        else:
            without_error.add(record.key)
    ended = []
    for record in records:
        is_newest_error = record is newest_errors.get(record.key)
        if record.outcome != "error" or (is_newest_error and record.key not in without_error):
            ended.append(record)
    return ended


def _check_identity(
    folder: Path,
    facts: Trained,
    settings: Mapping[str, Any],
    config: Mapping[str, Any],
    records: Sequence[EpisodeRecord],
) -> None:
    """Make sure that the four files are of one training."""
    # The budget that was asked for: of some memories fewer tokens are built (`facts.budget`).
    memory = PolicySections.of(config, str(folder / CONFIG)).memory
    _, _, named = facts.row.partition("@")
    require(
        not named or str(memory.get("budget", named)) == named,
        f"{folder}: {facts.row} has {named} memory tokens by its name, but"
        f" {brief(memory.get('budget'))} in {CONFIG}. Correct the one that is wrong.",
    )
    expected: dict[str, Any] = {"training": facts.identity, "made_up": False}
    for key, field in _SETTINGS.items():
        if facts.trained or key in ("model", "split", "max_steps"):
            expected[field] = settings.get(key)
    if any(record.composition for record in records):
        expected["composition"] = composition_digest(config)
    source = {"training": TRAINED, "composition": CONFIG}
    for record in records:
        for field, value in expected.items():
            require(
                getattr(record, field) == value,
                f"{folder}: {field} of {record.task} {record.episode} is {getattr(record, field)}"
                f" in its record, but {value} in {source.get(field, RUN_FILE)}. These files are not"
                " of one training.",
            )


def _numbered(folder: Path, records: Sequence[EpisodeRecord]) -> list[EpisodeRecord]:
    """The records with their episodes numbered from 0 within each task.

    Raises:
        UserError: they are not the first scenes of each task that can be built.
    """
    split = records[0].split
    file = folder.resolve().parent.parent / SCENES
    # Episode → why its scene cannot be built, empty if it can
    tried: dict[str, str] = {}
    if file.is_file():
        tried = read_json(file, "the scenes of a split").get("tried", {})
        require(
            isinstance(tried, Mapping),
            f"{file}: tried must be a section of keys, not {brief(tried)}.",
        )
    n_scenes = max(Counter(record.task for record in records).values())
    by_key = {record.key: record for record in records}
    numbered = []
    missing = []
    for task in dict.fromkeys(record.task for record in records):
        built = [spec for spec in episodes(task, split) if not tried.get(f"{task} {spec.episode}")]
        for number, spec in enumerate(built[:n_scenes]):
            record = by_key.pop(EpisodeKey(task, spec.episode), None)
            if record is None:
                missing.append(f"{task} {spec.episode}")
                continue
            require(
                (record.seed, record.difficulty) == (spec.seed, spec.difficulty),
                f"{folder}: {task} {spec.episode} has seed {record.seed} ({record.difficulty}),"
                f" but that of split {split!r} has {spec.seed} ({spec.difficulty}).",
            )
            numbered.append(replace(record, episode=number))
    others = [f"{task} {n}" for task, n in by_key]
    require(
        not missing and not others,
        f"{folder} does not have the first {n_scenes} scenes of each task in split {split!r}: it"
        f" lacks {listed(missing) or 'none'}, and has {listed(others) or 'none'} beside them.",
    )
    return numbered
