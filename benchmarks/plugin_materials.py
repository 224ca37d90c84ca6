"""The Mitsuba plugin on fitted materials: sampling, energy, precision, first picture.

    python benchmarks/plugin_materials.py [MATERIAL ...] [--work out/plugin_materials] [--time 80s]

MATERIAL is what ``mbtf-gen`` takes; by default five assets and six texture sets. Data (128 × 128 texels, 200
queries per texel) and fits are made in ``--work`` where they are missing, two or three minutes each. Every
material is then measured in a process of its own, with an empty kernel cache:

- **first picture**: seconds from loading the material to its first 1080p picture of a plane;
- **conformance**: largest deviation from the material's conformance values, in single and half precision;
- **χ²** of the plugin's samples at 32 random positions, footprints and views; the smallest p of all
  materials is corrected for their number (Šidák);
- **variance** of the light reflected under a constant sky by cosine sampling, over that by the sampler; the
  threshold is for glossy materials, as their maps and the variance of cosine sampling show;
- **energy**: reflectance of the tile by elevation of the light, beside the path-traced one of the same
  queries, with the error of the paired difference.

The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    HEIGHT_SCALES,
    RELIEFS,
    ROOT,
    conformance_deviation,
    finish,
    is_available,
    parser_of,
    source,
    start,
)
from numpy.typing import NDArray
from support.chi_square import Cap, chi_square_test

from mbtf_core.directions import from_angles, from_projected_disk

# What counts as glossy: at least this share of what the maps reflect is specular, the median roughness is at
# most this, and light sampled by the cosine alone varies by at least this, as a relative variance.
GLOSSY_SHARE, GLOSSY_ROUGHNESS, GLOSSY_VARIANCE = 0.33, 0.65, 0.1
# What a dielectric of index 1.5 reflects of light from everywhere.
FRESNEL = 0.092
# First picture in seconds, deviations, χ² after correction, variance ratio of glossy materials, and what
# energies have too much, in standard errors.
THRESHOLDS = {
    "first_picture": 10.0,
    "single": 1e-4,
    "half": 1e-2,
    "chi_square": 0.01,
    "variance": 2.0,
    "energy": 3.0,
}
PLACES, SAMPLES = 32, 60_000
ELEVATIONS = (10.0, 20.0, 35.0, 50.0, 65.0, 85.0)
ENERGY_QUERIES, ENERGY_SPP = 4096, 64


def random_views(random: np.random.Generator, n: int) -> NDArray[np.float64]:
    """(n, 3), uniform on the projected disk down to a cosine of 0.1."""
    angle, radius = 2 * np.pi * random.random(n), np.sqrt(0.99 * random.random(n))
    return from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))


def hits(mi: Any, dr: Any, aspect: float, u: Any, sigma: Any, views: Any, each: int) -> Any:
    """Surface interactions on the tile, `each` for every row."""
    n = len(sigma)
    index = dr.arange(mi.UInt32, n * each) // each

    def lanes(array: Any) -> Any:
        return dr.gather(mi.Float, mi.Float(np.ascontiguousarray(array, np.float32)), index)

    si = dr.zeros(mi.SurfaceInteraction3f, n * each)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, -1, 0)
    si.uv = mi.Point2f(lanes(u[:, 0]), aspect * (1.0 - lanes(u[:, 1])))
    # A square pixel of two standard deviations.
    si.duv_dx, si.duv_dy = mi.Vector2f(2 * lanes(sigma), 0), mi.Vector2f(0, 2 * lanes(sigma))
    si.wi = mi.Vector3f(lanes(views[:, 0]), lanes(views[:, 1]), lanes(views[:, 2]))
    return si


def uniform(mi: Any, n: int, seed: int) -> tuple[Any, Any]:
    """(choice, point) of the unit cube."""
    xi = np.random.default_rng(seed).random((3, n), np.float32)
    return mi.Float(xi[0]), mi.Point2f(xi[1:])


def chi_squares(mi: Any, dr: Any, bsdf: Any) -> list[float]:
    """p-values of the samples at random places, footprints and views."""
    random = np.random.default_rng(11)
    lattice, context = bsdf.lattice, mi.BSDFContext()
    u, views = random.random((PLACES, 2)), random_views(random, PLACES)
    sigma = 0.5 * np.exp2(-lattice.finest * random.random(PLACES))
    out = []
    for k in range(PLACES):
        here = partial(hits, mi, dr, lattice.aspect, u[k : k + 1], sigma[k : k + 1], views[k : k + 1])
        si = here(SAMPLES)
        bs, _ = bsdf.sample(context, si, *uniform(mi, SAMPLES, 100 + k))
        # What fell below the surface was thrown away.
        drawn = np.where(np.array(bs.pdf) > 0, np.array(bs.wo), [[0.0], [0.0], [-1.0]]).T

        def density(w: Any, here: Any = here) -> NDArray[np.float64]:
            place = here(len(w))
            return np.array(bsdf.pdf(context, place, mi.Vector3f(w.T.astype(np.float32))), np.float64)

        out.append(chi_square_test(drawn, density, Cap(cos_min=0.0), bins=(16, 32)).p_value)
    return out


def variance_of(mi: Any, dr: Any, bsdf: Any, each: int = 2048, places: int = 512) -> tuple[float, float]:
    """(mean, mean variance of one sample) of the light reflected under a constant sky, over random places."""
    random = np.random.default_rng(12)
    sigma = 0.5 * np.exp2(-bsdf.lattice.finest * random.random(places))
    si = hits(
        mi, dr, bsdf.lattice.aspect, random.random((places, 2)), sigma, random_views(random, places), each
    )
    _, weight = bsdf.sample(mi.BSDFContext(), si, *uniform(mi, places * each, 13))
    x = np.array(mi.luminance(mi.Color3f(weight)), np.float64).reshape(places, each)
    return float(x.mean()), float(x.var(1, ddof=1).mean())


def energies(material: Path, shards: Path, evaluator: Any) -> list[dict[str, float]]:
    """Reflected share by elevation of the light: fit, reference, error of their difference. Of views, those
    that the data have, and of elevations too."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_core.data.schema import Queries
    from mbtf_gen.config.generator import GeneratorConfig
    from mbtf_gen.planning.job import Job
    from mbtf_gen.planning.run_plan import reference_plan
    from mbtf_gen.planning.simulation import build_estimator
    from mbtf_gen.render.estimates import Stream

    config = GeneratorConfig.model_validate(Dataset.open(shards).manifest["config"])
    job = Job.load(config)
    estimator = build_estimator(job, reference_plan(job))
    random = np.random.default_rng([14, zlib.crc32(material.name.encode())])
    n, rows, lowest = ENERGY_QUERIES, [], config.queries.min_cos
    for k, elevation in enumerate(ELEVATIONS):
        if np.sin(np.radians(elevation)) < lowest:
            continue
        angle, radius = 2 * np.pi * random.random(n), np.sqrt((1 - lowest**2) * random.random(n))
        views = from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
        turned = 2 * np.pi * random.random(n)
        flat = np.cos(np.radians(elevation))
        lights = np.stack(
            [flat * np.cos(turned), flat * np.sin(turned), np.full(n, from_angles(elevation, 0.0)[2])], -1
        )
        queries = Queries(
            *(a.astype(np.float32) for a in (random.random((n, 2)), np.full(n, 0.5), lights, views))
        )
        traced = estimator.estimate(queries, ENERGY_SPP, Stream(1, "reference", k))
        share = np.pi * (1 - lowest**2)
        true = share * 0.5 * (traced.value_a + traced.value_b).mean(-1)
        fit = share * evaluator.evaluate(queries.u, queries.sigma, lights, views).mean(-1)
        difference = (fit - true).astype(np.float64)
        rows.append(
            {
                "elevation": elevation,
                "fit": float(fit.mean()),
                "reference": float(true.mean()),
                "error": float(difference.std(ddof=1) / np.sqrt(n)),
            }
        )
    return rows


