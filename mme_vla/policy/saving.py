"""Save a policy to a folder or the hub, and load it."""

import inspect
import json
import re
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mme_vla.backbone.building import shapes_only
from mme_vla.config.devices import find_device
from mme_vla.config.naming import DECISIVE, digest, flat
from mme_vla.config.plugins import import_trusted
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief, check_known, did_you_mean, require
from mme_vla.policy.card import CARD_FILE, model_card
from mme_vla.policy.finetune import add_adapters
from mme_vla.policy.run_folders import newest_checkpoint
from mme_vla.policy.sections import KNOWN_SECTIONS, PolicySections
from mme_vla.policy.self_check import FILE as SELF_CHECK
from mme_vla.policy.self_check import SelfCheck
from mme_vla.policy.tensor_files import (
    assign_tensors,
    dtype_of,
    list_weight_files,
    load_tensors,
    save_tensors,
)
from mme_vla.policy.training_identity import KEY as TRAINING
from mme_vla.policy.training_identity import weights_digest
from mme_vla.registry import POLICIES
from mme_vla.utils import checked_file, read_json, to_json, write_sums

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy


def composition_digest(config: Mapping[str, Any]) -> str:
    """Twelve letters that are equal for two policies exactly if they are composed alike, sizes
    included.

    Args:
        config: of a policy, as it is saved with the weights. Where its tokenizer lies, what it was
            trained on and in which precision it computes do not count; nor do keys that are not
            set, so that a later option with an empty default changes no digest. The robot counts
            where it is not RoboMME's Panda in joint space.
    """
    settings = flat({key: config.get(key) for key in (*DECISIVE, "backbone")})
    name = policy_name(config)
    if name != DEFAULT_POLICY:  # which configurations did not use to name
        settings["policy.name"] = name
    settings.pop("processor.tokenizer", None)
    settings = {key: value for key, value in settings.items() if value is not None}
    robot = embodiment_of(config)
    if robot != ROBOMME_JOINT.with_horizon(robot.action.horizon):
        settings |= flat({"embodiment": robot.to_dict()})
    return digest(settings, 12)


DEFAULT_POLICY = "mme"
"""The policy of configurations that name none: backbone × memory × integration."""


def policy_name(config: Mapping[str, Any]) -> str:
    """What the section `policy` of a configuration calls its class."""
    section = PolicySections.of(config).policy
    return section.get("name", DEFAULT_POLICY)  # the registry refuses what is no name


def policy_class(config: Mapping[str, Any]) -> type[Any]:
    """The class of the policy that a configuration describes."""
    kind: type[Any] = POLICIES[policy_name(config)]
    return kind


