"""The self-check of a checkpoint: a synthetic observation history, its noise, and the actions that
the policy answered where it was trained. Whoever loads the weights compares.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from mme_vla.config.sections import read_section
from mme_vla.embodiment import Embodiment, Option
from mme_vla.errors import UserError, listed, require
from mme_vla.policy.tensor_files import check_header, check_values, read_safetensors
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.utils import Sums, checked_file, parse_json

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy

FILE = "self_check.safetensors"
FORMAT: Literal["mme_vla self-check 1"] = "mme_vla self-check 1"
MOST_BYTES = 2_000_000
"""Of the file."""
MOST_DIFFERENCE = 0.01
"""Largest difference of any number of the chunk where both were computed in float32, in half ranges
of the training data's actions.
"""
MEAN_DIFFERENCE = 0.05
"""Largest mean difference over the chunk where one was computed in bfloat16: rounding may move one
discrete choice, such as a point, far.
"""
NONE = "self-check: none (the checkpoint is from before there were any, or left it out)"
_GOAL = "put the red cube on the target"
_OPTIONS = ("pick up the cube", "press the button")
_SEED = 56
_FRAMES = 17
_SIZE = 64
_ABOUT, _CHUNK, _STATES, _DEMO, _ACTIONS = "about", "chunk", "states", "is_demo", "actions"
_VIEW, _NOISE = "view/", "noise/"
_NUMBERS = tuple((kind, n) for kind in (torch.float32, torch.int64, torch.bool) for n in range(9))
_KINDS = {
    _CHUNK: ((torch.float32, 2),),
    _STATES: ((torch.float32, 2),),
    _DEMO: ((torch.bool, 1),),
    _ACTIONS: ((torch.float32, 2),),
    "view": ((torch.uint8, 4), (torch.int16, 4), (torch.float32, 3)),
    "noise": _NUMBERS,
}
"""Dtypes and numbers of axes of the tensors, by the first part of their names."""


@dataclass(frozen=True)
class _About:
    """What the file says in words, in the header of its tensors."""

    format: Literal["mme_vla self-check 1"]
    goal: str
    options: tuple[str, ...]
    precision: Literal["float32", "bfloat16"]
    device: str


@dataclass(frozen=True)
class SelfCheck:
    """A history, what the policy drew for it, and what it answered.

    views: by the name of a camera, or of what it reads beside its images, [t, …]. states: [t, s].
    is_demo: [t]. actions: [t, w], those that led to the frames. noise: of `Policy.sampling_noise`.
    chunk: [h, w] float32, as the robot takes it. options: of policies that choose. precision: that
    the policy computed in.
    """

    views: Mapping[str, np.ndarray]
    states: np.ndarray
    is_demo: np.ndarray
    actions: np.ndarray
    noise: Mapping[str, Tensor]
    chunk: np.ndarray
    goal: str
    options: tuple[str, ...]
    precision: str
    device: str

    def write(self, folder: Path) -> str:
        """Write the file into a checkpoint and return its name."""
        (folder / FILE).write_bytes(self._content())
        return FILE

    def _content(self) -> bytes:
        from safetensors.torch import save

        tensors = {
            _CHUNK: torch.from_numpy(self.chunk),
            _STATES: torch.from_numpy(self.states),
            _DEMO: torch.from_numpy(self.is_demo),
            _ACTIONS: torch.from_numpy(self.actions),
        }
        for name, view in self.views.items():
            tensors[_VIEW + name] = torch.from_numpy(view)
        for name, noise in self.noise.items():
            tensors[_NOISE + name] = noise.contiguous()
        about = _About(
            FORMAT, self.goal, self.options, _precision_name(self.precision), self.device
        )
        # One text: the order of several is not defined.
        return save(tensors, {_ABOUT: json.dumps(asdict(about), sort_keys=True)})


@dataclass(frozen=True)
class Comparison:
    """How far a loaded policy's chunk is from the stored one.

    kind: `largest` or `mean`. difference: that of the chunk's numbers, in half ranges of the
    training data's actions. tolerance: what is allowed of it.
    recorded, now: where the two were computed, in words.
    """

    kind: str
    difference: float
    tolerance: float
    recorded: str
    now: str

    @property
    def passed(self) -> bool:
        return self.difference <= self.tolerance  # NaN fails

    @property
    def line(self) -> str:
        """The result in one line."""
        numbers = (
            f"{self.kind} difference of the chunk {self.difference:.2g} of the actions' half range,"
            f" at most {self.tolerance:g} is allowed (recorded: {self.recorded}; here: {self.now})"
        )
        if self.passed:
            return f"self-check: passed, {numbers}"
        return (
            f"self-check: FAILED, {numbers}. The weights, statistics or code are not those that the"
            " check was recorded with: fetch the checkpoint again, or use its author's versions."
        )


@torch.compiler.set_stance("force_eager")  # one chunk is not worth compiling for
@torch.no_grad()
def record_self_check(policy: "Policy") -> SelfCheck:
    """Show a policy a synthetic history and keep it with the answer.

    The images are drawn, and states and actions computed from the statistics that the checkpoint
    holds in any case: nothing of the training data is in it. No generator of the caller changes.

    Raises:
        UserError: the policy lacks statistics, or the file would be too large.
    """
    robot = policy.embodiment
    stats = policy.require_processor().require_stats()
    views = _synthetic_views(robot)
    count = len(next(iter(views.values())))
    is_demo = np.zeros(count, bool)
    if robot.conditioning_video:
        is_demo[: count // 2] = True
    states = _wander(stats.state, count)
    noise = policy.sampling_noise(torch.Generator().manual_seed(_SEED))
    blank = SelfCheck(
        views=views,
        states=states,
        is_demo=is_demo,
        actions=_synthetic_actions(robot, stats, states),
        noise=noise,
        chunk=np.zeros((0, robot.action.width), np.float32),
        goal=_GOAL,
        options=_OPTIONS if robot.action.choice else (),
        precision=_precision_of(policy),
        device=policy.device.type,
    )
    answered = SelfCheck(**{**vars(blank), "chunk": _answer(policy, blank)})
    size = len(answered._content())
    require(
        size <= MOST_BYTES,
        f"A self-check of this policy would take {size / 1e6:.1f} MB, more than"
        f" {MOST_BYTES / 1e6:g}: set train.self_check=false.",
    )
    return answered


def read_self_check(folder: Path) -> SelfCheck | None:
    """Read the self-check of a checkpoint, which may be untrusted; None if it has none.

    Raises:
        UserError: the file is damaged, too large, or was removed from a checkpoint that lists it.
    """
    if not (folder / FILE).exists():
        require(
            FILE not in Sums(folder).table,
            f"{folder} lacks {FILE}, which its checksums list: fetch the checkpoint again.",
        )
        return None
    path = checked_file(folder, FILE)
    check_header(path)
    size = path.stat().st_size
    require(
        size <= MOST_BYTES,
        f"{path} has {size:,} bytes, more than the {MOST_BYTES:,} of a self-check: it is none.",
    )
    tensors = read_safetensors(path)
    check_values(tensors, str(path))
    about = _read_about(path)
    missing = [name for name in (_CHUNK, _STATES, _DEMO, _ACTIONS) if name not in tensors]
    require(not missing, f"{path} is no self-check: it lacks {listed(missing)}.")
    for name, tensor in tensors.items():
        kinds = _KINDS.get(name.split("/")[0], ())
        require(
            (tensor.dtype, tensor.ndim) in kinds and tensor.numel(),
            f"{path} is no self-check: {name!r} is {tensor.dtype} {list(tensor.shape)}.",
        )
    count = len(tensors[_STATES])
    require(
        count <= _FRAMES, f"{path} has {count:,} frames, more than the {_FRAMES} of a self-check."
    )
    views: dict[str, np.ndarray] = {}
    noise: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        if name.startswith(_VIEW):
            views[name.removeprefix(_VIEW)] = tensor.numpy()
        elif name.startswith(_NOISE):
            noise[name.removeprefix(_NOISE)] = tensor
    return SelfCheck(
        views=views,
        states=tensors[_STATES].numpy(),
        is_demo=tensors[_DEMO].numpy(),
        actions=tensors[_ACTIONS].numpy(),
        noise=noise,
        chunk=tensors[_CHUNK].numpy(),
        goal=about.goal,
        options=about.options,
        precision=about.precision,
        device=about.device,
    )


@torch.compiler.set_stance("force_eager")
@torch.no_grad()
def compare(policy: "Policy", folder: Path) -> Comparison | None:
    """Compare a loaded policy with the self-check of its checkpoint; None if it has none.

    Raises:
        UserError: the file is damaged, or does not fit the policy.
    """
    stored = read_self_check(folder)
    if stored is None:
        return None
    robot = policy.embodiment
    names = {*robot.camera_names, *robot.readings}
    require(
        stored.views.keys() == names and len(stored.options) <= len(robot.action.choice),
        f"{folder / FILE} does not fit this policy: it holds other cameras or options.",
    )
    drawn = policy.sampling_noise(torch.Generator().manual_seed(_SEED))
    fits = drawn.keys() == stored.noise.keys()
    for name in drawn.keys() & stored.noise.keys():
        same_shape = drawn[name].shape == stored.noise[name].shape
        if not same_shape or drawn[name].dtype != stored.noise[name].dtype:
            fits = False
    require(fits, f"{folder / FILE} does not fit this policy: its noise has other names or sizes.")
    try:
        chunk = _answer(policy, stored)
    except UserError as error:
        raise UserError(f"{folder / FILE} does not fit this policy: {error}") from error
    require(
        chunk.shape == stored.chunk.shape,
        f"{folder / FILE} does not fit this policy: its chunk is {list(stored.chunk.shape)}, the"
        f" policy's {list(chunk.shape)}.",
    )
    stats = policy.require_processor().require_stats()
    half_range = (stats.actions.q99 - stats.actions.q01) / 2
    scale = np.where(half_range > 0, half_range, 1)
    precision = _precision_of(policy)
    differences = np.abs(chunk - stored.chunk) / scale
    kind, difference, tolerance = "largest", differences.max(), MOST_DIFFERENCE
    if "bfloat16" in (precision, stored.precision):
        kind, difference, tolerance = "mean", differences.mean(), MEAN_DIFFERENCE
    return Comparison(
        kind=kind,
        difference=float(difference),
        tolerance=tolerance,
        recorded=f"{stored.precision}, {stored.device}",
        now=f"{precision}, {policy.device.type}",
    )


def _answer(policy: "Policy", check: SelfCheck) -> np.ndarray:
    """The chunk [h, w] for the stored history and noise."""
    was_training = policy.training
    policy.eval()
    devices = [policy.device] if policy.device.type == "cuda" else []
    try:
        with torch.random.fork_rng(devices=devices):
            torch.manual_seed(_SEED)  # of whatever draws beside the noise
            episode = policy.start_episode(check.goal, _SEED)
            if policy.require_processor().prompt_spec.reads_subgoal:
                episode.subgoal = check.goal
            episode.options = tuple(
                Option(chr(ord("a") + number), text, needs_point=True)
                for number, text in enumerate(check.options)
            )
            actions = None
            if policy.embodiment.action.frames is not None:
                actions = check.actions
            episode.observe(check.views, check.states, check.is_demo, actions)
            episode.noise = check.noise
            return np.asarray(policy.act(episode), np.float32)
    finally:
        policy.train(was_training)


def _read_about(path: Path) -> _About:
    from safetensors import safe_open

    with safe_open(path, "pt") as opened:
        text = (opened.metadata() or {}).get(_ABOUT)
    require(text is not None, f"{path} is no self-check: it has no description.")
    assert text is not None
    return read_section(_About, parse_json(text, f"The description of {path}"), str(path))


def _precision_of(policy: "Policy") -> str:
    stored = {p.dtype for p in policy.parameters()}
    coarse = policy.compute_dtype == torch.bfloat16 or torch.bfloat16 in stored
    return "bfloat16" if coarse else "float32"


def _precision_name(text: str) -> Literal["float32", "bfloat16"]:
    return "bfloat16" if text == "bfloat16" else "float32"


def _synthetic_views(robot: Embodiment) -> dict[str, np.ndarray]:
    """Of every camera a shaded ground with a square that moves, and flat depth where it is read."""
    readings = len(robot.readings) // 2
    pixels = _SIZE * _SIZE * (3 * len(robot.cameras) + 2 * readings)
    count = int(np.clip(MOST_BYTES * 3 // 4 // pixels, 1, _FRAMES))
    views: dict[str, np.ndarray] = {}
    for number, camera in enumerate(robot.cameras):
        rows, columns = np.mgrid[:_SIZE, :_SIZE]
        ground = np.stack([2 * rows + 40, 2 * columns + 60, rows + columns + 20 * number], -1)
        images = np.repeat(ground[None] % 256, count, 0).astype(np.uint8)
        for t in range(count):
            left = (3 * t + 5 * number) % (_SIZE - 16)
            images[t, 24:40, left : left + 16] = (220, 30, 40)
        views[camera.name] = images
        if camera.depth:
            depth_name, pose_name = camera.readings
            depth = (800 + 4 * rows)[None, :, :, None].repeat(count, 0)
            pose = np.eye(3, 4, dtype=np.float32)
            pose[2, 3] = 1  # a metre before the camera
            views[depth_name] = depth.astype(np.int16)
            views[pose_name] = pose[None].repeat(count, 0)
    return views


def _wander(stats: QuantileStats, count: int) -> np.ndarray:
    """Rows [count, d] float32 around the mean, within the quantiles."""
    turn = np.arange(count)[:, None] / 4 + np.arange(len(stats))
    rows = stats.mean + 0.2 * (stats.q99 - stats.q01) * np.sin(turn)
    clipped: np.ndarray = np.clip(rows, stats.q01, stats.q99).astype(np.float32)
    return clipped


def _synthetic_actions(robot: Embodiment, stats: NormStats, states: np.ndarray) -> np.ndarray:
    """Absolute actions [t, w] that could have led to the states."""
    rows = torch.from_numpy(_wander(stats.actions, len(states)))
    absolute = [
        robot.action.to_absolute(row[None], torch.from_numpy(state))[0]
        for row, state in zip(rows, states, strict=True)
    ]
    return torch.stack(absolute).float().numpy()
