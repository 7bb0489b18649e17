"""How far a freshly added memory moves a memoryless π0.5: relative distance of the predicted
velocity.

    python benchmarks/initial_distance.py

Every variant gets the same weights as a `pi05` whose adaptive gates are open (a fresh π0.5 has them
shut, which would hide everything); only the memory's own parameters are as initialised. Mean over
eight random batches.
"""

import argparse

import torch

from mme_vla.testing.small import NEURAL, random_batch, random_history, small_policy


@torch.no_grad()
def distance(name: str, **overrides: object) -> float:
    """Mean of |v_memory − v_plain| / |v_plain|."""
    baseline, remembering = small_policy("pi05"), small_policy(name, **overrides)
    remembering.load_state_dict(baseline.state_dict(), strict=False)
    distances = []
    for seed in range(8):
        batch = random_batch(baseline, seed=seed)
        noise = torch.randn(batch.actions.shape, generator=torch.Generator().manual_seed(seed))
        time = torch.full((len(noise),), 0.5)
        before = baseline.predict(batch, noise, time)
        batch.history = random_history(remembering, len(noise), remembering.memory.budget, seed)
        after = remembering.predict(batch, noise, time)
        distances.append(float((after - before).norm() / before.norm()))
    return sum(distances) / len(distances)


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    print("| model | relative distance at initialisation |\n|---|---:|")
    for name in NEURAL:
        print(f"| `{name}` | {distance(name):.1e} |")
    exact = distance("framesamp_modul", integration={"exact_identity": True})
    print(f"| `framesamp_modul integration.exact_identity=true` | {exact:.1e} |")


if __name__ == "__main__":
    main()
