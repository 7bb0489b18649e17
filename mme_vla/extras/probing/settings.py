"""What a probe may be told (`configs/probe.yaml`), checked before PyTorch is imported."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Self

from mme_vla.config.sections import NonNegativeInt, PathText, PositiveInt, Range, read_section
from mme_vla.data.lerobot_files import resolve_root
from mme_vla.data.sources import listed_sources
from mme_vla.errors import ERROR, UserError, brief, check_choice, require, text_of
from mme_vla.evaluation.rollout.events import event_arms
from mme_vla.evaluation.rollout.settings import check_config
from mme_vla.memory.perturbation import Word, split_word
from mme_vla.registry import PERTURBATIONS

NO_DATA = (
    "A probe on recorded episodes needs some: recordings=<dataset>. Those of the benchmark are made"
    " by `mme-vla record tasks=… episodes=0-9 split=val output=<new folder>`; offline=false"
    " online=true probes in closed loop alone."
)
IN_CLOSED_LOOP = (
    "event=…: events act in closed loop: add online=true to the command, or tasks=… in Python."
)


@dataclass(frozen=True)
class OfflineSettings:
    """Settings of a probe on recorded episodes.

    draws: chunks sampled at each step, of the same noise in every arm; the policy's own spread is
        between two of them.
    moments: most steps of an episode.
    scan: whether each entry is left out by itself.
    flow_steps: of the sampler; None for the policy's own.
    """

    seed: NonNegativeInt = 42
    draws: Annotated[int, Range(least=2)] = 8
    moments: PositiveInt | None = 8
    scan: bool = True
    flow_steps: int | None = None


@dataclass(frozen=True)
class ProbeChoice:
    """What a probe is to do; the keys and their meaning are those of `configs/probe.yaml`.

    arms: of `with`.
    compare: alone or a list.
    trust_plugins: whether the checkpoint's plugins are imported, which may register perturbations.
    """

    compare: PathText | tuple[PathText, ...] | None
    card: bool
    twins: bool
    offline: bool
    online: bool
    recordings: Any
    event: Any
    server: Any
    references: Mapping[str, PathText] | None
    arms: Any
    trust_plugins: bool

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration, plain and resolved."""
        return read_section(cls, config, others=True, arms=config["with"])

    @property
    def on_recordings(self) -> bool:
        """Whether recorded episodes are probed.

        A server chooses a chunk once, so recordings are only what contents are taken from. Twins
        make their own scenes.
        """
        return self.offline and not self.twins and self.server is None

    @property
    def in_closed_loop(self) -> bool:
        """Whether episodes of the closed loop are probed."""
        return self.online or self.card

    def check(self) -> None:
        """Make sure that there is something to probe, that it has what it needs, and that names in
        `with` and datasets exist.
        """
        if self.twins:
            without_effect = {
                "card": self.card,
                "online": self.online,
                "recordings": self.recordings,
                "with": self.arms,
                "event": self.event,
                "server": self.server,
                "references": self.references,
            }
            for key, value in without_effect.items():
                require(
                    not value,
                    "twins=true measures the policy as it is and without memory: leave out"
                    f" {key}=….",
                )
            return
        require(
            self.offline or self.in_closed_loop,
            "offline=false online=false leaves nothing to probe: set one of them to true.",
        )
        require(
            self.in_closed_loop or self.server is None,
            "server=…: a served policy is probed in closed loop alone: add online=true.",
        )
        needs_data = self.on_recordings and not self.card
        require(not needs_data or self.recordings is not None, NO_DATA)
        for key, value in {"with": self.arms, "event": self.event}.items():
            require(
                not (self.card and value),
                f"card=true measures the histories of a report card: leave out {key}=….",
            )
        require(
            self.card or not self.references,
            "references=… stand beside the figures of a report card: add card=true, or leave it"
            " out.",
        )
        require(self.online or not event_arms(self.event), IN_CLOSED_LOOP)
        check_all(self._check_arms, self._check_recordings)

    def _check_arms(self) -> None:
        """Arms are read again once the policy is loaded, whose plugins may register some."""
        if self.arms is None or self.trust_plugins:
            return
        for spec in listed_arms(self.arms):
            if not isinstance(spec, Mapping):
                words_of_arm(spec)

    def _check_recordings(self) -> None:
        """Datasets are opened once the policy is loaded, whose robot names their columns."""
        if self.recordings is None:
            return
        for entry in listed_sources(self.recordings):
            resolve_root(entry.root)


def check_all(*checks: Callable[[], object]) -> None:
    """Call checks that do not need each other's success, and name all that failed in one error.

    Raises:
        UserError: the messages of the failed checks, one a line. Each line begins as the first
            does once a command prints it.
    """
    failed = []
    for check in checks:
        try:
            check()
        except UserError as error:
            failed.append(text_of(error))
    require(not failed, f"\n{ERROR}".join(failed))


def check_probe(config: Mapping[str, Any]) -> None:
    """Check rollouts, tasks and checkpoint of a probe, and what it is to do.

    Args:
        config: plain and resolved.
    """
    choice = ProbeChoice.from_config(config)
    if choice.compare is None:
        offline = partial(read_section, OfflineSettings, config, others=True)
        check_all(partial(check_config, config), choice.check, offline)


def listed_arms(specs: Any) -> list[Any]:
    """The arms that `with` lists, each a word or a mapping with a name."""
    return [specs] if isinstance(specs, str | Mapping) else list(specs)


def words_of_arm(spec: Any) -> list[tuple[str, Word]]:
    """The perturbations of an arm such as `drop:2` or `nodemo+shuffle`, each with its text.

    Raises:
        UserError: it has another form, or there is no perturbation of a name.
    """
    if not isinstance(spec, str) or not spec:
        raise UserError(
            f"with={brief(spec)}: write words such as drop:2 or nodemo+shuffle, or {{name: drop,"
            " …}."
        )
    words = []
    for text in spec.split("+"):
        word = split_word(text)
        if word is None or word.unit is not None:
            raise UserError(f"with={text}: write a name, as drop, or a name and a number, drop:2.")
        check_choice(f"with={text}: name", word.name, PERTURBATIONS)
        words.append((text, word))
    return words
