"""Learning from a policy's own trajectories: collection, log-probability, a head of choices."""
