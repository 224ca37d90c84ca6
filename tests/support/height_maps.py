"""Periodic height maps without any symmetry, and their normal maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def fractal(rows: int, columns: int, exponent: float = 2.0, seed: int = 5) -> Floats:
    """Heights in [0, 1], amplitude 1/frequency^exponent, periodic, no symmetry."""
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=(rows, columns)))
    v = np.fft.fftfreq(rows)[:, None] * rows * (columns / rows)
    frequency = np.hypot(v, np.fft.rfftfreq(columns) * columns)
    spectrum *= np.where(frequency > 0, 1.0, 0.0) / np.maximum(frequency, 1.0) ** exponent
    h = np.fft.irfft2(spectrum, (rows, columns))
    return (h - h.min()) / np.ptp(h)


def rms(x: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x**2)))


def slopes(h: Floats) -> Floats:
    """Periodic differences of neighboring heights along v and u."""
    return np.stack([np.roll(h, -1, 0) - h, np.roll(h, -1, 1) - h])


def normals_of(height: Floats, factor: float) -> Floats:
    """OpenGL normals (H, W, 3) of heights (H, W) times `factor` tile widths, row 0 at v → 1."""
    columns = height.shape[1]
    du = factor * 0.5 * columns * (np.roll(height, -1, 1) - np.roll(height, 1, 1))
    dv = factor * 0.5 * columns * (np.roll(height, 1, 0) - np.roll(height, -1, 0))
    return slope_normals(np.stack([du, dv], axis=-1))


def slope_normals(slopes: Floats) -> Floats:
    """Normals (H, W, 3) of slopes (H, W, 2) along u and v."""
    n = np.concatenate([-slopes, np.ones_like(slopes[..., :1])], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def save_normals(path: Path, normals: NDArray[Any], *, dx: bool = False) -> Path:
    """Write a normal map as 8-bit PNG."""
    from PIL import Image as Pillow

    flipped = normals * np.array([1.0, -1.0 if dx else 1.0, 1.0])
    Pillow.fromarray(np.rint((flipped + 1) * 127.5).astype(np.uint8)).save(path)
    return path


def save_heights(path: Path, height: Floats, bits: int = 16) -> Path:
    """Write heights in [0, 1] as gray PNG of 8 or 16 bits."""
    from PIL import Image as Pillow

    codes = np.rint(height * (2**bits - 1))
    Pillow.fromarray(codes.astype(np.uint8 if bits == 8 else np.uint16)).save(path)
    return path
