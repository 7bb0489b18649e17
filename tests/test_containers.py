"""The Dockerfiles, as far as they can be checked without building them: they are built where Docker is."""

import json
import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from mme_vla.config.comments import COMMANDS, keys

REPOSITORY = Path(__file__).resolve().parent.parent
FILES = sorted((REPOSITORY / "docker").glob("*.Dockerfile"))


def steps(file: Path) -> list[tuple[str, str]]:
    """Instructions and their words, comments left out and continued lines joined."""
    lines = [line for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines))
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in joined.splitlines())]


def test_there_is_one_to_serve_and_one_to_evaluate() -> None:
    assert [file.name for file in FILES] == ["evaluate.Dockerfile", "serve.Dockerfile"]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_dockerfile_says_nothing_that_cannot_be(file: Path) -> None:
    found = steps(file)
    assert found[0][0] == "FROM" and re.fullmatch(r"[\w.-]+:[\w.-]+", found[0][1]), "a pinned image"
    python = found[0][1].partition(":")[2].removesuffix("-slim")
    assert (REPOSITORY / ".python-version").read_text().strip().startswith(python)
    for word, rest in found:
        assert word in {"FROM", "WORKDIR", "COPY", "RUN", "USER", "EXPOSE", "ENTRYPOINT", "CMD"}
        if word == "COPY":
            assert (REPOSITORY / rest.split()[0]).exists(), rest
        if "apt-get install" in rest:
            assert "--no-install-recommends" in rest and rest.endswith("rm -rf /var/lib/apt/lists/*"), rest
        if "pip install" in rest:
            assert "--no-cache-dir" in rest and re.search(r"\w==[\d.]+$", rest), rest
        assert not re.search(r"\b(sudo|cd) |:latest|\| *(ba)?sh\b", rest), rest
        for script in re.findall(r"bash (\S+\.sh)", rest):
            assert (REPOSITORY / script).is_file()
    assert [rest for word, rest in found if word == "USER"][-1] != "root"
    words = [word for word, _ in found]
    assert words.index("WORKDIR") < words.index("COPY"), "a relative place needs a folder"
    assert words.count("ENTRYPOINT") == words.count("CMD") == 1


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_it_installs_an_extra_that_exists_and_runs_a_command_with_its_own_words(file: Path) -> None:
    found = dict(steps(file))
    extras = re.findall(r"--extra (\w+)", " ".join(rest for _, rest in steps(file)))
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert extras and set(extras) <= set(project["optional-dependencies"])
    entry, more = json.loads(found["ENTRYPOINT"]), json.loads(found["CMD"])
    assert entry[:2] == [".venv/bin/python", "-m"] and find_spec(entry[2]) is not None
    config = next(name for name, command in COMMANDS.items() if command == f"python -m {entry[2]}")
    known = {key.name for key in keys(REPOSITORY / "configs" / f"{config}.yaml")}
    assert {word.partition("=")[0] for word in [*entry[3:], *more]} <= known
    ports = re.search(r"^port: (\d+)", (REPOSITORY / "configs/serve.yaml").read_text(), re.MULTILINE)
    assert found.get("EXPOSE") in (None, ports[1])


def test_what_an_image_needs_is_not_left_out() -> None:
    left_out = (REPOSITORY / ".dockerignore").read_text().splitlines()
    needed = {"mme_vla", "configs", "plugins", "scripts", "pyproject.toml", "README.md", "LICENSE", "constraints.txt"}
    assert not needed & set(left_out)
