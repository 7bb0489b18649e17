"""A memory and a task of one's own, in a package of one's own: they work in every command, once the
user says so.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from helpers import REPOSITORY
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.cli import inspect
from mme_vla.cli.weights import convert
from mme_vla.config import plugins
from mme_vla.config.composition import compose
from mme_vla.config.plugins import TRUST_FLAG, TRUST_WORD, plugins_of
from mme_vla.config.plugins import import_plugins as import_modules
from mme_vla.envs import metadata
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions, choose_jobs
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.probing.cli import analyse
from mme_vla.testing.small import SMALL_VISION, random_batch, unit_stats

MEMORY = '''
"""The newest frames, weighted by their age: with a table that no checkpoint holds."""
from dataclasses import replace

import numpy as np
import torch
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.base import PerceptualMemory
from mme_vla.registry import MEMORIES


@MEMORIES.register("{name}")
class Fading(PerceptualMemory):
    def __init__(self, d_vision, width, budget=32, grid=4):
        super().__init__(d_vision, width, budget, StorageSpec(grid))
        self.register_buffer("fade", torch.linspace(1, 0.5, budget), persistent=False)
        self.ages = torch.arange(budget)

    def select(self, history, step, rng=None):
        frames = np.arange(max(step - 1, 0), step + 1)
        return np.stack(np.meshgrid(frames, np.arange(16), indexing="ij"), axis=-1).reshape(-1, 2)

    def forward(self, history):
        tokens = super().forward(history)
        weights = self.fade[: tokens.tokens.shape[1]] * (self.ages[: tokens.tokens.shape[1]] >= 0)
        return replace(tokens, tokens=tokens.tokens * weights[:, None])
'''
TASK = '''
"""Nothing to do but wait."""
from mme_vla.envs.subtasks import SubTask
from mme_vla.registry import TASKS
from mme_vla.envs.task import Task


@TASKS.register("{name}")
class Stay(Task):
    def build(self, draws):
        pass

    def subtasks(self):
        return [SubTask("stay", done=lambda: False, run=lambda _: None)]

    def goals(self):
        return ["stay where you are"]
'''
USER_PACKAGE = "own_parts"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a package of one's own, and a checkpoint of its memory after one update, in
    `checkpoint`.
    """
    folder = tmp_path_factory.mktemp("place")
    (folder / USER_PACKAGE).mkdir()
    (folder / USER_PACKAGE / "__init__.py").write_text("")
    (folder / USER_PACKAGE / "memory.py").write_text(MEMORY.format(name="fading"))
    (folder / USER_PACKAGE / "task.py").write_text(TASK.format(name="Stay"))
    (folder / "configs" / "model").mkdir(parents=True)
    (folder / "configs" / "model" / "fading.yaml").write_text(
        "# @package _global_\ndefaults: [{/integration: context}]\nname: fading\nmemory: {name:"
        f" fading}}\nplugins: [{USER_PACKAGE}.memory]\n"
    )
    before = list(sys.path)
    sys.path.insert(0, str(folder))
    try:
        small = {"vision": {**SMALL_VISION, "patch_size": 16}}
        policy = build_policy("fading", config_dir=folder / "configs", backbone=small)
    finally:
        sys.path[:] = before
        # not asked of other tests' worker processes
        plugins._imported.pop(f"{USER_PACKAGE}.memory", None)
    policy.require_processor().stats = unit_stats()
    policy(random_batch(policy, 1, valid=32))[0].backward()
    torch.optim.SGD(policy.parameters(), 1e-3).step()
    policy.save_pretrained(folder / "checkpoint")
    return folder


