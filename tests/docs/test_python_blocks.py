"""The Python blocks of each page run in order, in an empty folder, with what the reader has at that
point.
"""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import REPOSITORY, commands
from helpers.published import published_folder
from mme_vla import build_policy
from mme_vla.testing.small import unit_stats

pytestmark = pytest.mark.nightly

TESTED_BY = {
    "README.md": "tests/integration/test_model_alone.py",
    "docs/start/python.md": "tests/end_to_end/test_python_page.py",
    "docs/extend/add-a-memory.md": "tests/memory/test_own_memory.py",
    "docs/extend/add-an-integration.md": "tests/integration/test_own_integration.py",
    "docs/extend/add-a-backbone.md": "tests/backbone/test_own_backbone.py",
    "docs/extend/add-a-task.md": "tests/envs/test_own_task.py",
    "docs/extend/your-robot.md": "tests/embodiment/test_your_robot.py",
    "docs/extend/export.md": "tests/policy/test_export.py",
    "docs/extend/auxiliary-losses.md": "tests/end_to_end/test_examples.py",
    "docs/extend/history-transforms.md": "tests/end_to_end/test_examples.py",
    "docs/extend/trajectories.md": "tests/extras/trajectories/test_rollouts.py",
    "docs/start/first-hour.md": "tests/end_to_end/test_first_hour.py",
    "docs/concepts/budget.md": "tests/end_to_end/test_guides.py",
    "docs/concepts/history.md": "tests/end_to_end/test_guides.py",
    "docs/concepts/integration.md": "tests/end_to_end/test_guides.py",
    "docs/concepts/memory.md": "tests/end_to_end/test_guides.py",
    "docs/reference/model-card.md": "tests/end_to_end/test_guides.py",
}
"""Pages whose blocks have a test of their own."""
NOT_RUN = {
    "docs/train/weights.md": "reads published weights of full size",
    "docs/train/diffusion-policy.md": "needs trained weights of full size",
}
INSTEAD = {
    "docs/evaluate/evaluation.md": [
        ('"outputs/framesamp_modul/latest"', 'MMEPolicy.from_pretrained("policy")'),
        ("episodes=5", "episodes=1, max_steps=1, render=False"),
        ("workers=4", "workers=1"),
    ],
    "docs/benchmark/benchmark.md": [
        ("episode=0,", "episode=0, max_steps=2,"),
        ("action = ...", "action = np.zeros(8)"),
    ],
    "docs/start/getting-started.md": [("outputs/tokendrop_expert/latest", "policy")],
    "docs/serve/serving.md": [("8001", "PORT")],
    "docs/train/subgoals.md": [
        (
            '"adapter": "outputs/subgoal/grounded/adapter"',
            '"model": "tiny", "dtype": "float32", "device": "cpu"',
        )
    ],
}
"""Page → texts of its blocks and what the test runs instead: small sizes and paths."""


def blocks(page: str) -> list[str]:
    return re.findall(
        r"^```python\n(.*?)^```", (REPOSITORY / page).read_text(), re.DOTALL | re.MULTILINE
    )


def pages() -> list[str]:
    """Every page with a Python block."""
    files = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
    return [name for file in files if blocks(name := file.relative_to(REPOSITORY).as_posix())]


def saved_policy() -> Any:
    """A tiny policy with memory, also in the folder `policy`."""
    policy = build_policy("tokendrop_expert", backbone="tiny")
    policy.processor.stats = unit_stats()
    policy.save_pretrained("policy")
    return policy


def robot(space: dict[str, Any]) -> None:
    """Observations of a robot, and `run`, which executes one chunk."""
    frames, states = np.zeros((4, 256, 256, 3), np.uint8), np.zeros((4, 8), np.float32)

    def run(actions: np.ndarray) -> Any:
        space["done"] = True
        images = np.zeros((len(actions), 256, 256, 3), np.uint8)
        past = np.zeros((len(actions), 8), np.float32)
        return (images, past) if "client" in space else (images, images, past)

    space.update(
        video=frames, wrist_video=frames, video_states=states, states=states, done=False, run=run
    )
    space.update(front=frames[0], wrist=frames[0], state=states[0], goal="pick up the red cube")


