"""The formulas of a known surface in NumPy, written from the descriptions in a material alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

F64 = NDArray[np.float64]


def bilinear(texture: F64, at: F64) -> F64:
    """Periodic texture (rows, columns, channels), row 0 at v → 1, at uv positions (…, 2)."""
    rows, columns = texture.shape[:2]
    x, y = at[..., 0] * columns - 0.5, (1 - at[..., 1]) * rows - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - i)[..., None], (y - j)[..., None]
    top, bottom = (
        texture[(j + k) % rows, i % columns] * (1 - fx) + texture[(j + k) % rows, (i + 1) % columns] * fx
        for k in (0, 1)
    )
    return np.asarray(top * (1 - fy) + bottom * fy)


def rotate(a: F64, w: F64) -> F64:
    """The rotation that takes a to z, of directions (n, 3)."""
    t = a[:, 0] * w[:, 0] + a[:, 1] * w[:, 1]
    s = w[:, 2] + t / (1 + a[:, 2])
    return np.stack([w[:, 0] - a[:, 0] * s, w[:, 1] - a[:, 1] * s, a[:, 2] * w[:, 2] + t], -1)


@dataclass(frozen=True)
class WrittenSurface:
    """Tensors of a surface by their names, with the numbers beside them."""

    tensors: dict[str, F64]
    light_width: float
    dielectric: float
    aspect: float
    finest: int

    def height(self, at: F64) -> F64:
        """Heights of the two triangles of each cell at uv positions (n, 2)."""
        z = self.tensors["surface.heights"][::-1, :, 0]
        rows, columns = z.shape
        x, y = at[:, 0] * columns - 0.5, at[:, 1] * rows - 0.5
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        fx, fy = x - i, y - j
        corner = {(a, b): z[(j + b) % rows, (i + a) % columns] for a in (0, 1) for b in (0, 1)}
        right, up, near, far = corner[1, 0], corner[0, 1], corner[0, 0], corner[1, 1]
        first = near + fx * (right - near) + fy * (up - near)
        second = far + (1 - fx) * (up - far) + (1 - fy) * (right - far)
        return np.where(fx + fy <= 1, first, second)

    def seen(self, u: F64, omega: F64) -> float:
        """Height of the first point of the line through u along omega that lies on the surface: between the
        borders of triangles, the line's height above the surface is linear."""
        z = self.tensors["surface.heights"]
        rows, columns = z.shape[:2]
        rate = omega[:2] / omega[2] / [1, self.aspect]
        start = np.array([u[0] * columns - 0.5, u[1] * rows - 0.5])
        drift = np.array([rate[0] * columns, rate[1] * rows])
        borders = [np.array([0.0, z.min() - 1e-6])]
        for first, step in ((start[0], drift[0]), (start[1], drift[1]), (start.sum(), drift.sum())):
            low, high = sorted((first, first + step * borders[0][1]))
            if abs(step) > 1e-12:
                borders.append((np.arange(np.ceil(low), np.floor(high) + 1) - first) / step)
        t = np.unique(np.concatenate(borders))[::-1]
        above = t - self.height(u + t[:, None] * rate)
        k = int(np.argmax(above <= 0))
        if k == 0:
            return 0.0
        return float(t[k - 1] + (t[k] - t[k - 1]) * above[k - 1] / (above[k - 1] - above[k]))

    def blended(self, name: str, last: int, at: F64, level: F64) -> F64:
        """The textures `name`.0 to `last` at uv positions (n, 2), blended by level."""
        level = np.minimum(level, last)
        low = np.minimum(np.floor(level).astype(int), max(0, last - 1))
        both = np.stack([bilinear(self.tensors[f"{name}.{s}"], at) for s in range(last + 1)])
        n, fine = np.arange(len(at)), (level - low)[:, None]
        return np.asarray((1 - fine) * both[low, n] + fine * both[np.minimum(low + 1, last), n])

    def hints(self, u: F64, level: F64, omega_i: F64, omega_o: F64, places: int) -> tuple[F64, F64]:
        """(z (n,), [e, n.x, n.y, core] (n, 6)): means over the places."""
        step = np.sqrt(0.75)
        offsets = {
            1: [(0.0, 0.0)],
            2: [(-step, 0.0), (step, 0.0)],
            4: [(x * step, y * step) for y in (-1, 1) for x in (-1, 1)],
        }[places]
        finer = 0 if places == 1 else 1
        flat = omega_o[:, :2]
        along = np.array([w / np.hypot(*w) if w.any() else [1.0, 0.0] for w in flat])
        across = along[:, ::-1] * [-1, 1]
        heights, parts = [], []
        for offset in offsets:
            moved = offset[0] * across + offset[1] * along
            x = u + (2.0**-level / 2)[:, None] * moved / [1, self.aspect]
            z = np.array([self.seen(*both) for both in zip(x, omega_o, strict=True)])
            hit = x + (z / omega_o[:, 2])[:, None] * omega_o[:, :2] / [1, self.aspect]
            heights.append(z)
            parts.append(self.shaded(hit, level + finer, omega_i, omega_o))
        return np.mean(heights, 0), np.mean(parts, 0)

    def shaded(self, hit: F64, level: F64, omega_i: F64, omega_o: F64) -> F64:
        """[e, n.x, n.y, core] (n, 6) at surface points."""
        maps = self.blended("surface.maps", self.finest + 1, hit, level)
        sx, sy, q, b = maps[:, 0], maps[:, 1], maps[:, 2], maps[:, 3:6]
        normal = np.stack([-sx, -sy, np.ones_like(sx)], -1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        cosine = (normal * omega_i).sum(1)
        e = self.visibility(hit, level, omega_i) * np.maximum(0, cosine) / omega_i[:, 2]
        value: Any = b / np.pi
        if maps.shape[1] == 8:
            k = maps[:, 7:8]
            alpha2 = np.clip(maps[:, 6] + np.maximum(0, q - sx**2 - sy**2) + self.light_width**2, 1e-4, 4)
            f0 = (1 - k) * self.dielectric + k * b
            ci, co = np.maximum(0.01, cosine), np.maximum(0.05, (normal * omega_o).sum(1))
            h = omega_i + omega_o
            h /= np.linalg.norm(h, axis=1, keepdims=True)
            d = np.maximum(0, (normal * h).sum(1))
            facets = alpha2 / (np.pi * (d**2 * (alpha2 - 1) + 1) ** 2)
            fresnel = f0 + (1 - f0) * ((1 - (omega_o * h).sum(1)) ** 5)[:, None]
            masking: Callable[[F64], F64] = lambda c: np.sqrt(1 + alpha2 * (1 / c**2 - 1))  # noqa: E731
            lobe = facets / (2 * (masking(ci) + masking(co)) * ci * co)
            value = (1 - k) * value + fresnel * lobe[:, None]
        return np.concatenate([e[:, None], normal[:, :2], e[:, None] * value], 1)

    def visibility(self, hit: F64, level: F64, omega_i: F64) -> F64:
        """V (n,)."""
        horizons = self.blended("surface.horizons", self.finest, hit, level)
        count = horizons.shape[1] // 2
        azimuth = np.degrees(np.arctan2(omega_i[:, 1] + 0.0, omega_i[:, 0] + 0.0)) % 360
        known = np.arange(count + 1) * 360 / count
        m, q = (
            np.array([np.interp(a, known, [*row, row[0]]) for a, row in zip(azimuth, part, strict=True)])
            for part in (horizons[:, :count], horizons[:, count:])
        )
        spread = np.maximum(1e-8, np.maximum(0, q - m**2) + (0.8 * self.light_width) ** 2)
        return np.asarray((1 + erf((np.arcsin(omega_i[:, 2]) - m) / np.sqrt(2 * spread))) / 2)
