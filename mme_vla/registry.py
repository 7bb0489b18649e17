"""Name → class tables, and the packages that add to them.

A decorator registers; a configuration names the key. `mme_vla.extras` and installed packages list
what they add in an `Extension`.
"""

import importlib
import inspect
import pkgutil
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

from mme_vla.errors import UserError, brief, check_choice, did_you_mean, require

ENTRY_POINTS = "mme_vla.plugins"
"""The entry-point group in which an installed package names its `Extension`."""


@dataclass(frozen=True)
class Command:
    """A command of `mme-vla`.

    module: its `main` runs the command.
    text: one line of help.
    config: the YAML file of the tree's top level that configures it; empty for commands with
        options.
    processes: what it does where a launcher starts several: `one` is refused, `shared` divides the
        work, `any` may run in each.
    reads_words: its `main` reads the command line itself, and takes no configuration.
    check: `module:function` that reads the configuration, plain and resolved, before PyTorch is
        imported, and raises a `UserError` on values that cannot work.
    """

    module: str
    text: str
    config: str = ""
    processes: Literal["one", "shared", "any"] = "one"
    reads_words: bool = False
    check: str = ""


@dataclass(frozen=True)
class WeightFormat:
    """A checkpoint format of one method: the functions that read and write it.

    module: where the functions are, imported when first used.
    text: what the format is.
    matches: whether tensor names are its.
    adapter: its name table for a policy.
    write: a policy as its files.
    model: the name of the model it holds; the format's own name by default.
    native: for files of `torch.save`: tensors under the one spelling of the name table. Called with
        the tensors and the file's name.
    spelling: as `native`, for safetensors. Called with the tensors and their folder.
    stats: reads its statistics.
    check: compares its config.json with a policy.
    configure: a composed configuration as its config.json says.
    named_base: for runs that hold adapters apart from what they were trained on: the name of that
        base, or None where a folder holds no such adapters.
    merge: for the same runs: the tensors of the base with the adapters in a folder merged in.
    """

    module: str
    text: str
    matches: str
    adapter: str
    write: str
    model: str | None = None
    native: str | None = None
    spelling: str | None = None
    stats: str | None = None
    check: str | None = None
    configure: str | None = None
    named_base: str | None = None
    merge: str | None = None

    def function(self, role: str) -> Callable[..., Any]:
        """The function that has this role, imported now."""
        name: str = getattr(self, role)
        function: Callable[..., Any] = getattr(importlib.import_module(self.module), name)
        return function


@dataclass(frozen=True)
class Extension:
    """What a package adds to the library: names alone, so that reading it imports nothing.

    parts: kind of `REGISTRIES` → name → module that registers it.
    commands: name → command.
    configs: a folder of YAML files, searched after the library's (`config/trees.py`).
    checkpoints: name → folder.
    weight_formats: name → format that `weights` reads and writes.
    owner: which package or extra this is, for messages; set where extensions are listed.
    """

    parts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    commands: Mapping[str, Command] = field(default_factory=dict)
    configs: Path | None = None
    checkpoints: Mapping[str, Path] = field(default_factory=dict)
    weight_formats: Mapping[str, WeightFormat] = field(default_factory=dict)
    owner: str = ""


def join_names[T](
    what: str, core: Mapping[str, T], brought: Iterable[tuple[Extension, Mapping[str, T]]]
) -> dict[str, T]:
    """The core's entries of one kind, then those that extensions bring.

    Raises:
        UserError: two of them bring different entries under one name.
    """
    joined = dict(core)
    owners = dict.fromkeys(core, "the library")
    for extension, entries in brought:
        for name, entry in entries.items():
            taken = joined.setdefault(name, entry)
            owner = owners.setdefault(name, extension.owner)
            first, second = (getattr(one, "module", one) for one in (taken, entry))
            require(
                taken == entry,
                f"Two packages define the {what} {name!r}: {owner} ({first}), and {extension.owner}"
                f" ({second}). Rename it in one of them, or uninstall one.",
            )
    return joined


@cache
def extras() -> tuple[Extension, ...]:
    """The extensions of `mme_vla.extras`: each folder in it has `extension.py` with `EXTENSION`."""
    package = importlib.import_module("mme_vla.extras")
    names = sorted(module.name for module in pkgutil.iter_modules(package.__path__))
    listed = []
    for name in names:
        module = importlib.import_module(f"{package.__name__}.{name}.extension")
        listed.append(replace(module.EXTENSION, owner=f"the extra {name!r}"))
    return tuple(listed)


