"""What every composition has to do, whatever memory and integration it is made of."""

import copy

import numpy as np
import pytest
import torch

from mme_vla import UserError, build_policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import (
    SMALL_VISION,
    moving_frames,
    random_batch,
    random_history,
    small_policy,
)
from mme_vla.utils import SUMS

TOLERANCE = 2e-5
FEW_TOKENS = {"vision": {**SMALL_VISION, "patch_size": 8}}
"""8×8 tokens a view; nothing here depends on their number."""
MEMORY = {"budget": 128}
NEURAL = [
    "framesamp_context",
    "tokendrop_modul",
    "framesamp_expert",
    "rmt_context",
    "ttt_modul",
    "ttt_expert",
]
"""Every memory, and every integration with a memory that selects tokens and with a
recurrent one.
"""


@pytest.fixture(params=["pi05", *NEURAL])
def policy(request):
    memory = {} if request.param == "pi05" else {"memory": MEMORY}
    return small_policy(request.param, backbone=FEW_TOKENS, **memory)


@pytest.fixture(params=NEURAL)
def remembering(request):
    return small_policy(request.param, backbone=FEW_TOKENS, memory=MEMORY)


@torch.no_grad()
def velocity(policy, batch, seed=1):
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(batch.actions.shape, generator=generator)
    return policy.predict(batch, noise, torch.full((len(noise),), 0.6))


@torch.no_grad()
def test_cached_prefix_equals_the_joint_pass(policy):
    batch = random_batch(policy)
    noise = torch.randn(batch.actions.shape, generator=torch.Generator().manual_seed(2))
    time_ = torch.full((2,), 0.7)
    prefix, injection = prefill(policy, batch)
    action = policy.backbone.action_block(noise)
    transformer = policy.backbone.transformer
    layout = transformer.layout([action], policy.integration.visibility, prefix)
    condition = policy.backbone.time_condition(time_)
    hidden = transformer([action], layout, condition, injection.hook, prefix)
    cached = policy.backbone.project_actions(hidden)
    assert (cached - policy.predict(batch, noise, time_)).abs().max() < TOLERANCE


def test_masked_history_cannot_change_the_action(remembering):
    batch = random_batch(remembering, valid=100)
    before = velocity(remembering, batch)
    hidden = ~batch.history.mask
    assert hidden.any()
    batch.history.features[hidden] = 1e3
    batch.history.positions[hidden] = 77
    assert torch.allclose(velocity(remembering, batch), before, atol=TOLERANCE)


def test_remembered_history_changes_the_action(remembering):
    batch = random_batch(remembering, valid=100)
    before = velocity(remembering, batch)
    batch.history.features[batch.history.mask] += 3.0
    assert (velocity(remembering, batch) - before).abs().max() > 1e-4


def test_order_of_time_matters_through_positions_alone(remembering):
    batch = random_batch(remembering, valid=100)
    before = velocity(remembering, batch)
    mask = batch.history.mask[0]
    batch.history.positions[:, mask, 0] = batch.history.positions[:, mask, 0].flip(1)
    assert (velocity(remembering, batch) - before).abs().max() > 1e-6  # fresh slots hardly move yet


def test_padding_of_the_prompt_never_matters(policy):
    batch = random_batch(policy)
    before = velocity(policy, batch)
    batch.prompt = torch.where(batch.prompt_mask, batch.prompt, 99)
    assert torch.allclose(velocity(policy, batch), before, atol=TOLERANCE)


def test_a_hidden_view_never_matters(policy):
    batch = random_batch(policy)
    batch.image_mask[:, 1] = False
    before = velocity(policy, batch)
    batch.images[:, 1] = 255 - batch.images[:, 1]
    assert torch.allclose(velocity(policy, batch), before, atol=TOLERANCE)


def test_batch_equals_each_alone(policy):
    batch = random_batch(policy, batch=3)
    together = velocity(policy, batch)
    for i in range(3):
        alone = batch._map(lambda x, i=i: x[i : i + 1])
        noise = torch.randn(batch.actions.shape, generator=torch.Generator().manual_seed(1))[
            i : i + 1
        ]
        with torch.no_grad():
            one = policy.predict(alone, noise, torch.full((1,), 0.6))
        assert (one - together[i : i + 1]).abs().max() < TOLERANCE


