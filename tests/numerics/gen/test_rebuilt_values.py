"""Values rebuilt in NumPy from the documentation alone, in double precision, from image files to M.

The equations are those of ``docs/explanation`` and ``docs/reference/material-yaml.md``. Expected values use
nothing of the packages.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from support.height_maps import fractal, save_heights
from support.scenes import queries
from support.surfaces import point, vectors

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import reference_plan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.bsdf.surface import SurfaceParts
from mbtf_gen.render.estimates import Stream

Array = NDArray[np.float64]
ROWS, COLUMNS, MESH, SCALE = 30, 40, 12, 2.0
ASPECT = ROWS / COLUMNS


def gauss(image: Array, t: float) -> Array:
    """Periodic Gaussian filter of standard deviation t texels."""
    v, u = np.meshgrid(*map(np.fft.fftfreq, image.shape), indexing="ij")
    return np.fft.ifft2(np.fft.fft2(image) * np.exp(-2 * (np.pi * t) ** 2 * (u * u + v * v))).real


def dequantized(h: Array, delta: float) -> Array:
    q = h / delta
    p = q.copy()
    for i in range(13):
        t = 0.5 * 2 ** (i / 2)
        g = 2 * gauss(q, t) - gauss(gauss(q, t), t)
        w = np.clip((1.05**2 - 12 * gauss((g - q) ** 2, 2 * t)) / (1.05**2 - 0.9**2), 0, 1)
        if not w.any():
            break
        p += w * (g - p)
    return h + delta * np.clip(p - q, -0.5, 0.5)


def box(image: Array, rows: int, columns: int) -> Array:
    """Fewer texels: the mean over each one's area, with every texel as many small ones."""
    h, w = image.shape[:2]
    fine = image.repeat(rows, 0).repeat(columns, 1)
    return fine.reshape(rows, h, columns, w, *image.shape[2:]).mean((1, 3))


def bilinear(image: Array, uv: Array) -> Array:
    """Interpolation between texel centers ((i+½)/W, 1-(j+½)/H), around the period."""
    h, w = image.shape[:2]
    x, y = uv[..., 0] * w - 0.5, (1 - uv[..., 1]) * h - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = ((c - k).reshape(c.shape + (1,) * (image.ndim - 2)) for c, k in ((x, i), (y, j)))
    at = lambda b, a: image[b % h, a % w]  # noqa: E731
    return (1 - t) * ((1 - s) * at(j, i) + s * at(j, i + 1)) + t * (
        (1 - s) * at(j + 1, i) + s * at(j + 1, i + 1)
    )


def catmull_rom(image: Array, rows: int, columns: int) -> Array:
    """More texels: the cubic through the four nearest texels along each axis."""

    def along(a: Array, size: int) -> Array:
        x = (np.arange(size) + 0.5) * len(a) / size - 0.5
        i = np.floor(x).astype(int)
        f = (x - i)[:, None]
        p = [a[(i + k) % len(a)] for k in (-1, 0, 1, 2)]
        return 0.5 * (
            2 * p[1]
            + f * (p[2] - p[0])
            + f**2 * (2 * p[0] - 5 * p[1] + 4 * p[2] - p[3])
            + f**3 * (3 * p[1] - p[0] - 3 * p[2] + p[3])
        )

    return along(along(image, rows).T, columns).T


def texels(rows: int, columns: int) -> Array:
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, 1 - (np.arange(rows) + 0.5) / rows)
    return np.stack([u, v], -1)


def mesh(h: Array, columns: int = MESH, scale: float = SCALE) -> Array:
    rows = max(1, round(ASPECT * columns))
    h = box(h, rows, columns) if columns < h.shape[1] else catmull_rom(h, rows, columns)
    return scale * h - (scale * h).max()


def slopes(z: Array) -> Array:
    rows, columns = z.shape
    along_u = (np.roll(z, -1, 1) - np.roll(z, 1, 1)) * columns / 2
    along_v = (np.roll(z, 1, 0) - np.roll(z, -1, 0)) * rows / (2 * ASPECT)
    return np.stack([along_u, along_v], -1)


def residual(n: Array, z: Array, absolute: bool = False) -> Array:
    t = -n[..., :2] / np.maximum(n[..., 2:], 0.05)
    (rows, columns), (h, w) = z.shape, n.shape[:2]
    m = slopes(z)
    m = box(m, h, w) if h < rows else bilinear(m, texels(h, w))
    dj, di = math.ceil(h / rows), math.ceil(w / columns)
    inner = (slice(dj, h - dj), slice(di, w - di)) if min(h - 2 * dj, w - 2 * di) > 0 else ()
    c = max(0.0, float(np.sum(m[inner] * t[inner]) / np.sum(m[inner] ** 2)))
    return t - (1.0 if absolute else min(c, 1.0)) * m


