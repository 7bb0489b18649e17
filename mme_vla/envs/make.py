"""`make_env`: one benchmark episode as an environment, in one line."""

import re
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Unpack

from mme_vla.envs import metadata
from mme_vla.envs.metadata import TASK_NAMES, check_task_name
from mme_vla.envs.observations import Include
from mme_vla.envs.rendering import render_backend
from mme_vla.envs.rows import DIFFICULTIES, TaskOptions
from mme_vla.errors import check_known, missing_extra, require
from mme_vla.registry import TASKS

if TYPE_CHECKING:
    from mme_vla.envs.interface import RoboMMEEnv


ROBOMME = "mme_vla"
"""The environment that is RoboMME."""
ACTION_SPACES = ("joint_angle", "ee_pose", "waypoint", "multi_choice")


def make_env(
    task: str,
    split: str = "test",
    episode: int = 0,
    action_space: str = "joint_angle",
    *,
    seed: int | None = None,
    difficulty: str | None = None,
    recovery: str | None = None,
    max_steps: int | None = None,
    row: Mapping[str, Any] | None = None,
    render: bool = True,
    reward: str = "none",
    include: Include | None = None,
) -> "RoboMMEEnv":
    """Make the environment of one episode of RoboMME.

    Environments of the user's own are opened by `environment(name).open(task, split, episode)`.

    Args:
        task: one of the 16 task names, or a task of your own registered in `TASKS`.
        split: `train`, `val`, `test`, `hard`, `challenge`, `ood`, `ood:<tier>`, or a JSONL file of
            scenes; `twin` or `stress:<dial>=<n>` for variants of the test split, `twin:<split>` of
            another; `further` for 100 scenes beyond it.
        episode: which episode of the split.
        action_space: `joint_angle`, `ee_pose`, `waypoint` or `multi_choice`.
        seed: builds the scene of this seed instead of an episode of the split.
        difficulty: with `seed`: `easy`, `medium` or `hard`; by default seed % 3 decides.
        recovery: `z` or `xy`: sample as recovery demonstrations do, such as train episodes 0-5 (it
            changes the order of BinFill's colours); by default nothing, as in the official
            evaluation.
        max_steps: control steps until the status becomes `timeout`; by default as many as the split
            allows.
        row: builds the scene of these values (`env.scene_values()`) instead of an episode of the
            split.
        render: whether observations hold images; without it no Vulkan is needed and steps are some
            30 times faster.
        reward: `none`, as in the benchmark: always 0. `sparse`: 1 with the step that succeeds.
            `subtask`: an equal share for each sub-task of the execution as it is done, 1 in all. Or
            your own, registered in `REWARDS`.
        include: what observations and infos hold beyond the standard keys, such as
            `Include(front_depth=True)`.

    Returns:
        The environment; call `reset()` first. Close it when done.
    """
    check_names(task, action_space, difficulty, seed)
    variant = metadata.check_split(split)
    if max_steps is None:
        max_steps = metadata.step_limit(split)
    if row is not None:
        spec = metadata.read_row(row)
        require(
            spec.task == task and seed is None,
            f"row is a scene of {spec.task} with its own seed: name that task, and leave out seed.",
        )
        scene = spec.options
    elif seed is not None:
        require(
            variant is None,
            f"seed={seed} builds a scene of no split, and split={split} varies those of one: leave"
            " out one of them.",
        )
        scene = {"seed": seed, "difficulty": difficulty}
    else:
        scene = metadata.episode(task, split, episode).options
    if recovery is not None:
        scene["recovery"] = recovery
    if include is None:
        include = Include()
    require(
        isinstance(include, Include),
        f"include={include!r} must be an Include, such as Include(front_depth=True).",
    )
    if action_space == "multi_choice":
        # A policy that chooses a pixel needs the front camera's matrices.
        include = replace(include, front_camera_extrinsic=True, front_camera_intrinsic=True)
    obs_mode = "none"
    if include.maniskill_obs:
        obs_mode = "rgb+depth+segmentation" if render else "state_dict"
    simulated = make_task(task, render=render, obs_mode=obs_mode, **scene)
    from mme_vla.envs.interface import RoboMMEEnv

    return RoboMMEEnv(simulated, action_space, max_steps, include, render, reward)


def check_names(
    task: str, action_space: str, difficulty: str | None = None, seed: int | None = None
) -> None:
    """Refuse what can be refused without the simulator."""
    check_task_name(task)
    check_known("action space", action_space, ACTION_SPACES)
    if difficulty is not None:
        check_known("difficulty", difficulty, DIFFICULTIES)
        require(seed is not None, "A difficulty needs a seed: an episode of a split has its own.")


def require_simulator() -> None:
    """Refuse to continue without the simulator's packages."""
    if find_spec("mani_skill") is None:
        raise missing_extra("The simulator", "sim")


def load_tasks(*tasks: str) -> None:
    """Register tasks, all of them if none is named: in `TASKS`, and with Gymnasium under their own
    names.

    >>> load_tasks()  # doctest: +SKIP
    >>> gymnasium.make("StopCube", seed=0, difficulty="easy", obs_mode="rgb")  # doctest: +SKIP
    """
    require_simulator()
    for task in tasks or TASK_NAMES:
        check_task_name(task)
        if task in TASK_NAMES:
            # `pick_xtimes` of `PickXtimes`
            module = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", task).lower()
            import_module(f"mme_vla.envs.robomme.tasks.{module}")


def make_task(
    task: str, *, render: bool, obs_mode: str = "none", **options: Unpack[TaskOptions]
) -> Any:
    """Build one task as a bare ManiSkill environment.

    Args:
        task: its registered name.
        render: build what is there to be seen; otherwise no Vulkan is needed.
        obs_mode: ManiSkill's observation mode.
        options: of the scene, such as `seed` and `difficulty`.
    """
    load_tasks(task)
    backend = "none"
    if render:
        backend = render_backend()
    return TASKS[task](
        obs_mode=obs_mode, render_backend=backend, sim_backend="physx_cpu", **options
    )
