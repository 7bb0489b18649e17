"""The self-check of a checkpoint: a synthetic observation history, its noise, and the chunk that
the policy predicted where it was trained. A user who loads the weights compares.
"""

import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from mme_vla.config.sections import read_section
from mme_vla.embodiment import Embodiment, Option
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.policy.episode import executable_actions
from mme_vla.policy.tensor_files import check_header, check_values, read_safetensors
from mme_vla.processing.normalise import QuantileStats
from mme_vla.types import stack_noise
from mme_vla.utils import Sums, checked_file, parse_json

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy

FILE = "self_check.safetensors"
FORMAT: Literal["mme_vla self-check 1"] = "mme_vla self-check 1"
MOST_BYTES = 2_000_000
"""Of the file."""
FLOAT32_TOLERANCE = 1e-3
"""Of `relative_difference` where both chunks were computed in float32 (docs/evidence/self-check.md
has the figures).
"""
BFLOAT16_TOLERANCE = 0.02
"""The same where one was computed in bfloat16."""
ACTIONS_TOLERANCE = 1e-4
"""Of the robot's actions that the stored chunk becomes: arithmetic of statistics in float32."""
NO_CHECK = "self-check: none (the checkpoint is from before there were any, or left it out)"
_GOAL = "put the red cube on the target"
_OPTIONS = ("pick up the cube", "press the button")
_SEED = 56
_FRAMES = 17
_SIZE = 64
_ABOUT, _CHUNK, _ACTIONS = "about", "chunk", "actions"
_STATES, _DEMO, _PAST_ACTIONS = "states", "is_demo", "past_actions"
_REQUIRED = (_CHUNK, _ACTIONS, _STATES, _DEMO, _PAST_ACTIONS)
_VIEW, _NOISE = "view/", "noise/"
_ROWS = ((torch.float32, 2),)
_KINDS: dict[str, tuple[tuple[torch.dtype, int], ...]] = {
    _CHUNK: _ROWS,
    _ACTIONS: _ROWS,
    _STATES: _ROWS,
    _DEMO: ((torch.bool, 1),),
    _PAST_ACTIONS: _ROWS,
    "view": ((torch.uint8, 4), (torch.int16, 4), (torch.float32, 3)),
    "noise": tuple(
        (kind, n) for kind in (torch.float32, torch.int64, torch.bool) for n in range(9)
    ),
}
"""Dtypes and numbers of axes of the tensors, by the first part of their names."""


class IncomparableError(UserError):
    """The policy raised an error in place of a chunk: the self-check says nothing of it."""


@dataclass(frozen=True)
class About:
    """Words in the header of the file's tensors.

    options: of policies that choose.
    precision: of the weights and the computation.
    """

    format: Literal["mme_vla self-check 1"]
    goal: str
    options: tuple[str, ...]
    precision: Literal["float32", "bfloat16"]
    device: str


@dataclass(frozen=True)
class SelfCheck:
    """A synthetic history, the noise of one chunk, and the chunk that the policy predicted.

    views: by the name of a camera, or of a reading beside its images, [t, …].
    states: [t, s].
    is_demo: [t].
    past_actions: [t, w], those that led to the frames.
    noise: of `Policy.sampling_noise`.
    chunk: [h, a] float32, in the network's units.
    actions: [h, w] float32, the chunk as the robot executes it.
    """

    views: Mapping[str, np.ndarray]
    states: np.ndarray
    is_demo: np.ndarray
    past_actions: np.ndarray
    noise: Mapping[str, Tensor]
    chunk: np.ndarray
    actions: np.ndarray
    about: About

    def to_bytes(self) -> bytes:
        """The content of the file."""
        from safetensors.torch import save

        tensors = {
            _CHUNK: torch.from_numpy(self.chunk),
            _ACTIONS: torch.from_numpy(self.actions),
            _STATES: torch.from_numpy(self.states),
            _DEMO: torch.from_numpy(self.is_demo),
            _PAST_ACTIONS: torch.from_numpy(self.past_actions),
        }
        for name, view in self.views.items():
            tensors[_VIEW + name] = torch.from_numpy(view)
        for name, noise in self.noise.items():
            tensors[_NOISE + name] = noise.contiguous()
        # One text: the order of several is not defined.
        return save(tensors, {_ABOUT: json.dumps(asdict(self.about), sort_keys=True)})


@dataclass(frozen=True)
class Comparison:
    """How far a loaded policy is from its self-check.

    chunk: relative difference of the predicted chunk from the stored one.
    actions: that of the actions which the stored chunk becomes here.
    tolerance: of `chunk`.
    recorded, current: precision and device of the two.
    """

    chunk: float
    actions: float
    tolerance: float
    recorded: str
    current: str

    @property
    def passed(self) -> bool:
        # NaN fails
        return self.chunk <= self.tolerance and self.actions <= ACTIONS_TOLERANCE

    @property
    def line(self) -> str:
        """The result in one line."""
        numbers = (
            f"the chunk differs by {self.chunk:.2g} of its size, at most {self.tolerance:g} is"
            f" allowed (recorded: {self.recorded}; here: {self.current})"
        )
        if self.passed:
            return f"self-check: passed, {numbers}"
        cause = "The weights, statistics or code are not"
        if not self.actions <= ACTIONS_TOLERANCE:
            numbers = (
                f"the stored chunk becomes other actions here, by {self.actions:.2g} of their size,"
                f" at most {ACTIONS_TOLERANCE:g} is allowed"
            )
            cause = "The statistics, the robot or the code are not"
        return (
            f"self-check: FAILED, {numbers}. {cause} those that the check was recorded with: fetch"
            " the checkpoint again, or use its author's versions."
        )