class Surface:
    """The mesh, repeated as far as any ray of this module gets."""

    def __init__(self, z: Array, around: int = 2) -> None:
        rows, columns = z.shape
        j, i = np.meshgrid(
            np.arange(-around * rows, (around + 1) * rows + 1),
            np.arange(-around * columns, (around + 1) * columns + 1),
            indexing="ij",
        )
        x, y = (i + 0.5) / columns, ASPECT * (1 - (j + 0.5) / rows)
        p = np.stack([x, y, z[j % rows, i % columns]], -1)
        upper_left, upper_right = p[:-1, :-1], p[:-1, 1:]
        lower_left, lower_right = p[1:, :-1], p[1:, 1:]
        triangles = [[upper_left, lower_left, lower_right], [upper_left, lower_right, upper_right]]
        self.a, self.b, self.c = (np.concatenate([t[k].reshape(-1, 3) for t in triangles]) for k in range(3))
        n = np.cross(self.b - self.a, self.c - self.a)
        self.n = n / np.linalg.norm(n, axis=-1, keepdims=True)

    def hit(self, o: Array, d: Array) -> tuple[float, Array]:
        """(distance, normal) of the first triangle that a ray meets (Möller and Trumbore 1997)."""
        e1, e2, s = self.b - self.a, self.c - self.a, o - self.a
        p = np.cross(d, e2)
        det = np.sum(e1 * p, -1)
        det = np.where(np.abs(det) < 1e-15, np.inf, det)
        q = np.cross(s, e1)
        u, v, t = np.sum(s * p, -1) / det, q @ d / det, np.sum(e2 * q, -1) / det
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9), t, np.inf)
        return float(t.min()), self.n[t.argmin()]


def shading_normal(n: Array, e: Array, omega: Array) -> tuple[Array, bool]:
    tilted = np.array([n[0] - e[0] * n[2], n[1] - e[1] * n[2], n[2]])
    tilted /= np.linalg.norm(tilted)
    c = tilted @ omega
    if c >= 0.01:
        return tilted, False
    bent = tilted + (0.01 - c) * omega
    bent /= np.linalg.norm(bent)
    assert bent @ omega == pytest.approx(0.01 / math.sqrt(1 - c * c + 1e-4), rel=1e-4)
    return bent, True


def lobe(mu_i: float, mu_o: float, h_n: float, h_i: float, roughness: float, f0: Array) -> Array:
    a2 = roughness**4
    d = a2 / (np.pi * (h_n**2 * (a2 - 1) + 1) ** 2)
    si, so = ((math.sqrt(1 + a2 * (1 - m * m) / (m * m)) - 1) / 2 for m in (mu_i, mu_o))
    f90 = np.minimum(1, 50 * f0)
    return (f0 + (f90 - f0) * (1 - h_i) ** 5) * d / ((1 + si + so) * 4 * mu_i * mu_o)


def rebuilt(
    surface: Surface, maps: dict[str, Array], u: Array, omega_i: Array, omega_o: Array
) -> tuple[Array, bool]:
    """M (3,) at σ = 0 under a delta light, without interreflection; was the normal bent?"""
    x = np.array([u[0], ASPECT * u[1], 0.0])
    t, n = surface.hit(x, -omega_o)
    x = x - t * omega_o
    uv = x[:2] / (1, ASPECT)
    n_s, bent = shading_normal(n, bilinear(maps["slopes"], uv), omega_o)
    mu = n_s @ omega_i
    if mu <= 0 or n @ omega_i <= 0 or np.isfinite(surface.hit(x, omega_i)[0]):
        return np.zeros(3), bent
    if "base_color" in maps:
        f = bilinear(maps["base_color"], uv) / np.pi
    else:
        h = (omega_i + omega_o) / np.linalg.norm(omega_i + omega_o)
        f0 = 0.08 * np.full(3, bilinear(maps["specular"], uv))
        f = lobe(n_s @ omega_o, mu, n_s @ h, omega_o @ h, float(bilinear(maps["roughness"], uv)), f0)
    return f * mu / omega_i[2], bent


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of one tile: 8-bit heights with a seam, normals that repeat some of their slopes, reflectance."""
    out = tmp_path_factory.mktemp("maps")
    h = 0.1 * fractal(ROWS, COLUMNS, 1.5) + 0.05 * np.arange(COLUMNS) / COLUMNS
    save_heights(out / "height.png", h, bits=8)
    rng = np.random.default_rng(3)
    t = rng.normal(0, 0.8, (15, 20, 2)) + 0.7 * box(slopes(SCALE * h), 15, 20)
    n = np.concatenate([-t, np.ones((15, 20, 1))], -1)
    np.save(out / "normal.npy", (n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32))
    Image.fromarray(rng.integers(0, 256, (9, 12, 3), dtype=np.uint8)).save(out / "color.png")
    for name in ("roughness", "specular"):
        np.save(out / f"{name}.npy", rng.uniform(0.2, 1.0, (9, 12)).astype(np.float32) ** 2)
    shared = "height: {file: height.png, scale: 2}\nnormal: {file: normal.npy, convention: gl}\n"
    (out / "matte.yaml").write_text(shared + "base_color: color.png\n")
    glossy = "base_color: {value: [0, 0, 0]}\nroughness: roughness.npy\nspecular: specular.npy\n"
    (out / "glossy.yaml").write_text(shared + glossy)
    return out


def job_of(path: Path, mesh: int = MESH, mode: str = "residual", scale: float = SCALE) -> Job:
    config: dict[str, Any] = {
        "material": str(path),
        "geometry": {"mesh": mesh, "height_scale": scale},
        "light": {"width": 0},
        "effects": {"normal": mode},
        "transport": {"max_depth": 1},
    }
    return Job.load(GeneratorConfig.model_validate(config))


def stored(folder: Path) -> Array:
    return np.asarray(Image.open(folder / "height.png"), np.float64) / 255


def normals(folder: Path) -> Array:
    n = np.load(folder / "normal.npy").astype(np.float64)
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))


@pytest.mark.parametrize("columns", [8, 12, 27, 40, 53])
@pytest.mark.parametrize("scale", [SCALE, -SCALE])
def test_heights_of_the_mesh(folder: Path, columns: int, scale: float) -> None:
    """Dequantized, resampled, scaled; the maximum that touches the reference plane is the mesh's own."""
    job = job_of(folder / "matte.yaml", columns, scale=scale)
    expected = mesh(dequantized(stored(folder), 1 / 255), columns, scale)
    np.testing.assert_allclose(job.material.grid.z, expected, atol=2e-7 * abs(scale))
    assert np.abs(job.material.grid.z - mesh(stored(folder), columns, scale)).max() > 1e-4


