"""What stands between raw data and SimpleMemVLA: a time-stamped video, a prompt with its response,
mean and deviation.

Shapes: b batch · L tokens · P temporal patches of a sample · K of a batch · c cameras without a
past.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.config.sections import Positive, PositiveInt, Range, read_section, without
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief, check_choice
from mme_vla.extras.methods.simplememvla.config import SimpleMemVlaSizes
from mme_vla.extras.methods.simplememvla.model import WordIds
from mme_vla.extras.methods.simplememvla.prompt import (
    BYTES,
    QWEN,
    CameraTokens,
    Robot,
    Tokens,
    WordTokenizer,
    clean_response,
    encode,
    instruction,
)
from mme_vla.extras.methods.simplememvla.video import (
    TEMPORAL,
    Window,
    channels_first,
    fitting_size,
    resized,
)
from mme_vla.memory.base import stack_history
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.base import (
    CONFIG_FILE,
    STATS_FILE,
    PolicyProcessor,
    PromptSpec,
    Sample,
    SampleSpec,
    StatsSpec,
    read_settings,
)
from mme_vla.processing.images import as_uint8_frames
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.processing.prompt import GOAL_CASES, goal_case, spelled
from mme_vla.registry import PROCESSORS
from mme_vla.types import HistoryTokens, TensorStruct
from mme_vla.utils import checked_file

NAME = "simplememvla"
TOKENIZER_FILE = "tokenizer.json"
LEAST_DEVIATION = 0.01
"""Deviations below are raised to it: a number that hardly moved in the data is not blown up."""


@dataclass(frozen=True)
class PromptSettings:
    """Keys of the section `processor`, explained in `configs/processor/simplememvla.yaml`."""

    tokenizer: str = QWEN
    robot: str = "Panda single-arm robot"
    control_hz: Positive = 20
    video: bool = True
    seconds: Positive = 60
    fps: Positive = 2
    native_fps: Positive = 20
    variable: bool = True
    side: PositiveInt | None = None
    video_pixels: tuple[PositiveInt, PositiveInt] = (4096, 25_165_824)
    image_pixels: tuple[PositiveInt, PositiveInt] = (65_536, 16_777_216)
    max_words: Annotated[int, Range(1, 1024)] = 64
    max_tokens: PositiveInt = 8192
    goal_case: str | None = None


def processor_settings(config: Mapping[str, Any]) -> PromptSettings:
    """The section `processor` of a policy's configuration."""
    section = PolicySections.of(config).processor
    return read_section(PromptSettings, without(section, "name"), "processor")


@dataclass
class VideoBatch(TensorStruct):
    """Prompts with the images that are in them.

    ids: [b, L] padded on the right.
    kinds: [b, L] int8 (`prompt.TEXT`, …).
    positions: [b, 3, L].
    prompts, lengths: tokens of each row's prompt, and with its response.
    patches: temporal patches of each row.
    video: [K, 2, 3, H, W] uint8, the temporal patches of all rows one after the other; None where
        `features` are given.
    features: [K, m, D], their tokens.
    images: [b, c, 3, H, W] uint8, of the cameras without a past.
    state: [b, s] normalised.
    actions: [b, h, a] normalised.
    action_mask: [b, h] bool.
    history: of a memory.
    words: ids that each row takes instead of generated ones, up to `<|im_end|>`; None to generate
        them.
    """

    ids: Tensor
    kinds: Tensor
    positions: Tensor
    prompts: tuple[int, ...]
    lengths: tuple[int, ...]
    patches: tuple[int, ...]
    state: Tensor
    images: Tensor
    video: Tensor | None = None
    features: Tensor | None = None
    actions: Tensor | None = None
    action_mask: Tensor | None = None
    history: HistoryTokens | None = None
    words: tuple[tuple[int, ...], ...] | None = None

    @property
    def spans(self) -> list[tuple[int, int]]:
        """First token of each response, and the one behind its last."""
        return list(zip(self.prompts, self.lengths, strict=True))

    def rows(self, index: Tensor | slice) -> Self:
        """Rows of the batch, with the temporal patches that belong to them."""
        selected = index if isinstance(index, slice) else index.cpu().numpy()
        indices = np.arange(len(self.ids))[selected].tolist()
        starts = np.cumsum([0, *self.patches])
        patches = [np.arange(starts[i], starts[i + 1]) for i in indices]
        places = torch.from_numpy(np.concatenate([np.zeros(0, np.int64), *patches]))
        changed: dict[str, Any] = {}
        for name in ("video", "features"):  # rows are temporal patches
            values = getattr(self, name)
            if values is not None:
                changed[name] = values[places.to(values.device)]
        for name in ("prompts", "lengths", "patches", "words"):
            values = getattr(self, name)
            if values is not None:
                changed[name] = tuple(values[i] for i in indices)
        bare = replace(self, video=None, features=None)
        return replace(bare._map(lambda x: x[index]), **changed)


