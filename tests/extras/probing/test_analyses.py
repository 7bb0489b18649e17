"""The analyses: what they see is what the network computes, and watching changes nothing."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers import REPOSITORY
from helpers.probe_fakes import MadeUpSource
from helpers.rollout_fakes import quick_policy
from mme_vla import UserError
from mme_vla.backbone import gemma
from mme_vla.data.episodes import EpisodeSource
from mme_vla.extras.probing.analyses.cost import count_model, write_costs
from mme_vla.extras.probing.analyses.replay import recurrence_curves, recurrence_plot, replay
from mme_vla.extras.probing.analyses.watches import AttentionWatch, ModulationWatch
from mme_vla.extras.probing.cli.analyse import main
from mme_vla.testing.small import random_batch, small_policy


@pytest.fixture(scope="module")
def sample() -> EpisodeSource:
    return EpisodeSource("sample")


def fixed_noise() -> Tensor:
    return torch.randn(2, 20, 32, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("model", ["framesamp_context", "tokendrop_expert", "pi05"])
def test_attention_mass_is_that_of_the_networks_logits(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = small_policy(model)
    batch = random_batch(policy, 2)
    masks: list[tuple[Tensor, ...]] = []
    original = gemma.attend

    def spy(q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
        masks.append((q, k.clone(), mask))  # the next step writes its keys into the same place
        return original(q, k, v, mask)

    monkeypatch.setattr(gemma, "attend", spy)
    with AttentionWatch(policy) as watch:
        policy.sample_actions(batch, fixed_noise(), steps=2)
    mass = watch.result()
    assert mass.layers.sum(1) == pytest.approx(torch.ones(3))
    depth, actions = len(policy.backbone.transformer.layers), 20
    first = [(q, k, m) for q, k, m in masks if q.shape[1] == actions and k.shape[1] > actions][
        ::depth
    ]  # layer 0
    assert len(first) == 2
    expected = []
    for q, k, m in first:
        logits = (
            q.transpose(1, 2)
            @ k.expand(-1, -1, q.shape[2], -1).permute(0, 2, 3, 1)
            / q.shape[-1] ** 0.5
            + m
        )
        probabilities = logits.softmax(-1).mean((0, 1, 2))
        expected.append(probabilities[-actions:].sum())  # the actions' own share
    assert float(mass.layers[0, mass.parts.index("action")]) == pytest.approx(
        float(torch.stack(expected).mean()), abs=1e-5
    )
    assert ("memory" in mass.parts) == (model != "pi05")
    shares = [mass.share(part).mean() for part in mass.parts if part != "action"]
    assert float(sum(shares)) == pytest.approx(1)


def test_the_cached_and_the_joint_pass_show_the_same_attention() -> None:
    policy = small_policy("framesamp_expert")
    batch, noise = random_batch(policy, 2), fixed_noise()
    with AttentionWatch(policy) as sampled:
        policy.sample_actions(batch, noise, steps=1)
    with AttentionWatch(policy) as joint, torch.no_grad():
        policy.predict(batch, noise, torch.ones(2))
    assert sampled.result().layers == pytest.approx(joint.result().layers, abs=1e-5)


def test_watching_changes_no_action_and_leaves_no_hook() -> None:
    policy = small_policy("framesamp_modul")
    batch, noise = random_batch(policy, 2), fixed_noise()
    before = policy.sample_actions(batch, noise)
    with AttentionWatch(policy), ModulationWatch(policy):
        watched = policy.sample_actions(batch, noise)
    assert torch.equal(before, watched)
    assert not any(m._forward_pre_hooks or m._forward_hooks for m in policy.modules())


def test_modulation_statistics_are_those_of_what_was_predicted() -> None:
    policy = small_policy("tokendrop_modul")
    with torch.no_grad():
        for layer in policy.integration.layers:
            # a constant answer: scale 2 and −1 in turns, bias 0.5
            layer.modulation.weight.zero_()
            half = len(layer.modulation.bias) // 2
            layer.modulation.bias[:half] = torch.tensor([2.0, -1.0]).repeat(half // 2)
            layer.modulation.bias[half:] = 0.5
    with ModulationWatch(policy) as watch:
        policy.sample_actions(random_batch(policy, 2), fixed_noise(), steps=1)
    stats = watch.result()
    assert stats.overall["scale"] == pytest.approx((0.5, 1.5))
    assert stats.overall["bias"] == pytest.approx((0.5, 0.0), abs=1e-6)
    assert stats.scale[0] == pytest.approx(torch.full((3,), 0.5))


def test_wrong_policies_are_named() -> None:
    with pytest.raises(UserError, match="no modulator"):
        ModulationWatch(small_policy("framesamp_context")).__enter__()
    with pytest.raises(UserError, match="let the policy act"):
        AttentionWatch(small_policy("pi05")).result()
    with pytest.raises(UserError, match="no memory, so no budget"):
        count_model("pi05", 64, "tiny")


def test_a_replay_shows_every_frame_once() -> None:
    policy, source = quick_policy("framesamp_modul"), MadeUpSource(lengths=(60,), video=20)
    observed = [
        (step, running.n_observed_frames) for step, running in replay(policy, source, 0, stride=16)
    ]
    assert observed == [(20, 21), (36, 37), (52, 53)]
    assert [step for step, _ in replay(policy, source, 0, stride=16, most=2)] == [20, 52]
    with pytest.raises(UserError, match="has episodes 0 … 0"):
        next(replay(policy, source, 1))


@pytest.mark.parametrize("offset", [0, 1])
def test_a_replay_pairs_frames_with_the_actions_that_the_policy_learned(
    sample: EpisodeSource, offset: int
) -> None:
    policy = small_policy("pi05_past_actions")
    policy.config["data"] = {"action_offset": offset}
    read = policy.require_processor().prompt_spec.past_actions
    for step, running in replay(policy, sample, 0, most=3):
        expected = sample.past_actions(0, step, read, offset)
        np.testing.assert_array_equal(running._executed, expected)


def test_ttt_learns_from_each_frame_and_rmt_reports_its_change(sample: EpisodeSource) -> None:
    curves = recurrence_curves(quick_policy("ttt_modul", 8), sample, 1)
    before, after = curves.curves["inner_loss_before"], curves.curves["inner_loss_after"]
    assert len(before) == len(curves.frames)
    assert (after < before).mean() > 0.9
    assert before[-1] < before[0]
    assert recurrence_plot([curves], "ttt").startswith("<svg")
    assert set(recurrence_curves(quick_policy("rmt_expert", 8), MadeUpSource(), 1).curves) == {
        "slot_change"
    }
    with pytest.raises(UserError, match="no recurrent memory"):
        recurrence_curves(small_policy("pi05"), sample, 1)


def test_the_attention_command_works_on_a_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small_policy("framesamp_expert").save_pretrained(tmp_path / "policy")
    out = tmp_path / "out.json"
    options = ["--episodes", "1", "--most", "1", "--output", str(out)]
    main(["attention", "--checkpoint", str(tmp_path / "policy"), *options])
    assert "1.3 / 21.8" in capsys.readouterr().out  # the paper's FrameSamp+Expert
    made = json.loads(out.read_text())
    assert np.sum(made["layers"], 1) == pytest.approx(1)


def test_shipped_costs_are_what_the_code_costs(tmp_path: Path) -> None:
    write_costs([count_model("pi05")], tmp_path / "cost.csv")
    columns, row = (tmp_path / "cost.csv").read_text().splitlines()
    shipped = (REPOSITORY / "mme_vla" / "assets" / "cost.csv").read_text().splitlines()
    assert columns == shipped[0] and row in shipped


def test_a_smaller_memory_costs_less_and_a_stream_less_than_a_window(tmp_path: Path) -> None:
    assert (
        count_model("framesamp_expert", 64, "tiny").chunk
        < count_model("framesamp_expert", 512, "tiny").chunk
    )
    main(
        [
            "cost",
            "--backbone",
            "tiny",
            "--models",
            "ttt_modul",
            "--output",
            str(tmp_path / "cost.csv"),
        ]
    )
    (row,) = csv.DictReader((tmp_path / "cost.csv").open())
    assert 0 < int(row["streamed"]) < int(row["memory"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["attention"], "Name one policy"), (["cost", "--models", "framesamp"], "Did you mean")],
)  # fmt: skip
def test_mistakes_end_with_a_sentence(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("command", ["selection", "attention"])
def test_a_memory_of_ones_own_is_found_by_config_dir(
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    example = REPOSITORY / "examples" / "last_frames"
    monkeypatch.syspath_prepend(example)
    words = {
        "selection": ["--memory", "last_frames", "--every", "60", "--output", f"{tmp_path}/s.mp4"],
        "attention": ["--model", "last_frames_context", "--episodes", "0", "--most", "1"],
    }
    main([command, "--config-dir", str(example / "configs"), *words[command]])
    assert {"selection": "wrote", "attention": "observation"}[command] in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "logged"),
    [
        (["attention", "--model", "framesamp_context", "--most", "1"], "attention/memory"),
        (["modulation", "--model", "framesamp_modul", "--most", "1"], "modulation/scale_mean"),
        (
            ["recurrence", "--model", "rmt_modul", "--stride", "200", "--output", "{}/r.svg"],
            "recurrence/slot_change",
        ),
        (
            ["selection", "--memory", "framesamp", "--every", "60", "--output", "{}/s.mp4"],
            "remembered",
        ),
    ],
    ids=["attention", "modulation", "recurrence", "selection"],
)
@pytest.mark.filterwarnings("ignore:load_recording:DeprecationWarning")
def test_rerun_gets_images_words_and_numbers(
    arguments: list[str], logged: str, tmp_path: Path
) -> None:
    rerun = pytest.importorskip("rerun", reason="needs the extra viz")
    path = tmp_path / "log.rrd"
    episode = [] if arguments[0] == "selection" else ["--episodes", "0"]
    main([*(word.format(tmp_path) for word in arguments), *episode, "--rerun", str(path)])
    schema = str(rerun.recording.load_recording(path).schema())
    for entity in ("views/front", "views/wrist", "goal", "simple_subgoal", logged):
        assert f"/episode_0/{entity}:" in schema
    assert "timeline:step" in schema


def test_laps_of_a_watch_add_up_to_the_total() -> None:
    policy = small_policy("framesamp_modul")
    batch = random_batch(policy, 2)
    with AttentionWatch(policy) as attention, ModulationWatch(policy) as modulation:
        laps = []
        for seed in range(2):
            noise = torch.randn(2, 20, 32, generator=torch.Generator().manual_seed(seed))
            policy.sample_actions(batch, noise, steps=1)
            laps.append((attention.lap().layers, modulation.lap().overall["scale"][0]))
        with pytest.raises(UserError, match="has seen nothing"):
            attention.lap()
    assert not torch.equal(laps[0][0], laps[1][0])
    assert torch.stack([mass for mass, _ in laps]).mean(0) == pytest.approx(
        attention.result().layers
    )
    assert np.mean([scale for _, scale in laps]) == pytest.approx(
        modulation.result().overall["scale"][0]
    )
