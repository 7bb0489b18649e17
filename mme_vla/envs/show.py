"""`python -m mme_vla.envs.show`: the command is mme_vla/commands/gallery.py."""

from mme_vla.commands.gallery import main

if __name__ == "__main__":
    main()