@PROCESSORS.register(NAME)
class SimpleMemVlaProcessor(PolicyProcessor):
    """Shows the past of the memory camera as a video, and the current image of every other camera.

    Args:
        sizes: pixels of a side that become a merged token (`factor`), and tokens of a memory in the
            video's place.
    """

    stats_spec = StatsSpec(horizon=1, every=True, exact=True, video=True)

    def __init__(
        self,
        settings: PromptSettings,
        embodiment: Embodiment,
        factor: int,
        memory_tokens: int = 0,
        image_side: int = 256,
        tokenizer: WordTokenizer | None = None,
        stats: NormStats | None = None,
    ) -> None:
        """Put the parts together.

        Args:
            factor: pixels of a side that become one token.
            memory_tokens: of a memory that takes the video's place.
            image_side: of the images that a memory stores.
            tokenizer: in place of the one that the settings name.
        """
        self.settings, self.embodiment = settings, embodiment
        self.factor, self.memory_tokens, self.image_side = factor, memory_tokens, image_side
        if settings.goal_case is not None:
            check_choice("processor.goal_case", settings.goal_case, GOAL_CASES)
        if settings.side is not None and settings.side % factor:
            raise UserError(
                f"processor.side={settings.side} must be a multiple of {factor} pixels."
            )
        if settings.seconds * settings.fps > 4096:
            raise UserError(
                f"processor.seconds={settings.seconds:g} at fps={settings.fps:g}: at most 4096"
                " frames."
            )
        if embodiment.fps is not None and embodiment.fps != settings.native_fps:
            raise UserError(
                f"processor.native_fps={settings.native_fps:g}: the robot {embodiment.name!r} has"
                f" {embodiment.fps:g} frames per second, so the video would be shown at another"
                " speed than its timestamps say. Set it to embodiment.fps."
            )
        self.window = Window(settings.seconds, settings.fps, settings.native_fps, settings.variable)
        self.tokenizer = tokenizer or WordTokenizer.load(settings.tokenizer)
        self.word_ids = WordIds(self.tokenizer.id("<|im_end|>"), self.tokenizer.encode("\n")[0])
        self.samples = SampleSpec(history=self.frames)
        self.stats = stats

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> Self:
        sizes = SimpleMemVlaSizes.from_dict(sections["backbone"])
        settings = processor_settings(sections)
        robot = embodiment_of(sections)
        settings = replace(settings, goal_case=settings.goal_case or goal_case(robot))
        memory = (sections.get("memory") or {}).get("budget", 0)
        built = cls(settings, robot, sizes.factor, memory, sizes.image_size)
        rows = sizes.qwen.text_config.vocab_size
        if built.tokenizer.vocab_size > rows:
            raise UserError(
                f"The tokenizer {built.tokenizer.spec!r} has {built.tokenizer.vocab_size} entries"
                f" but backbone.vlm.text_config.vocab_size={rows}: choose the processor that goes"
                " with the backbone."
            )
        return built

    # Frames

    @property
    def shows_video(self) -> bool:
        """Whether prompts have a video of the past; else a memory may be in its place."""
        return self.settings.video and not self.memory_tokens

    def frames(self, step: int) -> np.ndarray:
        """Frames of the memory camera that are shown at a step, an even number, the current one
        last: int64 [n].
        """
        return self.window.frames(step) if self.shows_video else np.full(TEMPORAL, step)

    def video(self, frames: Tensor) -> Tensor:
        """Frames [n, 3, H, W] uint8 as temporal patches [n/2, 2, 3, h, w]."""
        return resized(
            frames, self._size(frames, len(frames), self.settings.video_pixels)
        ).unflatten(0, (-1, TEMPORAL))

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """Current images of all cameras, [H, W, 3] or [n, H, W, 3] each, as [v, 3, h, w] or [n, v,
        3, h, w] uint8.
        """
        tensors = [channels_first(as_uint8_frames(view)) for view in views]
        bounds = self.settings.image_pixels
        return torch.stack([resized(view, self._size(view, 1, bounds)) for view in tensors], -4)

    def memory_images(
        self, frames: np.ndarray | Tensor, device: torch.device | str | None = None
    ) -> Tensor:
        """Frames [n, H, W, 3] uint8 that a memory stores, as [n, 3, s, s] uint8."""
        images = channels_first(np.asarray(frames)).to(device)
        return resized(images, (self.image_side, self.image_side))

    def _size(self, frames: Tensor, count: int, bounds: tuple[int, int]) -> tuple[int, int]:
        if (side := self.settings.side) is not None:
            return side, side
        height, width = frames.shape[-2:]
        return fitting_size(height, width, count, self.factor, bounds)

    # Prompts

    @property
    def prompt_spec(self) -> PromptSpec:
        return PromptSpec(
            self.tokenizer.spec, "simplememvla", fingerprint=self.tokenizer.fingerprint
        )

    def prompt(
        self,
        goal: str,
        subgoal: str | None = None,
        state: np.ndarray | Tensor | None = None,
        past_actions: np.ndarray | Tensor | None = None,
    ) -> str:
        """The request that a prompt ends with; its tokens depend on what is shown (`tokens`)."""
        settings = self.settings
        robot = Robot(settings.robot, settings.control_hz, self.embodiment.action.horizon)
        goal = spelled(goal, settings.goal_case or "given")  # not written by earlier versions
        return instruction(goal, robot, 1, len(self.embodiment.cameras) - 1)

    def tokens(
        self,
        request: str,
        patches: int,
        size: tuple[int, int],
        image_size: tuple[int, int],
        response: str | None = None,
    ) -> Tokens:
        """A prompt that shows so many temporal patches.

        Args:
            request: of `prompt`.
            size, image_size: (h, w) of the video's frames and of current images.
            response: the sub-task that is learned.
        """
        cameras = []
        for name in self.embodiment.camera_names:
            if name == self.embodiment.memory_camera:
                times = self.window.times(TEMPORAL * patches)
                cameras.append(CameraTokens(name, self._grid(size), times, self.memory_tokens))
            else:
                cameras.append(CameraTokens(name, self._grid(image_size)))
        return encode(self.tokenizer, cameras, request, response)

    def _grid(self, size: tuple[int, int]) -> tuple[int, int]:
        return size[0] // self.factor, size[1] // self.factor

    # States and actions

    def states(self, states: Tensor) -> Tensor:
        """Raw states [..., s] as the network reads them."""
        return _standardise(states, self.require_stats().state)

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        raw = torch.as_tensor(chunk, dtype=torch.float32)
        at = torch.as_tensor(state, dtype=torch.float32)
        relative = self.embodiment.action.to_relative(raw, at)
        return _standardise(relative, self.require_stats().actions)

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        mean, deviation = _moments(self.require_stats().actions, chunk.float())
        raw = chunk.float() * deviation + mean
        return self.embodiment.action.to_absolute(raw, state.to(raw))

    # Batches

    def item(self, sample: Sample) -> dict[str, Any]:
        """One step: its prompt with the sub-task as the response, images, state and chunk."""
        if sample.subgoal is None:
            raise UserError(
                "SimpleMemVLA learns to generate the current sub-task: set subgoal_text.kind to"
                " simple_subgoal or grounded_subgoal."
            )
        robot = self.embodiment
        state = torch.from_numpy(sample.states[-1])
        video = self.video(channels_first(sample.views[robot.memory_camera]))
        views = []
        for name in robot.camera_names:
            if name != robot.memory_camera:
                views.append(sample.views[name][-1])
        images = torch.zeros(0, *video.shape[2:], dtype=torch.uint8)
        if views:
            images = self.images(views)
        response = clean_response(sample.subgoal)
        tokens = self.tokens(
            self.prompt(sample.goal), len(video), _side(video), _side(images), response
        )
        if len(tokens.ids) > self.settings.max_tokens:
            raise UserError(
                f"A sample has {len(tokens.ids):,} tokens, more than"
                f" processor.max_tokens={self.settings.max_tokens:,}: raise it, or show a shorter"
                " video (processor.seconds, processor.fps)."
            )
        return {
            "tokens": tokens,
            "video": video,
            "images": images,
            "state": self.states(state),
            "actions": self.actions(sample.actions, state),
        }

    def collate(self, items: Sequence[dict[str, Any]]) -> VideoBatch:
        columns = {name: [item[name] for item in items] for name in items[0]}
        states = torch.stack(columns["state"])
        batch = self.batch(columns["tokens"], columns["images"], states)
        patches = tuple(len(video) for video in columns["video"])
        batch = replace(batch, video=_joined(columns["video"]), patches=patches)
        if "actions" in columns:
            batch = replace(batch, actions=torch.stack(columns["actions"]))
        if "action_mask" in columns:
            batch = replace(batch, action_mask=torch.stack(columns["action_mask"]))
        if "history" in columns:
            batch = replace(batch, history=stack_history(columns["history"]))
        return batch

    def batch(
        self, tokens: Sequence[Tokens], images: Sequence[Tensor], states: Tensor
    ) -> VideoBatch:
        """Prompts, current images and states as a batch, without video."""
        longest = max(len(one.ids) for one in tokens)

        def padded(name: str) -> Tensor:
            rows = []
            for one in tokens:
                row = torch.from_numpy(np.ascontiguousarray(getattr(one, name)))
                rows.append(functional.pad(row, (0, longest - row.shape[-1])))
            return torch.stack(rows)

        return VideoBatch(
            ids=padded("ids"),
            kinds=padded("kinds"),
            positions=padded("positions"),
            prompts=tuple(one.prompt for one in tokens),
            lengths=tuple(len(one.ids) for one in tokens),
            patches=(0,) * len(tokens),
            state=states,
            images=_joined([image[None] for image in images]),
        )

    # Folders

    def to_config(self) -> dict[str, Any]:
        settings = dict(vars(self.settings))
        for name, value in settings.items():
            if isinstance(value, tuple):
                settings[name] = list(value)  # as YAML and JSON have it
        shipped = self.tokenizer.spec == BYTES
        return {
            "name": NAME,
            **settings,
            "tokenizer": BYTES if shipped else TOKENIZER_FILE,
            "tokenizer_fingerprint": self.tokenizer.fingerprint,
            "factor": self.factor,
            "memory_tokens": self.memory_tokens,
            "image_side": self.image_side,
            "embodiment": self.embodiment.to_dict(),
            "stats": None if self.stats is None else STATS_FILE,
        }

    def save(self, folder: Path | str) -> list[str]:
        saved = super().save(folder)
        if self.tokenizer.spec == BYTES:
            return saved
        (Path(folder) / TOKENIZER_FILE).write_text(self.tokenizer.content, encoding="utf-8")
        return [*saved, TOKENIZER_FILE]

    @classmethod
    def load(cls, folder: Path | str, tokenizer: Path | str | None = None) -> Self:
        folder = Path(folder)
        values = read_settings(folder)
        if values.pop("name", None) != NAME:
            raise UserError(f"{folder} holds a processor of another kind of policy.")
        try:
            sizes = {key: values.pop(key) for key in ("factor", "memory_tokens", "image_side")}
            robot = Embodiment.from_dict(values.pop("embodiment"))
            stats = values.pop("stats")
            fingerprint = values.pop("tokenizer_fingerprint")
        except KeyError as error:
            raise UserError(
                f"{folder / CONFIG_FILE} lacks {error}: it is damaged, or of another version."
            ) from None
        if (
            any(isinstance(value, bool) or not isinstance(value, int) for value in sizes.values())
            or sizes["factor"] < 1
        ):
            raise UserError(
                f"{folder / CONFIG_FILE}: factor, memory_tokens and image_side must be whole"
                " numbers."
            )
        if tokenizer is None:
            named = values.get("tokenizer", "")
            tokenizer = BYTES if named == BYTES else checked_file(folder, named, "tokenizer")
        words = WordTokenizer.load(tokenizer)
        if words.fingerprint != fingerprint:
            raise UserError(
                f"The tokenizer {words.spec!r} has fingerprint {words.fingerprint}, but"
                f" {brief(fingerprint)} was used in training: its ids would mean other words. Give"
                " the file that was used."
            )
        settings = read_section(PromptSettings, values, f"{folder / CONFIG_FILE}: processor")
        built = None if stats is None else NormStats.load(checked_file(folder, stats, "statistics"))
        return cls(settings, robot, **sizes, tokenizer=words, stats=built)


def _side(images: Tensor) -> tuple[int, int]:
    return images.shape[-2], images.shape[-1]


def _joined(parts: Sequence[Tensor]) -> Tensor:
    sizes = {_side(part) for part in parts}
    if len(sizes) > 1:
        raise UserError(
            f"The images of one batch have the sizes {sorted(sizes)}: videos of different lengths"
            " were shrunk differently. Set processor.side."
        )
    return torch.cat(list(parts))


def _moments(stats: QuantileStats, like: Tensor) -> tuple[Tensor, Tensor]:
    return like.new_tensor(stats.mean), like.new_tensor(stats.std).clamp(min=LEAST_DEVIATION)


def _standardise(x: Tensor, stats: QuantileStats) -> Tensor:
    mean, deviation = _moments(stats, x)
    return (x - mean) / deviation
