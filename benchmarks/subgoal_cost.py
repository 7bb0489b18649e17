"""What a subgoal predictor costs in an episode, beside the policy that reads it: calls, tokens and
FLOPs.

    python benchmarks/subgoal_cost.py [--episodes 0 1 2 3]

Plays the execution of demonstrations of the embedded sample through the real predictors, 16 steps
at a time, with stand-ins for the models: they give the recorded subgoals (and MemER's keyframes) as
answers, and count. Qwen3-VL-4B's FLOPs are those of PyTorch's `FlopCounterMode` over the real code
on the meta device: vision tower, one pass over the question with keys and values kept, one pass for
each token of the answer. Tokens of images are exact; words are counted with a small tokenizer of
RoboMME's language, where Qwen's own would take about as many. Gemini's FLOPs are not known; its
tokens of an image are what its documentation says (258), and its thoughts are left out.
"""

import argparse
from collections.abc import Callable, Sequence
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch

from mme_vla.extras.probing.analyses.cost import count_model, flops
from mme_vla.subgoal import Gemini, Memer, QwenVL
from mme_vla.subgoal.finetuning.collecting import Demonstration, open_input
from mme_vla.subgoal.finetuning.labels import Labels, keyframes
from mme_vla.subgoal.models.qwen3vl import VLM, Question
from mme_vla.subgoal.models.replies import Reply
from mme_vla.subgoal.text import mark_points, memer_reply, write_boxes

TERA = 1e12
RUN = 16  # actions executed of a chunk
IMAGE_TOKENS = 258  # Gemini's tokens of an image
QWEN3_VL_4B = {
    "text_config": {
        "vocab_size": 151936,
        "hidden_size": 2560,
        "intermediate_size": 9728,
        "num_hidden_layers": 36,
        "num_attention_heads": 32,
        "num_key_value_heads": 8,
        "head_dim": 128,
        "max_position_embeddings": 262144,
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 5e6,
            "mrope_section": [24, 20, 20],
            "mrope_interleaved": True,
        },
    },
    "vision_config": {
        "depth": 24,
        "hidden_size": 1024,
        "intermediate_size": 4096,
        "num_heads": 16,
        "out_hidden_size": 2560,
        "num_position_embeddings": 2304,
        "deepstack_visual_indexes": [5, 11, 17],
    },
    "tie_word_embeddings": True,
}


@cache
def qwen() -> Any:
    """Qwen3-VL-4B on the meta device."""
    from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

    config: Any = Qwen3VLConfig
    with torch.device("meta"):
        return Qwen3VLForConditionalGeneration(config(**QWEN3_VL_4B)).eval()


@cache
def vision_flops(patches: int, n_images: int) -> int:
    """The vision tower and its mergers on images of this many patches each, attention
    within each.
    """
    tower = qwen().model.visual
    total = patches * n_images
    pixels = torch.empty(total, 3 * 2 * 16 * 16, device="meta")
    angles = torch.empty(total, 64, device="meta")
    # on the CPU: the attention splits by their values
    bounds = torch.arange(n_images + 1) * patches

    def run() -> None:
        hidden = tower.patch_embed(pixels)
        for layer, block in enumerate(tower.blocks):
            hidden = block(hidden, cu_seqlens=bounds, position_embeddings=(angles, angles))
            if layer in tower.deepstack_visual_indexes:
                tower.deepstack_merger_list[tower.deepstack_visual_indexes.index(layer)](hidden)
        tower.merger(hidden)

    return flops(run)


@cache
def language_flops(read: int, n_output: int) -> int:
    """The language model on `read` tokens, then on `n_output` tokens one after the other."""
    from transformers import DynamicCache

    model, width = qwen(), QWEN3_VL_4B["text_config"]["hidden_size"]
    cache = DynamicCache(config=model.config.get_text_config())

    def step(tokens: int, first: int) -> int:
        positions = torch.arange(first, first + tokens, device="meta").expand(3, 1, -1)

        def run() -> None:
            out = model.model.language_model(
                inputs_embeds=torch.empty(1, tokens, width, device="meta"),
                position_ids=positions,
                past_key_values=cache,
                use_cache=True,
            )
            model.lm_head(out.last_hidden_state[:, -1:])

        return flops(run)

    # the pass over the question gives the first token
    return step(read, 0) + max(n_output - 1, 0) * step(1, read)