def test_loss_reaches_every_trainable_parameter(policy):
    """What no action reads is not there: no parameter is left without a gradient."""
    policy.train()
    for parameter in policy.backbone.vision.parameters():
        parameter.requires_grad_(False)
    loss, metrics = policy(random_batch(policy))
    loss.backward()
    unread = [name for name, p in policy.named_parameters() if p.requires_grad and p.grad is None]
    assert unread == []
    assert torch.isfinite(metrics["loss"])


def test_gradient_checkpointing_changes_nothing(remembering):
    losses = []
    for checkpointing in (False, True):
        remembering.backbone.transformer.gradient_checkpointing = checkpointing
        remembering.zero_grad()
        batch = random_batch(remembering)
        noise = torch.zeros_like(batch.actions)
        loss, _ = remembering(batch, noise, torch.full((2,), 0.5))
        loss.backward()
        gradient = remembering.memory.encoder.project.weight.grad
        losses.append((loss.item(), gradient.clone()))
    assert losses[0][0] == pytest.approx(losses[1][0], abs=1e-6)
    assert torch.allclose(losses[0][1], losses[1][1], atol=1e-6)


def test_modulator_encodes_memory_once_per_chunk():
    policy = small_policy("framesamp_modul", backbone=FEW_TOKENS)
    calls = {"memory": 0, "keys": 0, "recall": 0}
    layer = policy.integration.layers[0]
    policy.memory.register_forward_hook(lambda *_: calls.update(memory=calls["memory"] + 1))
    layer.kv.register_forward_hook(lambda *_: calls.update(keys=calls["keys"] + 1))
    layer.q.register_forward_hook(lambda *_: calls.update(recall=calls["recall"] + 1))
    policy.sample_actions(random_batch(policy), steps=10)
    assert calls == {"memory": 1, "keys": 1, "recall": 10}


def test_exact_identity_modulator_is_the_memoryless_policy_to_the_bit():
    memoryless, modulated = (
        small_policy("pi05", backbone=FEW_TOKENS),
        small_policy(
            "framesamp_modul", backbone=FEW_TOKENS, integration={"exact_identity": "true"}
        ),
    )
    shared = memoryless.state_dict()
    assert not modulated.load_state_dict(shared, strict=False).unexpected_keys
    batch = random_batch(memoryless)
    before = velocity(memoryless, batch)
    batch.history = random_history(modulated, 2, 100)
    assert torch.equal(velocity(modulated, batch), before)


def test_released_modulator_starts_near_the_memoryless_policy():
    memoryless, modulated = (
        small_policy("pi05", backbone=FEW_TOKENS),
        small_policy("framesamp_modul", backbone=FEW_TOKENS),
    )
    modulated.load_state_dict(memoryless.state_dict(), strict=False)
    batch = random_batch(memoryless)
    before = velocity(memoryless, batch)
    batch.history = random_history(modulated, 2, 100)
    distance = (velocity(modulated, batch) - before).norm() / before.norm()
    assert 0 < distance < 0.05


def prefill(policy, batch):
    """Keys and values of the prefix, and what the memory injects."""
    memory = policy.model.memory_tokens(batch)
    injection = policy.model.inject(policy.model.prepare_images(batch), memory)
    transformer = policy.backbone.transformer
    layout = transformer.layout(injection.blocks, injection.visibility)
    space = transformer.cache_space(injection.blocks, policy.horizon)
    transformer(injection.blocks, layout, past=space)
    return space.after(layout), injection


@torch.no_grad()
def prefix_keys(policy, batch):
    """Last-layer keys of the valid image and prompt tokens."""
    prefix, _ = prefill(policy, batch)
    after_memory = slice(policy.memory.budget, None)
    return prefix.layers[-1].past()[0][:, after_memory][prefix.mask[:, after_memory]]


