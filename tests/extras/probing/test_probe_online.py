"""A probe in closed loop: paired with the unprobed run, gone on with after a stop, on one page with
the offline one.
"""

from pathlib import Path

import numpy as np
import pytest

from helpers.probe_fakes import JOBS, actions, made_up, reader
from helpers.rollout_fakes import FACTS, quick_policy, use_inline_envs
from helpers.scripted_env import make_moving_env
from mme_vla.errors import UserError
from mme_vla.evaluation.claims import Shard
from mme_vla.evaluation.rollout.evaluation import RunOptions
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.probing.findings import Findings
from mme_vla.extras.probing.lines import LINES
from mme_vla.extras.probing.report import table_of
from mme_vla.extras.probing.run import Probe, ProbePlan, probed_folder, run_probe
from mme_vla.extras.probing.settings import OfflineSettings

SILENT = RunOptions(show_progress=False)


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("framesamp_modul", "recent:8"),
        ("framesamp_modul", "nodemo+drop:1"),
        ("tokendrop_expert", "pause:8"),
        ("tokendrop_expert", "distract:1"),
        ("ttt_context", "pause:8"),
        ("ttt_context", "distract:1"),
    ],
)
def test_images_on_demand_are_all_that_an_arm_reads(name: str, word: str) -> None:
    policy = quick_policy(name, 8).eval()
    for few, every in zip(actions(policy, word), actions(policy, word, draw="all"), strict=True):
        assert np.array_equal(few, every)


def probe_both(folder: Path, show_progress: bool = False) -> Probe:
    policy = quick_policy("framesamp_modul").eval()
    recordings = made_up()
    offline = OfflineSettings(1, 2, 1, True, 2)
    events = ["pause:4", "pause:4@step:99"]
    request = ProbePlan(
        ["shuffle", "nodemo"], recordings[:1], recordings, JOBS, offline, events=events
    )
    settings = RolloutSettings(max_steps=24, flow_steps=2, workers=1, max_batch=1)
    options = RunOptions(base=make_moving_env, show_progress=show_progress)
    return run_probe(policy, request, folder, FACTS, settings, options)


def test_arms_are_paired_with_the_unprobed_run_and_both_probes_share_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    findings = probe_both(tmp_path)
    assert {c.first for c in findings.comparisons} == {
        "shuffle",
        "nodemo",
        "event pause:4",
        "event pause:4@step:99",
    }
    assert all(c.second == "unprobed" and c.episodes == 2 for c in findings.comparisons)
    assert findings.notes == [
        "event=pause:4@step:99 did not act in 2 episodes: its place never came."
    ]
    assert set(findings.findings.arms()) == {"shuffle", "nodemo"}
    page = findings.page.read_text()
    for words in (
        "At what age an entry matters",
        "In closed loop",
        "what is remembered changes places",
        "1 decision of 1 recorded episode",
        "data:image/webp;base64,",
    ):
        assert words in page
    assert "<script" not in page and 'src="http' not in page and 'href="http' not in page
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.jsonl")}
    assert len(before) == 6
    again = probe_both(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.jsonl")} == before
    assert again.findings == findings.findings
    assert "| tiny |" in table_of({"tiny": probed_folder(tmp_path)}) and isinstance(
        findings.findings, Findings
    )


def test_each_arm_has_a_heading_and_its_name_in_every_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    use_inline_envs(monkeypatch)
    probe_both(tmp_path, show_progress=True)
    lines = capsys.readouterr().err.splitlines()
    headings = [line for line in lines if line.startswith("arm ")]
    assert headings == [
        "arm 1 of 3 · unprobed: the policy as it is, which the other arms are compared with",
        "arm 2 of 3 · shuffle: what is remembered changes places, the times stay",
        "arm 3 of 3 · nodemo: the video before the episode is not shown",
    ]
    episodes = [line for line in lines if "VideoUnmask 0" in line]
    names = ["tiny · unprobed", "tiny · pause:4", "tiny · pause:4@step:99"]
    names += ["tiny · shuffle", "tiny · nodemo"]
    assert [line.partition(": ")[0] for line in episodes] == names


def test_the_page_links_the_videos_of_the_closed_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    videos = tmp_path / "online" / "shuffle" / "videos"
    videos.mkdir(parents=True)
    (videos / "success & more.mp4").touch()
    page = probe_both(tmp_path).page.read_text()
    assert (
        '<a href="online/shuffle/videos/success%20%26%20more.mp4">shuffle: success &amp; more</a>'
        in page
    )


def test_a_policy_that_ignores_its_memory_gets_one_sentence(tmp_path: Path) -> None:
    recordings = made_up()
    plan = ProbePlan(None, recordings, recordings, (), OfflineSettings(1, 2, 2, True, 2))
    probe = run_probe(reader(None), plan, tmp_path, FACTS, RolloutSettings(), SILENT)
    text = (tmp_path / "table.md").read_text()
    assert "None of the 11 interventions changes the actions" in text
    assert "|" not in text, "no table of zeros"
    page = probe.page.read_text()
    assert "<summary>The 11 interventions in numbers</summary>" in page
    assert "<svg" not in page and "subgoal" not in page


def test_shards_of_a_probe_meet_in_one_page(tmp_path: Path) -> None:
    policy, recordings = quick_policy("framesamp_modul").eval(), made_up()
    for index in range(2):
        request = ProbePlan(
            ["drop:all"],
            recordings,
            recordings,
            (),
            OfflineSettings(1, 2, 1, False, 2),
        )
        options = RunOptions(shard=Shard(index, 2), show_progress=False)
        findings = run_probe(policy, request, tmp_path, FACTS, RolloutSettings(), options)
    assert len(list((tmp_path / "offline").glob(LINES))) == 2
    assert {line.recording for line in findings.findings.moments} == {
        "made-up/0",
        "made-up/1",
        "made-up/2",
    }


def test_a_folder_of_another_probe_is_refused(tmp_path: Path) -> None:
    policy, recordings = quick_policy("framesamp_modul").eval(), made_up()
    for words in (["drop:all"], ["drop:1"]):
        request = ProbePlan(
            words, recordings[:1], recordings, (), OfflineSettings(1, 2, 1, False, 2)
        )
        if words == ["drop:all"]:
            run_probe(policy, request, tmp_path, FACTS, RolloutSettings(), SILENT)
        else:
            with pytest.raises(UserError, match="holds a run with other settings"):
                run_probe(policy, request, tmp_path, FACTS, RolloutSettings(), SILENT)
    with pytest.raises(UserError, match="holds no probe on recorded episodes"):
        probed_folder(tmp_path / "elsewhere")


@pytest.mark.parametrize("name", ["page.html", "table.md", "remembered/StopCube.png"])
def test_a_probe_replaces_no_file_of_somebody_else_and_runs_nothing_before_it_says_so(
    name: str, tmp_path: Path
) -> None:
    policy, recordings = quick_policy("framesamp_modul").eval(), made_up()
    request = ProbePlan(
        ["drop:all"], recordings[:1], recordings, (), OfflineSettings(1, 2, 1, False, 2)
    )
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=rf"{Path(name).parts[0]} exists"):
        run_probe(policy, request, tmp_path, FACTS, RolloutSettings(), SILENT)
    assert (tmp_path / name).read_text() == "mine" and not (tmp_path / "offline").exists()
    (tmp_path / name).unlink()
    for _ in range(2):  # an earlier page of its own is written again
        run_probe(policy, request, tmp_path, FACTS, RolloutSettings(), SILENT)
