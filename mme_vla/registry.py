"""Name → class tables. A decorator registers; a Hydra config names the key."""

from collections.abc import Callable, Iterator
from typing import Any

from mme_vla.errors import UserError, brief, did_you_mean


class Registry[T]:
    """A table of constructors under short names.

    >>> SHAPES = Registry("shape")
    >>> @SHAPES.register("dot")
    ... class Dot: ...
    >>> SHAPES["dot"] is Dot
    True
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._entries: dict[str, T] = {}

    def register(self, name: str) -> Callable[[Any], Any]:
        """Return a decorator that files a class or function under `name`.

        Raises:
            UserError: another object already has this name.
        """

        def decorate(entry: Any) -> Any:
            taken = self._entries.get(name)
            # A module imported twice (once as __main__) registers an equal twin: that is no clash.
            if taken is not None and getattr(taken, "__qualname__", None) != getattr(entry, "__qualname__", None):
                raise UserError(f"{self.kind} {name!r} is already registered by {taken!r}; choose another name.")
            self._entries[name] = entry
            return entry

        return decorate

    def __getitem__(self, name: str) -> T:
        if not isinstance(name, str) or name not in self._entries:
            raise UserError(f"Unknown {self.kind} {brief(name)}. {did_you_mean(brief(name), self._entries)}")
        return self._entries[name]

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._entries))


MEMORIES: Registry[Any] = Registry("memory")
INTEGRATIONS: Registry[Any] = Registry("integration")
BACKBONES: Registry[Any] = Registry("backbone")
SUBGOALS: Registry[Any] = Registry("subgoal predictor")
TASKS: Registry[Any] = Registry("task")
