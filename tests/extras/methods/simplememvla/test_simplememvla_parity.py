"""SimpleMemVLA computes what its authors' code computes: windows, prompts, pixels, hidden states,
losses and chunks.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("transformers", reason="needs the extra `vlm`: uv sync --inexact --extra vlm")

from helpers.baselines import relative_error as error
from helpers.simplememvla_golden import arrays, folder, frames, golden_policy, read
from mme_vla.extras.methods.simplememvla.head import Condition, channel_loss, scaled_section
from mme_vla.extras.methods.simplememvla.model import response_condition, words_loss
from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy
from mme_vla.extras.methods.simplememvla.processor import VideoBatch
from mme_vla.extras.methods.simplememvla.prompt import (
    CameraTokens,
    Robot,
    Tokens,
    WordTokenizer,
    encode,
    instruction,
)
from mme_vla.extras.methods.simplememvla.video import (
    Window,
    augment,
    augmentation_draw,
    channels_first,
    colour_matrix,
    fitting_size,
    pixel_rows,
    resized,
    timestamp,
)

TOLERANCE = 1e-4
"""Relative to the largest entry."""


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> SimpleMemVlaPolicy:
    return golden_policy(tmp_path_factory.mktemp("published"))


@pytest.fixture(autouse=True)
def _without_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


def test_windows_and_timestamps() -> None:
    cases = read("sampling")
    for case in cases["windows"]:
        window = Window(case["seconds"], case["fps"], case["native_fps"], case["variable"])
        visible = window.frames(case["current"])
        assert (window.length, window.stride) == (case["n_frames"], case["stride"])
        assert visible.tolist() == case["frames"]
        assert [timestamp(time) for time in window.times(len(visible))] == case["timestamps"]
    for case in cases["derive"]:
        window = Window(case["seconds"], case["fps"], case["native_fps"])
        assert [window.length, window.stride] == case["result"]


def test_instructions() -> None:
    for case in read("prompt")["texts"]:
        robot = Robot("Panda single-arm robot", 20, 30)
        assert (
            instruction(case["goal"], robot, case["history_cameras"], case["current_cameras"])
            == case["text"]
        )


def test_token_layouts() -> None:
    meta, golden, config = read("meta"), arrays("prompt"), read("meta")["config"]
    tokenizer = WordTokenizer.load(folder() / "tokenizer.json")
    robot = Robot(config["robot_tag"], config["control_frequency_hz"], config["action_horizon"])
    window = Window(
        config["history_video_sec"], config["history_video_fps"], config["native_video_fps"]
    )
    side = meta["processor"]["patch"] * meta["processor"]["merge"]
    names = [key.rpartition(".")[2] for key in config["image_keys"]]
    for k, case in enumerate(read("prompt")["layouts"]):
        cameras = [
            CameraTokens(
                name,
                _grid_of(
                    meta["sizes"]["frame"], case["frames"] if name in case["history"] else 1, side
                ),
                window.times(case["frames"]) if name in case["history"] else None,
            )
            for name in names
        ]
        videos = len(case["history"])
        request = instruction(meta["sizes"]["goal"], robot, videos, len(names) - videos)
        tokens = encode(tokenizer, cameras, request, case["answer"])
        np.testing.assert_array_equal(tokens.ids, golden[f"{k}/input_ids"])
        np.testing.assert_array_equal(tokens.kinds, golden[f"{k}/mm_token_type_ids"])
        np.testing.assert_array_equal(
            np.arange(len(tokens.ids)) >= tokens.prompt, golden[f"{k}/span"]
        )


def _grid_of(size: list[int], count: int, side: int) -> tuple[int, int]:
    """Merged tokens of images of this size."""
    settings = read("meta")["processor"]
    bounds = settings["min_pixels"], settings["max_pixels"]
    height, width = fitting_size(size[0], size[1], count, side, bounds)
    return height // side, width // side


def test_sizes_of_images() -> None:
    cases = read("meta")["smart_resize_full_size"]
    for count, height, width, *expected in cases["video"]:
        assert [*fitting_size(height, width, count, 32, (4096, 25_165_824))] == expected
    for height, width, *expected in cases["image"]:
        assert [*fitting_size(height, width, 1, 32, (65_536, 16_777_216))] == expected


def test_pixels() -> None:
    golden, settings = arrays("pictures"), read("meta")["processor"]
    patch, merge, bounds = (
        settings["patch"],
        settings["merge"],
        (settings["min_pixels"], settings["max_pixels"]),
    )

    def rows(images: Tensor, video: bool) -> Tensor:
        height, width = images.shape[-2:]
        size = fitting_size(height, width, len(images) if video else 1, patch * merge, bounds)
        images = resized(images, size)
        pairs = (
            images.unflatten(0, (-1, 2)) if video else images[:1, None].expand(-1, 2, -1, -1, -1)
        )
        return pixel_rows(pairs, patch, merge)

    def first(name: str) -> Tensor:
        return channels_first(golden[name].numpy())

    cases = {
        "video/pixels": (first("video/frames"), True),
        "image/pixels": (first("image/frame")[None], False),
        "resized/video_pixels": (first("resized/frames"), True),
        "resized/image_pixels": (first("resized/frames"), False),
    }
    for name, case in cases.items():
        assert error(rows(*case), golden[name]) < 1e-5


def test_augmentation() -> None:
    golden, sizes, views = arrays("pictures"), read("meta")["sizes"], frames()
    k = 0
    while f"augment/{k}/params" in golden:
        params, clip = golden[f"augment/{k}/params"].numpy(), golden[f"augment/{k}/clip"].numpy()
        assert (
            np.abs(colour_matrix(*params[5:]) - golden[f"augment/{k}/matrix"].numpy()).max() < 1e-5
        )
        changed = (
            augment(channels_first(views["front"][: len(clip)]), params)
            .movedim(1, -1)
            .numpy()
            .astype(int)
        )
        difference = np.abs(changed - clip)
        assert difference.max() <= 1 and (difference > 0).mean() < 1e-3
        k += 1
    source = np.random.RandomState(sizes["seed"])
    draws = np.stack(
        [augmentation_draw(source.random_sample(7).tolist()) for _ in golden["augment/drawn"]]
    )
    np.testing.assert_allclose(draws, golden["augment/drawn"].numpy(), rtol=1e-12)


def test_rotary_sections() -> None:
    for half, section, scaled in read("meta")["sections"]:
        assert scaled_section(tuple(section), half) == scaled


def test_vision_tower(policy: SimpleMemVlaPolicy) -> None:
    golden, visual = arrays("vision"), policy.backbone.model.visual
    assert (
        error(visual(golden["pixels"], grid_thw=golden["grid"]).pooler_output, golden["features"])
        < TOLERANCE
    )
    image = visual(golden["image_pixels"], grid_thw=golden["image_grid"]).pooler_output
    assert error(image, golden["image_features"]) < TOLERANCE
    pairs = policy.require_processor().video(channels_first(frames()["front"][:4]))
    alone = [policy.backbone.encode_patches(pair[None])[0] for pair in pairs]
    assert error(torch.stack(alone), policy.backbone.encode_patches(pairs)) < 1e-5


def _patch() -> tuple[int, int]:
    settings = read("meta")["processor"]
    return settings["patch"], settings["merge"]


def test_head(policy: SimpleMemVlaPolicy) -> None:
    golden, head = arrays("head"), policy.action_head
    mask = golden["in/condition_attention_mask"].bool()
    inputs = golden["in/condition_hidden_states"], golden["in/condition_token_embeds"]
    condition = Condition(*inputs, golden["in/condition_position_ids"].transpose(0, 1), mask)
    without_tokens = Condition(inputs[0], None, condition.positions, mask)
    odd = Condition(*inputs, golden["in/odd_positions"].transpose(0, 1), mask)
    actions, times, state = golden["in/actions"], golden["in/times"], golden["in/state"]
    short = actions[:, : golden["shorter"].shape[1]]
    assert error(head(actions, times, condition, state), golden["with_state"]) < TOLERANCE
    assert error(head(actions, times, condition, None), golden["without_state"]) < TOLERANCE
    assert error(head(actions, times, without_tokens, state), golden["without_tokens"]) < TOLERANCE
    assert error(head(short, times, condition, state), golden["shorter"]) < TOLERANCE
    # unscaled sections: 5e-4
    assert error(head(actions, times, odd, state), golden["odd_positions"]) < TOLERANCE
    assert error(head.time_embed(golden["time/in"]), golden["time/out"]) < TOLERANCE
    for steps in (1, 4, 10):
        chunk = head.sample(golden["sample/noise"], condition, state, steps)
        assert error(chunk, golden[f"sample/steps{steps}"]) < TOLERANCE
    cooler = head.sample(0.5 * golden["sample/noise"], condition, state, 4)
    assert error(cooler, golden["sample/temperature0.5"]) < TOLERANCE
    loss = channel_loss(golden["loss/pred"], golden["loss/target"], golden["loss/mask"])
    assert error(loss, golden["loss/value"]) < TOLERANCE


def _training_batch(policy: SimpleMemVlaPolicy) -> VideoBatch:
    """The batch of the case, made by the processor from frames, states and words."""
    golden, config, processor = (
        arrays("training"),
        read("meta")["config"],
        policy.require_processor(),
    )
    views, anchors = frames(), golden["made/anchors"].tolist()
    items: list[dict[str, Any]] = []
    for i, (anchor, output) in enumerate(
        zip(anchors, read("meta")["sizes"]["answers"], strict=True)
    ):
        video = processor.video(channels_first(views["front"][processor.frames(anchor)]))
        images = processor.images([views["wrist"][anchor]])
        request = processor.prompt(read("meta")["sizes"]["goal"])
        side, image_side = ((x.shape[-2], x.shape[-1]) for x in (video, images))
        actions, last = golden["made/raw_actions"], len(golden["made/raw_actions"]) - 1
        steps = torch.arange(anchor, anchor + config["action_horizon"])
        items.append(
            {
                "tokens": processor.tokens(request, len(video), side, image_side, output),
                "video": video,
                "images": images,
                "state": processor.states(golden["made/raw_states"][anchor]),
                "actions": processor.actions(
                    actions[steps.clamp(max=last)], golden["made/raw_states"][anchor]
                ),
                "action_mask": golden["batch/action_mask"][i, :, 0],
            }
        )
    return processor.collate(items)


def test_training_batch(policy: SimpleMemVlaPolicy) -> None:
    golden, batch = arrays("training"), _training_batch(policy)
    valid = golden["batch/attention_mask"].bool()
    np.testing.assert_array_equal(batch.ids[valid], golden["batch/input_ids"][valid])
    np.testing.assert_array_equal(batch.kinds[valid], golden["batch/mm_token_type_ids"][valid])
    np.testing.assert_array_equal(
        batch.positions.transpose(1, 2)[valid], golden["position_ids"].permute(1, 2, 0)[valid]
    )
    labelled = [torch.nonzero(row != -100).flatten() for row in golden["batch/labels"]]
    assert batch.spans == [(int(row[0]), int(row[-1]) + 1) for row in labelled]
    assert error(batch.state, golden["batch/state"]) < 1e-5
    assert batch.actions is not None and batch.video is not None
    counted = golden["batch/action_mask"]
    assert error(batch.actions[counted], golden["batch/actions"][counted]) < 1e-5
    assert error(pixel_rows(batch.video, *_patch()), golden["batch/pixel_values_videos"]) < 1e-5


def test_hidden_states_velocity_and_losses(policy: SimpleMemVlaPolicy) -> None:
    golden, batch = arrays("training"), _training_batch(policy)
    embedded = policy.embed(batch)
    hidden = policy.backbone.hidden(embedded, batch.positions)
    valid = golden["batch/attention_mask"].bool()
    assert error(hidden[valid], golden["last_hidden"][valid]) < TOLERANCE
    condition = response_condition(hidden, embedded, batch.positions, batch.spans)
    velocity = policy.action_head(
        golden["head/in/noisy_actions"],
        golden["head/in/timesteps"],
        condition,
        golden["batch/state"],
    )
    assert error(velocity, golden["head/velocity"]) < TOLERANCE
    words, right = words_loss(policy.backbone, hidden, batch.ids, batch.spans)
    # the case is trained on these answers: the loss is near the precision of a probability of 1
    assert right == 1
    assert words.item() == pytest.approx(golden["vl_loss"].item(), rel=TOLERANCE, abs=1e-6)
    loss, metrics = policy(batch, {"noise": golden["noise"], "time": golden["times"]})
    assert error(metrics["action"], golden["action_loss"]) < TOLERANCE
    assert error(loss, golden["loss"]) < TOLERANCE


def test_gradients(policy: SimpleMemVlaPolicy) -> None:
    golden, batch, norms = arrays("training"), _training_batch(policy), read("meta")["gradients"]
    with torch.enable_grad():
        loss, _ = policy(batch, {"noise": golden["noise"], "time": golden["times"]})
        loss.backward()
    largest = max(norms.values())
    for name, parameter in policy.named_parameters():
        assert parameter.grad is not None, name
        assert abs(float(parameter.grad.norm()) - norms[name]) < TOLERANCE * max(
            norms[name], 1e-2 * largest
        ), name
    policy.zero_grad()


def _decided(
    policy: SimpleMemVlaPolicy, golden: dict[str, Tensor], key: str, step: int, prefix: str = ""
) -> Any:
    """An episode at a step of the case, its noise the case's."""
    views = frames(prefix)
    episode = policy.start_episode(read("meta")["sizes"]["goal"])
    states = golden[f"{key}/state"].numpy()[None].repeat(step + 1, 0)
    episode.observe({name: view[: step + 1] for name, view in views.items()}, states)
    episode.draw = lambda: {"noise": golden[f"{key}/noise"][0]}  # type: ignore[method-assign]
    return episode


