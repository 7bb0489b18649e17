"""`Processor`: what stands between raw data and a network that reads prompts, π0.5's above all."""

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.backbone.building import shape_of
from mme_vla.config.sections import section_keys, without
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import (
    UserError,
    brief,
    check_choice,
    check_integer,
    listed,
    require,
)
from mme_vla.processing.base import (
    CONFIG_FILE,
    STATS_FILE,
    PolicyProcessor,
    PromptSpec,
    Sample,
    collate,
    pad_width,
    read_settings,
)
from mme_vla.processing.images import as_uint8_frames, resize_with_pad, resize_with_pad_uint8
from mme_vla.processing.normalise import NormStats, normalize, unnormalize
from mme_vla.processing.prompt import (
    GOAL_CASES,
    PROMPTS,
    PromptInput,
    checked_text,
    encode_prompt,
    goal_case,
    shorten,
    spelled,
)
from mme_vla.processing.tokenizer import HUB, PALIGEMMA, SAMPLE, Tokenizer
from mme_vla.registry import PROCESSORS
from mme_vla.types import Batch, send
from mme_vla.utils import Sums, checked_file, inside

TOKENIZER_FILE = "tokenizer.model"


@PROCESSORS.register("pi05")
class Processor(PolicyProcessor):
    """Converts raw images, text, states and actions into the network's inputs, and its chunks into
    actions.

    Args:
        image_size: s; side of the square images the vision tower takes, in pixels.
        tokenizer: turns prompts into ids.
        prompt: name of the prompt format (`PROMPTS`).
        prompt_length: longest prompt in tokens, without the options of a robot that chooses.
        subgoal_length: longest subgoal in it, in tokens; None for no limit of its own.
        action_dim: a; width of the network's actions, the robot's own padded with zeros.
        embodiment: the robot: its cameras, in the order the network sees them, its state and its
            actions.
        stats: normalisation statistics; without them everything works but states and actions.
        goal_case: `lower` spells every goal and subgoal as in training; `given` leaves them, as
            those of the benchmark's robots.
    """

    def __init__(
        self,
        image_size: int,
        tokenizer: Tokenizer,
        prompt: str = "plain",
        prompt_length: int = 64,
        action_dim: int = 32,
        embodiment: Embodiment = ROBOMME_JOINT,
        stats: NormStats | None = None,
        subgoal_length: int | None = None,
        goal_case: str = "given",
    ) -> None:
        check_choice("processor.goal_case", goal_case, GOAL_CASES)
        check_integer("processor.image_size", image_size)
        check_integer("processor.prompt_length", prompt_length)
        check_integer("processor.action_dim", action_dim)
        if subgoal_length is not None:
            check_integer("processor.subgoal_length", subgoal_length)
        self.prompt_format = PROMPTS[prompt]()
        self.prompt_name = prompt
        self.tokenizer = tokenizer
        self.image_size = image_size
        self.prompt_length = prompt_length
        self.subgoal_length = subgoal_length
        self.action_dim = action_dim
        self.embodiment = embodiment
        embodiment.check_network(action_dim, embodiment.action.horizon)
        self.stats = stats
        self.goal_case = goal_case

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> Self:
        backbone = shape_of(sections["backbone"])
        sizes = {"image_size": backbone.image_size, "action_dim": backbone.action_dim}
        robot = embodiment_of(sections)
        settings = without(sections["processor"], "name")
        settings["goal_case"] = settings.get("goal_case") or goal_case(robot)
        processor = cls.from_config({**settings, **sizes, "embodiment": robot.to_dict()})
        vocab_size = sections["backbone"].get("vocab_size")
        tokenizer = processor.tokenizer
        if vocab_size is not None and tokenizer.vocab_size > vocab_size:
            raise UserError(
                f"The tokenizer {tokenizer.spec!r} has {tokenizer.vocab_size} entries but"
                f" backbone.vocab_size={vocab_size}: choose the processor that goes with the"
                " backbone."
            )
        return processor

    @property
    def prompt_spec(self) -> PromptSpec:
        return PromptSpec(
            self.tokenizer.spec,
            self.prompt_name,
            self.prompt_format.reads_subgoal,
            self.prompt_format.past_actions,
            self.tokenizer.fingerprint,
        )

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """Resize the current images of all cameras with Pillow, as released.

        Args:
            views: one entry a camera in the order of the embodiment's: [H, W, 3], or [n, H, W, 3]
                for n observations; uint8, or float in [0, 1].

        Returns:
            [v, 3, s, s] uint8, or [n, v, 3, s, s].
        """
        names = self.embodiment.camera_names
        if len(views) != len(names):
            raise UserError(f"Expected {len(names)} views ({', '.join(names)}), got {len(views)}.")
        resized = [resize_with_pad_uint8(as_uint8_frames(view), self.image_size) for view in views]
        if len({view.shape for view in resized}) > 1:
            raise UserError(
                "All views need as many images, got shapes"
                f" {[list(view.shape) for view in resized]}."
            )
        channels_first = np.moveaxis(np.stack(resized, axis=-4), -1, -3)
        return torch.from_numpy(np.ascontiguousarray(channels_first))

    def memory_images(
        self, frames: np.ndarray | Tensor, device: torch.device | str | None = None
    ) -> Tensor:
        """Resize memory frames [n, H, W, 3] uint8 to [n, 3, s, s] float32 in [-1, 1], on `device`
        if one is given.
        """
        if not isinstance(frames, Tensor):
            # A copy where the array is read-only (memory-mapped), which PyTorch cannot share
            # safely.
            frames = torch.from_numpy(np.require(frames, requirements=["C", "W"]))
        if device is not None:
            frames = send(frames, torch.device(device))
        return resize_with_pad(frames, self.image_size)

    def prompt(
        self,
        goal: str,
        subgoal: str | None = None,
        state: np.ndarray | Tensor | None = None,
        past_actions: np.ndarray | Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Tokenise the prompt.

        Args:
            goal: the task in words.
            subgoal: the language subgoal; formats that do not use one ignore it.
            state: [s] raw state; formats that do not use it ignore it.
            past_actions: [n, w] absolute actions executed so far, oldest first; formats that do not
                use them ignore them, the others read the last ones, relative to `state`.

        Returns:
            ids [l] int64 and mask [l] bool.
        """
        normalised = None
        if state is not None and self.prompt_format.reads_state:
            normalised = normalize(_float(state), self.require_stats().state).numpy()
        past = None
        count = self.prompt_format.past_actions
        if count and state is not None and past_actions is not None:
            recent = _float(past_actions)[-count:]
            relative = self.embodiment.action.to_relative(recent, _float(state))
            past = normalize(relative, self.require_stats().actions).numpy()
        goal = spelled(checked_text(goal, "the goal"), self.goal_case)
        if subgoal is not None and self.prompt_format.reads_subgoal:
            subgoal = spelled(checked_text(subgoal, "the subgoal"), self.goal_case)
            subgoal = shorten(subgoal, self.tokenizer, self.subgoal_length)
        inputs = PromptInput(goal, subgoal, normalised, past)
        longest = self.prompt_length + self.embodiment.action.options_length
        return encode_prompt(self.prompt_format, self.tokenizer, inputs, longest)

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """Convert recorded actions into targets of the network.

        Args:
            chunk: [h, w] absolute actions.
            state: [s] raw state at the observation.

        Returns:
            [h, action_dim] float32: relative where the embodiment says so, quantile-normalised,
            padded with zeros.
        """
        stats = self.require_stats()
        chunk = _float(chunk)
        state = _float(state)
        expected = (self.embodiment.action.horizon, len(stats.actions))
        if chunk.shape != expected or state.shape != (len(stats.state),):
            raise UserError(
                f"Expected actions {list(expected)} and a state [{len(stats.state)}], got"
                f" {list(chunk.shape)} and {list(state.shape)}."
            )
        relative = self.embodiment.action.to_relative(chunk, state)
        return pad_width(normalize(relative, stats.actions), self.action_dim)

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """Convert a chunk of the network into actions of the robot: the inverse of `actions`.

        Args:
            chunk: [..., h, action_dim] normalised.
            state: [..., s] raw.

        Returns:
            [..., h, w] float32 on the device of `chunk`.
        """
        stats = self.require_stats()
        relative = unnormalize(chunk.float()[..., : len(stats.actions)], stats.actions)
        return self.embodiment.action.to_absolute(relative, state.to(relative))

    def item(self, sample: Sample) -> dict[str, Any]:
        """Images [v, 3, s, s], prompt ids and mask [l], raw state [s] and normalised actions [h,
        action_dim].
        """
        state = sample.states[-1]
        prompt, prompt_mask = self.prompt(
            sample.goal, sample.subgoal, state=state, past_actions=sample.past_actions
        )
        return {
            "images": self.images([frames[-1] for frames in sample.views.values()]),
            "prompt": prompt,
            "prompt_mask": prompt_mask,
            "state": torch.from_numpy(state),
            "actions": self.actions(sample.actions, state),
        }

    def collate(self, items: Sequence[dict[str, Any]]) -> Batch:
        return collate(items)

    def to_config(self) -> dict[str, Any]:
        tokenizer = TOKENIZER_FILE
        if self.tokenizer.spec.startswith(HUB):
            tokenizer = self.tokenizer.spec
        config = {
            "image_size": self.image_size,
            "tokenizer": tokenizer,
            "tokenizer_fingerprint": self.tokenizer.fingerprint,
            "prompt": self.prompt_name,
            "prompt_length": self.prompt_length,
            "subgoal_length": self.subgoal_length,
            "action_dim": self.action_dim,
            "embodiment": self.embodiment.to_dict(),
            "stats": None if self.stats is None else STATS_FILE,
        }
        if self.goal_case != "given":
            config["goal_case"] = self.goal_case
        return config

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Build a processor.

        Args:
            config: the constructor's arguments by name, some in words: `tokenizer` as
                `Tokenizer.load` takes it, `stats` as the path of a `norm_stats.json` or None,
                `embodiment` as `Embodiment.to_dict` writes it. `tokenizer_fingerprint`, if given,
                is checked.
        """
        known = {*inspect.signature(cls).parameters, "tokenizer_fingerprint"}
        settings = section_keys(config, "processor", known)
        for key in ("image_size", "tokenizer", "embodiment"):
            require(
                key in settings,
                f"The processor's settings lack {key!r}; they hold {listed(sorted(settings))}.",
            )
        PROMPTS[str(settings.get("prompt", "plain"))]  # checks the name before any file is read
        settings["embodiment"] = Embodiment.from_dict(settings["embodiment"])
        fingerprint = settings.pop("tokenizer_fingerprint", None)
        tokenizer = Tokenizer.load(settings["tokenizer"])
        if fingerprint is not None and tokenizer.fingerprint != fingerprint:
            raise UserError(
                f"The tokenizer {tokenizer.spec!r} has fingerprint {tokenizer.fingerprint}, but"
                f" {brief(fingerprint)} was used in training: its ids would mean other words. Give"
                " the file that was used."
            )
        settings["tokenizer"] = tokenizer
        stats = settings.pop("stats", None)
        if stats is not None:
            settings["stats"] = NormStats.load(stats)
        return cls(**settings)

    def save(self, folder: Path | str) -> list[str]:
        """Write `processor.json`, the statistics, and the tokenizer unless it is on the hub; the
        names of the files.
        """
        saved = super().save(folder)
        if self.to_config()["tokenizer"] == TOKENIZER_FILE:
            self.tokenizer.save(Path(folder) / TOKENIZER_FILE)
            saved.append(TOKENIZER_FILE)
        return saved

    @classmethod
    def load(cls, folder: Path | str, tokenizer: Path | str | None = None) -> Self:
        """Read what `save` wrote. Nothing outside of the folder is read for it, and of the hub only
        π0.5's tokenizer.

        Args:
            folder: of a checkpoint, which may be untrusted.
            tokenizer: in place of the one that `processor.json` names, as `Tokenizer.load` takes
                it.
        """
        folder = Path(folder)
        config = read_settings(folder)
        # Its files are in the folder, and have their checksums.
        named = config.get("tokenizer", "")
        if tokenizer is None and named in (SAMPLE, PALIGEMMA):
            tokenizer = str(named)
        elif tokenizer is None and isinstance(named, str) and named.startswith(HUB):
            if not (folder / TOKENIZER_FILE).is_file():
                raise UserError(
                    f"{folder} takes its tokenizer from the network, at {brief(named, 200)}, which"
                    " is not fetched on a checkpoint's word. If you trust it: from_pretrained(…,"
                    f" tokenizer={brief(named, 200)}), or download that file into the folder as"
                    f" {TOKENIZER_FILE}."
                )
            # it may be added later: its fingerprint is in processor.json
            Sums(folder).check(TOKENIZER_FILE)
            tokenizer = inside(folder, TOKENIZER_FILE, "tokenizer")
        elif tokenizer is None:
            tokenizer = checked_file(folder, named, "tokenizer")
        stats = config.get("stats")
        if stats is not None:
            stats = checked_file(folder, stats, "statistics")
        try:
            return cls.from_config({**config, "tokenizer": tokenizer, "stats": stats})
        except UserError as error:
            raise UserError(f"{folder / CONFIG_FILE}: {error}") from None


def _float(x: np.ndarray | Tensor) -> Tensor:
    return torch.as_tensor(x, dtype=torch.float32)
