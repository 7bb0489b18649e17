"""What is kept of an evaluated episode, the file that holds it, and how records come together into
runs.
"""

import fcntl
import os
import time
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, Annotated, Any, NamedTuple, Self, TypedDict

from mme_vla.config.sections import Range, read_section
from mme_vla.envs.make import ROBOMME
from mme_vla.envs.metadata import DEFAULT_STEPS
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT
from mme_vla.errors import UserError, brief, check_choice, require
from mme_vla.policy.run_folders import shipped_checkpoints
from mme_vla.policy.training_identity import TrainingIdentity
from mme_vla.utils import name_place, parse_json, read_lines, to_line, verified

Integer = Annotated[int, Range(-(2**63), 2**63)]  # beyond is damage
Count = Annotated[int, Range(0, 2**63)]
Duration = Annotated[float, Range(0, 2.0**63)]
OUTCOMES = ("success", "fail", "timeout", "error")


ARM = " · "
"""Between a model and what was done to it, in records and labels."""


def display_name(model: str, checkpoint: int | str) -> str:
    """What people call a policy: a shipped one by its checkpoint (`nano`), others by their model.

    model: as records have it; what follows ` · `, the arm of a probe, stays.
    """
    if str(checkpoint) not in shipped_checkpoints():
        return model
    _, dot, arm = model.partition(ARM)
    return f"{checkpoint}{dot}{arm}"


def checkpoint_number(checkpoint: int | str) -> int | str:
    """A checkpoint as records have it: 60000 and "60000" are one."""
    return int(checkpoint) if str(checkpoint).isdecimal() else checkpoint


class RunKey(NamedTuple):
    """What one pass over the benchmark is a pass of: one policy, one training, one checkpoint, one
    model seed. All records of a run have it in common; the fields are those of `EpisodeRecord`.
    """

    model: str
    checkpoint: int | str
    model_seed: int
    split: str = "test"
    subgoal: str | None = None
    memory_budget: int | None = None
    composition: str | None = None
    training: TrainingIdentity | None = None
    event: str | None = None

    @property
    def label(self) -> str:
        """What headings and tables call the policy: a shipped one by the name of its checkpoint."""
        text = display_name(self.model, self.checkpoint)
        if self.subgoal is not None:
            text += f"+{self.subgoal}"
        if self.memory_budget is not None and not self.is_shipped:
            text += f"@{self.memory_budget}"
        if self.event is not None:
            text += f"{ARM}{self.event}"
        return text

    @property
    def is_shipped(self) -> bool:
        """Whether the checkpoint is one that comes with the library or an installed package."""
        return str(self.checkpoint) in shipped_checkpoints()

    def __str__(self) -> str:
        text = display_name(self.model, self.checkpoint)
        if self.subgoal is not None:
            text += f"+{self.subgoal}"
        if self.memory_budget is not None and not self.is_shipped:
            text += f", {self.memory_budget} memory tokens"
        if self.training is not None:
            recipe = f"recipe {str(self.training.recipe)[:6]}"
            if self.training.seed is not None:
                recipe = f"training seed {self.training.seed} of {recipe}"
            text += f", {recipe}"
        if not self.is_shipped:
            text += f", checkpoint {self.checkpoint}"
        text += f", seed {self.model_seed}, {self.split}"
        if self.event:
            text += f", event {self.event}"
        return text


class EpisodeKey(NamedTuple):
    """An episode of the benchmark's split."""

    task: str
    episode: int


@dataclass(frozen=True)
class Seconds:
    """Where an episode's wall time went.

    sim: building and stepping the environment, without its images.
    render: those (0 where they cannot be separated).
    policy: the episode's share of the policy's batches.
    total: from its beginning to its end, waiting included.
    """

    sim: Duration = 0.0
    policy: Duration = 0.0
    total: Duration = 0.0
    render: Duration = 0.0


class EventEntry(TypedDict):
    """An event of an episode, and the control step at which it acted; None where it did not."""

    event: str
    step: Count | None


