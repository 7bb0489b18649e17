"""What a reader of the paper does not need.

Each package adds names to the core in its `extension.py`.

The core never imports an extra. From the top: audit, mikasa, nano, probing, play, trajectories,
methods. Each imports only those below it.
"""
