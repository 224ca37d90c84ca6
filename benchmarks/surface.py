"""Energy and cost of the project's surface beside Mitsuba's ``principled``.

    python benchmarks/surface.py [--runs 5] [--queries 32768] [--spp 16]

**Energy**: what a white surface under white light returns, by roughness and cosine of the view, from 2^18
samples of the BSDF's own sampler.
**Cost**: processor seconds per million paths of the estimator, on a relief of 256² cells with bitmaps of
color, roughness and metallic, light of 1°, at most 6 interactions; the least of the runs, which alternate.
Processor time, not elapsed time, so that other work on the machine matters little.

Tables go to standard error; the last line is one JSON object with the figures.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.engine.runtime import load_mitsuba

ROUGHNESSES = (0.02, 0.1, 0.3, 0.5, 1.0)
COSINES = (1.0, 0.5, 0.2, 0.05)
WHITE = {"type": "rgb", "value": 1.0}


def say(line: str) -> None:
    """One line to standard error."""
    print(line, file=sys.stderr, flush=True)


def albedo(mi: Any, bsdf: dict[str, Any], cosine: float, count: int = 1 << 18) -> float:
    """∫ f μo dωo of a BSDF for a view of the given cosine."""
    import drjit as dr

    rng = mi.PCG32(size=count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = mi.Vector3f((1 - cosine * cosine) ** 0.5, 0, cosine)
    xi = mi.Point2f(rng.next_float32(), rng.next_float32())
    _, weight = mi.load_dict(bsdf).sample(mi.BSDFContext(), si, rng.next_float32(), xi)
    return float(np.mean(np.array(weight.x, np.float64)))


def energies(mi: Any) -> dict[str, dict[str, list[float]]]:
    """Returned shares of a dielectric over a white base, and of white metal."""
    out: dict[str, dict[str, list[float]]] = {}
    for metallic, name in ((0.0, "dielectric over white"), (1.0, "white metal")):
        say(f"{name}: returned share at view cosines {COSINES}")
        out[name] = {}
        for kind in ("principled", "mbtf_surface"):
            for roughness in ROUGHNESSES:
                bsdf = {"type": kind, "base_color": WHITE, "roughness": roughness, "specular": 0.5}
                row = [albedo(mi, {**bsdf, "metallic": metallic}, c) for c in COSINES]
                out[name][f"{kind} {roughness}"] = [round(x, 4) for x in row]
                say(f"  {kind:14} roughness {roughness:<5}  " + "  ".join(f"{x:.3f}" for x in row))
    return out


def relief(resolution: int = 256) -> NDArray[np.float64]:
    """Periodic random relief in [0, 1]."""
    rng = np.random.default_rng(1)
    frequency = np.fft.fftfreq(resolution, 1.0 / resolution)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    h = np.fft.ifft2(np.exp(2j * np.pi * rng.random(radius.shape) - (radius / 8.0) ** 2)).real
    return (h - h.min()) / np.ptp(h)


def surfaces(mi: Any) -> dict[str, dict[str, Any]]:
    """BSDFs to compare."""
    pixels = np.random.default_rng(2).uniform(0.2, 0.8, (256, 256, 3)).astype(np.float32)

    def bitmap(a: NDArray[np.float32]) -> dict[str, Any]:
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(a)), "raw": True}

    color, rough, metal = bitmap(pixels), bitmap(pixels[..., :1]), bitmap(pixels[..., 1:2])
    own = {"type": "mbtf_surface", "base_color": color}
    stock = {"type": "principled", "base_color": color, "roughness": rough, "specular": 0.5}
    return {
        "diffuse": {"type": "diffuse", "reflectance": color},
        "mbtf_surface Lambert": own,
        "principled": {**stock, "metallic": 0.0},
        "mbtf_surface specular": {**own, "roughness": rough, "specular": 0.5},
        "principled metallic map": {**stock, "metallic": metal},
        "mbtf_surface metallic map": {**own, "roughness": rough, "specular": 0.5, "metallic": metal},
        "principled coat": {**stock, "metallic": metal, "clearcoat": 1.0},
        "mbtf_surface coat": {
            **own,
            "roughness": rough,
            "specular": 0.5,
            "metallic": metal,
            "clearcoat": 1.0,
            "clearcoat_roughness": 0.1,
        },
    }


def costs(mi: Any, runs: int, count: int, spp: int) -> dict[str, float]:
    """Processor seconds per million paths."""
    from mbtf_gen.render.estimator import Estimator, Stream
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene
    from mbtf_gen.sampling.light_kernel import LightKernel
    from mbtf_gen.sampling.query_sampler import Queries
    from mbtf_gen.tile.heights.grid import HeightGrid

    rng = np.random.default_rng(3)

    def directions() -> NDArray[np.float32]:
        r, phi = 0.99 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
        return np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - r * r)], axis=-1).astype(np.float32)

    u, sigma = rng.random((count, 2)).astype(np.float32), np.full(count, 0.01, np.float32)
    queries = Queries(u, sigma, directions(), directions())
    grid = HeightGrid.from_map(relief(), 0.15)
    transport = Transport(max_depth=6)
    traced = {
        name: Estimator(build_scene(grid, bsdf), LightKernel(1.0), transport)
        for name, bsdf in surfaces(mi).items()
    }
    seconds: dict[str, list[float]] = {name: [] for name in traced}
    for run in range(runs + 1):
        for name, estimator in traced.items():
            start = time.process_time()
            estimator.estimate(queries, spp, Stream(run, "test", 0))
            # The first run compiles.
            if run:
                seconds[name].append(time.process_time() - start)
    million = count * spp / 1e6
    least = {name: min(s) / million for name, s in seconds.items()}
    for name, value in least.items():
        ratio = value / least["principled"]
        say(f"{name:26} {value:5.2f} processor s per million paths, {ratio:.2f} of principled")
    return {name: round(value, 3) for name, value in least.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--queries", type=int, default=1 << 15)
    parser.add_argument("--spp", type=int, default=16)
    options = parser.parse_args()
    mi = load_mitsuba()
    from mbtf_gen.render.scene import register_plugins

    register_plugins()
    figures = {"energy": energies(mi), "cost": costs(mi, options.runs, options.queries, options.spp)}
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
