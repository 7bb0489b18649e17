"""MIKASA-Robo-VLA 1.0.0 by its protocol: `env=mikasa`, `env=mikasa_video`, where the cue is a
conditioning video, and `env=mikasa_choices`, where actions are choices as well.

Its tasks are ManiSkill environments and run on the library's ManiSkill. The package's wrappers are
not used: what they do (cameras, state, no motion while a cue is shown) is done here, with images on
demand.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from string import ascii_lowercase
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np

from mme_vla.envs.base import CHOICES, Actions, Environment
from mme_vla.envs.facts import Candidates, Fact, FactLog
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.rendering import keep_renderer, lean_shaders, links_culled, render_backend
from mme_vla.errors import check_known, require
from mme_vla.extras.mikasa.assets import are_there, check_assets, check_package
from mme_vla.extras.mikasa.catalog import FAMILY_OF, STEPS, by_horizon, by_memory
from mme_vla.extras.mikasa.demonstrators import demonstrate, place_of, wrapped
from mme_vla.extras.mikasa.facts import facts_of_task
from mme_vla.registry import ENVS

CAMERAS = {"top": "base_camera", "wrist": "hand_camera"}
FIRST_SEEDS = {"test": 4_242_424_242, "train": 0, "val": 1_000_000}
"""Of each split, the same for every task: the protocol's for the test split."""
_SIDE = 128  # of images


