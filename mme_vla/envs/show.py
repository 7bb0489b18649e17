"""`python -m mme_vla.envs.show`: the command is mme_vla/commands/gallery.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("gallery")
