"""`python -m mme_vla.subgoal.build`: the command is mme_vla/commands/subgoal_build.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("subgoal_build")
