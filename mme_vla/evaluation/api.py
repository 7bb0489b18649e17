"""`evaluate` from Python: a policy on the benchmark in one call, with what the command
would set.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Unpack

from mme_vla.config.sections import read_section
from mme_vla.envs.base import environment
from mme_vla.envs.make import make_env
from mme_vla.evaluation.rollout.evaluation import (
    Evaluation,
    RunOptions,
    choose_episodes,
    evaluate_policy,
    predictor_of,
)
from mme_vla.evaluation.rollout.events import event_arms
from mme_vla.evaluation.rollout.settings import RolloutKeywords, RolloutSettings
from mme_vla.policy.base import Policy
from mme_vla.subgoal import SubgoalPredictor


def evaluate(
    policy: Policy | str | Path,
    tasks: str | Sequence[str] = "all",
    episodes: int | Sequence[int] | None = None,
    *,
    seed: int = 42,
    output: str | Path | None = None,
    subgoal: str | SubgoalPredictor | None = None,
    name: str | None = None,
    base: Callable[..., Any] = make_env,
    show_progress: bool = True,
    recordings: Any = None,
    event: str | Sequence[str] | None = None,
    **settings: Unpack[RolloutKeywords],
) -> Evaluation:
    """Run a policy on episodes of the benchmark; what `output` holds already is not run again.

    Workers are processes that import the calling script: keep its work under
    `if __name__ == "__main__":`. A notebook needs nothing of the kind.

    Args:
        policy: one with statistics; or what to load one from: a folder, a hub repository, or the
            name of a shipped one, such as `nano`.
        tasks, episodes: as `tasks=` and `episodes=` of the command: `"all"` or names; None for all
            of the split, a number for the first so many, or a list.
        seed: of the policy's noise.
        output: the run's folder, by default the one the command would choose.
        subgoal: a predictor, or the name of one, for policies that read subgoals.
        name: what records call the policy; its own name by default.
        base: makes an environment with the benchmark's interface, importable by name.
        recordings: datasets whose first episodes `split="stress:sessions=2"` shows before each.
        event: what happens in every episode, such as `"pause:100@subtask:2"`; of a list each by
            itself. Every episode runs without it too, in `output` itself.
        show_progress: whether a progress bar is shown.
        settings: of `RolloutSettings`, such as `workers=4` or `render=False`.

    Returns:
        The records of these episodes, and `success_rate`; of those with events, `matched` are the
        ones without.

    >>> result = evaluate("outputs/framesamp_modul/latest", "StopCube", 5)  # doctest: +SKIP
    >>> result.success_rate  # doctest: +SKIP
    0.4
    """
    run_settings = read_section(RolloutSettings, {**settings, "seed": seed})
    events = event_arms(event)
    jobs = choose_episodes(tasks, episodes, run_settings.split, run_settings.env)
    if base is make_env:
        environment(run_settings.env).check_installed()
    loaded, source = load(policy)
    predictor = predictor_of(loaded, subgoal)
    label = type(subgoal).__name__ if isinstance(subgoal, SubgoalPredictor) else subgoal
    options = RunOptions(subgoals=predictor, source=source, base=base, show_progress=show_progress)
    return evaluate_policy(
        loaded.eval(),
        jobs,
        run_settings,
        events,
        options,
        name=name,
        predictor=label,
        output=output,
        recordings=recordings,
    )


def load(policy: Policy | str | Path) -> tuple[Policy, str | None]:
    """A policy, and where its weights are from; one that is given keeps to itself."""
    if isinstance(policy, Policy):
        return policy, None
    from mme_vla.policy.run_folders import locate_checkpoint

    source = locate_checkpoint(policy)
    return Policy.from_pretrained(source), source
