"""Run commands one after the other in one process: what imports cost is paid once.

`python command_series.py OUTPUT < COMMANDS`: COMMANDS is a JSON list of command lines (`mme_vla
NAME …` or `mme_vla.NAME …`), OUTPUT becomes a JSON list of `[exit code, printed text]`, written
after each command. A traceback is printed as Python prints it, with exit code 1.
"""

import json
import os
import sys
import tempfile
import traceback
from pathlib import Path


def run(line: str) -> tuple[int, str]:
    """Exit code and output of one command, that of extension modules and child processes
    included.
    """
    from mme_vla.cli import run as run_command

    program, *words = line.split()
    name = program.removeprefix("mme_vla").removeprefix(".") or words.pop(0)
    sys.argv = [program, *words]
    code = 0
    with tempfile.TemporaryFile() as printed:
        sys.stdout.flush()
        sys.stderr.flush()
        streams = [os.dup(1), os.dup(2)]
        os.dup2(printed.fileno(), 1)
        os.dup2(printed.fileno(), 2)
        try:
            run_command(name)
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else int(error.code is not None)
        except BaseException:
            traceback.print_exc()
            code = 1
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, stream in enumerate(streams, start=1):
                os.dup2(stream, number)
                os.close(stream)
        printed.seek(0)
        return code, printed.read().decode(errors="replace")


if __name__ == "__main__":
    output = Path(sys.argv[1]).resolve()  # commands change sys.argv
    results = []
    for line in json.load(sys.stdin):
        results.append(run(line))
        output.write_text(json.dumps(results))
