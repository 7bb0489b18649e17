"""An audit names what a served policy reads, from outside, and agrees with the card from inside."""

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from helpers import REPOSITORY, commands
from helpers.serving_fakes import Served
from helpers.tiers import slow_or_nightly
from mme_vla.cli.record import record_environment
from mme_vla.config import plugins
from mme_vla.config.plugins import import_plugins
from mme_vla.data.sources import open_sources
from mme_vla.embodiment import Embodiment
from mme_vla.envs.base import environment
from mme_vla.evaluation.records import EpisodeKey
from mme_vla.evaluation.rollout import evaluation
from mme_vla.evaluation.rollout.evaluation import RunOptions, choose_jobs, facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import find_records, read_records
from mme_vla.extras.audit import audit as audit_module
from mme_vla.extras.audit.audit import Audit, AuditSettings, run_audit, scenes_a_task
from mme_vla.extras.audit.conclusion import FORGET, INTERVENTIONS, VERDICTS, conclude, resolution
from mme_vla.extras.audit.floor import RANDOM
from mme_vla.extras.probing.card import (
    CONTENT,
    TIME,
    WRONG_SCENE,
    Card,
    grade,
    measure_card,
    run_card,
)
from mme_vla.extras.probing.recordings import Recording, all_recordings
from mme_vla.extras.probing.run import ProbePlan
from mme_vla.extras.trajectories.local import LocalEnvs
from mme_vla.memory.base import stack_history
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.run_folders import locate_checkpoint
from mme_vla.serving.remote.policy import RemotePolicy
from mme_vla.serving.remote.settings import ConnectionSettings, ServerChoice
from mme_vla.testing.small import SMALL_VISION, small_policy

pytest.importorskip("lerobot", reason="records a LeRobot dataset: uv sync --inexact --extra data")

EXAMPLES = REPOSITORY / "examples"
PROCESSES = evaluation.VecEnv
SILENT = RunOptions(show_progress=False)


TASK_OF_GOAL = {"follow the light": "Cues", "move to where the light was": "Blink"}
ENVS = {"Cues": "cues", "Told": "cues", "Blink": "blink"}


def settings(task: str = "Cues") -> RolloutSettings:
    return RolloutSettings(env=ENVS[task], max_steps=20)


class OneEnv(LocalEnvs):
    """A `VecEnv` of one environment in this process."""

    def __init__(self, jobs: Any, workers: int, make: Any, timeout: Any) -> None:
        super().__init__(make)


@pytest.fixture(scope="module")
def examples() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("servers", "blink"):
            patch.syspath_prepend(EXAMPLES / name)
        patch.setattr(evaluation, "VecEnv", OneEnv)
        patch.setattr(plugins, "_imported", dict(plugins._imported))
        import_plugins(["cues", "blink"])
        yield patch


@pytest.fixture(scope="module")
def robot(examples: pytest.MonkeyPatch) -> Embodiment:
    return Embodiment.from_dict(environment("cues").embodiment)


@pytest.fixture(scope="module")
def recordings(
    examples: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[Recording]]:
    """Demonstrations, by task."""
    folder = tmp_path_factory.mktemp("demonstrations")
    words = {"tasks": "all", "task": None, "split": "train", "fps": 20, "episodes": 8}
    by_task: dict[str, list[Recording]] = {}
    for env in ("cues", "blink"):
        place = str(folder / env)
        record_environment(OmegaConf.create({**words, "env": env, "output": place}))
        robot = Embodiment.from_dict(environment(env).embodiment)
        for recording in all_recordings(open_sources(place, robot)):
            task = TASK_OF_GOAL.get(recording.goal, "Told")
            by_task.setdefault(task, []).append(recording)
    return by_task


def audit(
    policy: Policy, task: str, folder: Path, lend: list[Recording], scenes: int = 14, **more: Any
) -> Audit:
    jobs = choose_jobs(task, scenes, "test", ENVS[task])
    facts = facts_of(policy, None, None, settings(task), None)
    budget = AuditSettings(**more)
    return run_audit(policy, jobs, folder, facts, settings(task), SILENT, budget, lend)


