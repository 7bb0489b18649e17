"""Learning from a policy's own trajectories: collection, and the log-probability of chunks."""
