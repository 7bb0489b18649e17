"""Where everything in a scene stood, and what of it was drawn: kept of every frame, put back to draw some of them."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.envs.task import Task


class Snapshots:
    """Snapshots of one task's scene, in the order they were taken; velocities are not part of them.

    A snapshot is read from the simulator's own objects: that takes a tenth of what `get_state_dict` takes, and brings
    back marks and traces, which belong to no thing of the task, as they were drawn.
    """

    def __init__(self, task: "Task") -> None:
        from sapien.render import RenderBodyComponent

        entities = [actor._objs[0] for actor in task.scene.actors.values() if actor.px_body_type != "static"]
        self._entities = entities
        bodies = [entity.find_component_by_type(RenderBodyComponent) for entity in entities]
        self._bodies = [body for body in bodies if body is not None]
        self._articulations = [each._objs[0] for each in task.scene.articulations.values()]
        self._taken: list[tuple[list[Any], list[float], list[tuple[Any, Any]]]] = []

    def __len__(self) -> int:
        return len(self._taken)

    def take(self) -> None:
        """Keep the scene as it stands."""
        self._taken.append((
            [entity.pose for entity in self._entities],
            [body.visibility for body in self._bodies],
            [(each.root_pose, each.qpos) for each in self._articulations],
        ))  # fmt: skip

    def put_back(self, number: int) -> None:
        """Make the scene stand as in a snapshot, counted from 0."""
        poses, visibilities, joints = self._taken[number]
        for entity, pose in zip(self._entities, poses, strict=True):
            entity.pose = pose
        for body, visibility in zip(self._bodies, visibilities, strict=True):
            body.visibility = visibility
        for each, (root, qpos) in zip(self._articulations, joints, strict=True):
            each.root_pose = root
            each.qpos = qpos