def policy_options(cls: type, config: Mapping[str, Any]) -> dict[str, Any]:
    """The section `policy`, whose keys beside `name` are the constructor's keyword-only arguments.

    Where a constructor takes `**options`, those of its parent class count too.
    """
    options = dict(PolicySections.of(config).policy)
    options.pop("name", None)
    known: list[str] = []
    for owner in cls.__mro__:
        if "__init__" in vars(owner):
            parameters = inspect.signature(vars(owner)["__init__"]).parameters.values()
            known += [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
            if not any(p.kind is p.VAR_KEYWORD for p in parameters):
                break
    known = list(dict.fromkeys(known))
    for key in options:
        if key not in known:
            raise UserError(f"policy has no key {brief(key)}. {did_you_mean(str(key), known)}")
    return options


_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_PLACE = re.compile(rf"({_REPOSITORY.pattern})((?:/[\w-][\w. -]*)*)")
"""A repository, and a folder or file in it."""


def local_folder(source: str | Path, revision: str | None = None, token: str | None = None) -> Path:
    """Return `source` if it exists on disk, else the downloaded snapshot of the hub repository of
    that name.

    A folder of a training run means its newest checkpoint, and `latest` for the newest run beside
    it.

    Args:
        source: a path, or `owner/name` of a hub repository, or `owner/name/folder` of one in it: no
            other is fetched.
        revision: branch, tag or commit of the repository; its main branch by default.
        token: for private repositories; the one stored by `hf auth login` by default.
    """
    path = newest_checkpoint(Path(source).expanduser())
    place = _PLACE.fullmatch(str(source))
    if path.exists() or place is None:
        require(
            revision is None,
            f"revision={revision!r} names a state of a hub repository, but {source} is a path.",
        )
        return path
    import httpx
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled

    repository = place[1]
    within = place[2].strip("/")
    options: dict[str, Any] = {"revision": revision, "token": token}
    if within:
        options["allow_patterns"] = [within, f"{within}/*"]
    try:
        root = Path(snapshot_download(repository, **options))
    except (
        HfHubHTTPError,
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
        httpx.HTTPError,
        OSError,
    ) as error:
        at = "" if revision is None else f" at revision {revision!r}"
        reason = str(error).strip() or "no answer"
        raise UserError(
            f"{source} is not a path on this machine, and the hub repository of that name{at} could"
            f" not be fetched ({type(error).__name__}: {reason.splitlines()[0]}). Check the name,"
            " the network, and for a private or gated repository your token (hf auth login)."
        ) from error
    if not (root / within).exists():
        raise UserError(f"The hub repository {repository} has nothing called {within!r}.")
    return root / within


def push_folder(
    folder: Path,
    repo_id: str,
    *,
    private: bool,
    token: str | None,
    revision: str | None,
    message: str,
) -> str:
    """Create the repository if need be, upload the folder's files as one commit, and return its
    address.
    """
    require(
        _REPOSITORY.fullmatch(repo_id),
        f"repo_id={repo_id!r} must read owner/name, such as my-group/framesamp-modul.",
    )
    import huggingface_hub
    from huggingface_hub.errors import HfHubHTTPError

    api: Any = huggingface_hub.HfApi(token=token)
    try:
        address = api.create_repo(repo_id, private=private, exist_ok=True)
        if revision is not None:
            api.create_branch(repo_id, branch=revision, exist_ok=True)
        api.upload_folder(
            repo_id=repo_id, folder_path=folder, commit_message=message, revision=revision
        )
    except HfHubHTTPError as error:
        raise UserError(
            f"The hub refused to store {repo_id}: {error}. Is the token allowed to write there?"
        ) from error
    return str(address)


CONFIG = "config.json"


def read_config(folder: Path) -> dict[str, Any]:
    """Read `config.json` of a checkpoint, as plain values: nothing in it is resolved
    or imported.
    """
    config: dict[str, Any] = read_json(
        checked_file(folder, CONFIG), "a policy's configuration", limit=2**20
    )
    return config


def save_policy(
    policy: "Policy",
    folder: Path,
    *,
    dtype: str = "float32",
    card: Mapping[str, Any] | None = None,
    facts: Mapping[str, Any] | None = None,
    self_check: SelfCheck | None = None,
) -> None:
    """Write a policy to a folder; see `Policy.save_pretrained`.

    Args:
        facts: sections that join the policy's configuration in the file.
        self_check: of these weights, to lie beside them.
    """
    kind = dtype_of(dtype)
    if card is not None:
        policy.config["card"] = {**PolicySections.of(policy.config).card, **card}
    save_tensors(policy.state_dict(), folder, dtype=kind)
    settings = save_settings(policy, folder, facts, self_check)
    # without the card, which people edit
    write_sums(folder, [*settings, *list_weight_files(folder)])


def save_settings(
    policy: "Policy",
    folder: Path,
    facts: Mapping[str, Any] | None = None,
    self_check: SelfCheck | None = None,
) -> list[str]:
    """Write all files of a checkpoint but the weights; return the names of those that get
    checksums.
    """
    config = {**policy.config, **(facts or {})}
    (folder / CONFIG).write_text(
        json.dumps(config, indent=2, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    names = [CONFIG]
    if self_check is None:
        (folder / SELF_CHECK).unlink(missing_ok=True)  # of the weights that lay here before
    else:
        (folder / SELF_CHECK).write_bytes(self_check.to_bytes())
        names.append(SELF_CHECK)
    (folder / CARD_FILE).write_text(
        model_card(policy, config, self_check is not None), encoding="utf-8"
    )
    if policy.processor is not None:
        names += policy.processor.save(folder)
    return names


def load_policy[P: "Policy"](
    requested: type[P],
    source: str | Path,
    *,
    device: str | torch.device = "cpu",
    dtype: str = "float32",
    revision: str | None = None,
    token: str | None = None,
    trust_plugins: bool = False,
    tokenizer: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
) -> P:
    """Load a policy of the class `requested`, or of a subclass; see `Policy.from_pretrained`.

    Args:
        options: overrides of the section `policy`.
    """
    from mme_vla.processing.base import load_processor

    place = find_device(device)
    requested_dtype = None if dtype == "auto" else dtype_of(dtype)
    folder = local_folder(source, revision, token)
    require(
        (folder / CONFIG).is_file(),
        f"No policy at {source}: it lacks {CONFIG}, which save_pretrained() writes.",
    )

    # The configuration, which may be untrusted.
    config = read_config(folder)
    if isinstance(config.get(TRAINING), dict):
        config[TRAINING] = {**config[TRAINING], "weights": weights_digest(folder)}
    require(
        config.get("backbone") is not None,
        f"{folder / CONFIG} is not this library's: it lacks the section 'backbone'. Weights of"
        " other formats are read by mme_vla.weights.load_weights() and converted by mme-vla"
        " weights.",
    )
    for key in config:
        check_known(f"section in {folder / CONFIG}:", key, KNOWN_SECTIONS)
    PolicySections.of(config, str(folder / CONFIG))  # refuses a section that is none
    import_trusted(config, str(source), trust_plugins)
    policy_type = requested
    described = policy_class(config)
    if not issubclass(requested, described):
        require(
            issubclass(described, requested),
            f"{source} holds a {policy_name(config)!r} policy, which is no {requested.__name__}:"
            " load it with Policy.from_pretrained(), which knows every kind.",
        )
        policy_type = described

    # Precision: `auto` rounds on a GPU, if the policy is made for it.
    kind = requested_dtype or torch.float32
    in_bfloat16 = getattr(policy_type, "acts_in_bfloat16", False)
    if requested_dtype is None and place.type == "cuda" and in_bfloat16:
        kind = torch.bfloat16
    settings: dict[str, Any] = {}
    if kind == torch.bfloat16:
        settings["compute_dtype"] = "bfloat16"
    settings |= options or {}

    # The policy on meta, then its tensors.
    policy = build_saved(policy_type, config, str(folder / CONFIG), settings)
    assign_tensors(policy, load_tensors(folder), str(source), kind)
    recompute_buffers(policy)
    policy.processor = load_processor(folder, tokenizer)
    check_processor(policy, str(source))
    policy._renews_self_check = (folder / SELF_CHECK).is_file()
    if kind == torch.bfloat16:
        policy.requires_grad_(False)
    return policy.to(place).eval()


def build_saved[P: "Policy"](
    kind: type[P], config: dict[str, Any], source: str, options: Mapping[str, Any] | None = None
) -> P:
    """Build what the configuration of a checkpoint describes, on meta, adapters included.

    Args:
        config: plain sections.
        source: where they are from, for messages.
        options: overrides of the section `policy`.
    """
    sections = PolicySections.of(config, source)
    section = config.get("policy")
    require(
        section is None or isinstance(section, Mapping),  # not even an empty list
        f"{source}: policy={brief(section)} must be a section of keys.",
    )
    config = {**config, "policy": {**sections.policy, **(options or {})}}
    try:
        with shapes_only():
            built = kind.from_config(config)
            if sections.adapters:
                add_adapters(built, **sections.adapters)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error
    except Exception as error:
        if sections.plugins:
            raise  # it may be in the user's own code
        reason = brief(f"{type(error).__name__}: {error}", 300, quote=False)
        raise UserError(
            f"{source} describes no policy that can be built ({reason}). It is damaged, or of a"
            " newer version."
        ) from error
    return built


def recompute_buffers(policy: "Policy") -> None:
    """Compute the tensors of a policy built on meta that constructors make and no file holds.

    These are buffers registered with `persistent=False`, and tensors kept as plain attributes. A
    module with `reset_buffers()` computes its own; for the others the policy is built a second
    time.
    """
    for module in policy.modules():
        reset = getattr(module, "reset_buffers", None)
        if callable(reset):
            reset()
    unsaved = []
    for path, module in policy.named_modules():
        for name, value in [*module.named_buffers(recurse=False), *vars(module).items()]:
            if isinstance(value, Tensor) and value.is_meta:
                unsaved.append((path, name))
    if not unsaved:
        return
    fresh = any(path.startswith("backbone") for path, _ in unsaved)
    with torch.random.fork_rng(devices=[]):
        real = type(policy).from_config(policy.config, fresh_backbone=fresh)
    for path, name in unsaved:
        value = getattr(real.get_submodule(path), name)
        setattr(policy.get_submodule(path), name, value)


def check_processor(policy: "Policy", source: str) -> None:
    """Make sure that a policy and its processor have the same robot, settings and sizes."""
    processor = policy.require_processor()
    robot = embodiment_of(policy.config)
    if robot != processor.embodiment:
        raise UserError(
            f"{source}: the processor is of the robot {brief(processor.embodiment.name)} and the"
            f" configuration of {brief(robot.name)}, or they describe it differently. The files are"
            " from two checkpoints, or one was changed."
        )
    # Settings that both files hold; where the tokenizer lies is each one's own.
    settings = to_json(processor.to_config())
    for name, expected in PolicySections.of(policy.config).processor.items():
        actual = settings.get(name)
        if name != "tokenizer" and actual is not None:
            require(
                expected in (None, actual),
                f"{source}: the processor's {name} is {brief(actual)}, that of the configuration"
                f" (processor.{name}) {brief(expected)}. The files are from two checkpoints, or one"
                " was changed.",
            )
    for name, expected in policy.info.processor_sizes.items():
        actual = attrgetter(name)(processor)
        require(
            actual == expected,
            f"{source}: the processor's {name} is {brief(actual)}, the network's {expected}. The"
            " files are from two checkpoints, or one was changed.",
        )