@pytest.mark.parametrize("integration", ["context", "expert"])
def test_prompt_sees_memory_only_if_requested(integration):
    for sees in (True, False):
        setting = {"prompt_sees_memory": str(sees).lower()}
        policy = small_policy(
            f"framesamp_{integration}", backbone=FEW_TOKENS, memory=MEMORY, integration=setting
        )
        row = policy.integration.visibility["prompt"]
        assert ("memory" in row) is sees
        batch = random_batch(policy)
        before = prefix_keys(policy, batch)
        batch.history.features += 3.0
        unmoved = torch.allclose(before, prefix_keys(policy, batch), atol=TOLERANCE)
        assert unmoved is not sees


@pytest.mark.parametrize("budget", [64, 2048])
@pytest.mark.parametrize("memory", ["framesamp", "tokendrop", "ttt", "rmt"])
def test_budget_is_a_number_in_the_config(memory, budget):
    policy = small_policy(f"{memory}_context", backbone=FEW_TOKENS, memory={"budget": budget})
    batch = random_batch(policy, batch=1, valid=64)
    tokens = policy.model.memory_tokens(batch)
    assert tokens.tokens.shape[1] == tokens.mask.shape[1] == budget
    assert velocity(policy, batch).isfinite().all()


def test_unknown_names_are_answered_with_the_near_ones():
    with pytest.raises(UserError, match="tokendrop_expert"):
        build_policy("tokendrp_expert")
    with pytest.raises(UserError, match="budget"):
        build_policy("framesamp_context", memory={"bugdet": 256})


def test_seed_of_an_episode_may_be_any_integer():
    policy = small_policy("pi05", backbone=FEW_TOKENS)
    state = policy.start_episode("go", 3).noise_state
    assert torch.equal(policy.start_episode("go", np.int64(3)).noise_state, state)
    for seed in (None, 1.5, "7", 2**64):
        with pytest.raises(UserError, match="must be a whole number of 64 bits"):
            policy.start_episode("go", seed)


@pytest.mark.parametrize(
    "model", ["framesamp_modul", "rmt_context", "actions_modul", "spacetime_modul"]
)
def test_copies_of_an_episode_share_its_policy_and_nothing_else(model):
    policy = small_policy(model, backbone=FEW_TOKENS)
    frames = moving_frames(5, size=policy.backbone.image_size)
    views = {"front": frames, "wrist": frames}

    def begun():
        episode = policy.start_episode("press the button")
        episode.observe(views, np.zeros((5, 8), np.float32))
        return episode

    def observed(episode):
        episode.observe(views, np.ones((5, 8), np.float32))
        return policy.act(episode)

    episode = begun()
    branch = copy.deepcopy(episode)
    assert branch.policy is policy
    assert (observed(branch) == observed(begun())).all()
    assert (observed(copy.copy(episode)) == observed(begun())).all()
    assert (policy.act(episode) == policy.act(begun())).all()
    other, beside = copy.deepcopy([policy, episode])
    assert beside.policy is other is not policy


def test_an_episode_does_not_share_arrays_with_its_caller():
    policy = small_policy("pi05", backbone=FEW_TOKENS, processor={"prompt": "past_actions"})
    frames = moving_frames(4, size=policy.backbone.image_size)
    views = {"front": frames, "wrist": frames}
    states = np.zeros((4, 8), np.float32)
    chunks = []
    for reuses in (False, True):
        episode = policy.start_episode("press the button")
        episode.observe(views, states)
        chunk = policy.act(episode)
        prefix = chunk[4:8].copy()
        episode.set_action_prefix(prefix, np.int64(2))
        if reuses:
            chunk[:] = prefix[:] = 9.0
        episode.observe(views, states)
        chunks.append(policy.act(episode))
    assert (chunks[0] == chunks[1]).all()


def test_past_states_out_of_range_are_refused_as_current_ones_are(remembering):
    episode = remembering.start_episode("press the button")
    frames = moving_frames(4, size=remembering.backbone.image_size)
    states = np.zeros((4, 8), np.float32)
    states[1, 2] = 5000
    with pytest.raises(UserError, match="5000 for number 3 of 8"):
        episode.add_frames(frames, states=states)
    assert episode.n_observed_frames == 0


