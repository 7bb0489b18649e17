"""`lerobot-train` as it is, but that a resumed run begins its first update with the random state of
its checkpoint.

LeRobot restores that state, then makes the iterator of its data loader, which draws one number from
it.
"""

from typing import Any

import torch
from lerobot.scripts import lerobot_train


def main() -> None:
    load, update = lerobot_train.load_training_state, lerobot_train.update_policy
    states: list[torch.Tensor] = []

    def loading(*args: Any, **options: Any) -> Any:
        state = load(*args, **options)
        states.append(torch.get_rng_state())
        return state

    def updating(*args: Any, **options: Any) -> Any:
        if states:
            torch.set_rng_state(states.pop())
        return update(*args, **options)

    lerobot_train.load_training_state, lerobot_train.update_policy = loading, updating
    lerobot_train.main()


if __name__ == "__main__":
    main()