@pytest.fixture
def foreign_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder, in a process that has not imported what lies there."""
    for name in [name for name in sys.modules if name.split(".")[0] == USER_PACKAGE]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry != str(place)])
    monkeypatch.chdir(place)
    return place


def opened_by_python(folder: Path, trust: bool) -> None:
    MMEPolicy.from_pretrained(folder, trust_plugins=trust)


def opened_by_inspect(folder: Path, trust: bool) -> None:
    inspect.main(compose("inspect", [f"checkpoint={folder}", *[TRUST_WORD] * trust]))


def opened_by_convert(folder: Path, trust: bool) -> None:
    convert(folder, folder.parent / "converted", dtype="bfloat16", trust_plugins=trust)


def opened_by_analyse(folder: Path, trust: bool) -> None:
    words = [
        "attention",
        "--checkpoint",
        str(folder),
        "--episodes",
        "0",
        "--most",
        "1",
        *[TRUST_WORD] * trust,
    ]
    arguments = analyse._parser().parse_args(analyse.trust_as_flag(words))
    arguments.run(arguments)


@pytest.mark.parametrize(
    "opened", [opened_by_python, opened_by_inspect, opened_by_convert, opened_by_analyse]
)
def test_a_checkpoints_plugins_are_imported_only_when_the_user_says_so(
    opened: Callable[[Path, bool], None], foreign_run: Path
) -> None:
    with pytest.raises(
        UserError, match=rf"plugin {USER_PACKAGE}\.memory.*{TRUST_FLAG}.*trust_plugins=True"
    ):
        opened(foreign_run / "checkpoint", False)
    assert f"{USER_PACKAGE}.memory" not in sys.modules
    opened(foreign_run / "checkpoint", True)


def test_what_constructors_compute_is_there_after_loading(foreign_run: Path) -> None:
    policy = MMEPolicy.from_pretrained(foreign_run / "checkpoint", trust_plugins=True)
    memory = policy.require_memory()
    assert torch.equal(memory.fade, torch.linspace(1, 0.5, 32))
    assert torch.equal(memory.ages, torch.arange(32))
    assert torch.isfinite(policy(random_batch(policy, 1, valid=32))[0])
    before = torch.random.get_rng_state()
    MMEPolicy.from_pretrained(foreign_run / "checkpoint", trust_plugins=True)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("names", ["[1]", "{a: 1}", "['rm -rf']", "3", "['../x']"])
def test_plugins_are_names_of_modules(names: str) -> None:
    from omegaconf import OmegaConf

    with pytest.raises(UserError, match="list of modules"):
        plugins_of(OmegaConf.create(f"plugins: {names}"), "the configuration")


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("mani_skill") is None, reason="the simulator (extra `sim`) is not installed"
)
def test_a_memory_and_a_task_of_the_user_are_evaluated_in_a_worker_process(
    foreign_run: Path, tmp_path: Path
) -> None:
    policy = MMEPolicy.from_pretrained(foreign_run / "checkpoint", trust_plugins=True)
    import_modules([f"{USER_PACKAGE}.task"])
    settings = RolloutSettings(max_steps=3, execute=2, flow_steps=1, workers=1, render=False)
    facts = RunKey("fading", 1, 42)
    jobs, options = choose_jobs("Stay", 1), RunOptions(show_progress=False)
    records = EvaluationRun(policy, jobs, tmp_path, facts, settings, options).run().records
    assert [(r.task, r.outcome, r.steps) for r in records] == [("Stay", "timeout", 4)]


def test_episodes_of_a_custom_task_have_separate_seeds(foreign_run: Path) -> None:
    if find_spec("mani_skill") is None:
        pytest.skip("the simulator (extra `sim`) is not installed")
    import_modules([f"{USER_PACKAGE}.task"])
    seeds = {spec.seed for split in ("val", "test") for spec in metadata.episodes("Stay", split)}
    benchmark = {
        spec.seed for split in ("val", "test") for spec in metadata.episodes("PickXtimes", split)
    }
    assert len(seeds) == 100
    assert not seeds & benchmark
    assert [job.episode for job in choose_jobs("Stay", [3], "val")] == [3]


@pytest.mark.slow
def test_hydra_imports_nothing_from_the_folder_one_stands_in(tmp_path: Path) -> None:
    (tmp_path / "hydra_plugins" / "strange").mkdir(parents=True)
    (tmp_path / "hydra_plugins" / "strange" / "__init__.py").write_text(
        "open('ran', 'w').close()\n"
    )
    code = (
        "import mme_vla.config.composition; from hydra.core.plugins import Plugins;"
        " Plugins.instance()"
    )
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
    assert not (tmp_path / "ran").exists()


def test_a_file_where_one_stands_takes_no_place_of_an_installed_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_plugin_beside.py").write_text("import tabnanny\n")
    (tmp_path / "tabnanny.py").write_text(
        "raise AssertionError('this is not the installed module')\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    for name in ("tabnanny", "own_plugin_beside"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import_modules(["own_plugin_beside"])
    assert hasattr(sys.modules["tabnanny"], "check")
    sys.modules.pop("own_plugin_beside")
    plugins._imported.pop("own_plugin_beside")
