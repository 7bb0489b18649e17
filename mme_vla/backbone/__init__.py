"""The π0.5 backbone: it knows nothing of memory, and opens two doors for it (blocks and the per-layer hook)."""
