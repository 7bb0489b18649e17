r"""How this checkpoint was made and asked, with the code of commit 7acc6d8 (before the folders were
rearranged).

    python -m mme_vla.train model=framesamp_modul backbone=tiny data=sample \
        backbone.vision.{image_size=16,patch_size=1,depth=1,width=8,mlp_dim=8,num_heads=1} \
        backbone.{vlm,action}.{width,mlp_dim}=8 backbone.{depth,num_heads}=1 backbone.{head_dim,action_dim}=8 \
        backbone.vocab_size=1024 memory.budget=32 memory.grid=2 train.steps=4 train.log_every=1 train.save_every=2 \
        train.val_samples=2 train.open_loop_chunks=0 train.workers=0 train.batch_size=2 logger=none

`run/` is that run as its second update left it; `expected.json` holds the losses of the next two,
and the actions that this file prints.
"""  # noqa: E501

import json
import sys

import numpy as np

from mme_vla import MMEPolicy


def actions(policy: MMEPolicy, cameras: tuple[str, str]) -> np.ndarray:
    """Two chunks [2, 20, 8] of one episode: after a short video, and four frames later."""
    rng = np.random.default_rng(5)
    episode = policy.start_episode("press the button", seed=3)
    chunks = []
    for count in (9, 4):
        frames = {
            name: rng.integers(0, 256, (count, 64, 64, 3), dtype=np.uint8) for name in cameras
        }
        state = rng.normal(size=(count, 8)).astype(np.float32)
        episode.observe(
            frames, state, is_demo=np.arange(count) < count - 1 if count == 9 else False
        )
        chunks.append(policy.act([episode])[0])
    return np.stack(chunks)


if __name__ == "__main__":
    print(
        json.dumps(
            actions(MMEPolicy.from_pretrained(sys.argv[1]), ("image", "wrist_image")).tolist()
        )
    )