def test_decisions_from_images(policy: SimpleMemVlaPolicy) -> None:
    golden, cases = (
        arrays("acting"),
        [case for case in read("meta")["said"] if case["kind"] == "plain"],
    )
    for k, case in enumerate(cases):
        episode = _decided(policy, golden, f"plain/{k}", case["current"])
        assert (
            policy.require_processor().frames(case["current"]).tolist()
            == golden[f"plain/{k}/frames"].tolist()
        )
        actions = torch.from_numpy(policy.act(episode))
        assert episode.subtask == case["said"]
        assert error(actions, golden[f"plain/{k}/actions"]) < TOLERANCE
        message, condition = policy.generate(_with_features(policy, episode))
        prompt = golden[f"plain/{k}/prompt_ids"].shape[1]
        assert message[0] == golden[f"plain/{k}/full_ids"][0, prompt:].tolist()
        assert error(condition.hidden, golden[f"plain/{k}/cond_hidden"]) < TOLERANCE
        assert condition.tokens is not None
        assert error(condition.tokens, golden[f"plain/{k}/cond_token"]) < TOLERANCE
        np.testing.assert_array_equal(
            condition.positions.transpose(0, 1), golden[f"plain/{k}/cond_pos"]
        )


def _with_features(policy: SimpleMemVlaPolicy, *episodes: Any) -> VideoBatch:
    batch = policy.observation(episodes)
    batch.features = torch.cat([e.encode(policy.backbone, e.pairs(e.step)) for e in episodes])
    return batch


