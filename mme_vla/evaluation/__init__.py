"""From a policy and an environment to the paper's tables: records, protocol, results, analyses."""