class MikasaScene(gymnasium.Env[Any, Any]):
    """A task with observations by the protocol: two images, and position [3], roll, pitch and yaw
    of the hand and the opening of the gripper. Actions are changes of the hand's pose in [−1, 1]:
    0.1 m and 0.1 rad at 1, and the gripper (1 opens it). By choices the pose is relative to the
    first one.

    Attributes:
        scene: the task itself.
        time: steps since the reset.
        frozen: first steps in which no action has an effect, by the protocol. By choices, all but
            the last of those before the answer can be given, of any task.
        cue_end: the first step at which the answer can be given.
        scene_facts: what its frames show.
        log: the facts of those so far.
    """

    def __init__(
        self, task: str, render: bool, is_twin: bool = False, by_choice: bool = False
    ) -> None:
        check_assets(task)
        import mani_skill.envs  # noqa: F401
        import mikasa_robo_suite.vla.memory_envs  # noqa: F401  registers the tasks

        self._rendered = render
        self._backend = render_backend() if render else "none"
        # Images are taken on demand. What ShellGamePush's reward reads is computed with its state.
        observed = "state" if task == "ShellGamePush" else "none"
        with self._building() as cameras:
            self._env = gymnasium.make(
                f"{task}-VLA-v0",
                num_envs=1,
                obs_mode=observed,
                control_mode="pd_ee_delta_pose",
                reward_mode="normalized_dense",
                sim_backend="physx_cpu",
                render_backend=self._backend,
                sensor_configs=cameras,
            )
        self.scene: Any
        self.scene = self._env.unwrapped
        if render:
            keep_renderer(self.scene._render_device)
        self._task = task
        self._is_twin = is_twin
        self._by_choice = by_choice
        self._freezes = FAMILY_OF[task].frozen and not task.endswith("-Long")
        self.time = 0

    @contextmanager
    def _building(self) -> Iterator[dict[str, Any]]:
        """Build scenes that render faster: with RoboMME's lean shaders, and the body of the wrist
        camera, 425,160 of the robot's 560,708 triangles, with no more detail than shows.

        Yields:
            Settings of the cameras.
        """
        from mani_skill.agents.robots.panda.panda_wristcam import PandaWristCam

        from mme_vla.envs.robomme.robot.robots import description

        cameras: dict[str, Any] = {}
        if self._backend == "sapien_cpu":
            lean = lean_shaders()
            if lean is not None:
                cameras["shader_config"] = lean
        # The tasks look for the stock robot's name, so that one of another name cannot be given.
        stock = PandaWristCam.urdf_path
        PandaWristCam.urdf_path = description(stock, visible=self._rendered)
        try:
            yield cameras
        finally:
            PandaWristCam.urdf_path = stock

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Build the scene of a seed."""
        with self._building():
            _, info = self._env.reset(seed=seed, options=options)
        self.time = 0
        self.cue_end = 0
        for name in ("cue_steps_per_env", "empty_steps_per_env"):
            if hasattr(self.scene, name):
                self.cue_end += int(getattr(self.scene, name)[0])
        self.frozen = 0
        if self._by_choice:
            self.frozen = max(self.cue_end - 1, 0)  # the decision is made before the answer is seen
        elif self._freezes:
            self.frozen = self.cue_end
        self.scene_facts = facts_of_task(self._task)(self.scene, self.cue_end, self._by_choice)
        if self._is_twin:
            self.scene_facts.flip()
            self.scene.get_info()  # which places what is shown
        self.log = FactLog()
        self.log.add(*self.scene_facts.visible_facts(0))
        goal = info["language_instruction"]
        if not isinstance(goal, str):
            goal = goal[0]
        return self.observe(), {"goal": goal, "frozen": self.frozen}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Perform an action [7]."""
        action = np.clip(np.asarray(action, np.float32), -1, 1)
        if self.time < self.frozen:
            action = np.zeros_like(action)
        _, reward, terminated, truncated, info = self._env.step(action)
        self.time += 1
        self.log.add(*self.scene_facts.visible_facts(self.time))
        success = bool(info["success"])
        return (
            self.observe(),
            float(reward),
            bool(terminated),
            bool(truncated),
            {"success": success},
        )

    def observe(self) -> dict[str, Any]:
        """The state [7], and for each camera the function that takes its image [128, 128, 3]."""
        from transforms3d.euler import quat2euler

        tool = self.scene.agent.tcp.pose.raw_pose[0].cpu().numpy().astype(np.float64)
        opening = self.scene.agent.robot.get_qpos()[0, -2:].sum().cpu().numpy()
        pose = np.concatenate([tool[:3], quat2euler(tool[3:])])
        if self._by_choice:
            # All tasks share their seeds, and the first pose would tell which seed it is.
            if self.time == 0:
                self._first_pose = pose
            pose = pose - self._first_pose
            pose[3:] = [wrapped(angle) for angle in pose[3:]]
        state = np.append(pose, opening).astype(np.float32)
        self._is_current = False  # the renderer's copy of the scene
        images: dict[str, Callable[[], np.ndarray]] = {}
        for name, camera in CAMERAS.items():
            images[name] = partial(self._image, camera)
        return {**images, "state": state}

    def _image(self, camera: str) -> np.ndarray:
        """The image of a camera [H, W, 3] now."""
        if not self._rendered:
            return np.zeros((_SIDE, _SIDE, 3), np.uint8)
        if not self._is_current:
            for hidden in self.scene._hidden_objects:
                hidden.hide_visual()
            self.scene.scene.update_render(update_sensors=True, update_human_render_cameras=False)
            self._is_current = True
        sensor = self.scene.scene.sensors[camera]
        with links_culled(self.scene, sensor.camera):
            sensor.capture()
        taken = sensor.get_obs(rgb=True, depth=False, position=False, segmentation=False)
        image: np.ndarray = taken["rgb"][0].cpu().numpy()
        return image

    def oracle(self) -> dict[str, str]:
        """The choice that leads to success."""
        return {"choice": ascii_lowercase[self.scene_facts.correct_choice()]}

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()