def test_an_answer_that_reaches_the_limit_of_words(tmp_path: Path) -> None:
    golden, case = arrays("acting"), next(c for c in read("meta")["said"] if c["kind"] == "capped")
    policy = golden_policy(tmp_path, max_words=case["limit"])
    episode = _decided(
        policy,
        {f"capped/{n}": golden[f"plain/1/{n}"] for n in ("state", "noise")},
        "capped",
        case["current"],
    )
    actions = torch.from_numpy(policy.act(episode))
    assert episode.subtask == case["said"].strip()
    assert error(actions, golden["capped/actions"]) < TOLERANCE


def test_two_episodes_in_a_batch(policy: SimpleMemVlaPolicy) -> None:
    golden, cases = arrays("acting"), read("meta")["said"]
    first = next(case for case in cases if case["kind"] == "plain" and case["decision"] == 2)
    frame = int(golden["batched/1/frames"][-1])
    pair = [
        _decided(policy, golden, "plain/2", first["current"]),
        _decided(policy, golden, "batched/1", frame, "other_"),
    ]
    actions = torch.from_numpy(policy.act(pair))
    for row, episode in enumerate(pair):
        assert error(actions[row], golden[f"batched/{row}/actions"]) < TOLERANCE
        assert episode.subtask == next(
            c["said"] for c in cases if c["kind"] == "batched" and c["row"] == row
        )


