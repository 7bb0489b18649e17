"""Choices of the library's own files are composed once, and values set on them: as Hydra itself would have done."""

import os
import sys
from pathlib import Path

import pytest
from hydra._internal.sources_registry import SourcesRegistry

from mme_vla import UserError
from mme_vla.config.composition import cli, compose
from mme_vla.config.hydra_engine import remembered_files

MEMORY = ["model=framesamp_modul", "memory.budget=5"]


@pytest.mark.parametrize(
    "words",
    [
        [*MEMORY, "memory={budget:4}", "train.lr=1", "train.lr=2"],
        [*MEMORY, "+memory.extra=2", "~memory.extra", "++train.more=1", "backbone.depth=1"],
        ["model=framesamp_modul", "backbone=tiny", "~memory", "name=${seed}"],
        ["model=pi05", "memory=[framesamp,ttt]", "integration=expert"],
        ["model=ttt_expert", "memory.chunk=2", "memory.max_steps=3"],
    ],
)
def test_values_are_set_as_hydra_sets_them(words: list[str], tmp_path: Path) -> None:
    compose("train", words[:1])  # remembered from now on
    quick = compose("train", words)
    anew = compose("train", words, extra_dirs=[tmp_path])  # with a folder more Hydra composes anew
    assert quick != compose("train", words[:1])
    for composed in (quick, anew):
        composed.output = str(Path(composed.output).parent)  # what it is called there is the second it was made in
    assert quick == anew


@pytest.mark.parametrize("word", ["train.lrr=3", "+train.lr=3", "~train.lrr", "train.lr@x=3", "seed=1,2", "~model=pi0"])
def test_what_does_not_fit_is_said_in_the_same_words(word: str, tmp_path: Path) -> None:
    said = []
    for folders in ([], [tmp_path]):
        with pytest.raises(UserError) as refused:
            compose("train", [*MEMORY, word], extra_dirs=folders)
        said.append(str(refused.value))
    assert said[0] == said[1]


def test_what_is_remembered_is_not_what_is_handed_out() -> None:
    compose("train", MEMORY).memory.budget = 6
    assert compose("train", MEMORY).memory.budget == 5 == compose("train", [*MEMORY, "seed=1"]).memory.budget


def test_a_command_reads_no_file_of_the_library_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    files = SourcesRegistry.instance().resolve("file")
    load = files.load_config
    monkeypatch.setattr(
        files, "load_config", lambda self, config_path: read.append(config_path) or load(self, config_path)
    )
    monkeypatch.setattr(sys, "argv", ["train", *MEMORY, f"output={tmp_path}"])
    monkeypatch.setattr(os, "environ", {**os.environ})
    monkeypatch.chdir(tmp_path)
    remembered_files.cache_clear()
    named: list[str] = []
    cli("train")(lambda cfg: named.append(cfg.name))()
    assert named == ["framesamp_modul"]
    assert "memory/framesamp" in read and len(read) == len(set(read))