def episode_of(policy: Any) -> Any:
    episode = policy.start_episode("pick up the red cube", seed=0)
    frames = np.zeros((2, 256, 256, 3), np.uint8)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((2, 8), np.float32))
    return episode


def analyses(space: dict[str, Any]) -> None:
    policy = saved_policy()
    space.update(policy=policy, episodes=[episode_of(policy)])


def subgoals(space: dict[str, Any]) -> None:
    pytest.importorskip("transformers", reason="the extra `vlm` is not installed")
    robot(space)
    space.update(frames=space["video"], info=None, policy_episode=episode_of(saved_policy()))


def evaluation(space: dict[str, Any]) -> None:
    from mme_vla import MMEPolicy

    pytest.importorskip("mani_skill", reason="the extra `sim` is not installed")
    saved_policy()
    space.update(MMEPolicy=MMEPolicy, __name__="__main__")


def built_rows(space: dict[str, Any]) -> None:
    done = commands.run(
        "mme_vla",
        "subgoal-build",
        "input=sample",
        "output=subgoal_data",
        "sets=[grounded]",
        cwd=Path.cwd(),
    )
    assert done.returncode == 0, done.stderr


def simulated(space: dict[str, Any]) -> None:
    pytest.importorskip("mani_skill", reason="the extra `sim` is not installed")
    space.update(np=np)


PREPARE: dict[str, Callable[[dict[str, Any]], None]] = {
    "docs/evaluate/evaluation.md": evaluation,
    "docs/evaluate/play.md": simulated,
    "docs/evaluate/results.md": lambda space: space.update(
        folder=published_folder("nano") / "VideoUnmask/rmt_modul"
    ),
    "docs/probe/analyses.md": analyses,
    "docs/benchmark/benchmark.md": simulated,
    "docs/probe/events.md": lambda space: space.update(__name__="__main__"),
    "docs/start/getting-started.md": lambda space: (saved_policy(), robot(space)),
    "docs/serve/serving.md": robot,
    "docs/train/subgoals.md": subgoals,
    "docs/train/subgoal-training.md": built_rows,
}
"""Page → what makes the names that its blocks take as given."""


@pytest.fixture
def server(request: pytest.FixtureRequest) -> Iterator[str]:
    """The port of a server with a tiny policy, for the page that needs one."""
    if request.node.callspec.params["page"] != "docs/serve/serving.md":
        yield ""
        return
    pytest.importorskip("uvicorn", reason="the extra `serve` is not installed")
    process = commands.start(
        "mme_vla.serve",
        "model=pi05",
        "backbone=tiny",
        "port=0",
        "device=cpu",
        stderr=subprocess.STDOUT,
    )
    try:
        assert process.stdout is not None
        line = next(line for line in process.stdout if "ready at" in line)
        yield re.findall(r"ws://127.0.0.1:(\d+)", line)[0]
    finally:
        process.terminate()
        process.communicate()


@pytest.mark.parametrize(
    "page", [page for page in pages() if page not in TESTED_BY.keys() | NOT_RUN.keys()]
)
def test_the_blocks_of_a_page_run(
    page: str, server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["page"])
    space: dict[str, Any] = {"__name__": "page", "__file__": str(tmp_path / "page.py")}
    if page in PREPARE:
        PREPARE[page](space)
    for block in blocks(page):
        for text, other in INSTEAD.get(page, []):
            block = block.replace(text, other.replace("PORT", server))
        exec(compile(block, page, "exec"), space)


def test_each_exception_is_a_page_with_blocks_and_a_test() -> None:
    assert TESTED_BY.keys() | NOT_RUN.keys() | INSTEAD.keys() | PREPARE.keys() <= set(pages())
    assert all((REPOSITORY / test).is_file() for test in TESTED_BY.values())
    for page, replacements in INSTEAD.items():
        assert all(any(text in block for block in blocks(page)) for text, _ in replacements), page


@pytest.mark.parametrize("page", NOT_RUN)
def test_blocks_that_need_large_weights_compile_and_import(page: str) -> None:
    for block in blocks(page):
        compile(block, page, "exec")
        exec("\n".join(re.findall(r"^(?:from|import) .*", block, re.MULTILINE)), {})