def test_prompts_that_were_read_ahead(tmp_path: Path) -> None:
    """The authors' own path, and ours in its place, give what reading the whole prompt gives."""
    golden, policy = arrays("stream"), golden_policy(tmp_path, variable=False)
    views, processor, robot = frames(), policy.require_processor(), policy.embodiment
    episode: Any = policy.start_episode(read("meta")["sizes"]["goal"])
    observed, k = 0, 0
    while f"{k}/frames" in golden:
        step = int(golden[f"{k}/frames"][-1])
        states = golden[f"{k}/state"].numpy()[None].repeat(step + 1 - observed, 0)
        episode.observe({name: view[observed : step + 1] for name, view in views.items()}, states)
        observed = step + 1
        assert processor.frames(step).tolist() == golden[f"{k}/frames"].tolist()
        tokens: Tokens = policy._tokens(episode)
        np.testing.assert_array_equal(tokens.ids, golden[f"{k}/input_ids"][0])
        ahead = episode.video.ahead
        if golden[f"{k}/hit"] and robot.action.execute == 2 * processor.window.stride:
            assert ahead.length == int(golden[f"{k}/prefix_tokens"])
        episode.draw = lambda k=k: {"noise": golden[f"{k}/noise"][0]}
        actions = torch.from_numpy(policy.act(episode))
        assert error(actions, golden[f"{k}/actions"]) < TOLERANCE
        assert error(actions, golden[f"{k}/streamed_actions"]) < TOLERANCE
        while policy.prepare(episode):
            pass
        k += 1
    assert k > 1


