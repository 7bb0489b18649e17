"""Name → class tables. A decorator registers; a configuration names the key."""

import importlib
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mme_vla.errors import UserError, brief, check_choice, did_you_mean, require


class Registry[T]:
    """A table of constructors under short names.

    >>> SHAPES = Registry("shape")
    >>> @SHAPES.register("dot")
    ... class Dot: ...
    >>> SHAPES["dot"] is Dot
    True
    """

    def __init__(self, kind: str, shipped: Mapping[str, str] | None = None) -> None:
        """Make a table.

        Args:
            kind: what its entries are, for messages.
            shipped: name → module that registers it, imported when the name is first asked for.
        """
        self.kind = kind
        self._entries: dict[str, T] = {}
        self._shipped = dict(shipped or {})

    def register(self, name: str) -> Callable[[Any], Any]:
        """Return a decorator that files a class or function under `name`."""

        def decorate(entry: Any) -> Any:
            taken = self._entries.get(name)
            # A module imported twice (once as __main__) registers an equal twin: that is no clash.
            require(
                not (
                    taken is not None
                    and getattr(taken, "__qualname__", None) != getattr(entry, "__qualname__", None)
                ),
                f"{self.kind} {name!r} is already registered by {taken!r}; choose another name.",
            )
            module = self._shipped.get(name)
            require(
                taken is not None or module in (None, getattr(entry, "__module__", None)),
                f"{self.kind} {name!r} ships with the library ({module}); choose another name.",
            )
            self._entries[name] = entry
            return entry

        return decorate

    def __getitem__(self, name: str) -> T:
        if not isinstance(name, str) or name not in self:
            raise UserError(f"Unknown {self.kind} {brief(name)}. {did_you_mean(brief(name), self)}")
        if name not in self._entries:
            importlib.import_module(self._shipped[name])
        return self._entries[name]

    def build(self, section: Mapping[str, Any], *args: Any, **fixed: Any) -> Any:
        """Call the constructor that a section of the configuration names, with the section's other
        keys as options.

        The options are compared with the constructor's signature before it is called, so that
        whatever goes wrong inside it keeps its own traceback.

        Args:
            section: `name`, and the options. args, fixed: what the caller adds; no option may say
                the same.
        """
        options = {key: value for key, value in section.items() if key != "name"}
        if not isinstance(section.get("name"), str):
            raise UserError(
                f"The section of the {self.kind} needs a name. {did_you_mean('', self)}"
            )
        entry: Any = self[section["name"]]
        if twice := sorted(set(options) & set(fixed)):
            name = f"{self.kind} {section['name']!r}"
            raise UserError(
                f"{name}: {twice[0]} is not an option; it follows from the other parts."
            )
        signature = inspect.signature(entry)
        try:
            signature.bind(*args, **fixed, **options)
        except TypeError as error:
            raise self._refused(section, fixed, len(args), str(error)) from None
        try:
            return entry(*args, **fixed, **options)
        except (
            TypeError
        ) as error:  # a constructor that passes `**options` on is asked only when it is called
            unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
            if unknown is None or unknown[1] not in options:
                raise
            raise self._refused(section, fixed, len(args), str(error)) from error

    def _refused(
        self, section: Mapping[str, Any], fixed: Mapping[str, Any], n_args: int, reason: str
    ) -> UserError:
        """The error about a section's options, with those that its constructor and its base
        classes' take.
        """
        options = {key: value for key, value in section.items() if key != "name"}
        entry: Any = self[section["name"]]
        makers = list(entry.__mro__ if isinstance(entry, type) else (entry,))
        for maker in list(makers):
            makers += vars(maker).get("option_types", ())  # structs that it builds from options
        kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        parameters = [
            p
            for maker in makers
            for p in inspect.signature(maker).parameters.values()
            if p.kind in kinds
        ]
        takes = [name for name in dict.fromkeys(p.name for p in parameters) if name not in fixed][
            n_args:
        ]
        unknown = [name for name in options if name not in takes]
        hint = (
            did_you_mean(unknown[0], takes) if unknown else f"Known: {', '.join(takes) or 'none'}."
        )
        text = (
            ", ".join(f"{name}={brief(value)}" for name, value in options.items()) or "no options"
        )
        return UserError(
            f"{self.kind} {section['name']!r} does not take these options: {text} ({reason})."
            f" {hint}"
        )

    def __contains__(self, name: object) -> bool:
        return name in self._entries or name in self._shipped

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._entries, *self._shipped}))