def gloss(source: Path, config: dict[str, Any]) -> dict[str, float]:
    """Share of what the material's maps reflect that is specular, and their median roughness; 1 for
    Lambert."""
    from mbtf_gen.tile.loading import load_material

    maps = load_material(source, config["geometry"]["make_tileable"]).maps
    if "roughness" not in maps:
        return {"specular_share": 0.0, "roughness": 1.0}
    color = float(np.mean(maps["base_color"] @ np.array([0.2126, 0.7152, 0.0722])))
    metal = float(np.mean(maps.get("metallic", 0.0)))
    specular, diffuse = (1 - metal) * FRESNEL + metal * color, (1 - metal) * (1 - FRESNEL) * color
    return {
        "specular_share": specular / (specular + diffuse),
        "roughness": float(np.median(maps["roughness"])),
    }


def is_glossy(row: dict[str, Any]) -> bool:
    """Whether a material's figures make it a glossy one."""
    return bool(
        row["specular_share"] >= GLOSSY_SHARE
        and row["roughness"] <= GLOSSY_ROUGHNESS
        and row["cosine_variance"] >= GLOSSY_VARIANCE
    )


def plane_scene(mi: Any, bsdf: Any) -> Any:
    """Forty tiles across, seen at 45 degrees in 1080p under the sun and a sky."""
    flip = mi.ScalarTransform4f().scale([20.0, -20.0, 1.0])
    return mi.load_dict(
        {
            "type": "scene",
            "plane": {"type": "rectangle", "to_world": flip, "bsdf": bsdf},
            "sun": {"type": "directional", "direction": [0.5, 0.3, -0.8], "irradiance": 2.0},
            "sky": {"type": "constant", "radiance": 0.3},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": mi.ScalarTransform4f().look_at([0, -12, 12], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 1920, "height": 1080},
            },
        }
    )


