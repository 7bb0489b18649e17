"""Episode records: on disk at once, safe against a kill, merged by clear rules, bound to their
run's settings.
"""

import json
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

import mme_vla
from helpers.rollout_fakes import quick_policy
from mme_vla import UserError
from mme_vla.cli import evaluate
from mme_vla.config.composition import compose
from mme_vla.evaluation.records import (
    ARM,
    EpisodeRecord,
    RecordLog,
    Seconds,
    check_settings,
    display_name,
    merge,
)
from mme_vla.evaluation.rollout.evaluation import facts_of, run_settings
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import (
    begin_run,
    check_run_folder,
    find_records,
    read_records,
    read_run,
)
from mme_vla.utils import draft_of


def test_a_shipped_policy_is_called_as_the_user_typed_it() -> None:
    model = "framesamp_modul-every_8-grid_1"
    assert display_name(model, "nano") == "nano"
    assert display_name(f"{model}{ARM}drop:all", "nano") == f"nano{ARM}drop:all"
    assert display_name(model, 60000) == model


def record(**changes: Any) -> EpisodeRecord:
    values = {
        "model": "pi05",
        "checkpoint": 100,
        "model_seed": 7,
        "task": "BinFill",
        "episode": 0,
        "seed": 540_000,
        "difficulty": "easy",
        "outcome": "success",
        "steps": 321,
        "seconds": Seconds(1.5, 0.5, 2.25),
    }
    return EpisodeRecord(**{**values, **changes})


@pytest.mark.parametrize("entry", [{"event": 5, "step": 1}, {"step": None}, {"event": "pause:3"}])
def test_an_event_without_text_or_step_is_refused(entry: dict[str, Any], tmp_path: Path) -> None:
    line = {**json.loads(record().to_json()), "events": [entry]}
    line.pop("crc32", None)
    (tmp_path / "episodes.jsonl").write_text(json.dumps(line) + "\n")
    with pytest.raises(UserError, match=r"record\.events"):
        read_records(tmp_path / "episodes.jsonl")


def test_a_record_survives_its_line() -> None:
    made = record(
        error="IK failed\nat step 3",
        outcome="error",
        subgoal="qwenvl",
        video="a/b.mp4",
        extra={"mine": 1},
    )
    line = made.to_json()
    assert "\n" not in line
    assert EpisodeRecord.from_json(line) == made


def test_a_shipped_policy_is_called_by_its_checkpoint_and_records_keep_its_model() -> None:
    made = record(model="framesamp_modul-every_8-grid_1", checkpoint="nano", memory_budget=4)
    assert made.run.label == "nano" and str(made.run) == "nano, seed 7, test"
    arm = replace(made, model="framesamp_modul-every_8-grid_1 · drop:all", event="pause:9")
    assert arm.run.label == "nano · drop:all · pause:9"
    trained = replace(made, checkpoint=800)
    assert trained.run.label == "framesamp_modul-every_8-grid_1@4"
    assert made.run.model == trained.run.model


def test_wrong_values_are_named() -> None:
    good = asdict(record())
    for values, message in (
        ({**good, "outcome": "sucess"}, r"outcome='sucess'.*'success'"),
        ({**good, "episode": "3"}, r"record\.episode='3' must be a whole number"),
        ({**good, "sucess": True}, r"Unknown key record\.sucess"),
        ({"model": "pi05"}, "lacks the key 'checkpoint'"),
        ({**good, "episode": -1}, r"record\.episode=-1 must be a whole number from 0"),
        ({**good, "steps": -3}, r"record\.steps=-3 must be a whole number from 0"),
        ({**good, "seconds": {"total": -1.0}}, r"record\.seconds\.total=-1.0 must be"),
    ):
        with pytest.raises(UserError, match=message):
            EpisodeRecord.from_dict(values)


