"""The checks of ``mbtf-gen selftest``: scenes with known answers, measured by the generator's estimator."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.directions import from_angles, normalize
from mbtf_core.stats import Estimate, mean_estimate, mean_of_halves
from mbtf_gen.diagnostics.closed_forms import Groove, Wall, mirror
from mbtf_gen.diagnostics.selftest import Case, Check
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.sampling.query_sampler import Queries
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.fibers.curves import Curve
from mbtf_gen.tile.heights.grid import HeightGrid

F64 = NDArray[np.float64]
Cases = Mapping[str, Case]

_UP = from_angles(90.0, 0.0)
_PLANE = HeightGrid(np.zeros((4, 4)), 1.0)
_PAIRS = [((70, 0), (80, 0)), ((35, 10), (50, 200)), ((20, 180), (60, 30)), ((15, 60), (25, 75))]
_GRAZING = (1.0, 0.1, 1e-2, 1e-4)


def all_checks() -> list[Check]:
    """Every check, in the order in which they are reported."""
    return [
        Check(
            "Lambert plane",
            "M = albedo/π for footprints of 0 … 100 tiles, light and view down to cosine 1e-4",
            1e-4,
            _lambert,
        ),
        Check(
            "irradiance",
            "the irradiance on the reference plane is 1, also where the horizon cuts the light",
            1e-4,
            _irradiance,
        ),
        Check("mirror", "a mirror reflects the light's lobe, path by path", 2e-3, _mirror, repeated=False),
        Check("V-groove", "tile means of a groove agree with the closed form", 1e-3, _groove),
        Check("wall", "shadow and flank of a wall of slope 100 agree with the closed form", 1e-3, _wall),
        Check("furnace", "a white surface under constant radiance 1 has radiance 1", 2e-4, _furnace),
        Check(
            "fibers",
            "what white fibers return of constant radiance 1 and what passes between them add up to 1",
            2e-4,
            _fibers,
        ),
        Check(
            "reciprocity",
            "exchanging light and view leaves the tile mean unchanged, interreflection included",
            2e-3,
            _reciprocity,
        ),
        Check("surface energy", "white glossy and metallic planes have albedo 1", 2e-3, _surface),
        Check("periodicity", "no ray passes through the tile's borders and corners", 0.0, _lost, "count"),
        Check(
            "launches",
            "values do not depend on the number of paths per launch",
            0.0,
            _launches,
            "count",
            repeated=False,
        ),
        Check(
            "directions",
            "npz and EXR keep directions, horizon included",
            1e-6,
            _stored,
            "rad",
            repeated=False,
        ),
        Check(
            "CUDA",
            "tile means of the groove on the GPU agree with the closed form",
            1e-3,
            _cuda,
            repeated=False,
            required=False,
        ),
    ]


def terraces(cells: int = 64) -> HeightGrid:
    """A periodic height field with terraces, steep flanks and no symmetry."""
    t = 2.0 * np.pi * np.arange(cells) / cells
    x, y = np.meshgrid(t, t)
    h = np.sin(x + 1.3 * np.sin(y)) + 0.6 * np.cos(2 * y - x + 0.4) + 0.3 * np.sin(3 * x + 2 * y)
    h = (h - h.min()) / np.ptp(h)
    return HeightGrid.from_map(0.7 * np.floor(5.0 * h) / 5.0 + 0.3 * h, 0.2)


def _diffuse(albedo: float) -> dict[str, Any]:
    return {"type": "mbtf_surface", "base_color": {"type": "rgb", "value": [albedo] * 3}}


def _queries(u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike, n: int) -> Queries:
    def rows(x: ArrayLike, trailing: tuple[int, ...]) -> NDArray[np.float32]:
        return np.broadcast_to(np.asarray(x, np.float32), (n, *trailing)).copy()

    return Queries(rows(u, (2,)), rows(sigma, ()), rows(omega_i, (3,)), rows(omega_o, (3,)))


def _positions(n: int, round_number: int) -> F64:
    return np.random.default_rng([7, round_number]).random((n, 2))


def _estimates(
    shape: HeightGrid | FiberTile,
    bsdf: dict[str, Any],
    light: LightKernel | None,
    queries: Queries,
    spp: int,
    round_number: int,
    *,
    direct: bool = False,
    launch: int = 1 << 20,
    variant: str | None = None,
) -> Any:
    """Estimates of M; each round has its own random numbers."""
    from mbtf_gen.engine.runtime import CPU_VARIANT, load_mitsuba

    load_mitsuba(variant or CPU_VARIANT)
    from mbtf_gen.render.estimates import Stream
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    estimator = Estimator(build_scene(shape, bsdf), light, Transport(max_depth=1 if direct else 0), launch)
    return estimator.estimate(queries, spp, Stream(17, "test", round_number))


def _tile_mean(
    grid: HeightGrid,
    bsdf: dict[str, Any],
    light: LightKernel | None,
    omega_i: ArrayLike,
    omega_o: ArrayLike,
    round_number: int,
    n: int = 16_000,
    **options: Any,
) -> Estimate:
    """Tile mean: footprints with σ of four tile widths, each of which covers the tile evenly."""
    q = _queries(_positions(n, round_number), 4.0, omega_i, omega_o, n)
    e = _estimates(grid, bsdf, light, q, 16, round_number, **options)
    return mean_estimate(0.5 * (e.value_a.astype(np.float64) + e.value_b)[:, 0])


def _off(measured: Estimate, expected: float) -> Case:
    return Case(measured.value / expected - 1.0, measured.error / abs(expected))


def _towards(cosine: float, azimuth: float) -> F64:
    return from_angles(math.degrees(math.asin(cosine)), azimuth)


def _lambert(round_number: int) -> Cases:
    out = {}
    n = 2000
    sigma, u = np.resize([0.0, 1e-3, 0.5, 100.0], n), _positions(n, round_number)
    for width, light, view in itertools.product((0.0, 1.0), _GRAZING, _GRAZING):
        q = _queries(u, sigma, _towards(light, 20), _towards(view, 200), n)
        e = _estimates(_PLANE, _diffuse(0.5), LightKernel(width), q, 32, round_number)
        name = f"light {width:g}°, cosines {light:g} and {view:g}"
        out[name] = _off(mean_of_halves(e.value_a[:, 0], e.value_b[:, 0]), 0.5 / math.pi)
    return out


def _irradiance(round_number: int) -> Cases:
    """Irradiance by sampling the light: E[L ω_z / density]."""
    from mbtf_gen.engine.runtime import load_mitsuba

    mi = load_mitsuba()
    import drjit as dr

    from mbtf_gen.render.directional_light import DirectionalLight

    n, out = 100_000, {}
    rng = np.random.default_rng([3, round_number])
    for width in (0.05, 1.0, 30.0):
        kernel = LightKernel(width)
        for cosine in _GRAZING:
            omega_i = _towards(cosine, 77).astype(np.float32)
            lanes = DirectionalLight(
                "lobe",
                mi.Vector3f(*(dr.full(mi.Float, float(c), n) for c in omega_i)),
                dr.full(mi.Float, 1.0 / float(kernel.irradiance(omega_i)), n),
                dr.opaque(mi.Float, kernel.kappa),
            )
            omega = lanes.sample(mi.Point2f(rng.random((2, n), np.float32)))
            value = np.array(lanes.radiance(omega) * omega.z / lanes.sampling_density(omega), np.float64)
            out[f"light {width:g}°, cosine {cosine:g}"] = _off(mean_estimate(value), 1.0)
    return out


def _mirror(round_number: int) -> Cases:
    out = {}
    rng = np.random.default_rng(5)
    metal = {**_diffuse(0.9), "metallic": 1.0, "roughness": 0.0}
    for width in (0.05, 1.0, 10.0):
        light, n = LightKernel(width), 200
        rise = np.degrees(np.arcsin(10 ** rng.uniform(-3, 0, n)))
        view = from_angles(rise, 360 * rng.random(n))
        omega_i = view * (-1.0, -1.0, 1.0) + np.radians(width) * rng.normal(size=view.shape)
        omega_i[:, 2] = np.maximum(np.abs(omega_i[:, 2]), 1e-3)
        omega_i = normalize(omega_i).astype(np.float32)
        view = view.astype(np.float32)
        e = _estimates(_PLANE, metal, light, _queries([0.5, 0.5], 0.1, omega_i, view, n), 2, round_number)
        expected = mirror(0.9, light, omega_i, view)
        # Relative to at least 1e-3, because values far out in the lobe vanish.
        off = (e.value_a[:, 0] - expected) / np.maximum(expected, 1e-3)
        out[f"light {width:g}°"] = Case(float(off[np.argmax(np.abs(off))]))
    return out


def _direct_mean(
    scene: Groove | Wall, omega_i: F64, omega_o: F64, round_number: int, variant: str | None = None
) -> Estimate:
    """Tile mean under a delta light, without interreflection."""
    bsdf, light = _diffuse(scene.albedo), LightKernel(0.0)
    return _tile_mean(scene.grid, bsdf, light, omega_i, omega_o, round_number, direct=True, variant=variant)


def _groove(round_number: int, variant: str | None = None) -> Cases:
    groove, out = Groove(0.4, 0.7), {}
    for light, view in _PAIRS:
        omega_i, omega_o = from_angles(*light), from_angles(*view)
        mean = _direct_mean(groove, omega_i, omega_o, round_number, variant)
        out[f"light {light}, view {view}"] = _off(mean, groove.tile_mean(omega_i, omega_o))
    return out


def _wall(round_number: int) -> Cases:
    wall, out = Wall(64, 100.0, 0.7), {}
    for elevation, azimuth in itertools.product((65.0, 80.0), (0.0, 180.0)):
        light = from_angles(elevation, azimuth)
        mean = _direct_mean(wall, light, _UP, round_number)
        out[f"light {elevation:g}°, azimuth {azimuth:g}°"] = _off(mean, wall.tile_mean_from_above(light))
    return out


def _furnace(round_number: int) -> Cases:
    heights, white = terraces(), _diffuse(1.0)
    return {
        f"view {elevation:g}°": _off(
            _tile_mean(heights, white, None, _UP, from_angles(elevation, 40), round_number, 4000), 1.0
        )
        for elevation in (90.0, 30.0, 3.0, 0.5)
    }


def _fibers(round_number: int) -> Cases:
    from mbtf_gen.engine.runtime import load_mitsuba

    load_mitsuba()
    rng, s, out = np.random.default_rng(5), np.arange(8) / 8, {}
    curves = []
    for k in range(40):
        wave = 2.0 * np.pi * (s + rng.random())
        across, down = rng.random() + 0.05 * np.sin(wave), 0.02 * np.cos(wave) - 0.2 * rng.random()
        points = np.column_stack([s, across, down] if k % 2 else [across, s, down])
        curves.append(Curve.through(points, 0.01, np.eye(3)[1 - k % 2]))
    felt = FiberTile.settled(1.0, curves, np.zeros(len(curves), int), np.ones((1, 3)))
    for elevation in (90.0, 20.0, 3.0):
        n = 1000
        q = _queries(_positions(n, round_number), 4.0, _UP, from_angles(elevation, 40), n)
        e = _estimates(felt, felt.surface(), None, q, 16, round_number)
        total = 0.5 * (e.value_a.astype(np.float64) + e.value_b)[:, 0] + e.transmittance
        out[f"view {elevation:g}°"] = _off(mean_estimate(total), 1.0)
    return out


def _reciprocity(round_number: int) -> Cases:
    heights, out = terraces(), {}
    for light, view in _PAIRS[1:]:
        one, other = from_angles(*light), from_angles(*view)
        forth, back = (
            _tile_mean(heights, _diffuse(0.9), LightKernel(0.0), i, o, 2 * round_number + k)
            for k, (i, o) in enumerate(((one, other), (other, one)))
        )
        mean = 0.5 * (forth.value + back.value)
        error = math.hypot(forth.error, back.error) / mean
        out[f"{light} and {view}"] = Case((forth.value - back.value) / mean, error)
    return out


def _surface(round_number: int) -> Cases:
    out = {}
    for metallic, roughness, cosine in itertools.product(
        (0.0, 1.0), (0.0, 0.1, 0.5, 1.0), (1.0, 0.3, 1e-2, 1e-4)
    ):
        bsdf = {**_diffuse(1.0), "specular": 0.5, "metallic": metallic, "roughness": roughness}
        q = _queries([0.5, 0.5], 0.1, _UP, _towards(cosine, 30), 1000)
        e = _estimates(_PLANE, bsdf, None, q, 32, round_number)
        name = f"metallic {metallic:g}, roughness {roughness:g}, cosine {cosine:g}"
        out[name] = _off(mean_of_halves(e.value_a[:, 0], e.value_b[:, 0]), 1.0)
    return out


def _lost(round_number: int) -> Cases:
    """Number of rays from above that hit no surface, of 300 000 per round and shape."""
    out = {}
    rng = np.random.default_rng([11, round_number])
    for aspect in (1.0, 0.5):
        grid, n = HeightGrid(terraces().z, aspect), 150_000
        u = rng.random((n, 2))
        border = np.array([0.0, 0.5 / 64, 1.0 - 0.5 / 64, 1.0 - 1e-7])
        third = n // 3
        u[:third, 0] = rng.choice(border, third)
        u[third : 2 * third] = rng.choice(border, (third, 2))
        z = np.exp(rng.uniform(math.log(0.02), 0.0, n))
        phi = 2.0 * np.pi * rng.random(n)
        # Rays along the axes of the grid run inside edges.
        phi[::2] = np.round(phi[::2] / (0.5 * np.pi)) * 0.5 * np.pi
        r = np.sqrt(1.0 - z * z)
        view = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
        q = _queries(u, 0.0, _UP, view, n)
        e = _estimates(grid, _diffuse(0.0), LightKernel(0.0), q, 2, round_number, direct=True)
        out[f"aspect {aspect:g}"] = Case(float(e.lost + e.capped))
    return out


def _launches(round_number: int) -> Cases:
    """Number of values that differ between launches of different size."""
    n = 1000
    q = _queries(_positions(n, 0), 0.1, from_angles(40, 60), from_angles(55, 200), n)
    light = LightKernel(5.0)
    whole, pieces = (
        _estimates(terraces(), _diffuse(0.8), light, q, 8, round_number, launch=launch)
        for launch in (1 << 20, 1 << 11)
    )
    different = np.count_nonzero((whole.value_a != pieces.value_a) | (whole.value_b != pieces.value_b))
    return {"launches of 2048 and 8000 paths": Case(float(different))}


def _stored(round_number: int) -> Cases:
    from mbtf_gen.dataset.shard_io import read_shard, write_shard

    n, out = 20_000, {}
    rng = np.random.default_rng(13)
    cosine, phi = 10 ** rng.uniform(-9, 0, n), 2 * np.pi * rng.random(n)
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    omega = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
    q = _queries([0.5, 0.5], 0.1, omega, omega, n)
    value = np.ones((n, 3), np.float32)
    arrays = {"u": q.u, "sigma": q.sigma, "omega_i": q.omega_i, "omega_o": q.omega_o}
    arrays |= {"value_a": value, "value_b": value, "spp": q.sigma}
    with tempfile.TemporaryDirectory(prefix="mbtf-selftest-") as folder:
        for suffix in ("npz", "exr"):
            path = Path(folder, f"train-00000.{suffix}")
            write_shard(path, arrays)
            back = np.array(read_shard(path, mapped=False)["omega_i"], np.float64)
            off = 2.0 * np.arcsin(0.5 * np.linalg.norm(back - omega, axis=1))
            # Near the horizon the relative error of the cosine matters.
            rise = np.abs(back[:, 2] / omega[:, 2] - 1.0)
            out[f"{suffix}, angle"] = Case(float(off.max()))
            out[f"{suffix}, cosine (relative)"] = Case(float(rise.max()))
    return out


def _cuda(round_number: int) -> Cases | None:
    """In a child process, because a driver may abort it. None without a device."""
    from mbtf_core.child_process import run_child
    from mbtf_core.errors import EngineError
    from mbtf_gen.engine.runtime import CUDA_VARIANT, prove

    if prove(CUDA_VARIANT).fault:
        return None
    outcome = run_child(__name__, "groove_on_cuda", timeout=180.0)
    if outcome.fault:
        raise EngineError(outcome.fault)
    return {name: Case(*numbers) for name, numbers in outcome.answers.items()}


def groove_on_cuda() -> Iterator[dict[str, Any]]:
    """Child process of the CUDA check."""
    from mbtf_gen.engine.runtime import CUDA_VARIANT

    yield {name: (c.off, c.error) for name, c in _groove(0, CUDA_VARIANT).items()}