@pytest.mark.parametrize(
    ("rendered", "says"),
    [
        ({"front": [7], "wrist": [0]}, r"rendered\['front'\]=\[7\] must be ascending .* 0 to 2"),
        ({"front": [1, 0], "wrist": [0, 1]}, "must be ascending"),
        ({"front": [0]}, r"rendered=\['front'\] lacks the camera 'wrist'"),
    ],
)
def test_indices_of_rendered_frames_that_cannot_be_are_refused(rendered, says):
    policy = small_policy("framesamp_modul", backbone=FEW_TOKENS)
    frames = moving_frames(3, size=policy.backbone.image_size)
    views = {name: frames[: len(rendered.get(name, [0]))] for name in ("front", "wrist")}
    episode = policy.start_episode("press the button")
    with pytest.raises(UserError, match=says):
        episode.observe(views, np.zeros((3, 8), np.float32), rendered=rendered)
    assert episode.n_observed_frames == 0


def test_an_episode_of_another_policy_is_refused():
    policy, other = (small_policy("pi05", backbone=FEW_TOKENS) for _ in range(2))
    frames = moving_frames(1, size=policy.backbone.image_size)
    episode = policy.start_episode("press the button")
    episode.observe({"front": frames, "wrist": frames}, np.zeros((1, 8), np.float32))
    before = episode.noise_state
    with pytest.raises(UserError, match="An episode belongs to another policy"):
        other.act([episode])
    assert torch.equal(episode.noise_state, before)


def test_a_device_that_is_none_is_refused():
    with pytest.raises(UserError, match="device='cudo' is not a device; choose auto, cpu, cuda"):
        build_policy("pi05", device="cudo")


def test_change_of_precision_keeps_masks_and_indices():
    batch = random_batch(small_policy("framesamp_modul", backbone=FEW_TOKENS, memory=MEMORY))
    half = batch.to(dtype=torch.bfloat16)
    assert half.actions.dtype == half.history.features.dtype == torch.bfloat16
    for name in ("images", "image_mask", "prompt", "prompt_mask"):
        assert getattr(half, name).dtype == getattr(batch, name).dtype
    assert half.history.mask.dtype == torch.bool
    assert batch.to("meta", torch.bfloat16).prompt_mask.device.type == "meta"


def test_bfloat16_compute_stays_close_to_float32(remembering):
    batch = random_batch(remembering)
    exact = velocity(remembering, batch)
    remembering.compute_dtype = torch.bfloat16
    rounded = velocity(remembering, batch)
    assert rounded.dtype == torch.float32
    assert (rounded - exact).norm() / exact.norm() < 0.05
    assert all(p.dtype == torch.float32 for p in remembering.parameters())


def test_sampling_is_reproducible_and_follows_its_noise(policy):
    batch = random_batch(policy)
    first = policy.sample_actions(batch, generator=torch.Generator().manual_seed(3))
    again = policy.sample_actions(batch, generator=torch.Generator().manual_seed(3))
    other = policy.sample_actions(batch, generator=torch.Generator().manual_seed(4))
    assert torch.equal(first, again)
    assert not torch.allclose(first, other)


def test_checkpoint_round_trip_keeps_every_number(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    loaded = MMEPolicy.from_pretrained(tmp_path)
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, loaded.state_dict()[name]), name
    batch = random_batch(policy)
    assert torch.equal(velocity(policy, batch), velocity(loaded, batch))


def test_foreign_checkpoints_are_refused(tmp_path):
    policy = small_policy("framesamp_modul", backbone=FEW_TOKENS)
    with pytest.raises(UserError, match=r"config\.json"):
        MMEPolicy.from_pretrained(tmp_path / "nowhere")
    policy.save_pretrained(tmp_path / "first")
    other = small_policy("tokendrop_expert", backbone=FEW_TOKENS)
    other.save_pretrained(tmp_path / "other")
    (tmp_path / "other" / "config.json").write_text(
        (tmp_path / "first" / "config.json").read_text()
    )
    (tmp_path / "other" / SUMS).unlink()
    with pytest.raises(UserError, match=r"(?s)missing.*unexpected"):
        MMEPolicy.from_pretrained(tmp_path / "other")