def test_a_half_saved_last_line_is_ignored_and_then_repaired(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    with RecordLog(path) as log:
        log.append(record(episode=0))
    line = record(episode=1).to_json()
    for cut in (1, len(line) // 2, len(line) - 1):
        with path.open("a") as file:
            file.write(line[:cut])
        with pytest.warns(UserWarning, match="half-written"):
            assert [r.episode for r in read_records(path)] == [0]
        with pytest.warns(UserWarning, match="removed"), RecordLog(path) as log:
            log.append(record(episode=2))
        assert [r.episode for r in read_records(path)] == [0, 2]
        path.write_text(record(episode=0).to_json() + "\n")


def test_a_last_line_that_lacks_only_its_end_is_valid(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    path.write_text(record(episode=0).to_json())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with RecordLog(path) as log:
            log.append(record(episode=1))
        assert [r.episode for r in read_records(path)] == [0, 1]


def test_two_processes_do_not_write_one_file(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    with RecordLog(path), pytest.raises(UserError, match="file of its own"):
        RecordLog(path)
    RecordLog(path).close()


def test_shards_of_a_folder_are_detected_once(tmp_path: Path) -> None:
    for name in ("a/episodes-0.jsonl", "a/episodes-1.jsonl", "b/episodes.jsonl", "b/other.jsonl"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    files = find_records([tmp_path, tmp_path / "b" / "episodes.jsonl"])
    assert [str(f.relative_to(tmp_path)) for f in files] == [
        "a/episodes-0.jsonl",
        "a/episodes-1.jsonl",
        "b/episodes.jsonl",
    ]
    (tmp_path / "b" / "up").symlink_to(tmp_path)
    (tmp_path / "collected").mkdir()
    (tmp_path / "collected" / "a").symlink_to(tmp_path / "a")
    assert len(find_records([tmp_path / "b"])) == 3 == len(find_records([tmp_path]))
    assert len(find_records([tmp_path / "collected"])) == 2, "links to folders are followed"
    with pytest.raises(UserError, match="does not exist"):
        find_records([tmp_path / "c"])
    (tmp_path / "c").mkdir()
    with pytest.raises(UserError, match="holds no results"):
        find_records([tmp_path / "c"])


@pytest.mark.parametrize("turned", [False, True])
def test_a_result_supersedes_an_error_in_whatever_order(turned: bool) -> None:
    both = [record(outcome="error", error="IK"), record(outcome="fail")]
    assert [r.outcome for r in merge(both[::-1] if turned else both)] == ["fail"]


def test_conflicting_outcomes_are_refused_or_selected_by_time() -> None:
    early, late = (
        record(when="2026-01-01T00:00:00+00:00"),
        record(outcome="fail", when="2026-01-02T00:00:00+00:00"),
    )
    with pytest.raises(UserError, match="evaluated twice"):
        merge([early, late])
    for order in ([early, late], [late, early]):
        assert merge(order, "first") == [early]
        assert merge(order, "last") == [late]
    same_second = replace(late, when=early.when)
    assert merge([early, same_second], "last") == [same_second]
    assert merge([early, same_second], "first") == [early]
    assert merge([early, replace(early, when=late.when)]) == [early]
    with pytest.raises(UserError, match="Did you mean 'last'"):
        merge([early], "lst")


def test_times_of_several_zones_are_compared_as_times() -> None:
    late = record(when="2026-01-01T12:00:00+00:00")
    for when in ("2026-01-01T13:30:00+02:00", "2026-01-01T11:30:00Z", "2026-01-01T11:30:00"):
        early = record(outcome="fail", when=when)
        for order in ([early, late], [late, early]):
            assert (merge(order, "first"), merge(order, "last")) == ([early], [late])
    with pytest.raises(UserError, match="when='yesterday' is no time"):
        merge([late, record(outcome="fail", when="yesterday")], "first")


def test_one_episode_in_two_environments_is_refused() -> None:
    with pytest.raises(UserError, match="seeds 540000 and 1"):
        merge([record(), record(seed=1)])
    failed = record(seed=1, outcome="error")
    for both in ([record(), failed], [failed, record()]):
        with pytest.raises(UserError, match="not the same benchmark"):
            merge(both)


def test_a_run_of_two_step_limits_is_refused() -> None:
    with pytest.raises(UserError, match="mixes max_steps 300 and 1300"):
        check_settings([record(), record(episode=1, max_steps=300)])


def test_a_task_of_one_name_in_two_environments_is_refused() -> None:
    of_one = [record(task="reach", env=env, episode=e) for e, env in enumerate(("mine", None))]
    check_settings(of_one)  # not every record names its environment
    with pytest.raises(UserError, match="mixes env mine and yours"):
        check_settings([*of_one, record(task="reach", env="yours", episode=2)])


def test_a_run_resumes_only_with_its_settings(tmp_path: Path) -> None:
    settings = {"checkpoint": 100, "seeds": (7, 42), "env": {"split": "test", "max_steps": 1300}}
    first = begin_run(tmp_path, settings, notes={"device": "cpu"})
    assert begin_run(tmp_path, settings, notes={"device": "cuda"}) == first == read_run(tmp_path)
    other = {**settings, "env": {"split": "test", "max_steps": 300}, "extra": 1}
    with pytest.raises(
        UserError, match=r"env.max_steps was 1300, is 300; extra was 'not set', is 1"
    ):
        begin_run(tmp_path, other)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["run.json"]


def test_a_run_does_not_continue_with_a_file_of_other_scenes(tmp_path: Path) -> None:
    policy = quick_policy("pi05")
    scenes = tmp_path / "scenes.jsonl"
    settings = RolloutSettings(split=str(scenes))
    facts = facts_of(policy, None, None, settings, None)

    def begin(folder: str) -> dict[str, Any]:
        return begin_run(tmp_path / folder, run_settings(policy, facts, settings))

    earlier = run_settings(policy, facts, settings)  # as versions that did not read the file
    begun = begin_run(tmp_path / "earlier", earlier)
    scenes.write_text('{"task": "StopCube"}')
    assert begin("new") == begin("new")
    scenes.write_text('{"task": "BinFill"}')
    with pytest.raises(UserError, match="other settings: split_sha256 was"):
        begin("new")
    assert begin("earlier") == begun


def test_a_run_of_compressed_records_is_not_run_again(tmp_path: Path) -> None:
    begin_run(tmp_path, {"a": 1})
    (tmp_path / "episodes.jsonl.xz").write_bytes(b"")
    with pytest.raises(UserError, match=r"episodes\.jsonl\.xz is compressed.*unpack it"):
        begin_run(tmp_path, {"a": 1})


def test_a_folder_of_something_else_is_not_filled_with_records(tmp_path: Path) -> None:
    for name in ("new", "empty", "run", "records", "begun", "foreign"):
        (tmp_path / name).mkdir()
    (tmp_path / "new").rmdir()
    begin_run(tmp_path / "run", {"a": 1})
    (tmp_path / "records" / "episodes-0.jsonl").write_text("")
    draft_of(tmp_path / "begun" / "run.json").write_text("")
    for name in ("new", "empty", "run", "records", "begun"):
        check_run_folder(tmp_path / name)
    (tmp_path / "foreign" / "model.yaml").write_text("")
    with pytest.raises(UserError, match="foreign holds files, but no run"):
        check_run_folder(tmp_path / "foreign")
    with pytest.raises(UserError, match=r"model\.yaml is a file"):
        check_run_folder(tmp_path / "foreign" / "model.yaml")
    words = ["checkpoint=nano", "tasks=StopCube", f"output={tmp_path / 'foreign'}"]
    with pytest.raises(UserError, match="holds files, but no run"):
        evaluate.main(compose("evaluate", words))
    with pytest.raises(UserError, match="holds files, but no run"):
        mme_vla.evaluate("nano", "StopCube", 1, output=tmp_path / "foreign")


def test_a_run_file_changed_by_hand_is_noticed(tmp_path: Path) -> None:
    begin_run(tmp_path, {"a": 1})
    path = tmp_path / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "settings": {"a": 2}}))
    with pytest.raises(UserError, match="changed manually"):
        read_run(tmp_path)
    path.write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        read_run(tmp_path)


def test_a_run_begins_and_resumes_where_there_are_no_hard_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_links(*_: object) -> None:
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr("os.link", no_links)
    first = begin_run(tmp_path, {"a": 1})
    assert begin_run(tmp_path, {"a": 1}) == first == read_run(tmp_path)
    with pytest.raises(UserError, match="a was 1, is 2"):
        begin_run(tmp_path, {"a": 2})
    assert sorted(f.name for f in tmp_path.iterdir()) == ["run.json"]


def test_processes_of_one_number_on_two_machines_do_not_share_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    linked = []
    monkeypatch.setattr("os.getpid", lambda: 1)
    monkeypatch.setattr("os.link", lambda source, _: linked.append(source))
    for _ in range(2):
        begin_run(tmp_path, {"a": 1})
    assert len(set(linked)) == 2


def test_what_is_absent_of_a_rollout_is_not_written() -> None:
    bare = json.loads(record().to_json())
    assert not {"env", "chunks", "events", "made_up", "extra"} & set(bare)
    full = record(suite="Counting", chunks=0, events=({"event": "restart", "step": 0},))
    fields = json.loads(full.to_json())
    assert (fields["suite"], fields["chunks"]) == ("Counting", 0)
    assert EpisodeRecord.from_json(full.to_json()) == full


def test_records_whose_rollout_was_kept_in_extra_are_read() -> None:
    extra = {"env": "mme_vla", "chunks": 3, "events": [{"event": "restart", "step": 0}], "mine": 1}
    earlier = EpisodeRecord.from_dict({**asdict(record()), "extra": extra})
    assert (earlier.env, earlier.chunks, earlier.extra) == ("mme_vla", 3, {"mine": 1})
    assert earlier.events == ({"event": "restart", "step": 0},)