@dataclass(frozen=True)
class EpisodeRecord:
    """One evaluated episode.

    model: name of the model (`framesamp_modul`).
    checkpoint: its step, or a name.
    model_seed: of the policy's noise; it does not reach the environment.
    task, episode: which episode of the split.
    seed, difficulty: the environment's, from the benchmark's metadata.
    outcome: `success`, `fail` (the environment ended it), `timeout` (`max_steps` passed), `error`
        (see `error`).
    steps: control steps executed, one an action but for planned motions.
    seconds: where the time went.
    subgoal: name of the subgoal predictor, None for a policy without.
    memory_budget: memory tokens, where it is not the model's usual number (a sweep over budgets).
    composition: `composition_digest` (policy/saving.py) of the policy, so that no two
        configurations are averaged under one name; None in records written before there was one,
        and of players that are no policy of this library.
    training: seed, recipe, data and weights of the training that the checkpoint is of; None in
        records written before checkpoints named it, and of what was not trained.
    event: what happened in the rollout (`pause:100@subtask:2`); None in the matched arm, which is
        the plain run.
    when: UTC time of the end, ISO 8601.
    extra: whatever else a runner of one's own keeps.
    scene: digest of the scene's values and places (`mme_vla/envs/scene_hash.py`); `no values` of
        an environment that gives none, `not built` where the episode ended before; None in records
        from before there were digests.

    What follows is of rollouts, and is not written where it is None or empty.

    env: the environment's name.
    goal: the instruction.
    chunks: how often the policy acted.
    video_frames: observed frames of the conditioning video.
    actions_sha256: digest of the executed actions.
    suite: the task's, where its environment has suites.
    groups: the task's in its environment's further groupings, title → name.
    refused: what the environment says of an episode that failed.
    video: name of the file.
    process: where the chain of sub-tasks broke (`ProcessScore`).
    events: what happened, and at which control step.
    subgoals: their score (`SubgoalScore`).
    made_up: whether the record is synthetic.
    """

    model: str
    checkpoint: Integer | str
    model_seed: Integer
    task: str
    episode: Count
    seed: Integer
    difficulty: str
    outcome: str
    steps: Count
    seconds: Seconds = field(default_factory=Seconds)
    error: str | None = None
    split: str = "test"
    max_steps: Count = DEFAULT_STEPS
    action_space: str = "joint_angle"
    subgoal: str | None = None
    memory_budget: Integer | None = None
    composition: str | None = None
    training: TrainingIdentity | None = None
    event: str | None = None
    when: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    extra: Mapping[str, Any] = field(default_factory=dict)
    scene: str | None = None
    _: KW_ONLY
    env: str | None = None
    goal: str | None = None
    chunks: Count | None = None
    video_frames: Count | None = None
    actions_sha256: str | None = None
    suite: str | None = None
    groups: Mapping[str, str] | None = None
    refused: str | None = None
    video: str | None = None
    process: Mapping[str, Any] | None = None
    events: tuple[EventEntry, ...] = ()
    subgoals: Mapping[str, Any] | None = None
    made_up: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "checkpoint", checkpoint_number(self.checkpoint))

    @property
    def success(self) -> bool:
        return self.outcome == "success"

    @property
    def named_scene(self) -> str | None:
        """The digest of the scene; None where there is none."""
        return None if self.scene in (NO_VALUES, NOT_BUILT) else self.scene

    @property
    def run(self) -> RunKey:
        return RunKey(*(getattr(self, name) for name in RunKey._fields))

    @property
    def key(self) -> EpisodeKey:
        return EpisodeKey(self.task, self.episode)

    def to_json(self) -> str:
        """One line, without its end; a checksum in it tells damage."""
        values = asdict(self)
        absent: dict[str, Any] = {"extra": {}, **_OF_ROLLOUTS}
        for name, default in absent.items():
            if values[name] == default:
                del values[name]
        return to_line(values)

    @classmethod
    def from_json(cls, line: str | bytes) -> Self:
        """Read a line."""
        # Not only finite numbers: a score that does not exist is kept as NaN.
        return cls.from_dict(
            verified(parse_json(line, "an episode record", finite=False), "an episode record")
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read the object of a line, without its checksum."""
        values = {**values, "seconds": values.get("seconds") or {}}
        extra = values.get("extra")
        if isinstance(extra, Mapping):  # where earlier versions kept what is of rollouts
            values["extra"] = {}
            for name, value in extra.items():
                section = values if name in _OF_ROLLOUTS else values["extra"]
                section[name] = value
        record = read_section(cls, values, "record")
        check_choice("record.outcome", record.outcome, OUTCOMES)
        return record


_OF_ROLLOUTS = {spec.name: spec.default for spec in fields(EpisodeRecord) if spec.kw_only}
"""Field that is not written at its default → that."""


_PROBED_S = 1.0  # other shards lock the file for a moment, to see who is alive (`claims.Claims`)


class RecordLog:
    """Appends records to a file of this process, each on disk when `append` returns."""

    def __init__(self, path: Path) -> None:
        """Open or create `path`, and remove a half-written last line."""
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: IO[bytes] = path.open("ab+")
        try:
            self._lock()
            self._repair()
        except BaseException:
            self._file.close()
            raise

    def append(self, record: EpisodeRecord) -> None:
        """Write one record, if the file is still there."""
        require(self.path.exists(), f"{self.path} was removed or moved: repeat the same command.")
        self._file.write(record.to_json().encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        name_place(error, self.path)
        try:
            self.close()
        except OSError:  # what a full disk did not take is tried once more on closing
            if error is None:
                raise

    def _lock(self) -> None:
        # The records themselves are locked, so that no other file lies beside them.
        until = time.monotonic() + _PROBED_S
        while True:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() >= until:
                    raise UserError(
                        f"{self.path} is being written by another process; give every shard a file"
                        " of its own, episodes-<shard>.jsonl."
                    ) from None
            except OSError:  # a file system without locks
                return
            time.sleep(0.01)

    def _repair(self) -> None:
        self._file.seek(0)
        content = self._file.read()
        last_line = content.rpartition(b"\n")[2]
        if not last_line:
            return
        try:
            EpisodeRecord.from_json(last_line)
        except UserError:
            warnings.warn(
                f"{self.path}: removed a half-written last line ({len(last_line)} bytes).",
                stacklevel=3,
            )
            self._file.truncate(len(content) - len(last_line))
        else:  # only the line's end is missing
            self._file.write(b"\n")


def read_records(path: Path) -> list[EpisodeRecord]:
    """Read a file of records; a half-written last line is ignored with a warning."""
    return read_lines(path, EpisodeRecord.from_dict, "episode records", finite=False)


def merge(records: Iterable[EpisodeRecord], conflicts: str = "refuse") -> list[EpisodeRecord]:
    """One record for each episode of each run, in the order they first came.

    Any other outcome supersedes an `error`, which was retried. Of equal outcomes the first stays.
    Different outcomes of one episode are refused: the same checkpoint and seed were evaluated
    twice. So are different scenes.

    records: of one or many files.
    conflicts: `refuse`, or keep the `first` or the `last` by time.
    """
    check_choice("conflicts", conflicts, ("refuse", "first", "last"))
    merged: dict[tuple[RunKey, EpisodeKey], EpisodeRecord] = {}
    for new in records:
        at = (new.run, new.key)
        old = merged.get(at)
        if old is None:
            merged[at] = new
            continue
        require(
            new.seed == old.seed,
            f"{new.task} {new.episode} ({new.run}) was run with environment seeds {old.seed} and"
            f" {new.seed}: these are not the same benchmark; evaluate both from the same episode"
            " metadata.",
        )
        if old.outcome == "error" and new.outcome != "error":
            merged[at] = new
            continue
        if new.outcome == "error":
            continue
        scenes = {new.named_scene, old.named_scene} - {None}
        require(
            conflicts != "refuse" or len(scenes) < 2,
            f"{new.task} {new.episode} ({new.run}) was run in different scenes: {old.scene} at"
            f" {old.when}, {new.scene} at {new.when}. Name one of the runs, or choose conflicts"
            " first or last.",
        )
        if new.outcome == old.outcome and len(scenes) < 2:
            continue
        require(
            conflicts != "refuse",
            f"{new.task} {new.episode} ({new.run}) was evaluated twice with different outcomes:"
            f" {old.outcome} at {old.when}, {new.outcome} at {new.when}. Name one of the runs, or"
            " choose conflicts first or last.",
        )
        # Of records of one second the later in the list is the last.
        new_ended, old_ended = _ended(new), _ended(old)
        supersedes = new_ended >= old_ended if conflicts == "last" else new_ended < old_ended
        if supersedes:
            merged[at] = new
    return list(merged.values())


def _ended(record: EpisodeRecord) -> datetime:
    """The time of an episode's end; without an offset it is of UTC."""
    try:
        ended = datetime.fromisoformat(record.when)
    except ValueError:
        raise UserError(
            f"{record.task} {record.episode} ({record.run}): when={brief(record.when)} is no time."
            " Expected ISO 8601, such as 2026-01-31T12:00:00+00:00."
        ) from None
    return ended if ended.tzinfo is not None else ended.replace(tzinfo=UTC)


def check_settings(records: Iterable[EpisodeRecord]) -> None:
    """Make sure that a run has one action space, one step limit, and an environment for each task.

    Raises:
        UserError: its records name several.
    """
    values: dict[tuple[RunKey, str, str], set[Any]] = {}
    for record in records:
        # Tasks of other environments may have limits of their own.
        scope = "" if record.env in (None, ROBOMME) else record.task
        values.setdefault((record.run, "action_space", ""), set()).add(record.action_space)
        values.setdefault((record.run, "max_steps", scope), set()).add(record.max_steps)
        if record.env is not None:
            values.setdefault((record.run, "env", record.task), set()).add(record.env)
    for (run, name, _), different in values.items():
        if len(different) > 1:
            raise UserError(
                f"{run} mixes {name} {' and '.join(map(str, sorted(different)))}: evaluate it"
                " with one of them."
            )


def finished(records: Iterable[EpisodeRecord], retry_errors: bool = True) -> set[EpisodeKey]:
    """The episodes of one run that need not be run again; those that ended in an error do by
    default.
    """
    return {record.key for record in records if not (retry_errors and record.outcome == "error")}


def count_outcomes(records: Iterable[EpisodeRecord]) -> Mapping[str, int]:
    """How many episodes ended how, every outcome named."""
    counts = dict.fromkeys(OUTCOMES, 0)
    for record in records:
        counts[record.outcome] += 1
    return counts
