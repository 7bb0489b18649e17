"""Policies for `cues.py` that read one thing each, behind a stub of the released server.

python fakes.py clock --port 8000
mme-vla audit env=cues plugins=[cues] tasks=Cues server=ws://127.0.0.1:8000 recordings=<its demonstrations>
"""  # noqa: E501

import argparse

import numpy as np
from stub_servers import Seen, Stub, make_server


def light(frame: np.ndarray) -> int:
    """Where the light is in a frame: −1 left, 1 right, 0 nowhere."""
    bright = np.asarray(frame, int)[8:32, :, 0].mean(axis=0)
    left, right = bright[:32].mean(), bright[32:].mean()
    return 0 if abs(left - right) < 30 else int(np.sign(right - left))


def towards(side: int) -> np.ndarray:
    """Four steps to a side; to the right where none is known."""
    return np.full((4, 1), side or 1, np.float32)


def video(seen: Seen) -> np.ndarray:
    """Remembers where the light was in the video."""
    sides = [light(frame) for frame in seen.frames[: seen.n_video]]
    return towards(next((side for side in sides if side), 0))


def clock(seen: Seen) -> np.ndarray:
    """Counts frames, and never looks at one."""
    return towards(-1 if len(seen.frames) < 30 else 1)


def memoryless(seen: Seen) -> np.ndarray:
    """Sees the current frame alone."""
    return towards(light(seen.frames[-1]))


def own_actions(seen: Seen) -> np.ndarray:
    """Repeats its own last chunk; the first follows the current frame."""
    if seen.chunks:
        return towards(int(np.sign(seen.chunks[-1][0, 0])))
    return memoryless(seen)


def last_frame(seen: Seen) -> np.ndarray:
    """Remembers the frame before the current one, and no other."""
    return towards(light(seen.frames[-1]) or light(seen.frames[-2:][0]))


def goal(seen: Seen) -> np.ndarray:
    """Reads the goal alone."""
    return towards(-1 if "left" in seen.goal else 1)


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