MEMORIES: Registry[Any] = Registry(
    "memory",
    {
        **{
            name: f"mme_vla.memory.{name}"
            for name in ("framesamp", "tokendrop", "ttt", "rmt", "joined")
        },
        **{
            name: f"mme_vla.memory.extensions.{name}"
            for name in (
                "actions",
                "anchors",
                "bank",
                "events",
                "gist",
                "keyframes",
                "learned_topk",
                "moment",
                "present",
                "pyramid",
                "retrieval",
                "spacetime",
            )
        },
    },
)
INTEGRATIONS: Registry[Any] = Registry(
    "integration",
    {name: f"mme_vla.integration.{name}" for name in ("context", "modulator", "film")}
    | {"expert": "mme_vla.integration.context"},
)
BACKBONES: Registry[Any] = Registry(
    "backbone",
    {
        "pi05": "mme_vla.backbone.pi05",
        "nano": "mme_vla.backbone.nano",
        "openvla": "mme_vla.methods.openvla_oft.model",
    },
)
HEADS: Registry[Any] = Registry(
    "action head",
    {
        **dict.fromkeys(("flow", "clean_flow"), "mme_vla.backbone.flow"),
        "choice": "mme_vla.backbone.choice",
    },
)
POLICIES: Registry[Any] = Registry(
    "policy",
    {
        "mme": "mme_vla.policy.mme",
        "diffusion_policy": "mme_vla.methods.diffusion_policy.policy",
        "sam2act_plus": "mme_vla.methods.sam2act.policy",
        "openvla": "mme_vla.methods.openvla_oft.policy",
        "memoryvla": "mme_vla.methods.memoryvla.policy",
        "simplememvla": "mme_vla.methods.simplememvla.policy",
        "subtask": "mme_vla.methods.simplememvla.subtask",
    },
)
PROCESSORS: Registry[Any] = Registry(
    "processor",
    {
        "pi05": "mme_vla.processing.processor",
        "diffusion_policy": "mme_vla.methods.diffusion_policy.processor",
        "sam2act_plus": "mme_vla.methods.sam2act.processor",
        "openvla": "mme_vla.methods.openvla_oft.processor",
        "memoryvla": "mme_vla.methods.memoryvla.processor",
        "simplememvla": "mme_vla.methods.simplememvla.processor",
        "subtask": "mme_vla.methods.simplememvla.subtask",
    },
)
SUBGOALS: Registry[Any] = Registry(
    "subgoal predictor",
    {
        **{
            name: f"mme_vla.subgoal.{name}"
            for name in ("oracle", "qwenvl", "memer", "gemini", "notebook")
        },
        "openai": "mme_vla.subgoal.gemini",
    },
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
            "openvla",
            "openvla_subgoal",
        ),
        "mme_vla.processing.prompt",
    ),
)
TASKS: Registry[Any] = Registry("task")
ENVS: Registry[Any] = Registry(
    "environment", dict.fromkeys(("mme_vla", "official"), "mme_vla.envs.benchmark")
)
PLAYERS: Registry[Any] = Registry(
    "player",
    {
        **dict.fromkeys(("random", "oracle"), "mme_vla.play.players"),
        **dict.fromkeys(("qwenvl", "gemini", "openai"), "mme_vla.play.vlm_players"),
    },
)
INTERVENTIONS: Registry[Any] = Registry("intervention")
REWARDS: Registry[Any] = Registry(
    "reward", dict.fromkeys(("none", "sparse", "subtask"), "mme_vla.envs.subtasks")
)
HISTORY_TRANSFORMS: Registry[Any] = Registry(
    "history transform",
    dict.fromkeys(("repeat_frame", "speed", "drop_frames", "noise"), "mme_vla.memory.transforms"),
)
EVENTS: Registry[Any] = Registry(
    "event",
    dict.fromkeys(("pause", "gap", "speed", "restart"), "mme_vla.evaluation.rollout.events"),
)
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
    "intervention": INTERVENTIONS,
    "reward": REWARDS,
    "history_transform": HISTORY_TRANSFORMS,
    "prompt": PROMPTS,
    "event": EVENTS,
}


def register(kind: str, name: str) -> Callable[[Any], Any]:
    """Return a decorator that files a part of one's own under `name`, for YAML files and command
    lines to call it by.

    Args:
        kind: `memory`, `integration`, `backbone`, `head` (of a flow backbone), `policy`,
            `processor`, `subgoal` (a predictor), `task`, `env`, `player`, `intervention` (of a
            probe), `reward`, `history_transform`, `prompt` (a prompt format) or `event` (of a
            rollout).

    >>> @register("memory", "nothing")  # doctest: +SKIP
    ... class Nothing(Memory): ...
    """
    check_choice("kind of part", kind, REGISTRIES)
    return REGISTRIES[kind].register(name)