def record_self_check(policy: "Policy") -> SelfCheck:
    """Predict a chunk for a synthetic history and return both.

    The images are rendered by a formula, and states and actions follow from the statistics that the
    checkpoint holds in any case: nothing of the training data is in it. No generator of the caller
    changes.

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
    states = _synthetic_rows(stats.state, count)
    # Absolute actions [t, w] that could have led to the states.
    relative = torch.from_numpy(_synthetic_rows(stats.actions, count))
    past_actions = [
        robot.action.to_absolute(row[None], torch.from_numpy(state))[0]
        for row, state in zip(relative, states, strict=True)
    ]
    empty = np.zeros((0, robot.action.width), np.float32)
    history = SelfCheck(
        views=views,
        states=states,
        is_demo=is_demo,
        past_actions=torch.stack(past_actions).float().numpy(),
        noise=policy.sampling_noise(torch.Generator().manual_seed(_SEED)),
        chunk=empty,
        actions=empty,
        about=About(
            FORMAT,
            _GOAL,
            _OPTIONS if robot.action.choice else (),
            _precision_of(policy),
            policy.device.type,
        ),
    )
    chunk, actions = predict_chunk(policy, history)
    check = replace(history, chunk=chunk, actions=actions)
    size = len(check.to_bytes())
    require(
        size <= MOST_BYTES,
        f"A self-check of this policy would take {size / 1e6:.1f} MB, more than"
        f" {MOST_BYTES / 1e6:g}: set train.self_check=false.",
    )
    return check


def try_self_check(policy: "Policy") -> tuple[SelfCheck | None, str | None]:
    """The self-check of a policy that is about to be saved, or the reason why there is none.

    Weights are not lost because of their check, whatever a policy raises.
    """
    try:
        return record_self_check(policy), None
    except Exception as error:
        return None, _reason(error)


def renew_self_check(policy: "Policy", dtype: str) -> SelfCheck | None:
    """A self-check of the weights as they are now, for a policy whose checkpoint has one.

    Args:
        dtype: that the weights will be stored in.
    """
    if not policy._renews_self_check:
        return None
    check, reason = try_self_check(policy)
    if check is None:
        warnings.warn(f"saved without a self-check: {reason}", stacklevel=3)
        return None
    if dtype == "bfloat16":
        check = replace(check, about=replace(check.about, precision="bfloat16"))
    return check


def read_self_check(folder: Path) -> SelfCheck | None:
    """Read the self-check of a checkpoint, which may be untrusted; None if it has none.

    Raises:
        UserError: the file is damaged, too large, or was removed from a checkpoint that lists it.
    """
    from safetensors import safe_open

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
    with safe_open(path, "pt") as opened:
        text = (opened.metadata() or {}).get(_ABOUT)
    if text is None:
        raise UserError(f"{path} is no self-check: it has no description.")
    about = read_section(About, parse_json(text, f"The description of {path}"), str(path))
    missing = [name for name in _REQUIRED if name not in tensors]
    require(not missing, f"{path} is no self-check: it lacks {listed(missing)}.")
    views: dict[str, np.ndarray] = {}
    noise: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        kinds = _KINDS.get(name.split("/")[0], ())
        require(
            (tensor.dtype, tensor.ndim) in kinds and tensor.numel(),
            f"{path} is no self-check: {name!r} is {tensor.dtype} {list(tensor.shape)}.",
        )
        if name.startswith(_VIEW):
            views[name.removeprefix(_VIEW)] = tensor.numpy()
        elif name.startswith(_NOISE):
            noise[name.removeprefix(_NOISE)] = tensor
    count = len(tensors[_STATES])
    require(
        count <= _FRAMES, f"{path} has {count:,} frames, more than the {_FRAMES} of a self-check."
    )
    return SelfCheck(
        views=views,
        states=tensors[_STATES].numpy(),
        is_demo=tensors[_DEMO].numpy(),
        past_actions=tensors[_PAST_ACTIONS].numpy(),
        noise=noise,
        chunk=tensors[_CHUNK].numpy(),
        actions=tensors[_ACTIONS].numpy(),
        about=about,
    )


def compare(policy: "Policy", folder: Path) -> Comparison | None:
    """Compare a loaded policy with the self-check of its checkpoint; None if it has none.

    Raises:
        UserError: the file is damaged, or does not fit the policy.
        IncomparableError: the policy raises an error of its own, such as one of a dtype that it
            cannot compute in.
    """
    check = read_self_check(folder)
    if check is None:
        return None
    robot = policy.embodiment
    names = {*robot.camera_names, *robot.readings}
    require(
        check.views.keys() == names and len(check.about.options) <= len(robot.action.choice),
        f"{folder / FILE} does not fit this policy: it holds other cameras or options.",
    )
    expected = policy.sampling_noise(torch.Generator().manual_seed(_SEED))
    require(
        _layout(expected) == _layout(check.noise),
        f"{folder / FILE} does not fit this policy: its noise has other names or sizes.",
    )
    try:
        chunk, actions = predict_chunk(policy, check, stored=True)
    except UserError as error:
        raise UserError(f"{folder / FILE} does not fit this policy: {error}") from error
    except Exception as error:
        raise IncomparableError(
            f"self-check: not done, the policy predicts no chunk ({_precision_of(policy)},"
            f" {policy.device.type}): {_reason(error)}"
        ) from error
    for name, array, stored in (
        (_CHUNK, chunk, check.chunk),
        (_ACTIONS, actions, check.actions),
    ):
        require(
            array.shape == stored.shape,
            f"{folder / FILE} does not fit this policy: its {name} is {list(stored.shape)}, the"
            f" policy's {list(array.shape)}.",
        )
    precision = _precision_of(policy)
    tolerance = FLOAT32_TOLERANCE
    if "bfloat16" in (precision, check.about.precision):
        tolerance = BFLOAT16_TOLERANCE
    return Comparison(
        chunk=relative_difference(chunk, check.chunk),
        actions=relative_difference(actions, check.actions),
        tolerance=tolerance,
        recorded=f"{check.about.precision}, {check.about.device}",
        current=f"{precision}, {policy.device.type}",
    )


def relative_difference(chunk: np.ndarray, stored: np.ndarray) -> float:
    """Mean absolute difference of two chunks, as a share of the stored one's mean size."""
    size = float(np.abs(stored).mean())
    difference = float(np.abs(chunk - stored).mean())
    if size == 0:
        return difference
    return difference / size