@pytest.mark.parametrize("scale", [0.3 * SCALE, SCALE])
@pytest.mark.parametrize("columns", [8, 12, 40])
def test_slopes_that_shading_adds(folder: Path, columns: int, scale: float) -> None:
    """Of a map that repeats more than the slopes of the mesh, or less."""
    job = job_of(folder / "matte.yaml", columns, scale=scale)
    found = job.material.normal_slopes(job.config.effects.normal)
    assert found[1] > 0.1
    n, z = normals(folder), job.material.grid.z
    np.testing.assert_allclose(found[0], residual(n, z), atol=1e-5)
    np.testing.assert_allclose(job.material.normal_slopes("absolute")[0], residual(n, z, True), atol=1e-5)


@pytest.mark.parametrize("name", ["matte", "glossy"])
def test_values(folder: Path, name: str) -> None:
    """M at points of a displaced tile; rounding may let two rays of 300 pass an edge."""
    job = job_of(folder / f"{name}.yaml")
    z = mesh(dequantized(stored(folder), 1 / 255))
    maps = {"slopes": residual(normals(folder), z)}
    if name == "matte":
        s = np.asarray(Image.open(folder / "color.png"), np.float64) / 255
        maps["base_color"] = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    else:
        maps |= {k: np.load(folder / f"{k}.npy").astype(np.float64) for k in ("roughness", "specular")}
    rng, n = np.random.default_rng(5), 300
    disk = rng.normal(size=(2, n, 2))
    disk *= (np.sqrt(rng.random((2, n))) * [[0.97], [0.99]] / np.linalg.norm(disk, axis=-1))[..., None]
    omega = np.concatenate([disk, np.sqrt(1 - np.sum(disk**2, -1, keepdims=True))], -1)
    q = queries(rng.random((n, 2)), 0.0, omega[0], omega[1], n)
    e = build_estimator(job, reference_plan(job)).estimate(q, 2, Stream(1, "test", 0))
    found = e.value_a.astype(np.float64)
    surface = Surface(z)
    pairs = [
        rebuilt(surface, maps, *(np.asarray(a[k], np.float64) for a in (q.u, q.omega_i, q.omega_o)))
        for k in range(n)
    ]
    expected, bent = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    wrong = np.any(np.abs(found - expected) > 2e-3 * expected + 1e-5, axis=-1)
    lit = expected.max(-1) > 0
    assert lit.sum() > 100
    assert (bent & lit).sum() > 10
    assert wrong.sum() <= 2, (found[wrong], expected[wrong])


def test_reflectance_at_grazing_angles_is_per_channel() -> None:
    """A metal whose channels lie below and above F0 = 2%, smooth enough for single scattering alone."""
    wi = np.array([math.sin(1.45), 0, math.cos(1.45)])
    wo = np.array([-math.sin(1.40), 0, math.cos(1.40)])
    base = np.array([0.3, 0.01, 0.002])
    maps = {"base_color": base[:, None], "metallic": 1.0, "roughness": 0.15}
    value = np.array(point(SurfaceParts(metallic=True), wi, **maps).eval_pdf(vectors(wo))[0]).ravel() / wo[2]
    h = (wi + wo) / np.linalg.norm(wi + wo)
    np.testing.assert_allclose(value, lobe(wi[2], wo[2], h[2], wi @ h, 0.15, base), rtol=5e-3)