def audit_fake(
    name: str, robot: Embodiment, folder: Path, lend: dict[str, list[Recording]], **more: Any
) -> Audit:
    import fakes
    import stub_servers

    task = "Told" if name == "goal" else "Cues"
    with stub_servers.serving("robomme", stub_servers.Stub(policy=fakes.FAKES[name])) as url:
        connection = ConnectionSettings(timeout_s=10, open_s=5, name=name)
        policy = RemotePolicy(ServerChoice(url, "robomme", connection), robot)
        try:
            return audit(policy, task, folder, lend[task], **more)
        finally:
            policy.close()


@pytest.mark.parametrize(
    ("fake", "verdict", "losses"),
    [
        ("video", "content", {"nothing remembered", "no video", CONTENT, "wrong scene first"}),
        ("clock", "clock", {"nothing remembered", TIME}),
        ("memoryless", "nothing", set()),
        ("own_actions", "own chunks", {"nothing remembered", "own chunks lost"}),
        ("last_frame", "last frames", {"nothing remembered", "last frames pushed out", CONTENT}),
        ("goal", "goal", {"another goal"}),
    ],
)
def test_each_planted_policy_is_named(
    fake: str,
    verdict: str,
    losses: set[str],
    robot: Embodiment,
    recordings: dict[str, list[Recording]],
    tmp_path: Path,
) -> None:
    result = audit_fake(fake, robot, tmp_path, recordings)
    assert result.conclusion.verdict == verdict
    beyond = {label for label, loss in result.card.arms.items() if loss.beyond_noise}
    assert losses <= beyond
    assert beyond <= losses or fake in ("video", "clock")
    page = result.page.read_text()
    assert VERDICTS[verdict] in page.replace("&#x27;", "'") and f"Audit of {fake}" in page
    meaning = "begins anew at each decision, with the current frame alone"
    assert meaning in " ".join(page.split()), "the page lacks what an arm does"
    content = json.loads((tmp_path / "audit.json").read_text())
    assert content["conclusion"]["verdict"] == verdict
    assert content["server"]["protocol"] == "robomme"
    # Demonstrations go to a side each: half of the scenes by chance, which one cannot be told.
    assert 0.2 < content["card"]["references"][RANDOM] < 0.8


class ReadsMemory(MMEPolicy):
    """Goes where the light was in the oldest frame it remembers; or, as a clock, by the newest
    frame's number.
    """

    is_clock = False
    direction: Tensor
    middle: Tensor

    def predict_chunk(
        self, batch: Any, episodes: Any, noise: Any, steps: int | None = None
    ) -> Tensor:
        histories = [episode.gather_selection() for episode in episodes]
        return self.sample_actions(replace(batch, history=stack_history(histories)))

    def sample_actions(
        self, batch: Any, draws: Any = None, steps: Any = None, **others: Any
    ) -> Tensor:
        history = batch.history
        sides = []
        for features, positions, mask in zip(
            history.features.float(), history.positions, history.mask, strict=True
        ):
            frames = positions[:, 0].masked_fill(~mask, torch.inf)
            if not mask.any():
                sides.append(1.0)
            elif self.is_clock:
                newest = float(positions[:, 0].masked_fill(~mask, -torch.inf).max())
                sides.append(-1.0 if newest < 29 else 1.0)
            else:
                oldest = features[frames == frames.min()].flatten()  # its four tokens
                sides.append(float(torch.sign((oldest - self.middle) @ self.direction)))
        width = self.embodiment.action.width
        return torch.tensor(sides)[:, None, None].expand(-1, self.horizon, width)


def remembering(scenes: dict[int, Any], env: str) -> ReadsMemory:
    """A policy whose memory is read by rule: the features of both lights are measured, not
    learned.

    scenes: side → image of its light.
    """
    built = small_policy(
        "framesamp_modul",
        env=env,
        backbone={"vision": {**SMALL_VISION, "patch_size": 8}},
        memory={"budget": 64, "grid": 2},
    )
    policy = ReadsMemory(
        built.backbone, built.memory, built.integration, built.processor, built.config
    )
    features = {}
    for side, image in scenes.items():
        episode = policy.start_episode("follow the light")
        episode.observe({"top": image[None]}, np.zeros((1, 1), np.float32))
        tokens = episode.gather_selection()
        features[side] = tokens.features[tokens.mask].float().flatten()
    policy.direction = features[1] - features[-1]
    policy.middle = (features[1] + features[-1]) / 2
    return policy.eval()


@pytest.fixture(scope="module")
def in_cues(examples: pytest.MonkeyPatch) -> ReadsMemory:
    import cues

    images = {}
    for side in (-1, 1):
        scene = cues.Cues(told=False)
        scene.side, scene.time = side, 0
        images[side] = scene.observe()["top"]
    return remembering(images, "cues")


