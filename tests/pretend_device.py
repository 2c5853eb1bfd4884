"""A pretend accelerator: its tensors are apart from the CPU's, as those of CUDA are.

Where the tests run there is no accelerator, so one is pretended. Its tensors are of the device
``meta``, which every torch knows, but hold numbers: each keeps a tensor of the CPU, on which its
operations run. What CUDA refuses is refused: operations on tensors of both devices, apart from
scalars of the CPU in pointwise operations, and indices; and what numpy or a compiled loop would
read. What CUDA's host waits for is counted. It says nothing of CUDA's own kernels, their precision
and their times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any
from unittest import mock

import torch
from pytorch_lightning.accelerators import Accelerator
from pytorch_lightning.strategies import SingleDeviceStrategy
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from nsm.tensors import transformed

NAME = "meta"
_COPIES = ("_to_copy", "copy_")
_INDEXING = ("index", "index_put", "index_put_", "_index_put_impl_")
# these take a scalar of the CPU beside tensors of a device, as pointwise operations do
_TAKES_SCALARS = (*_INDEXING, *_COPIES, "fill", "fill_")
# the host asks whether they succeeded; others that it waits for have tags that say so
_CHECKED = ("_linalg_check_errors", "_linalg_eigh", "_linalg_svd")
_TAGS = (torch.Tag.dynamic_output_shape, torch.Tag.data_dependent_output)


class OnDevice(Tensor):
    """A tensor of the pretend device; ``held`` has its numbers, on the CPU."""

    held: Tensor
    is_meta = False

    @staticmethod
    def __new__(cls, held: Tensor) -> OnDevice:
        made: OnDevice = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=NAME,
        )
        made.held = held
        return made

    def __reduce_ex__(self, protocol: Any) -> Any:
        """As it is read where the device is not: a checkpoint's tensors are mapped to the CPU."""
        return self.held.__reduce_ex__(protocol)

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"OnDevice({self.held})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise RuntimeError(f"{func}: the pretend device is there within its block alone")


class Counts:
    """What the pretend device did.

    Attributes:
        launched: operations by name, without views, which launch nothing.
        waits: operations that the host waits for, apart from copies, by name.
        to_host, to_device: elements of each copy.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin again."""
        self.launched: Counter[str] = Counter()
        self.waits: Counter[str] = Counter()
        self.to_host: list[int] = []
        self.to_device: list[int] = []


class _Operations(TorchDispatchMode):
    """Runs the operations of the device, refuses what CUDA would, and counts."""

    def __init__(self, counts: Counts) -> None:
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        own = [x for x in given if isinstance(x, OnDevice)]
        wanted = kwargs.get("device")
        here = bool(own) if wanted is None else torch.device(wanted).type == NAME
        if not own and not here:
            return func(*args, **kwargs)
        name = func.overloadpacket.__name__
        self._check(func, name, args, given)
        if wanted is not None:
            kwargs["device"] = "cpu"
            kwargs.pop("pin_memory", None)
        elif name == "copy_":
            here = isinstance(args[0], OnDevice)
        if not here:
            self.counts.to_host.append(given[-1].numel())
        elif name in _COPIES and len(own) < len(given):
            self.counts.to_device.append(given[-1].numel())
        elif name == "_local_scalar_dense":
            self.counts.to_host.append(1)
        elif not func.is_view:
            self.counts.launched[name] += 1
        inner, options = tree_map_only(OnDevice, lambda x: x.held, (args, kwargs))
        found = func(*inner, **options)
        if not here:
            return args[0] if name == "copy_" else found
        known = {id(x.held): x for x in own}

        def wrapped(x: Tensor) -> Tensor:
            return known[id(x)] if id(x) in known else OnDevice(x)

        return tree_map_only(Tensor, wrapped, found)

    def _check(self, func: Any, name: str, args: Any, given: list[Tensor]) -> None:
        """Refuse what CUDA refuses, and count what its host waits for."""
        apart = [x for x in given if not isinstance(x, OnDevice)]
        if any(x.device.type == NAME for x in apart):
            raise RuntimeError(f"{name}: a tensor of device {NAME} without numbers")
        waited_for = name in _CHECKED or any(tag in func.tags for tag in _TAGS)
        if name in _INDEXING:
            indices = [x for x in args[1] if x is not None]
            from_host = [x for x in indices if not isinstance(x, OnDevice)]
            self.counts.to_device += [x.numel() for x in from_host]
            apart = [x for x in apart if all(x is not index for index in from_host)]
            waited_for = any(x.dtype in (torch.bool, torch.uint8) for x in indices)
        if waited_for and name != "_local_scalar_dense":
            self.counts.waits[name] += 1
        scalars = torch.Tag.pointwise in func.tags or name in _TAKES_SCALARS
        changed = func._schema.is_mutable and not isinstance(args[0], (OnDevice, list))
        if name not in _COPIES and (changed or any(x.dim() or not scalars for x in apart)):
            if len(apart) < len(given):
                raise RuntimeError(f"{name}: expected all tensors to be on the same device")