@cache
def installed_extensions() -> tuple[Extension, ...]:
    """The extensions of installed packages, which name theirs under `mme_vla.plugins`.

    Raises:
        UserError: a package's entry point cannot be imported, or is no `Extension`; or it brings a
            part of no known kind, or under a name that is taken.
    """
    listed: list[Extension] = []
    for entry in sorted(entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
        package = getattr(entry.dist, "name", "?")
        plugin = f"installed plugin {entry.name!r} of the package {package!r} ({entry.value})"
        try:
            extension = entry.load()
        except Exception as error:  # any error of a third-party package
            raise UserError(
                f"The {plugin} cannot be imported: {type(error).__name__}: {error}. Mend or"
                " uninstall it."
            ) from error
        require(isinstance(extension, Extension), f"The {plugin} is no mme_vla.registry.Extension.")
        for key in extension.parts:
            check_choice(f"{plugin}: kind of part", key, REGISTRIES)
        listed.append(replace(extension, owner=f"the {plugin}"))
    for registry in REGISTRIES.values():
        registry.join([*extras(), *listed])
    return tuple(listed)


def extensions() -> tuple[Extension, ...]:
    """All extensions: those of the library's extras, then those of installed packages."""
    return extras() + installed_extensions()


LEFTOVER_OPTIONS = {
    key: "An option that you did not set is of the section's file: another name keeps it. Choose a"
    f" file with {key}=…, which brings its own options, or remove an option with ~{key}.<option>."
    for key in ("memory", "integration", "backbone", "subgoal")
}
"""What to do about options that another class of a section leaves over, by the section's key."""


class Registry[T]:
    """A table of constructors under short names.

    >>> SHAPES = Registry("shape")
    >>> @SHAPES.register("dot")
    ... class Dot: ...
    >>> SHAPES["dot"] is Dot
    True
    """

    def __init__(
        self, kind: str, core: Mapping[str, str] | None = None, key: str | None = None
    ) -> None:
        """Make a table.

        Args:
            kind: what its entries are, for messages.
            core: name → module that registers it, imported when the name is first asked for.
            key: the kind's name in `REGISTRIES`, under which extensions add to it; by default
                `kind`.
        """
        self.kind, self.key = kind, key or kind
        self._entries: dict[str, T] = {}
        self._core = dict(core or {})

    def join(self, listed: Iterable[Extension]) -> dict[str, str]:
        """Name → module: the library's own, and those of extensions.

        Raises:
            UserError: two of them bring one name.
        """
        # All keys that mean this registry, such as `event` and `intervention` of perturbations.
        keys = {self.key, *(key for key, registry in REGISTRIES.items() if registry is self)}
        brought = []
        for extension in listed:
            for key in sorted(keys):
                brought.append((extension, extension.parts.get(key, {})))
        return join_names(self.kind, self._core, brought)

    @property
    def _modules(self) -> dict[str, str]:
        return self.join(extensions())

    def _module_of(self, name: str) -> str | None:
        """The module that registers a name; extensions are listed only for names the core lacks."""
        return self._core[name] if name in self._core else self._modules.get(name)

    def register(self, name: str) -> Callable[[Any], Any]:
        """Return a decorator that files a class or function under `name`."""

        def decorate(entry: Any) -> Any:
            taken = self._entries.get(name)
            module = self._module_of(name)
            mine = str(getattr(entry, "__module__", None))
            if taken is None:
                holder = f"is taken by {module}"
                if name in self._core:
                    holder = f"ships with the library ({module})"
                require(
                    module in (None, mine),
                    f"{self.kind} {name!r} {holder}; choose another name in {mine}.",
                )
            else:
                # A module imported twice registers an equal twin.
                require(
                    getattr(taken, "__qualname__", None) == getattr(entry, "__qualname__", None),
                    f"{self.kind} {name!r} is already registered by {taken!r}; choose another name"
                    f" in {mine}.",
                )
                former = getattr(taken, "__module__", mine)
                if former != mine and "__main__" not in (former, mine):
                    warnings.warn(
                        f"{self.kind} {name!r} of {mine} replaces that of {former}.", stacklevel=2
                    )
            self._entries[name] = entry
            return entry

        return decorate

    def __getitem__(self, name: str) -> T:
        if not isinstance(name, str) or name not in self:
            hint = did_you_mean(brief(name), self)
            if hint.startswith("Known"):
                hint += " One of your own is registered by a module that `plugins` names."
            raise UserError(f"Unknown {self.kind} {brief(name)}. {hint}")
        if name not in self._entries:
            importlib.import_module(str(self._module_of(name)))
        return self._entries[name]

    def build(self, section: Mapping[str, Any], *args: Any, **fixed: Any) -> Any:
        """Call the constructor that a section of the configuration names, with the section's other
        keys as options.

        The options are compared with the constructor's signature before it is called, so that
        whatever goes wrong inside it keeps its own traceback.

        Args:
            section: `name`, and the options.
            args, fixed: what the caller adds; no option may say the same.

        Raises:
            UserError: the section is no mapping, its name is unknown, or the constructor does not
                take its options.
        """
        require(
            isinstance(section, Mapping),
            f"The section of the {self.kind} must be a section of keys, got {brief(section)}.",
        )
        options = dict(section)
        name = options.pop("name", None)
        if not isinstance(name, str):
            raise UserError(
                f"The section of the {self.kind} needs a name. {did_you_mean('', self)}"
            )
        entry: Any = self[name]
        if twice := sorted(set(options) & set(fixed)):
            raise UserError(
                f"{self.kind} {name!r}: {twice[0]} is not an option; it follows from the other"
                " parts."
            )
        signature = inspect.signature(entry)
        try:
            signature.bind(*args, **fixed, **options)
        except TypeError as error:
            raise self._refused(name, options, fixed, len(args), str(error)) from None
        try:
            return entry(*args, **fixed, **options)
        except TypeError as error:
            # a constructor that passes `**options` on is asked only when it is called
            unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
            if unknown is None or unknown[1] not in options:
                raise
            raise self._refused(name, options, fixed, len(args), str(error)) from error

    def _refused(
        self,
        name: str,
        options: Mapping[str, Any],
        fixed: Mapping[str, Any],
        n_args: int,
        reason: str,
    ) -> UserError:
        """The error about a section's options, with those that its constructor and its base
        classes' take.
        """
        for key in fixed:
            if f"'{key}'" in reason:
                return UserError(
                    f"{self.kind} {name!r}: its constructor must take {' and '.join(fixed)}, which"
                    f" follow from the other parts ({reason})."
                )
        entry: Any = self[name]
        makers = list(entry.__mro__ if isinstance(entry, type) else (entry,))
        for maker in list(makers):
            makers += vars(maker).get("option_types", ())  # structs that it builds from options
        parameters: dict[str, None] = {}  # in order, each once
        for maker in makers:
            for parameter in inspect.signature(maker).parameters.values():
                if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
                    parameters[parameter.name] = None
        known = [parameter for parameter in parameters if parameter not in fixed][n_args:]
        hint = f"Known: {', '.join(known) or 'none'}."
        for option in options:
            if option not in known:
                hint = did_you_mean(option, known)
                if self.key in LEFTOVER_OPTIONS:
                    hint += f" {LEFTOVER_OPTIONS[self.key]}"
                break
        text = ", ".join(f"{option}={brief(value)}" for option, value in options.items())
        return UserError(
            f"{self.kind} {name!r} does not take these options: {text or 'no options'}"
            f" ({reason}). {hint}"
        )

    def __contains__(self, name: object) -> bool:
        return name in self._entries or name in self._core or name in self._modules

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._entries, *self._modules}))


