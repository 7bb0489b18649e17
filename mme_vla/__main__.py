"""`mme-vla COMMAND …`, the same as `python -m mme_vla COMMAND …`: the library's commands under one
name.
"""

import sys

from mme_vla.cli import COMMANDS, run
from mme_vla.cli.errors import print_user_errors
from mme_vla.errors import did_you_mean


def main() -> None:
    """Run the command that the first word names, with the words after it; without one, list the
    commands.
    """
    name, *words = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        lines = "\n".join(
            f"  {command:<{width}}  {does}" for command, (_, does) in COMMANDS.items()
        )
        with print_user_errors():
            print(
                f"usage: mme-vla COMMAND …\n\n{lines}\n\nmme-vla COMMAND --help says more of one."
            )
        return
    if name not in COMMANDS:
        print(
            f"mme-vla: there is no command {name!r}. {did_you_mean(name, COMMANDS)}",
            file=sys.stderr,
        )
        raise SystemExit(2)
    sys.argv = [f"mme-vla {name}", *words]
    run(COMMANDS[name][0])


if __name__ == "__main__":
    main()