def test_noise_that_is_not_given_is_sampled():
    policy = small_policy("pi05", backbone=FEW_TOKENS)
    batch = random_batch(policy, batch=2)
    noise, time_ = torch.randn(batch.actions.shape), torch.full((2,), 0.5)
    with torch.no_grad():
        for given in ({}, {"noise": {}}, {"noise": noise}, {"time": time_}):
            loss, _ = policy(batch, **given)
            assert torch.isfinite(loss)


def test_a_masked_loss_does_not_depend_on_what_is_computed_together():
    policy = small_policy("pi05", backbone=FEW_TOKENS)
    batch = random_batch(policy, batch=4)
    batch.action_mask = torch.arange(batch.actions.shape[1]).expand(4, -1) < torch.tensor(
        [[1], [20], [7], [20]]
    )
    noise, time_ = torch.randn(batch.actions.shape), torch.full((4,), 0.5)
    with torch.no_grad():
        together, _ = policy(batch, noise, time_)
        halves = [
            policy(batch._map(lambda x, rows=rows: x[rows]), noise[rows], time_[rows])[0]
            for rows in (slice(0, 2), slice(2, 4))
        ]
        changed = batch.actions.clone()
        changed[0, 1:] += 9.0
        batch.actions = changed
        unchanged, _ = policy(batch, noise, time_)
    assert together.item() == pytest.approx(sum(h.item() for h in halves) / 2, abs=1e-5)
    assert torch.isfinite(unchanged)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("memory", "options", "message"),
    [
        ("framesamp", {"budget": 500}, "memory.budget=500.*512|496"),
        ("framesamp", {"pooling": "median"}, "'median'"),
        ("framesamp", {"grid": 5, "budget": 500}, "grid=5"),
        ("framesamp", {"position_dim": 0}, "position_dim=0"),
        ("framesamp", {"position_hidden": 0}, "position_hidden=0 must be at least 1"),
        ("tokendrop", {"grid": 0}, "grid=0"),
        ("tokendrop", {"stride": 0}, "memory.stride=0"),
        ("tokendrop", {"budget": 63}, "memory.budget=63"),
        ("tokendrop", {"budget": 4096}, "memory.budget=4096"),
        ("ttt", {"budget": 4097}, "memory.budget=4097"),
        ("ttt", {"heads": 3}, "multiple of memory.heads=3"),
        ("ttt", {"max_rate": 0}, "above 0"),
        ("ttt", {"jitter": 8}, "memory.jitter=8"),
        ("ttt", {"chunk": 0}, "memory.chunk=0"),
        ("rmt", {"budget": 0}, "memory.budget=0"),
        ("rmt", {"rotation": "sine"}, "cosine_only"),
        ("rmt", {"attention_dtype": "int8"}, "bfloat16"),
        ("rmt", {"heads": 3}, "even multiple of heads"),
        ("retrieval", {"cut": 2.0}, "memory.cut"),
        ("retrieval", {"longest": 0}, "memory.longest"),
        ("moment", {"budget": 10}, "multiple of memory.moments"),
        ("moment", {"heads": 7}, "memory.heads=7"),
        ("gist", {"budget": 96}, "choose at least 104"),
        ("gist", {"recent": 0}, "memory.recent=0"),
        ("learned_topk", {"pool": 2}, "memory.pool=2"),
        ("learned_topk", {"temperature": 0.0}, "memory.temperature"),
        ("actions", {"layers": 0}, "memory.layers"),
        ("actions", {"max_steps": 0}, "memory.max_steps"),
        ("bank", {"budget": 16}, "budget=16 does not hold the 8×8 tokens"),
        ("bank", {"moments": 4}, "moments=4 must be .* more than memory.video=16"),
    ],
)
def test_options_of_a_memory_that_cannot_be_are_refused(memory, options, message):
    with pytest.raises(UserError, match=message):
        build_policy(f"{memory}_modul", memory=options, device="meta")


def test_a_backbone_of_no_size_is_refused():
    with pytest.raises(UserError, match="num_heads=0"):
        build_policy("pi05", backbone={"num_heads": 0})
