"""A checkpoint of this library behind another protocol: no client can tell it from another server.

    python served_checkpoint.py robomme outputs/run --port 8000
    mme-vla audit server=ws://127.0.0.1:8000 protocol=robomme …

All that a policy gets is what the protocol carries: of `robomme` every frame of the memory camera,
of `openpi` the current frame at each chunk.
"""

import argparse

import numpy as np
from stub_servers import Policy, Stream, Stub, make_server

from mme_vla import Policy as LoadedPolicy


def behind(policy: LoadedPolicy) -> Policy:
    """The policy as a stub's. It sees an episode's frames anew at each chunk."""
    robot = policy.embodiment

    def choose(stream: Stream) -> np.ndarray:
        episode = policy.start_episode(stream.goal)
        images = np.stack(stream.frames)
        is_demo = np.arange(len(images)) < stream.n_video
        episode.observe({robot.memory_camera: images}, np.stack(stream.states), is_demo)
        return policy.act(episode)

    return choose


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("protocol", choices=("openpi", "robomme"))
    parser.add_argument("checkpoint", help="of a policy with one camera")
    parser.add_argument("--port", type=int, default=8000)
    options = parser.parse_args()
    loaded = LoadedPolicy.from_pretrained(options.checkpoint, trust_plugins=True).eval()
    print(f"{options.protocol} at port {options.port}", flush=True)
    make_server(options.protocol, Stub(policy=behind(loaded)), options.port).serve_forever()
