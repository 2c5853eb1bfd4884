"""Make objects of settings with ``_target_``: freely for the user's own, by a list for others'.

Settings that a user composes (command line, conf folder, Python) name any importable class, as
Hydra's users know it. Settings in a file that may come from a stranger (a run folder, a saved
surface) are instantiated by :func:`instantiate_stored` alone: it makes classes of nsm, those of
torch on a short list, and those of modules that the user says to trust.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterable, Mapping
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf

from nsm.errors import NotRegistered, NotTrusted, NsmError

# packages and modules whose classes only compute: making one reads and writes no file; loggers get
# their folder from the run
_LOGGERS = ("nsm.results.loggers",)
_OURS = (
    *("nsm.maps", "nsm.energies", "nsm.domains", "nsm.tasks", "nsm.data", *_LOGGERS),
    *(f"nsm.pipeline.{task}" for task in ("overfit", "param", "pair_map", "collection_map")),
)
_TORCH = ("torch.nn.modules.activation", "torch.optim")
REGISTERED = "nsm.extensions.registered"  # what the user's process put there


def made(config: Any, *args: Any, **kwargs: Any) -> Any:
    """The object that a user's settings name, by ``hydra.utils.instantiate``.

    Args:
        config: a mapping with ``_target_``; nested ones are made first.
        args, kwargs: further arguments of the target.

    Raises:
        NsmError: the target cannot be imported, or refuses its arguments. What a user's own code
            raises beyond ValueError and TypeError passes through.
    """
    target = str(config.get("_target_")) if isinstance(config, Mapping) or config else ""
    try:
        return instantiate(config, *args, _convert_="all", **kwargs)
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, NsmError):
            raise cause from None
        if isinstance(cause, (ValueError, TypeError, ImportError, AttributeError)):
            reason = " ".join(str(cause).split())
            raise NsmError(f"{target}: {reason}", kind="not_instantiable", key=target) from error
        raise cause from error


def made_with(config: Mapping[str, Any], **offered: Any) -> Any:
    """The object that a user's settings name, from objects of ours as well.

    Unlike the further arguments of :func:`made`, objects are passed on as they are: Hydra would
    copy some of them.

    Args:
        config: a mapping with ``_target_``; what it sets itself takes precedence.
        offered: by name; the target gets those that its signature names.

    Raises:
        NsmError: as :func:`made`.
    """
    target = str(config["_target_"])
    factory = made({**config, "_partial_": True})
    names = _accepted(factory.func)
    given = {key: value for key, value in offered.items() if key in names and key not in config}
    try:
        return factory(**given)
    except (ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise NsmError(f"{target}: {reason}", kind="not_instantiable", key=target) from error


def _accepted(target: Any) -> set[str]:
    """Names of a target's parameters, with those of its bases where it takes ``**kwargs``."""
    names: set[str] = set()
    for kind in target.__mro__ if inspect.isclass(target) else (target,):
        parameters = inspect.signature(kind.__init__ if inspect.isclass(kind) else kind).parameters
        names |= set(parameters)
        if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            break
    return names


def is_trusted(target: str, trust: Iterable[str] = ()) -> bool:
    """Whether a stored ``_target_`` may be made.

    It may be a class that is defined in nsm's computing packages or on torch's short list, a class
    or function that is defined in a trusted module, or what this process registered. Only these
    modules and torch's are imported to find out. A path that leaves them through one of their
    imports, such as ``mypackage.os.system``, is refused.
    """
    trust = _modules(trust)
    module, _, name = target.rpartition(".")
    if not _within(module, (*_OURS, REGISTERED, "torch.nn", "torch.optim", *trust)):
        return False
    try:
        thing = getattr(importlib.import_module(module), name, None)
    except (ImportError, ValueError):  # no such module, or no name of a module
        return False
    if module == REGISTERED:
        return thing is not None
    home = getattr(thing, "__module__", None)
    if inspect.isclass(thing):
        return _within(home, (*_OURS, *_TORCH, *trust))
    return inspect.isfunction(thing) and _within(home, trust)


def _within(module: object, packages: Iterable[str]) -> bool:
    return any(module == p or str(module).startswith(f"{p}.") for p in packages)


def _modules(trust: Iterable[str]) -> tuple[str, ...]:
    return (trust,) if isinstance(trust, str) else tuple(trust)


def instantiate_stored(config: Any, *args: Any, trust: Iterable[str] = (), **kwargs: Any) -> Any:
    """As :func:`made`, of settings that may be a stranger's.

    Raises:
        NotTrusted, NsmError: as :func:`check_trusted` and :func:`made`.
    """
    check_trusted(config, trust)
    return made(config, *args, **kwargs)


def check_trusted(config: Any, trust: Iterable[str] = ()) -> None:
    """Refuse stored settings that would run code which is not to be trusted.

    Raises:
        NotTrusted: a target that :func:`is_trusted` refuses, anywhere within; a logger that names
            its folder, or any positional arguments.
        NotRegistered: a registered object that this process does not know.
        NsmError: ``interpolation``: a text with ``${``, which could become a target later.
    """
    trust = _modules(trust)
    if OmegaConf.is_config(config):
        config = OmegaConf.to_container(config, resolve=False)
    if isinstance(config, str) and "${" in config:
        message = f"{config[:80]!r} is an interpolation, which stored settings may not hold"
        raise NsmError(message, kind="interpolation")
    if isinstance(config, Mapping):
        target = str(config.get("_target_", ""))
        writes = _within(target, _LOGGERS) and "folder" in config  # anywhere on the disk
        if "_args_" in config or writes or ("_target_" in config and not is_trusted(target, trust)):
            module, _, name = target.rpartition(".")
            if module == REGISTERED:
                raise NotRegistered("object", name, "register_...")
            raise NotTrusted(target)
        for item in config.items():
            check_trusted(item, trust)
    elif isinstance(config, (list, tuple)):
        for value in config:
            check_trusted(value, trust)


def target_of(kind: Any) -> str:
    """The ``_target_`` of a class or function: where it can be imported from."""
    return f"{kind.__module__}.{kind.__qualname__}"


def named_object(target: str) -> Any:
    """The class or function of a user's ``_target_``; NsmError if it cannot be imported."""
    try:
        return pkgutil.resolve_name(target)
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        message = f"{target} cannot be imported ({reason})"
        raise NsmError(message, kind="not_importable", key=target) from error
