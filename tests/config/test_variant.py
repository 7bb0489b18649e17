"""A composition is called what it is, in folders, configurations and records, and results keep
compositions apart.
"""

import json
import textwrap
from pathlib import Path

import pytest

from helpers import commands
from mme_vla.config.composition import compose
from mme_vla.evaluation.records import EpisodeRecord, complete_compositions
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.store import read_folders
from mme_vla.policy.build import build_policy
from mme_vla.policy.saving import composition_digest

OWN = {
    "memory/mine.yaml": "{name: mine, budget: 64, spacing: 4}",
    "model/mine_context.yaml": """
        # @package _global_
        defaults: [{/memory: mine}, {/integration: context}]
        name: mine_context
        """,
}


def name_of(*words: str, extra: Path | None = None) -> str:
    return str(compose("train", words, extra_dirs=[] if extra is None else [extra]).name)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["memory=framesamp", "integration=modulator"], "framesamp_modul"),
        (["memory=none", "integration=none"], "pi05"),
        (["model=framesamp_modul", "backbone=pi05", "memory.budget=256"], "framesamp_modul"),
        (["model=hybrid"], "hybrid"),
        (["model=rmt_expert", "integration=context"], "rmt_context"),
        (["model=framesamp_modul", "memory.pooling=max"], "framesamp_modul-pooling_max"),
        (
            ["memory=framesamp", "integration=modulator", "memory.pooling=max"],
            "framesamp_modul-pooling_max",
        ),
        (["model=tokendrop_expert", "memory.causal=false"], "tokendrop_expert-causal_false"),
        (["model=pi05", "name=my_own", "processor.prompt=subgoal"], "my_own"),
    ],
)
def test_a_composition_is_called_what_it_is(words: list[str], name: str) -> None:
    assert name_of(*words) == name


@pytest.fixture
def config_folder(tmp_path: Path) -> Path:
    for file, text in OWN.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(textwrap.dedent(text))
    return tmp_path


def test_custom_memories_are_named_by_their_files_and_components(config_folder: Path) -> None:
    assert name_of("model=mine_context", extra=config_folder) == "mine_context"
    assert (
        name_of("model=mine_context", "memory.spacing=2", extra=config_folder)
        == "mine_context-spacing_2"
    )
    assert name_of("memory=mine", "integration=modulator", extra=config_folder) == "mine_modulator"
    assert (
        name_of("memory=mine", "integration=modulator", "memory.spacing=2", extra=config_folder)
        == "mine_modulator-spacing_2"
    )
    assert name_of("memory=mine", "integration=context", extra=config_folder) == "mine_context"


@pytest.mark.slow
def test_a_command_and_its_sweep_work_in_folders_of_the_true_name(tmp_path: Path) -> None:
    app = tmp_path / "app.py"
    app.write_text(
        'from mme_vla.cli.command import cli\n@cli("train")\ndef main(cfg):\n    from'
        ' hydra.core.hydra_config import HydraConfig\n    print("at", cfg.name,'
        ' cfg.output.split("/")[1], HydraConfig.get().runtime.output_dir)\nmain()\n'
    )
    words = ["integration=modulator", "memory=framesamp"]
    done = commands.run(str(app), *words, cwd=tmp_path)
    assert done.stdout.startswith(
        f"at framesamp_modul framesamp_modul {tmp_path}/outputs/framesamp_modul/"
    ), done
    words = ["--multirun", "integration=modulator", "memory=framesamp,tokendrop"]
    done = commands.run(str(app), *words, cwd=tmp_path)
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith("at ")]
    assert [(line[1], Path(line[3]).name) for line in lines] == [
        ("framesamp_modul", "0_framesamp_modul"),
        ("tokendrop_modul", "1_tokendrop_modul"),
    ], done.stderr


def test_the_digest_tells_compositions_apart_and_nothing_else() -> None:
    config = json.loads(json.dumps(build_policy("framesamp_modul", device="meta").config))
    digest = composition_digest(config)
    unrelated = {
        **config,
        "name": "x",
        "card": {"data": "y"},
        "plugins": ["z"],
        "later_option": None,
    }
    unrelated["processor"] = {**config["processor"], "tokenizer": "tokenizer.model"}
    unrelated["memory"] = {**config["memory"], "later_option": None}
    assert composition_digest(unrelated) == digest
    for section, change in (
        ("memory", {"grid": 8}),
        ("integration", {"num_heads": 2}),
        ("backbone", {"depth": 9}),
    ):
        assert composition_digest({**config, section: {**config[section], **change}}) != digest


def record(episode: int, won: bool, **more: object) -> EpisodeRecord:
    outcome = "success" if won else "fail"
    return EpisodeRecord(
        "tokendrop_expert", 350, 7, "BinFill", episode, episode, "easy", outcome, 9, **more
    )  # type: ignore[arg-type]


def test_results_never_average_two_configurations_of_one_name() -> None:
    records = [
        record(e, won, composition=digest)
        for digest, won in (("a" * 12, True), ("b" * 12, False))
        for e in (0, 1)
    ]
    results = aggregate(records, Protocol(("BinFill",), 2))
    assert {m.label: m.average.mean for m in results.methods} == {
        "tokendrop_expert#aaaaaaaaaa": 100.0,
        "tokendrop_expert#bbbbbbbbbb": 0.0,
    }
    assert (
        "2 different configurations are called tokendrop_expert; they are not averaged"
        in results.notes[0]
    )


def test_records_of_earlier_versions_load_and_stay_apart_from_new_ones(tmp_path: Path) -> None:
    old = json.loads(record(0, True).to_json())
    del old["composition"], old["crc32"]
    assert EpisodeRecord.from_json(json.dumps(old)).composition is None
    mixed = [
        record(0, True),
        record(1, True),
        *(record(e, False, composition="c" * 12) for e in (0, 1)),
    ]
    results = aggregate(mixed, Protocol(("BinFill",), 2))
    assert [m.label for m in results.methods] == [
        "tokendrop_expert#unrecorded",
        "tokendrop_expert#cccccccccc",
    ]
    alone = aggregate(mixed[:2], Protocol(("BinFill",), 2))
    assert [m.label for m in alone.methods] == ["tokendrop_expert"]


def test_a_run_begun_before_there_were_digests_is_one_run(tmp_path: Path) -> None:
    for name, digest in (
        ("episodes-0of2.jsonl", record(0, True)),
        ("episodes-1of2.jsonl", record(1, True, composition="d" * 12)),
    ):
        (tmp_path / name).write_text(digest.to_json() + "\n")
    assert {r.composition for r in read_folders(sorted(tmp_path.glob("*.jsonl")))} == {"d" * 12}
    two = [
        record(0, True),
        record(1, True, composition="d" * 12),
        record(2, True, composition="e" * 12),
    ]
    assert complete_compositions(two)[0].composition is None