def test_the_cache_of_a_prefix(tmp_path: Path) -> None:
    """That of the prompt which follows the last decision of the case."""
    golden, policy = arrays("stream"), golden_policy(tmp_path, variable=False)
    views, window = frames(), policy.require_processor().window
    last = max(int(name.split("/")[0]) for name in golden if name.endswith("/frames"))
    step = int(golden[f"{last}/frames"][-1])
    states = golden[f"{last}/state"].numpy()[None].repeat(step + 1, 0)
    episode: Any = policy.start_episode(read("meta")["sizes"]["goal"])
    episode.observe({name: view[: step + 1] for name, view in views.items()}, states)
    following = step + 2 * window.stride
    assert episode.plan(following, policy._tokens(episode, following), policy.backbone)
    while episode.advance(policy.backbone):
        pass
    for name, expected in golden.items():
        if name.startswith("prefix/"):
            _, layer, kind = name.split("/")
            cached = getattr(
                episode.video.ahead.cache.layers[int(layer.removeprefix("layer"))], kind
            )
            assert error(cached, expected) < TOLERANCE


def test_names_and_shapes_at_full_size() -> None:
    from mme_vla import build_policy
    from mme_vla.extras.methods.simplememvla.weights import simplememvla_adapter

    policy = build_policy("simplememvla", backbone="simplememvla", device="meta")
    shapes = simplememvla_adapter(policy).shapes(policy.state_dict())
    assert {name: list(shape) for name, shape in shapes.items()} == read("full_size_names")