@pytest.fixture(scope="module")
def in_blink(examples: pytest.MonkeyPatch) -> ReadsMemory:
    import blink

    images = {}
    for side in (-1, 1):
        scene = blink.Blink()
        scene.side, scene.arm = side, 0.0
        images[side] = scene.observe(light=True)["top"]
    return remembering(images, "blink")


@contextmanager
def served(policy: MMEPolicy, protocol: str) -> Iterator[RemotePolicy]:
    """The policy behind this library's server, or behind a stub that has the released server's
    messages, which are openpi's and a buffer.
    """
    connection = ConnectionSettings(timeout_s=60, open_s=5)
    with ExitStack() as stack:
        if protocol == "mme_vla":
            server = stack.enter_context(Served(policy, flow_steps=None)).server
            url = f"ws://127.0.0.1:{server.port}"
        else:
            import stub_servers
            from served_checkpoint import behind

            stub = stub_servers.Stub(policy=behind(policy))
            url = stack.enter_context(stub_servers.serving(protocol, stub))
        remote = RemotePolicy(ServerChoice(url, protocol, connection), policy.embodiment)
        stack.callback(remote.close)
        yield remote


COMPARED = (FORGET, TIME, CONTENT, WRONG_SCENE)
"""Arms that change the same in both cards: in the memory, or in what is sent."""


def check_agreement(inside: dict[str, Any], outside: dict[str, Any]) -> None:
    """Compare two cards, as their JSON has them: each loss lies within the other's interval, and is
    beyond noise in both or in none.
    """
    assert inside["scenes"] == outside["scenes"]
    assert inside["matched"] == outside["matched"]
    for label in COMPARED:
        one, other = inside["arms"][label], outside["arms"][label]
        assert one["low"] <= other["loss"] <= one["high"], label
        assert other["low"] <= one["loss"] <= other["high"], label
        assert one["beyond_noise"] == other["beyond_noise"], label


