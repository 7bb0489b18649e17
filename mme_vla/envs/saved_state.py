"""`EpisodeState`: where a running episode stands, kept as what led there.

A simulator's positions and velocities are not all of its state: contacts, the solver's last solution and the script's
own memory belong to it, and a state without them continues otherwise. But the same scene and actions always give the
same episode, to the last bit on CPUs of one maker. So a state is its scene and its actions; restoring it plays them
again without images, at some two milliseconds a control step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

from mme_vla.envs.render_request import RenderRequest
from mme_vla.errors import UserError


@dataclass(frozen=True)
class EpisodeState:
    """A state that `RoboMMEEnv.save_state` made; it can be pickled, and restored in another process.

    task, seed, difficulty, recovery, in_view, stress: the scene. action_space, max_steps: of the environment.
    options: of the reset. actions: all that were given to `step` since.
    """

    task: str
    seed: int
    difficulty: str
    recovery: str | None
    in_view: bool
    stress: dict[str, int]
    action_space: str
    max_steps: int
    options: dict[str, Any]
    actions: tuple[Any, ...]

    def check(self, other: "EpisodeState") -> None:
        """Make sure that an environment whose own state is `other` can continue from here."""
        places = [field.name for field in fields(self) if field.name not in ("options", "actions")]
        differ = [name for name in places if getattr(self, name) != getattr(other, name)]
        if differ:
            differences = ", ".join(
                f"{name} {getattr(self, name)!r} (here {getattr(other, name)!r})" for name in differ
            )
            raise UserError(f"This state is of another environment: {differences}. Make one of the same episode.")


class Played(Protocol):
    """What of `RoboMMEEnv` an episode is played again on."""

    on_frame: Any
    render_request: RenderRequest | None

    def state_of(self, options: dict[str, Any], actions: Sequence[Any]) -> EpisodeState: ...
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]: ...
    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]: ...


def play_again(env: Played, state: EpisodeState) -> tuple[Any, dict[str, Any]]:
    """See `RoboMMEEnv.restore_state`."""
    state.check(env.state_of({}, ()))
    hook, request = env.on_frame, env.render_request
    grounded = request is None or request.grounded
    unseen, present = RenderRequest({}, now=(), grounded=grounded), RenderRequest({}, grounded=grounded)
    env.on_frame = None
    try:
        env.render_request = unseen if state.actions else present
        observation, info = env.reset(options=state.options)
        for number, action in enumerate(state.actions, 1):
            env.render_request = unseen if number < len(state.actions) else present
            observation, _, _, _, info = env.step(action)
    finally:
        env.on_frame, env.render_request = hook, request
    return observation, info
