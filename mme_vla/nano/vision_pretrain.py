"""`python -m mme_vla.nano.vision_pretrain`: the command is mme_vla/commands/vision_pretrain.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("vision_pretrain")