@ENVS.register("mikasa")
class Mikasa(Environment):
    """The tasks of MIKASA-Robo-VLA 1.0.0 that have all they need on this machine."""

    suites = by_memory()
    groupings: ClassVar = {"horizon": by_horizon()}
    steps = STEPS
    splits: ClassVar = {"train": 250, "val": 50, "test": 50}
    success: ClassVar[Literal["end", "once"]] = "once"
    reuse = True
    embodiment: ClassVar[Mapping[str, Any]] = {
        "name": "mikasa",
        "cameras": {"top": {"augment": "none"}, "wrist": {"augment": "none"}},
        "memory_camera": "top",
        "state": {"width": 7},
        "action": {
            "width": 7,
            "names": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"],
            "horizon": 8,
            "execute": 4,
        },
        "fps": 10,
    }

    @property
    def tasks(self) -> tuple[str, ...]:  # type: ignore[override]
        """Those whose models are on this machine."""
        return tuple(task for task, family in FAMILY_OF.items() if are_there(family.needs))

    def check_installed(self) -> None:
        check_package()

    def check_task(self, task: str) -> None:
        """A task of the benchmark, whose models are on this machine."""
        check_known("task", task, FAMILY_OF)
        if not are_there(FAMILY_OF[task].needs):
            check_assets(task)

    def episodes(self, task: str, split: str) -> list[EpisodeSpec]:
        """The protocol's seeds: the same for every task."""
        self.check_task(task)
        self.check_split(split)
        first = FIRST_SEEDS[split]
        return [
            EpisodeSpec(task, split, number, first + number, "")
            for number in range(self.splits[split])
        ]

    def make(self, spec: EpisodeSpec, render: bool = True) -> MikasaScene:
        self.check_installed()
        return MikasaScene(spec.task, render, is_twin=spec.row is not None)

    def choices(self, env: MikasaScene) -> Mapping[str, Actions]:
        return env.scene_facts.choices()

    def hold(self, env: MikasaScene) -> np.ndarray:
        """No motion; the gripper stays open, as it is in every scene's beginning."""
        return np.array([0, 0, 0, 0, 0, 0, 1], np.float32)

    def demonstrate(self, env: MikasaScene) -> Iterator[np.ndarray]:
        """Solve the episode from the simulator's state."""
        return demonstrate(env)

    def facts(self, env: MikasaScene) -> Sequence[Fact]:
        return env.log.facts

    def twin(self, spec: EpisodeSpec) -> Mapping[str, Any] | None:
        """The scene flips its fact itself."""
        return {"flipped": True} if facts_of_task(spec.task).has_twin else None

    def candidates(self, env: MikasaScene) -> Candidates | None:
        return env.scene_facts.candidates(env.time)

    def tool(self, env: MikasaScene) -> Sequence[float]:
        """X and y of the hand, in metres."""
        place: list[float] = place_of(env.scene.agent.tcp)[:2].tolist()
        return place


@ENVS.register("mikasa_video")
class MikasaVideo(Mikasa):
    """The same, where frozen steps are a conditioning video before the execution."""

    cue: ClassVar[Literal["steps", "video"]] = "video"
    embodiment: ClassVar[Mapping[str, Any]] = {
        **Mikasa.embodiment,
        "name": "mikasa_video",
        "conditioning_video": True,
    }


_LETTERS = ascii_lowercase[:15]  # as many objects as RememberShapeAndColor5x3 has


@ENVS.register("mikasa_choices")
class MikasaChoices(MikasaVideo):
    """The tasks whose answer is one of several things, by choices: an action is the letter of an
    option, which a script carries out. The cue of every task is a conditioning video.
    """

    embodiment: ClassVar[Mapping[str, Any]] = {
        "name": "mikasa_choices",
        # It looks down from above all objects, which are larger in its images than in `top`.
        "cameras": {"wrist": {"augment": "none"}},
        "memory_camera": "wrist",
        "state": {"width": 7},
        "action": {
            "space": CHOICES,
            "width": len(_LETTERS),
            "names": list(_LETTERS),
            "choice": list(range(len(_LETTERS))),
            "options_length": 160,
            "horizon": 4,
            "execute": 1,
            "frames": None,
        },
        "fps": 10,
        "conditioning_video": True,
    }

    @property
    def tasks(self) -> tuple[str, ...]:  # type: ignore[override]
        """Those with something to choose, whose models are on this machine."""
        return tuple(task for task in super().tasks if facts_of_task(task).has_choices)

    def check_task(self, task: str) -> None:
        """A task with something to choose, whose models are on this machine."""
        super().check_task(task)
        require(
            facts_of_task(task).has_choices,
            f"{task} has nothing to choose: take env=mikasa, or one of {', '.join(self.tasks)}.",
        )

    def make(self, spec: EpisodeSpec, render: bool = True) -> MikasaScene:
        self.check_installed()
        return MikasaScene(spec.task, render, is_twin=spec.row is not None, by_choice=True)