class CountingVLM:
    """A fake `VLM`: returns the given answers, and counts FLOPs of Qwen3-VL-4B for
    each question.
    """

    def __init__(self, tiny: VLM) -> None:
        self.tiny, self.next_reply, self.flops = tiny, "", 0

    def generate(self, questions: Sequence[Question], max_new_tokens: int) -> list[Reply]:
        (question,) = questions
        batch = self.tiny.encode([question])
        read = batch["input_ids"].shape[1]
        n_output = len(self.tiny.processor.tokenizer.encode(self.next_reply)) + 1
        for grid in ("image_grid_thw", "video_grid_thw"):
            for time, height, width in batch.get(
                grid, torch.zeros(0, 3, dtype=torch.long)
            ).tolist():
                self.flops += vision_flops(height * width, time)
        self.flops += language_flops(-(-read // 16) * 16, n_output)
        return [Reply(self.next_reply, read, n_output)]


class CountingClient:
    """A fake of openai's client."""

    def __init__(self, tokenizer: Any) -> None:
        self.tokenizer = tokenizer
        self.next_reply = ""
        self.chat = SimpleNamespace(completions=self)

    def create(self, *, messages: list[dict[str, Any]], **options: Any) -> Any:
        read = 0
        for message in messages:
            content = message["content"]
            if isinstance(content, str):
                content = [{"type": "text", "text": content}]
            for part in content:
                if part["type"] == "text":
                    read += len(self.tokenizer.encode(part["text"]))
                else:
                    read += IMAGE_TOKENS
        reply = SimpleNamespace(content=self.next_reply)
        n_output = len(self.tokenizer.encode(self.next_reply))
        return SimpleNamespace(
            choices=[SimpleNamespace(message=reply, finish_reason="stop")],
            usage=SimpleNamespace(prompt_tokens=read, completion_tokens=n_output),
        )


def play(predictor: Any, labels: Labels, say: Callable[[int], None]) -> int:
    """Run one demonstration's execution; returns the number of chunks."""
    blank = np.zeros((labels.length, 256, 256, 3), np.uint8)
    first = labels.exec_start
    episode = predictor.start_episode(labels.goal, blank[:first] if first else None, labels.task)
    episode.observe(blank[first : first + 1])
    chunks = 0
    for step in range(first, labels.length, RUN):
        say(step)
        predictor.predict([episode])
        episode.observe(blank[step + 1 : step + 1 + RUN])
        chunks += 1
    return chunks


def expected_reply(name: str, kind: str, labels: Labels, step: int) -> str:
    """What the model says at a step: the recorded subgoal, in the predictor's form."""
    text = write_boxes(*mark_points(labels.texts(kind)[step]))
    if name == "gemini":
        return f'{{"description": "the robot moved on", "subgoal": "{text}"}}'
    if name != "memer":
        return text
    displayed = [step] if step == labels.exec_start else list(range(step - 14, step + 1, 2))
    targets = keyframes(labels)
    return memer_reply(
        text, [i for i, t in enumerate(displayed, 1) if any(0 <= t - k <= 1 for k in targets)]
    )


def measure(
    name: str,
    kind: str,
    policy: str,
    predictor: Any,
    model: Any,
    episodes: Sequence[Labels],
    baseline: int,
) -> list[str]:
    """Play these episodes; the cells of one row, means over them."""
    chunks = 0
    for labels in episodes:
        reply_at = partial(expected_reply, name, kind, labels)
        chunks += play(
            predictor,
            labels,
            lambda step, reply_at=reply_at: setattr(model, "next_reply", reply_at(step)),
        )
    n, usage = len(episodes), predictor.usage
    acting, reference = chunks * count_model(policy).chunk, chunks * baseline
    counted = isinstance(model, CountingVLM)
    return [
        f"`{name}`, {kind}", f"`{policy}`", f"{chunks / n:.1f}", f"{usage.calls / n:.1f}",
        f"{usage.input_tokens / usage.calls:,.0f}", f"{usage.output_tokens / usage.calls:.0f}",
        f"{model.flops / usage.calls / TERA:.2f} T" if counted else "not known",
        f"{model.flops / n / TERA:.0f} T" if counted else "not known",
        f"{acting / n / TERA:.0f} T",
        f"{(acting + model.flops) / reference:.2f}x" if counted else "",
    ]  # fmt: skip


def count(demonstrations: Sequence[Demonstration]) -> None:
    """Print the table."""
    tiny = VLM.load("tiny", device="cpu")
    episodes = [demonstration.labels() for demonstration in demonstrations]
    baseline = count_model("pi05").chunk  # refuses a PyTorch whose counter leaves out attention
    heads = [
        "predictor", "policy", "chunks", "calls", "tokens read a call", "written a call", "a call",
        "predictor, an episode", "policy, an episode", "together, over `pi05`",
    ]  # fmt: skip
    print(f"| {' | '.join(heads)} |\n|---|---{'|---:' * 8}|")
    simple, grounded, memer = (CountingVLM(tiny) for _ in range(3))
    client = CountingClient(tiny.processor.tokenizer)
    cases = [
        ("qwenvl", "simple", "simplesg", QwenVL("simple", vlm=cast(VLM, simple)), simple),
        ("qwenvl", "grounded", "groundsg", QwenVL("grounded", vlm=cast(VLM, grounded)), grounded),
        ("memer", "grounded", "groundsg", Memer("grounded", vlm=cast(VLM, memer)), memer),
        (
            "gemini",
            "grounded",
            "groundsg",
            Gemini("grounded", client=client),
            client,
        ),
    ]
    for case in cases:
        print(f"| {' | '.join(measure(*case, episodes, baseline))} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--episodes", nargs="+", type=int, default=[0, 1, 2, 3], help="of the embedded sample"
    )
    args = parser.parse_args()
    sample = open_input("sample")
    count([sample[index] for index in args.episodes])


if __name__ == "__main__":
    main()
