"""One digest of the scenes of `tests/data/task_scenes.json`, to the bit.

`python -m helpers.scene_digest [EVERY]` prints it.
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

from mme_vla.envs.make import make_task

SCENES = json.loads((Path(__file__).resolve().parents[1] / "data" / "task_scenes.json").read_text())


def scene_bits(scene: dict[str, Any]) -> str:
    """Sampled values and poses of a scene as text that keeps every bit."""
    options = {key: scene[key] for key in ("seed", "difficulty", "recovery") if key in scene}
    env = make_task(scene["task"], render=False, **options)
    env.reset()
    poses = {thing.name: [*thing.pose.p.tolist(), *thing.pose.q.tolist()] for thing in env.things}
    # JSON writes a float by the shortest text that reads back as the same bits.
    text = json.dumps([env.scene_values()["spec"], poses], sort_keys=True)
    env.close()
    return text


def scene_digest(every: int = 1) -> str:
    """SHA-256 over every so many scenes of the file, in order."""
    digest = hashlib.sha256()
    for scene in SCENES[::every]:
        digest.update(scene_bits(scene).encode())
    return digest.hexdigest()


if __name__ == "__main__":
    print(scene_digest(int(sys.argv[1]) if len(sys.argv) > 1 else 1))
