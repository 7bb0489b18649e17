"""The π0.5 backbone: without memory, with two extension points for it (blocks and the per-layer
hook).
"""
