"""In which numbers networks compute while they are trained: float32, or bfloat16 where the processor is quicker at it.

Weights, losses, log densities and what leaves a network's head stay float32. What flies computes in float32.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Literal

import torch
from torch import nn

from imagine.core.errors import InputError

Precision = Literal["auto", "float32", "bfloat16"]
DeviceName = Literal["auto", "cpu", "cuda"]


def chosen_device(name: DeviceName) -> torch.device:
    """Return the device that a setting names; `auto` is CUDA where there is one. Raises InputError where it is not."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("run.device: cuda: torch finds no CUDA device here; say auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def compute_dtype(precision: Precision, device: torch.device) -> torch.dtype:
    """Return the type that `precision` means on a device.

    `auto` is bfloat16 on CUDA, and on processors with AMX, where an update of both networks takes about two thirds of
    the time; others emulate it.
    """
    if precision == "auto":
        return torch.bfloat16 if device.type == "cuda" or _has_amx() else torch.float32
    return torch.bfloat16 if precision == "bfloat16" else torch.float32


def _has_amx() -> bool:
    return bool(torch.cpu._is_amx_tile_supported())


def autocast(dtype: torch.dtype, device: torch.device) -> AbstractContextManager[None]:
    """Return a context in which layers compute in `dtype`; none for float32, which so leaves no trace in exports."""
    if dtype == torch.float32:
        return nullcontext()
    return torch.autocast(device.type, dtype=dtype)


class Computing(nn.Module):
    """A network whose layers, but for its head, compute in `dtype`."""

    dtype: torch.dtype = torch.float32

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.parameters()).device


@contextmanager
def at_precision(precision: Precision, *networks: Computing) -> Iterator[None]:
    """Let networks compute at a precision within a context."""
    before = [network.dtype for network in networks]
    for network in networks:
        network.dtype = compute_dtype(precision, network.device)
    try:
        yield
    finally:
        for network, dtype in zip(networks, before, strict=True):
            network.dtype = dtype