MEMORIES: Registry[Any] = Registry(
    "memory",
    {
        "framesamp": "mme_vla.memory.framesamp",
        "tokendrop": "mme_vla.memory.tokendrop",
        "ttt": "mme_vla.memory.ttt",
        "rmt": "mme_vla.memory.rmt",
        "joined": "mme_vla.memory.joined",
        "actions": "mme_vla.memory.extensions.actions",
        "anchors": "mme_vla.memory.extensions.anchors",
        "bank": "mme_vla.memory.extensions.bank",
        "events": "mme_vla.memory.extensions.events",
        "gist": "mme_vla.memory.extensions.gist",
        "keyframes": "mme_vla.memory.extensions.keyframes",
        "learned_topk": "mme_vla.memory.extensions.learned_topk",
        "moment": "mme_vla.memory.extensions.moment",
        "present": "mme_vla.memory.extensions.present",
        "pyramid": "mme_vla.memory.extensions.pyramid",
        "retrieval": "mme_vla.memory.extensions.retrieval",
        "spacetime": "mme_vla.memory.extensions.spacetime",
    },
)
INTEGRATIONS: Registry[Any] = Registry(
    "integration",
    {
        "context": "mme_vla.integration.context",
        "expert": "mme_vla.integration.context",
        "film": "mme_vla.integration.film",
        "modulator": "mme_vla.integration.modulator",
    },
)
BACKBONES: Registry[Any] = Registry("backbone", {"pi05": "mme_vla.backbone.pi05"})
HEADS: Registry[Any] = Registry(
    "action head",
    {
        "flow": "mme_vla.backbone.flow",
        "clean_flow": "mme_vla.backbone.flow",
    },
    key="head",
)
POLICIES: Registry[Any] = Registry("policy", {"mme": "mme_vla.policy.mme"})
PROCESSORS: Registry[Any] = Registry("processor", {"pi05": "mme_vla.processing.processor"})
SUBGOALS: Registry[Any] = Registry(
    "subgoal predictor",
    {
        "oracle": "mme_vla.subgoal.oracle",
        "qwenvl": "mme_vla.subgoal.qwenvl",
        "memer": "mme_vla.subgoal.memer",
        "notebook": "mme_vla.subgoal.notebook",
        "gemini": "mme_vla.subgoal.prompted",
        "openai": "mme_vla.subgoal.prompted",
    },
    key="subgoal",
)
PROMPTS: Registry[Any] = Registry(
    "prompt format",
    dict.fromkeys(
        (
            "plain",
            "state",
            "subgoal",
            "subgoal_sentence",
            "past_actions",
        ),
        "mme_vla.processing.prompt",
    ),
    key="prompt",
)
TASKS: Registry[Any] = Registry("task")
ENVS: Registry[Any] = Registry("environment", {"mme_vla": "mme_vla.envs.benchmark"}, key="env")
PLAYERS: Registry[Any] = Registry("player")
REWARDS: Registry[Any] = Registry(
    "reward", dict.fromkeys(("none", "sparse", "subtask"), "mme_vla.envs.subtasks")
)
PERTURBATIONS: Registry[Any] = Registry(
    "perturbation",
    dict.fromkeys(
        ("pause", "repeat_frame", "gap", "speed", "drop_frames", "noise", "restart"),
        "mme_vla.memory.perturbation",
    ),
)
TRAINING_SETS: Registry[Any] = Registry("kind of training samples", key="training_set")
"""`SampleSpec.kind` → a dataset of such samples, for policies that do not learn from steps.

Called with sources, processor, policy and caches, with `sampled` (false for held-out samples) and
the keywords of `TrainingDataset`.
"""
SIDE_FILES: Registry[Any] = Registry("side file of a dataset", key="side_file")
"""What `convert` keeps of each recording beside a dataset's tables: a module with
`file_of(root, episode)` and `write(episode, path)`.
"""
REGISTRIES = {
    "memory": MEMORIES,
    "integration": INTEGRATIONS,
    "backbone": BACKBONES,
    "head": HEADS,
    "policy": POLICIES,
    "processor": PROCESSORS,
    "subgoal": SUBGOALS,
    "task": TASKS,
    "env": ENVS,
    "player": PLAYERS,
    "reward": REWARDS,
    "prompt": PROMPTS,
    "perturbation": PERTURBATIONS,
    # The same by the option that takes it
    "history_transform": PERTURBATIONS,
    "event": PERTURBATIONS,
    "intervention": PERTURBATIONS,
    "training_set": TRAINING_SETS,
    "side_file": SIDE_FILES,
}


def register(kind: str, name: str) -> Callable[[Any], Any]:
    """Return a decorator that files a part of one's own under `name`, for YAML files and command
    lines to call it by.

    Args:
        kind: `memory`, `integration`, `backbone`, `head` (of a flow backbone), `policy`,
            `processor`, `subgoal` (a predictor), `task`, `env`, `player`, `reward`, `prompt` (a
            prompt format), `perturbation` (of training, rollouts or probes; also called
            `history_transform`, `event` and `intervention`), `training_set` or `side_file`
            (of a dataset).

    >>> @register("memory", "nothing")  # doctest: +SKIP
    ... class Nothing(Memory): ...
    """
    check_choice("kind of part", kind, REGISTRIES)
    return REGISTRIES[kind].register(name)
