"""What a reader of the paper does not need.

Each package adds names to the core in its `extension.py`.

The core never imports an extra. Extras import each other downward alone: methods, trajectories,
play, probing, nano.
"""