class _Numbers(TorchFunctionMode):
    """Tensors from numbers, and numbers from tensors, where torch does not ask the other mode."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if transformed():  # in the other mode, torch would end the process
            raise NotImplementedError(f"{func}: the pretend device knows no torch.func")
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.tolist and isinstance(args[0], OnDevice):
            return args[0].cpu().tolist()
        if func is torch.Tensor.new_tensor:
            kwargs = {"device": args[0].device, "dtype": args[0].dtype, **kwargs}
            func, args = torch.tensor, args[1:]
        if func not in (torch.tensor, torch.as_tensor, torch.asarray):
            return func(*args, **kwargs)
        device = kwargs.get("device")
        if device is None or torch.device(device).type != NAME:
            return func(*args, **kwargs)
        if not isinstance(args[0], Tensor):
            args = (func(*args, **{**kwargs, "device": "cpu"}),)
        return args[0].to(device, kwargs.get("dtype"))


class _Generator(torch.Generator):
    """A source of randomness of either device."""

    def __new__(cls, device: Any = "cpu") -> _Generator:
        kind = torch.device(device).type
        return super().__new__(cls, "cpu" if kind == NAME else kind)


@contextmanager
def pretended() -> Iterator[Counts]:
    """A block in which the device is there; gives what it does."""
    counts = Counts()
    with ExitStack() as stack:
        # torch has its optimizers' faster forms for the devices that it knows alone
        optimizers: Any = import_module("torch.optim.optimizer")
        for kind in ("foreach", "fused"):
            name = f"_get_{kind}_kernels_supported_devices"
            known = [*getattr(optimizers, name)(), NAME]
            stack.enter_context(mock.patch.object(optimizers, name, lambda known=known: [*known]))
        types = [*optimizers._foreach_supported_types, OnDevice]
        stack.enter_context(mock.patch.object(optimizers, "_foreach_supported_types", types))
        stack.enter_context(mock.patch.object(torch, "Generator", _Generator))
        stack.enter_context(_Numbers())
        stack.enter_context(_Operations(counts))
        yield counts


class PretendAccelerator(Accelerator):
    """The device for Lightning."""

    def setup_device(self, device: torch.device) -> None:
        assert device.type == NAME

    def teardown(self) -> None:
        pass

    @staticmethod
    def parse_devices(devices: Any) -> int:
        return int(devices)

    @staticmethod
    def get_parallel_devices(devices: int) -> list[torch.device]:
        return [torch.device(NAME)] * devices

    @staticmethod
    def auto_device_count() -> int:
        return 1

    @staticmethod
    def is_available() -> bool:
        return True

    @staticmethod
    def name() -> str:
        return "pretend"


def trainer(kind: Any, **arguments: Any) -> Any:
    """A trainer of Lightning's own kind on the device, whatever accelerator it is given."""
    one = SingleDeviceStrategy(device=NAME, accelerator=PretendAccelerator())
    return kind(**{**arguments, "accelerator": "auto", "strategy": one})
