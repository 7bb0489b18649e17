"""`probe` from Python: what a policy takes from its memory, in one call."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from mme_vla.data.sources import open_sources
from mme_vla.envs.make import make_env, require_simulator
from mme_vla.errors import UserError, did_you_mean
from mme_vla.evaluation.from_python import load
from mme_vla.evaluation.probe.offline import OfflineSettings
from mme_vla.evaluation.probe.probing import NO_DATA, Probe, Wanted, run_probe
from mme_vla.evaluation.probe.recordings import all_recordings
from mme_vla.evaluation.rollout.evaluation import checkpoint_label, memory_budget
from mme_vla.evaluation.rollout.plan import choose_episodes
from mme_vla.evaluation.rollout.runner import RunFacts
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.base import Policy
from mme_vla.subgoal import SubgoalPredictor, build_predictor


def probe(
    policy: Policy | str | Path,
    recordings: Any = None,
    arms: Sequence[Any] | None = None,
    *,
    output: str | Path,
    tasks: str | Sequence[str] | None = None,
    episodes: int | Sequence[int] | None = None,
    seed: int = 42,
    draws: int = 8,
    moments: int | None = 8,
    subgoal: str | SubgoalPredictor | None = None,
    name: str | None = None,
    base: Callable[..., Any] = make_env,
    shown: bool = True,
    **settings: Any,
) -> Probe:
    """Ask what a policy takes from its memory; what `output` holds already is not asked again.

    Args:
        policy: one with statistics; or a folder or hub repository to load one from.
        recordings: recorded episodes: folders of datasets, as for the command. Without them the closed loop is probed.
        arms: interventions, such as `["shuffle", "drop:2", "nodemo+delay:64"]`; by default all that are possible.
        output: the probe's folder, for its lines and its page.
        tasks, episodes: of the closed loop, as for `evaluate`; None leaves it out.
        seed: of noise and of what is drawn at random.
        draws: chunks sampled at each moment. moments: most of an episode.
        subgoal: a predictor, or the name of one, for policies that read subgoals in closed loop.
        name: what lines and records call the policy. base: makes an environment with the benchmark's interface.
        shown: whether a progress bar is shown. settings: of `RolloutSettings`, such as `workers=2`.

    Returns:
        Its findings, the paired comparisons of the closed loop, notes, and the path of the page.

    Raises:
        UserError: nothing to probe on, an intervention that does not exist or does not fit, or a setting likewise.

    >>> probe("outputs/mine/latest", "outputs/val", output="outputs/probe").page  # doctest: +SKIP
    """
    known = [option.name for option in fields(RolloutSettings) if option.name != "seed"]
    if unknown := [key for key in settings if key not in known]:
        raise UserError(f"probe() has no setting {unknown[0]!r}. {did_you_mean(unknown[0], known)}")
    if recordings is None and tasks is None:
        raise UserError(f"probe() needs recordings=…, tasks=…, or both. {NO_DATA}")
    chosen = RolloutSettings(seed=seed, **settings)
    loaded, source = load(policy)
    recorded = [] if recordings is None else all_recordings(open_sources(recordings, loaded.embodiment))
    jobs = [] if tasks is None else choose_episodes(tasks, episodes, chosen.split)
    if jobs and base is make_env and chosen.env == "mme_vla":
        require_simulator()
    predictor = build_predictor({"name": subgoal}) if isinstance(subgoal, str) else subgoal
    facts = RunFacts(
        name or str(loaded.config.get("name", "policy")), checkpoint_label(source), seed, chosen.split,
        chosen.max_steps, subgoal if isinstance(subgoal, str) else None, memory_budget(loaded),
    )  # fmt: skip
    wanted = Wanted(arms, recorded, recorded, jobs, OfflineSettings(seed, draws, moments), source=source)
    folder = Path(output).expanduser()
    return run_probe(loaded.eval(), wanted, folder, facts, chosen, subgoals=predictor, base=base, shown=shown)
