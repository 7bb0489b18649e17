"""A composition is called what it is, in folders, configurations and records, and results keep
compositions apart.
"""

import json
from pathlib import Path

import pytest

from mme_vla.config.composition import compose
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.policy.build import build_policy
from mme_vla.policy.saving import composition_digest


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["model=hybrid"], "hybrid"),
        (["model=framesamp_modul", "memory.pooling=max"], "framesamp_modul"),
        (["model=pi05", "name=my_own", "processor.prompt=subgoal"], "my_own"),
    ],
)
def test_a_run_has_the_name_of_its_model_or_the_users(words: list[str], name: str) -> None:
    cfg = compose("train", words)
    assert cfg.name == name and cfg.output.startswith(f"outputs/{name}/")


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
