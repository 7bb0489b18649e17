"""The Dockerfiles, as far as they can be checked without building them: they are built where Docker is."""

import json
import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from mme_vla.cli.help import COMMANDS, keys
from mme_vla.config.composition import compose
from mme_vla.errors import UserError
from mme_vla.serving.settings import ServeSettings

REPOSITORY = Path(__file__).resolve().parents[2]
FILES = sorted((REPOSITORY / "docker").glob("*.Dockerfile"))


def steps(file: Path) -> list[tuple[str, str]]:
    """Instructions and their words, comments left out and continued lines joined."""
    lines = [line for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines))
    return [(word, arguments) for word, _, arguments in (line.partition(" ") for line in joined.splitlines())]


def test_there_is_one_to_serve_and_one_to_evaluate() -> None:
    assert [file.name for file in FILES] == ["evaluate.Dockerfile", "serve.Dockerfile"]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_dockerfile_says_nothing_that_cannot_be(file: Path) -> None:
    instructions = steps(file)
    image = re.fullmatch(r"python:(\d+\.\d+)\.\d+-slim-[a-z]+", instructions[0][1])
    assert instructions[0][0] == "FROM" and image is not None, "one release of Python on one of Debian"
    assert image[1] == (REPOSITORY / ".python-version").read_text().strip()
    for word, arguments in instructions:
        assert word in {"FROM", "WORKDIR", "COPY", "RUN", "USER", "EXPOSE", "ENTRYPOINT", "CMD"}
        if word == "COPY":
            assert (REPOSITORY / arguments.split()[0]).exists(), arguments
        if "apt-get install" in arguments:
            assert "--no-install-recommends" in arguments and arguments.endswith("rm -rf /var/lib/apt/lists/*"), (
                arguments
            )
        if "pip install" in arguments:
            assert "--no-cache-dir" in arguments and re.search(r"\w==[\d.]+$", arguments), arguments
        assert not re.search(r"\b(sudo|cd) |:latest|\| *(ba)?sh\b", arguments), arguments
        for script in re.findall(r"bash (\S+\.sh)", arguments):
            assert (REPOSITORY / script).is_file()
    assert [arguments for word, arguments in instructions if word == "USER"][-1] != "root"
    words = [word for word, _ in instructions]
    assert words.index("WORKDIR") < words.index("COPY"), "a relative place needs a folder"
    assert words.count("ENTRYPOINT") == words.count("CMD") == 1


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_it_installs_an_extra_that_exists_and_runs_a_command_with_its_words(file: Path) -> None:
    instructions = dict(steps(file))
    extras = re.findall(r"--extra (\w+)", " ".join(arguments for _, arguments in steps(file)))
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert extras and set(extras) <= set(project["optional-dependencies"])
    entry, more = json.loads(instructions["ENTRYPOINT"]), json.loads(instructions["CMD"])
    assert entry[:2] == [".venv/bin/python", "-m"] and find_spec(entry[2]) is not None
    config = next(name for name, command in COMMANDS.items() if command == f"python -m {entry[2]}")
    known = {key.name for key in keys(REPOSITORY / "configs" / f"{config}.yaml")}
    assert {word.partition("=")[0] for word in [*entry[3:], *more]} <= known
    ports = re.search(r"^port: (\d+)", (REPOSITORY / "configs/serve.yaml").read_text(), re.MULTILINE)
    assert instructions.get("EXPOSE") in (None, ports[1])


def test_an_image_holds_what_it_needs_and_nothing_else() -> None:
    rules = [line for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if not line.startswith("#")]
    needed = {"mme_vla", "configs", "plugins", "scripts", "pyproject.toml", "README.md", "LICENSE", "constraints.txt"}
    assert rules[0] == "*", "what is not named, such as .env, keys, datasets and checkpoints, stays out"
    assert {rule[1:] for rule in rules if rule.startswith("!")} == needed | {".python-version"}
    assert {"**/.env*", "**/*.key", "**/*.pem"} <= set(rules)


def test_the_serving_image_does_not_start_without_a_key() -> None:
    (entry,) = [json.loads(rest) for word, rest in steps(FILES[1]) if word == "ENTRYPOINT"]
    assert {"host=0.0.0.0", "require_key=true"} <= set(entry)
    with pytest.raises(UserError, match="MME_VLA_API_KEY"):
        ServeSettings.from_dict({"host": "0.0.0.0", "require_key": True, "api_key": ""})
    assert ServeSettings.from_dict({"require_key": True, "api_key": "secret"}).api_key == "secret"
    config = compose("serve", [*entry[3:], "model=pi05", "backbone=tiny", "require_key=false"])
    assert config.require_key is False, "words after the image's name count"
