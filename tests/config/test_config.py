"""Composition of the YAML tree, and the errors of mistyped overrides."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import yaml
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from helpers import commands
from mme_vla.cli.command import check_overrides, run_configured
from mme_vla.config.composition import compose, resolved
from mme_vla.config.naming import expand_overrides
from mme_vla.config.plugins import import_plugins, plugins_of
from mme_vla.config.trees import library_files, library_trees
from mme_vla.errors import UserError

TREE = {
    "demo.yaml": """
        defaults: [{train: default}, {memory: none}, {model: small}, _self_]
        plugins: []
        seed: 1
        fast: false
        """,
    "train/default.yaml": "{lr: 1e-3, steps: 10, clip: {norm: 1.0}, note: null}",
    "memory/none.yaml": "{}",
    "memory/tokendrop.yaml": "{name: tokendrop, budget: 512}",
    "model/small.yaml": """
        # @package _global_
        defaults: [{override /memory: none}]
        name: small
        """,
    "model/tokendrop_expert.yaml": """
        # @package _global_
        defaults: [{override /memory: tokendrop}]
        name: tokendrop_expert
        """,
}


def write_tree(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(textwrap.dedent(text))
    return folder


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return write_tree(tmp_path / "tree", TREE)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "model=tokendrp_expert",
            "Unknown model 'tokendrp_expert'. Did you mean 'tokendrop_expert'? Known: small,",
        ),
        (
            "train.lrr=1",
            (
                "Unknown config key 'train.lrr'. In 'train': Did you mean 'lr'? Known: clip, lr,"
                " note, steps."
            ),
        ),
        ("~train.lrr", "Did you mean 'lr'?"),
        ("lr=1", "Unknown config key 'lr'. Did you mean 'train.lr'?"),
        ("modle=small", "Unknown config key 'modle'. Did you mean 'model'?"),
        ("memory.budget=64", "'memory' has no keys under these choices"),
        ("train.clip.norm.x=1", "'train.clip.norm' is a value"),
        ("train.steps=many", "'train.steps' is a number (default 10)"),
        ("train.clip=1", "'train.clip' is a section with the keys norm"),
        (
            "train.clip={nrm: 1}",
            "Unknown config key 'train.clip.nrm'. In 'train.clip': Did you mean 'norm'?",
        ),
        ("train.clip={of: 1}", "Known: norm. To add it: +train.clip.of=…"),
        ("fast=1", "'fast' is true or false"),
        ("train=3", "names no config of the group. Known: default."),
        ("=3", "the key is missing"),
        ("train.steps=[1", "Cannot read the override 'train.steps=[1'"),
    ],
)
def test_a_mistake_is_answered_with_the_near_names(tree: Path, override: str, message: str) -> None:
    with pytest.raises(UserError) as caught:
        compose("demo", [override], directory=tree)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "words",
    [
        ["model=framesamp_modul", "~memory.name"],
        ["model=pi05", "integration=modulator", "+memory.budget=64"],
    ],
)
def test_a_memory_without_a_name_is_reported(words: list[str]) -> None:
    with pytest.raises(UserError, match="`memory` has no name, only budget"):
        compose("train", words)


def test_a_broken_file_and_a_missing_folder_are_named(tree: Path) -> None:
    (tree / "model" / "broken.yaml").write_text("key: [1\nother: 2")
    with pytest.raises(UserError, match=r"Cannot read a config file.*\n?.*broken\.yaml"):
        compose("demo", ["model=broken"], directory=tree)
    with pytest.raises(UserError, match=r"'demoo'\. Did you mean 'demo'"):
        compose("demoo", directory=tree)
    with pytest.raises(UserError, match="nowhere' does not exist"):
        compose("demo", directory=tree / "nowhere")


@pytest.mark.parametrize(
    "words",
    [
        ["seed=5", "--cfg", "job", "train.lr=2"],
        ["seed=5", "train.lr=2", "-c", "job"],
        ["--cfg=job", "seed=5", "train.lr=2"],
    ],
)
def test_options_may_stand_anywhere(
    words: list[str], tree: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(sys, "argv", ["app", *words])
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)  # taken back at the end
    run_configured("demo", lambda cfg: None, tree)
    printed = capfd.readouterr().out
    assert "seed: 5" in printed and "lr: 2" in printed


def test_every_choice_of_a_sweep_is_checked(tree: Path) -> None:
    check_overrides(
        "demo",
        [
            "model=small,tokendrop_expert",
            "train.steps=range(1,4)",
            "seed=choice(1,2)",
            "train.lr=interval(0,1)",
        ],
        directory=tree,
    )
    with pytest.raises(UserError, match="Unknown model 'third'"):
        check_overrides(
            "demo", ["model=small,tokendrop_expert,third", "train.lr=1,2"], directory=tree
        )


@pytest.mark.parametrize("word", ["split=stress:count=2", "split=twin:stress:count=2"])
def test_the_amount_of_a_dial_needs_no_quotes(word: str) -> None:
    value = word.partition("=")[2]
    for form in (word, f"split='{value}'", f'split="{value}"'):
        assert compose("evaluate", ["checkpoint=nano", form]).split == value
    sweep = expand_overrides([f"{word},test"])
    assert [cfg.split for cfg in check_overrides("evaluate", sweep)] == [value, "test"]


def test_other_words_of_a_command_line_stay_as_they_are() -> None:
    words = ["seed=3", "~memory", "note='a:b=1,a:b=2'", "tasks=[a:b=1]", "output=a=1", "with=x:a=b"]
    assert expand_overrides(words) == words


def test_a_sweep_of_any_command_writes_under_outputs() -> None:
    for file in library_files("").values():
        if "hydra" in (cfg := OmegaConf.load(file)):
            # A job's folder is its number: the sweep may change what the name would follow from.
            (key,) = OmegaConf.to_container(cfg.hydra)["sweep"]
            assert key == "dir" and "dir: outputs/sweeps/" in file.read_text(), file


def test_sections_whose_keys_are_free_are_filled_by_a_mapping() -> None:
    for command, word in (
        ("train", "train.part_lr={vlm: 0.1}"),
        ("evaluate", "connection.keys={front: observation/left}"),
        ("probe", "references={memoryless: outputs/present}"),
        ("audit", "references={demonstrator: outputs/motions}"),
        ("nano", "demonstrations_of={StopCube: {easy: 3}}"),
    ):
        key, _, value = word.partition("=")
        assert OmegaConf.select(compose(command, [word]), key) == yaml.safe_load(value), word


def test_the_same_words_give_equal_but_separate_configurations() -> None:
    words = [
        "model=framesamp_modul",
        "train.steps=3",
        "output=runs/one",
    ]  # the default folder's name holds the time
    one, other = (compose("train", words) for _ in range(2))
    assert one == other
    one.train.steps = 7
    one.memory.budget = 64
    again = compose("train", words)
    assert again == other and again.train.steps == 3


def test_further_folders_add_choices(tree: Path, tmp_path: Path) -> None:
    mine = write_tree(tmp_path / "mine", {"memory/mine.yaml": "{name: mine, budget: 7}"})
    assert compose("demo", ["memory=mine"], directory=tree, extra_dirs=[mine]).memory.budget == 7
    with pytest.raises(UserError, match="Unknown memory 'mine'"):
        compose("demo", ["memory=mine"], directory=tree)


def test_composing_leaves_a_running_hydra_as_it_was(tree: Path) -> None:
    with initialize_config_dir(str(tree), version_base="1.3", job_name="outer"):
        outer = GlobalHydra.instance().hydra
        compose("demo", directory=tree)
        with pytest.raises(UserError):
            compose("demo", ["model=no"], directory=tree)
        assert GlobalHydra.instance().hydra is outer


def test_plugins_of_several_files_add_up(tmp_path: Path) -> None:
    custom = {
        "model/own.yaml": (
            "# @package _global_\ndefaults: [{/memory: mine}]\nname: own\nplugins: [one]\n"
        ),
        "memory/mine.yaml": "# @package _global_\nmemory: {name: framesamp}\nplugins: [two, one]\n",
    }
    mine = write_tree(tmp_path / "mine", custom)
    assert compose("train", ["model=own"], extra_dirs=[mine]).plugins == ["two", "one"]
    assert compose("train", ["model=own", "plugins=[three]"], extra_dirs=[mine]).plugins == [
        "three"
    ]


def test_plugins_are_imported_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_plugin_module.py").write_text("import sys\nloaded = True\n")
    (tmp_path / "my_broken_plugin.py").write_text("import no_such_module_here\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    import_plugins(["my_plugin_module"])
    assert sys.modules["my_plugin_module"].loaded
    with pytest.raises(UserError, match="No module named 'my_plugin'"):
        import_plugins(["my_plugin"])
    with pytest.raises(ModuleNotFoundError, match="no_such_module_here"):
        import_plugins(["my_broken_plugin"])
    assert plugins_of(OmegaConf.create({}), "a configuration") == []


APP = """
    from pathlib import Path
    from mme_vla.cli.command import run_configured
    from mme_vla.errors import UserError

    def main(cfg):
        if cfg.seed == 13:
            raise UserError("Seed 13 brings [bad] luck.")
        if cfg.seed == 14:
            raise RuntimeError("a bug")
        from hydra.core.hydra_config import HydraConfig
        print("ran", cfg.name, cfg.memory.get("budget"), cfg.train.lr, HydraConfig.get().job.name)

    if __name__ == "__main__":
        run_configured("demo", main, Path({tree!r}))