@torch.no_grad()
def predict_chunk(
    policy: "Policy", check: SelfCheck, stored: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """The chunk [h, a] for the history and noise of a self-check, and the actions [h, w] that it
    becomes.

    Args:
        stored: return the actions that the stored chunk becomes.
    """
    devices = [policy.device] if policy.device.type == "cuda" else []
    was_training, dtype = policy.training, policy.compute_dtype
    # The policy samples as it is evaluated, and computes in float32 where its weights are float32.
    policy.eval()
    if _precision_of(policy) == "float32":
        policy.compute_dtype = torch.float32
    try:
        # one chunk is not worth compiling for
        with torch.compiler.set_stance("force_eager"), torch.random.fork_rng(devices=devices):
            torch.manual_seed(_SEED)  # of what is sampled beside the noise
            episode = policy.start_episode(check.about.goal, _SEED)
            if policy.require_processor().prompt_spec.reads_subgoal:
                episode.subgoal = check.about.goal
            episode.options = tuple(
                Option(chr(ord("a") + number), text, needs_point=True)
                for number, text in enumerate(check.about.options)
            )
            past_actions = None
            if policy.embodiment.action.frames is not None:
                past_actions = check.past_actions
            episode.observe(check.views, check.states, check.is_demo, past_actions)
            batch = policy.observation([episode])
            noise = stack_noise([check.noise])
            chunk = policy.predict_chunk(batch, [episode], noise)[:1].float().cpu()
            becomes_actions = chunk
            if stored and chunk[0].shape == check.chunk.shape:
                becomes_actions = torch.from_numpy(check.chunk)[None]
            actions = executable_actions(policy, becomes_actions, [episode])[0].astype(np.float32)
    finally:
        policy.compute_dtype = dtype
        policy.train(was_training)
    return chunk[0].numpy(), actions


def _reason(error: Exception) -> str:
    """Kind and text of an error, in one line."""
    text = " ".join(str(error).split())
    return brief(f"{type(error).__name__}: {text}", 300, quote=False)


def _precision_of(policy: "Policy") -> Literal["float32", "bfloat16"]:
    """Of the weights, those of a sharded policy as they are gathered."""
    if any(p.dtype == torch.bfloat16 for p in policy.parameters()):
        return "bfloat16"
    return "float32"


def _layout(noise: Mapping[str, Tensor]) -> dict[str, tuple[torch.Size, torch.dtype]]:
    return {name: (tensor.shape, tensor.dtype) for name, tensor in noise.items()}


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
            pose[2, 3] = 1  # metres before the camera
            views[depth_name] = depth.astype(np.int16)
            views[pose_name] = pose[None].repeat(count, 0)
    return views


def _synthetic_rows(stats: QuantileStats, count: int) -> np.ndarray:
    """Rows [count, d] float32 around the mean, within the quantiles."""
    phase = np.arange(count)[:, None] / 4 + np.arange(len(stats))
    rows = stats.mean + 0.2 * (stats.q99 - stats.q01) * np.sin(phase)
    clipped: np.ndarray = np.clip(rows, stats.q01, stats.q99).astype(np.float32)
    return clipped
