"""`python -m mme_vla.evaluate`: the command is mme_vla/cli/evaluate.py.

The function `mme_vla.evaluate` is in mme_vla/evaluation/rollout/evaluation.py.
"""

from mme_vla.cli import run

if __name__ == "__main__":
    run("evaluate")