"""


@pytest.fixture
def app(tree: Path, tmp_path: Path) -> Path:
    file = tmp_path / "app.py"
    file.write_text(textwrap.dedent(APP).format(tree=str(tree)))
    return file


def run(app: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return commands.run(str(app), *arguments, cwd=app.parent)


@pytest.mark.slow
def test_a_user_error_is_printed_completely_and_a_bug_keeps_its_traceback(app: Path) -> None:
    done = run(app, "seed=13")
    assert done.returncode == 2
    assert "Error: Seed 13 brings [bad] luck." in done.stderr
    assert "Traceback" not in done.stderr
    bug = run(app, "seed=14")
    assert bug.returncode == 1
    assert "Traceback" in bug.stderr
    assert "app.py" in bug.stderr


@pytest.mark.slow
def test_a_value_still_needed_is_requested(app: Path, tree: Path) -> None:
    (tree / "train" / "default.yaml").write_text("lr: 1\ndata: ???")
    done = run(app)
    assert done.returncode == 2
    assert "A value is needed for train.data: add train.data=…" in done.stderr
    assert run(app, "--cfg", "job").returncode == 0


@pytest.mark.slow
def test_hydras_switches_still_work(app: Path, tmp_path: Path) -> None:
    mine = write_tree(tmp_path / "mine", {"memory/mine.yaml": "{name: mine, budget: 7}"})
    swept = run(app, "train.lr=1,2", "--multirun", "memory=mine", "--config-dir", str(mine))
    assert [line for line in swept.stdout.splitlines() if line.startswith("ran")] == [
        "ran small 7 1 app",
        "ran small 7 2 app",
    ], swept.stderr
    output = run(app, "--cfg", "job", "seed=5")
    assert "seed: 5" in output.stdout


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--cfg", "job", "--multirun"], 2, "Use one of --multirun and --cfg"),
        (["--config-dir", "nowhere"], 2, "nowhere' does not exist"),
        (["--help"], 0, "memory=none: none · tokendrop"),
    ],
)
def test_a_command_ends_before_it_starts_a_run(
    words: list[str],
    code: int,
    message: str,
    tree: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture,
) -> None:
    monkeypatch.setattr(sys, "argv", ["app", *words])
    with pytest.raises(SystemExit) as ended:
        run_configured("demo", lambda cfg: None, tree)
    assert ended.value.code == code
    assert message in "".join(capfd.readouterr())


@pytest.mark.parametrize("file", list(library_files("").values()), ids=lambda file: file.stem)
def test_no_key_of_a_command_has_the_name_of_a_folder_that_it_does_not_choose_from(
    file: Path,
) -> None:
    # Hydra reads such a word of the command line as a choice, and refuses it.
    tree = OmegaConf.to_container(OmegaConf.load(file))
    selected = {
        str(key).split("@")[0]
        for entry in tree["defaults"]
        if isinstance(entry, dict)
        for key in entry
    }
    folders = {
        folder.name for tree in library_trees() for folder in tree.iterdir() if folder.is_dir()
    }
    assert not (set(tree) & folders) - selected


def test_a_model_without_a_name_is_refused_by_the_key_that_lacks(tmp_path: Path) -> None:
    text = "# @package _global_\ndefaults: [{/memory: none}, {/integration: none}]\n"
    mine = write_tree(tmp_path / "mine", {"model/own.yaml": text})
    with pytest.raises(UserError, match=r"value of output .* 'name' not found.*`name: "):
        resolved(compose("train", ["model=own"], extra_dirs=[mine]))


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["memory=rmt", "integration=modulator"], "rmt_modulator"),
        (["memory=[tokendrop,{name: rmt}]"], "tokendrop+rmt_expert"),
        (["memory=none", "integration=none"], "memoryless"),
        (["memory.budget=64"], "tokendrop_expert"),
        (["model=pi05", "memory=rmt", "integration=context"], "pi05"),
        (["memory=rmt", "name=mine"], "mine"),
        (["memory.name=3", "integration.name=4"], "3_4"),
        (["experiment=real_robot", "data.sources=[a]", "integration=context"], "framesamp_modul"),
    ],
)
def test_a_composition_without_a_model_has_a_name_of_its_own(words: list[str], name: str) -> None:
    assert compose("train", words).name == name


@pytest.mark.parametrize("word", ["memory.name=ttt", "integration.name=expert"])
def test_another_part_does_not_keep_the_options_of_a_model(word: str) -> None:
    key, _, name = word.partition(".name=")
    with pytest.raises(UserError, match=f"would keep the options of .*Write {key}={name}, which"):
        compose("train", ["model=framesamp_modul", word])
    same = ["memory.name=framesamp", "integration.name=modulator", "name=train"]
    assert compose("train", ["model=framesamp_modul", *same]).name == "train"
