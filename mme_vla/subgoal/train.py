"""`python -m mme_vla.subgoal.train`: the command is mme_vla/commands/subgoal_train.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("subgoal_train")
