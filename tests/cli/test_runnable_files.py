"""Every file of `benchmarks/` and `examples/` that is meant to be run imports what it uses and has a `--help`."""

import json
from pathlib import Path

import pytest

from helpers import commands

REPOSITORY = Path(__file__).resolve().parents[2]

# One process for all files, which has imported PyTorch: that is most of the time.
ALL = """
import contextlib, io, json, runpy, sys, traceback
ended = {}
for file in json.loads(sys.argv[1]):
    sys.argv, sys.path[0] = [file, "--help"], file.rpartition("/")[0]
    printed, code = io.StringIO(), None
    try:
        with contextlib.redirect_stdout(printed):
            runpy.run_path(file, run_name="__main__")
    except SystemExit as error:
        code = error.code
    except Exception:
        code = traceback.format_exc()
    ended[file] = [code, printed.getvalue()]
print(json.dumps(ended))
"""


@pytest.mark.slow
def test_every_benchmark_and_example_imports_and_has_help(tmp_path: Path) -> None:
    files = sorted(
        str(file)
        for folder in ("benchmarks", "examples")
        for file in (REPOSITORY / folder).rglob("*.py")
        if '__name__ == "__main__"' in file.read_text()
    )
    assert any(file.endswith("subgoal_cost.py") for file in files)
    all_of_them = tmp_path / "all.py"
    all_of_them.write_text(ALL)
    done = commands.run(str(all_of_them), json.dumps(files))
    assert done.returncode == 0, done.stderr
    ended = json.loads(done.stdout.splitlines()[-1])
    assert {Path(file).name: code for file, (code, _) in ended.items() if code != 0} == {}
    assert [file for file, (_, printed) in ended.items() if not printed.startswith("usage: ")] == []
