"""Policies for `cues.py` that read one thing each, behind a stub of the released server.

python fakes.py clock --port 8000
mme-vla audit env=cues plugins=[cues] tasks=Cues server=ws://127.0.0.1:8000 recordings=<its demonstrations>
"""  # noqa: E501

import argparse

import numpy as np
from stub_servers import Stream, Stub, make_server


def light(frame: np.ndarray) -> int:
    """Where the light is in a frame: −1 left, 1 right, 0 nowhere."""
    bright = np.asarray(frame, int)[8:32, :, 0].mean(axis=0)
    left, right = bright[:32].mean(), bright[32:].mean()
    return 0 if abs(left - right) < 30 else int(np.sign(right - left))


def towards(side: int) -> np.ndarray:
    """Four steps to a side; to the right where none is known."""
    return np.full((4, 1), side or 1, np.float32)


def video(stream: Stream) -> np.ndarray:
    """Remembers where the light was in the video."""
    sides = [light(frame) for frame in stream.frames[: stream.n_video]]
    return towards(next((side for side in sides if side), 0))


def clock(stream: Stream) -> np.ndarray:
    """Counts frames, and never looks at one."""
    return towards(-1 if len(stream.frames) < 30 else 1)


def memoryless(stream: Stream) -> np.ndarray:
    """Sees the current frame alone."""
    return towards(light(stream.frames[-1]))


def own_actions(stream: Stream) -> np.ndarray:
    """Repeats its own last chunk; the first follows the current frame."""
    if stream.chunks:
        return towards(int(np.sign(stream.chunks[-1][0, 0])))
    return memoryless(stream)


def last_frame(stream: Stream) -> np.ndarray:
    """Remembers the frame before the current one, and no other."""
    return towards(light(stream.frames[-1]) or light(stream.frames[-2:][0]))


def goal(stream: Stream) -> np.ndarray:
    """Reads the goal alone."""
    return towards(-1 if "left" in stream.goal else 1)


FAKES = {fake.__name__: fake for fake in (video, clock, memoryless, own_actions, last_frame, goal)}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("fake", choices=FAKES)
    parser.add_argument("--protocol", default="robomme")
    parser.add_argument("--port", type=int, default=8000)
    options = parser.parse_args()
    stub = Stub(policy=FAKES[options.fake])
    print(f"{options.fake} at port {options.port}", flush=True)
    make_server(options.protocol, stub, options.port).serve_forever()
