"""The compiled kernel: forward and backward of all models, blur and Adam on CPUs.

Written in C, compiled when the package is installed (``setup.py``), called through ctypes. Without it
everything runs in PyTorch; the tests compare both.
"""

from __future__ import annotations

from mbtf_fit.native.library import Kernel, describe, kernel, missing_reason

__all__ = ["Kernel", "describe", "kernel", "missing_reason"]
