"""Probes: what a policy takes from its memory; and the paper's analyses of a memory."""
