"""`python -m mme_vla.play`: the command is mme_vla/commands/play.py."""

from mme_vla.commands.play import main

if __name__ == "__main__":
    main()