def measure(source: Path, shards: Path, folder: Path) -> dict[str, Any]:
    """All figures of one material; the kernel cache is empty."""
    from mbtf_gen.engine.runtime import load_mitsuba

    mi = load_mitsuba()
    import drjit as dr

    import mbtf_fit.backends.mitsuba
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.backends.mitsuba import Evaluator, read_material

    mbtf_fit.backends.mitsuba.register()
    start = time.perf_counter()
    plugin = {"type": "mbtf", "material": str(folder), "uv_scale": 40.0}
    scene = plane_scene(mi, plugin)
    loaded = time.perf_counter()
    tracer = mi.load_dict({"type": "mbtf_path", "max_depth": 2})
    np.array(mi.render(scene, integrator=tracer, spp=1))
    first = time.perf_counter()
    np.array(mi.render(scene, integrator=tracer, spp=1, seed=1))
    again = time.perf_counter()
    bsdf = mi.load_dict({"type": "mbtf", "material": str(folder), "sigma": 0.01})
    flat = mi.load_dict({"type": "mbtf", "material": str(folder), "sampling": "cosine", "sigma": 0.01})
    stored = read_material(folder)
    mean, variance = variance_of(mi, dr, bsdf)
    flat_mean, flat_variance = variance_of(mi, dr, flat)
    return {
        "material": source.name,
        "load_seconds": loaded - start,
        "first_picture_seconds": first - start,
        "picture_seconds": again - first,
        "single": conformance_deviation(bsdf.evaluator, stored),
        "half": conformance_deviation(Evaluator(stored, "half"), stored),
        "chi_square": chi_squares(mi, dr, bsdf),
        "reflected": [mean, flat_mean],
        "variance_ratio": flat_variance / variance,
        "cosine_variance": flat_variance / flat_mean**2,
        **gloss(source, Dataset.open(shards).manifest["config"]),
        "energy": energies(source, shards, bsdf.evaluator),
    }


def prepare(material: Path, work: Path, time: str) -> tuple[Path, Path]:
    """(shards, fit) of a material, made where they are missing.

    Raises
    ------
    SystemExit : generator or fitter failed; their message was shown
    """
    shards, folder = work / "shards" / material.name, work / "materials" / material.name
    if not (folder / "material.json").exists():
        options = ["--resolution", "128", "--mesh", "256", "--queries", "200/texel", "--spp", "4", "--quiet"]
        options += ["--set", "queries.test=16384", "--set", "queries.test_spp=128"]
        for words in (
            ["mbtf_gen", str(material), "-o", str(shards), *options],
            ["mbtf_fit", str(shards), "-o", str(folder), "--time", time, "--quiet"],
        ):
            if subprocess.run([sys.executable, "-m", *words], stdout=sys.stderr, cwd=ROOT).returncode:
                raise SystemExit(f"{' '.join(words)} failed")
    return shards, folder


def row_of(figures: dict[str, Any]) -> str:
    """A material's line of the table."""
    worst = max(figures["energy"], key=lambda e: (e["fit"] - e["reference"]) / e["error"])
    return (
        f"{figures['material']:16} first picture {figures['first_picture_seconds']:5.1f} s  deviation "
        f"{figures['single']:.0e} half {figures['half']:.0e}  least p of {PLACES} "
        f"{min(figures['chi_square']):.4f}  variance ratio {figures['variance_ratio']:5.2f}  energy at most "
        f"{worst['fit']:.4f} for {worst['reference']:.4f} ± {worst['error']:.4f} ({worst['elevation']:g}°)"
    )


def verdict(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures that the bars are held to."""
    least = min(p for r in rows for p in r["chi_square"])
    tests = sum(len(r["chi_square"]) for r in rows)
    excess = [(e["fit"] - e["reference"]) / e["error"] for r in rows for e in r["energy"]]
    return {
        "first_picture": max(r["first_picture_seconds"] for r in rows),
        "single": max(r["single"] for r in rows),
        "half": max(r["half"] for r in rows),
        "chi_square": float(-np.expm1(tests * np.log1p(-least))),
        "variance": min((r["variance_ratio"] for r in rows if is_glossy(r)), default=None),
        "energy": max(excess),
        "energy_share": max(e["fit"] / e["reference"] - 1.0 for r in rows for e in r["energy"]),
    }


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*", type=Path)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "plugin_materials")
    parser.add_argument("--time", default="80s", help="training time of each fit that is missing")
    parser.add_argument("--one", nargs=3, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(*options.one)))
        return 0
    default = [source(name)[0] for name in (*RELIEFS, *HEIGHT_SCALES) if is_available(name)]
    rows = []
    for material in options.materials or default:
        made = prepare(material, options.work, options.time)
        with tempfile.TemporaryDirectory(prefix="mbtf-kernels-") as cache:
            done = subprocess.run(
                [sys.executable, __file__, "--one", str(material), *map(str, made)],
                stdout=subprocess.PIPE,
                text=True,
                env={**os.environ, "DRJIT_CACHE_DIR": cache},
            )
        if done.returncode:
            raise SystemExit(f"{material.name} failed")
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(row_of(rows[-1]), flush=True)
    figures = verdict(rows)
    above = ("chi_square", "variance")
    missed = [
        name
        for name, limit in THRESHOLDS.items()
        if (value := figures[name]) is not None and (value < limit if name in above else value > limit)
    ]
    return finish({**figures, "missed": missed, "materials": rows}, THRESHOLDS, not missed)


if __name__ == "__main__":
    start(main)