@pytest.mark.parametrize(
    ("task", "is_clock", "protocol"),
    slow_or_nightly(
        [
            ("Cues", False, "mme_vla"),
            ("Cues", True, "mme_vla"),
            ("Blink", False, "mme_vla"),
            ("Blink", False, "robomme"),
        ],
        lambda case: case == ("Blink", False, "robomme"),
    ),
)
def test_the_cards_from_outside_and_from_inside_agree(
    task: str,
    is_clock: bool,
    protocol: str,
    in_cues: ReadsMemory,
    in_blink: ReadsMemory,
    recordings: dict[str, list[Recording]],
    tmp_path: Path,
) -> None:
    policy = {"Cues": in_cues, "Blink": in_blink}[task]
    policy.is_clock = is_clock
    lend = recordings[task]
    jobs = choose_jobs(task, 14, "test", ENVS[task])
    facts = facts_of(policy, None, None, settings(task), None)
    plan = ProbePlan(lend=lend, jobs=jobs)
    inside = run_card(policy, plan, tmp_path / "inside", facts, settings(task), SILENT)
    with served(policy, protocol) as remote:
        outside = audit(remote, task, tmp_path / "outside", lend)
    assert outside.conclusion.verdict == ("clock" if is_clock else "content")
    assert inside.matched == 1
    inner, outer = inside.memory_or_clock, outside.card.memory_or_clock
    assert inner.score == outer.score == (1.0 if is_clock else 0.0)
    check_agreement(asdict(inside), asdict(outside.card))


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
def test_the_cards_of_the_shipped_policy_agree(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(evaluation, "VecEnv", PROCESSES)  # which `examples` replaces
    place = locate_checkpoint("nano16")
    policy = MMEPolicy.from_pretrained(place).eval()
    recorded = commands.run(
        "mme_vla",
        "record",
        "tasks=[VideoUnmask,SwingXtimes]",
        "episodes=0-2",
        "split=val",
        f"output={tmp_path / 'val'}",
    )
    assert recorded.returncode == 0, recorded.stderr
    lend = all_recordings(open_sources(str(tmp_path / "val"), policy.embodiment))
    limits = RolloutSettings(
        seed=7, split="further_easy", max_actions=20, only_possible=True, workers=1
    )
    jobs = choose_jobs("VideoUnmask", list(range(2, 8)), limits.split)
    plan = ProbePlan(lend=lend, jobs=jobs)
    facts = facts_of(policy, None, place, limits, None)
    inside = run_card(policy, plan, tmp_path / "inside", facts, limits, SILENT)
    with served(policy, "mme_vla") as remote:
        facts = facts_of(remote, None, None, limits, None)
        arms = {label: INTERVENTIONS[label] for label in COMPARED}
        outside = measure_card(
            remote, plan, tmp_path / "outside", facts, limits, SILENT, interventions=arms
        )
    check_agreement(asdict(inside), asdict(outside))
    assert conclude(outside, 1.0, 1).verdict == "content"


def test_a_policy_is_audited_alike_here_and_behind_a_server(
    in_cues: ReadsMemory, recordings: dict[str, list[Recording]], tmp_path: Path
) -> None:
    in_cues.is_clock = False

    def strip(card: Card) -> dict[str, Any]:
        return {label: (loss.success, loss.lost) for label, loss in card.arms.items()}

    here = audit(in_cues, "Cues", tmp_path / "here", recordings["Cues"], scenes=6)
    with served(in_cues, "mme_vla") as remote:
        there = audit(remote, "Cues", tmp_path / "there", recordings["Cues"], scenes=6)
    assert strip(here.card) == strip(there.card)


def test_minutes_choose_the_scenes_once_and_say_what_they_cannot_resolve(
    robot: Embodiment, recordings: dict[str, list[Recording]], tmp_path: Path
) -> None:
    result = audit_fake("video", robot, tmp_path, recordings, minutes=1e-4)
    assert result.card.scenes == 3
    assert "resolve=0.3 was not reached with 3 scenes" in " ".join(result.conclusion.sentences)
    records = {path: path.read_bytes() for path in tmp_path.rglob("episodes*.jsonl")}
    assert len(records) == len(result.card.arms) + 3
    again = audit_fake("video", robot, tmp_path, recordings, minutes=100)
    assert again.card.scenes == 3, "the plan is that of the first command"
    assert {path: path.read_bytes() for path in records} == records
    for path in find_records([tmp_path]):
        assert len(read_records(path)) == 3


@pytest.mark.parametrize(("n_recorded", "seconds"), [(0, 2.0), (2, 6.0), (3, 9.0)])
def test_scenes_of_an_interrupted_pilot_do_not_make_a_scene_look_quick(
    n_recorded: int, seconds: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recorded = [SimpleNamespace(seconds=SimpleNamespace(total=9.0))]
    ended = dict.fromkeys(range(n_recorded), recorded)
    clock = iter([100.0, 106.0])
    monkeypatch.setattr(audit_module, "ended_scenes", lambda *_: ended)
    monkeypatch.setattr(audit_module, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    (tmp_path / "online" / "unprobed").mkdir(parents=True)
    jobs = choose_jobs("PickXtimes", 6, "test")
    limit = seconds * audit_module.N_RUNS * 4 / 60  # of four scenes and a little
    audit_module._affordable_scenes(jobs, tmp_path, 1.01 * limit, lambda _: None)
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert plan == {"scenes_a_task": 4, "seconds_a_scene": seconds}


def test_scenes_are_as_many_as_the_loss_needs() -> None:
    assert [resolution(n, 1) for n in (8, 10, 20)] == [0.5, 0.4, 0.2]
    assert resolution(3, 1) > 1
    assert scenes_a_task(AuditSettings(resolve=0.4), 1) == 10
    assert scenes_a_task(AuditSettings(resolve=0.4), 4) == 4
    assert scenes_a_task(AuditSettings(resolve=0.3), 16) == 2


@pytest.mark.parametrize("tasks", [1, 2, 5, 10])
def test_the_smallest_loss_beyond_noise_is_the_cards_for_as_many_tasks(tasks: int) -> None:
    # Of one scene a task nothing can be resampled: the exact interval needs more of them.
    smallest = {1: 4, 2: 4, 5: 6, 10: 6}[tasks] / 10
    assert resolution(10, tasks) == pytest.approx(smallest)
    keys = [EpisodeKey(str(number % tasks), number) for number in range(10)]
    solved = dict.fromkeys(keys, 1.0)
    for lost in range(1, 11):
        arm = solved | dict.fromkeys(keys[:lost], 0.0)
        loss = grade(solved, {"": arm}, solved).arms[""]
        assert loss.beyond_noise == (loss.loss > smallest - 1e-9)
