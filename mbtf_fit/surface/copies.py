"""Tensors that are read on several devices."""

from __future__ import annotations

import torch
from torch import Tensor


class DeviceCopies:
    """A tensor and its copies on other devices, each of which is made once.

    Parameters
    ----------
    tensor : Tensor
        Not changed afterwards.
    """

    def __init__(self, tensor: Tensor) -> None:
        self._copies = {tensor.device: tensor}
        self._first = tensor

    def on(self, device: torch.device) -> Tensor:
        """The tensor on a device."""
        if device not in self._copies:
            self._copies[device] = self._first.to(device)
        return self._copies[device]
