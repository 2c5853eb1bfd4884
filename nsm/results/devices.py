"""The devices that results are moved to, and trainings run on."""

from __future__ import annotations

import torch

from nsm.errors import NsmError
from nsm.wording import number_of

NO_GPU = "torch finds no GPU; give device=cpu, or install a driver and torch for it"


def count_of_gpus() -> int:
    """How many GPUs of CUDA torch finds."""
    from pytorch_lightning.accelerators import CUDAAccelerator  # seconds, which results need not

    # unlike torch's, Lightning's question for a GPU leaves the process fit for a fork
    return CUDAAccelerator.auto_device_count()


def as_device(given: torch.device | str) -> torch.device:
    """A device, as torch takes it.

    Raises:
        NsmError: ``unknown_option``: no device has that name; ``no_such_device``: it is not there.
    """
    try:
        device = torch.device("cuda" if given == "gpu" else given)
    except (RuntimeError, TypeError) as error:
        message = f"device={str(given)[:60]}: choose cpu, cuda or mps"
        raise NsmError(message, kind="unknown_option", key="device") from error
    count = count_of_gpus() if device.type == "cuda" else 0
    if device.type == "cuda" and (device.index or 0) >= count:
        some = f"torch finds {number_of(count, 'GPU')}; give one from cuda:0 to cuda:{count - 1}"
        message = f"device={given}: {some if count else NO_GPU}"
        raise NsmError(message, kind="no_such_device", key="device")
    if device.type == "mps" and not torch.backends.mps.is_available():
        message = f"device={given}: torch finds no GPU of Apple's; give device=cpu"
        raise NsmError(message, kind="no_such_device", key="device")
    return device
