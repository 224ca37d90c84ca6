"""Fitted materials on curved objects, beside the same objects really displaced, at equal view.

    python benchmarks/curved.py [--work out/plugin_materials] [--size 256] [--spp 128] [--picture FILE]

The objects (a sphere, a cow and a draped cloth) and the environment maps lie beside the project, in
``../shared/data``; a scene whose files or fit are missing is left out by name. The fits are those of
``plugin_materials.py``, which makes them. For every scene

- the **reference** is the tile's own mesh, that the data were made with, laid over the object; each vertex is
  moved along the normal by its height, scaled by the size that a tile has there; Mitsuba's ``path`` with the
  material's own surface. Heights looked up at other places than the tile's vertices would give a smoother
  relief: several per cent brighter where it is rough from texel to texel;
- the **material** is the smooth mesh with ``mbtf`` in ``mbtf_path``. Its footprint is the pixels' Gaussian
  filter already, so the film has a box; the reference's film has the Gaussian.

What is compared, with both sides' noise taken out (two independent halves each):

- **interior**: pixels well inside both outlines that see the smooth surface under a cosine of at least 0.35.
  Ratio of the means, and the RMS difference as a share of the mean, per pixel and of means over 4 x 4 and
  16 x 16 pixels;
- **of the fit**: ratio of what the fit and ``mbtf-gen`` make of the same direct light at the same queries.
  What is left of the interior's ratio beside this one comes from bending;
- **easy**: the interior's ratio where texture coordinates are hardly stretched and little light is grazing;
- **rim**: the same ratio for the other pixels that both sides cover;
- **outline**: by how much the displaced object's outline lies inside the smooth one's, in pixels, beside the
  relief's depth in pixels. A fitted material does not change the outline.

The last line is one JSON object: figures, and the bars they are held to. Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from curved_meshes import F64, Surface, displaced, load_object, refined
from numpy.typing import NDArray

from mbtf_core.exposure import auto_exposure, brightness, to_display
from mbtf_gen.render.runtime import load_mitsuba

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
# Means of the interior, as a share; RMS of 16 x 16 pixels as a share of the mean; the plane's mean beside
# what the fit makes of the same light.
BARS = {"mean": 0.05, "rms_16": 0.1, "flat": 0.01}
# Cosine of light that counts as grazing, and largest stretch and share of such light of easy places.
GRAZING, EASY = 0.3, (1.25, 0.3)
LOWEST, MARGIN, BLOCKS = 0.35, 4, (1, 4, 16)
FIELD_OF_VIEW = 28.0
# Triangles along an edge of the object's that the smooth mesh has.
SMOOTH = 4
# Cells of the mesh that plugin_materials.py makes its data with, and queries per figure.
MESH, QUERIES = 256, 300_000


@dataclass(frozen=True)
class Scene:
    """An object, what it is made of, and from where it is seen.

    Attributes
    ----------
    tiles : tiles per unit of the object's texture coordinates, along both
    towards : direction to the camera in the object's axes; y is up
    across : half the width of the picture, in radii of the ball around the object
    """

    name: str
    file: str
    material: str
    environment: str
    tiles: tuple[float, float]
    towards: tuple[float, float, float]
    across: float


SCENES = (
    # What is left where nothing is curved.
    Scene("plane", "", "turtle_shell", "studio.exr", (2, 2), (0.1, 1.0, 0.9), 0.8),
    # Its coordinates run once around and once from pole to pole.
    Scene("sphere", "materialx_sphere.obj", "turtle_shell", "studio.exr", (4, 2), (0.5, 0.35, 1.0), 1.06),
    Scene("cow", "spot_cow.obj", "cliff_rock", "park.exr", (12, 12), (-1.0, 0.35, -0.8), 0.85),
    Scene("cloth", "pbdsock_cloth.obj", "twisted_wool", "studio.exr", (10, 10), (0.35, 0.25, 1.0), 0.8),
)


def mesh_of(mi: Any, surface: Surface, bsdf: Any, *, smooth: bool, aspect: float = 1.0) -> Any:
    """Mitsuba's mesh; texture coordinates are divided by (1, aspect)."""
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    properties["face_normals"] = not smooth
    mesh = mi.Mesh(
        "object",
        len(surface.place),
        len(surface.faces),
        has_vertex_normals=smooth,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = surface.place.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = (surface.uv / (1.0, aspect)).astype(np.float32).ravel()
    parameters["faces"] = surface.faces.astype(np.uint32).ravel()
    if smooth:
        parameters["vertex_normals"] = surface.normal.astype(np.float32).ravel()
    parameters.update()
    return mesh


def scene_of(mi: Any, scene: Scene, mesh: Any, size: int, pixels: str) -> Any:
    """The object under its environment, with a filter of the pixels."""
    stored = mi.Bitmap(str(DATA / "env" / scene.environment))
    # Lossy compression has left a few numbers below zero.
    light = np.array(stored.convert(component_format=mi.Struct.Type.Float32))
    light = np.maximum(light[..., :3], 0.0)
    towards = np.array(scene.towards) / np.linalg.norm(scene.towards)
    origin = [float(c) for c in towards * scene.across / np.tan(np.radians(FIELD_OF_VIEW / 2))]
    return mi.load_dict(
        {
            "type": "scene",
            "object": mesh,
            "light": {"type": "envmap", "bitmap": mi.Bitmap(light), "scale": 1.0 / float(light.mean())},
            "sensor": {
                "type": "perspective",
                "fov": FIELD_OF_VIEW,
                "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "pixel_format": "rgb",
                    "rfilter": {"type": pixels},
                },
                "sampler": {"type": "independent"},
            },
        }
    )


def halves(mi: Any, scene: Any, integrator: str, spp: int) -> tuple[F64, F64]:
    """Two independent pictures (size, size, 3) of spp/2 paths per pixel."""
    tracer = mi.load_dict({"type": integrator, "max_depth": 12, "hide_emitters": True})
    a, b = (
        np.array(mi.render(scene, integrator=tracer, spp=spp // 2, seed=seed), np.float64) for seed in (1, 2)
    )
    return a, b


def fit_alone(
    mi: Any, scene: Any, bsdf: Any, estimator: Any, inside: NDArray[np.bool_]
) -> tuple[float, float]:
    """What the fit makes of the scene's direct light, beside what ``mbtf-gen`` traces for the same queries.

    Random places that the camera sees, and light that reaches them on the smooth object: (ratio of the
    radiances, its error). What is left of a difference of pictures comes from bending.
    """
    import drjit as dr

    from mbtf_fit.backends.mitsuba.bsdf import Frame, clamped
    from mbtf_fit.backends.mitsuba.integrator import camera_cone, write_footprint
    from mbtf_gen.render.estimator import Stream
    from mbtf_gen.sampling.query_sampler import Queries

    random, size = np.random.default_rng(5), len(inside)
    pixel = mi.UInt32(random.choice(np.flatnonzero(inside), QUERIES).astype(np.uint32))
    x, y, s, t = (mi.Float(v) for v in random.random((4, QUERIES), np.float32))
    at = mi.Point2f(mi.Float(pixel % size) + x, mi.Float(pixel // size) + y) / size
    ray, _ = scene.sensors()[0].sample_ray_differential(0.0, 0.5, at, mi.Point2f(0.5))
    width, spread = camera_cone(ray, 1)
    si = scene.ray_intersect(ray)
    si = write_footprint(si, ray, dr.fma(spread, si.t, width))
    ds, arriving = scene.sample_emitter_direction(si, mi.Point2f(s, t), True)
    frame = Frame.at(si)
    views, lights = clamped(frame.to_tile(si.wi), bsdf.min_cos), frame.to_tile(si.to_local(ds.d))
    good = si.is_valid() & (si.wi.z > 0) & (lights.z > 1e-3) & (dr.max(arriving) > 0)
    weight = np.array(arriving * lights.z).T
    rows = np.flatnonzero(np.array(good))

    def array(value: Any) -> Any:
        return np.ascontiguousarray(np.array(value, np.float32).T[rows])

    u = array(bsdf.uv(si))
    queries = Queries(u - np.floor(u), array(bsdf.footprint(si)), array(lights), array(views))
    queries.u[queries.u >= 1.0] = 0.0
    traced = estimator.estimate(queries, 4, Stream(1, "reference", 0))
    low = np.array(clamped(mi.Vector3f(queries.omega_i.T), bsdf.min_cos)).T
    fit = bsdf.evaluator.evaluate(queries.u, queries.sigma, low, queries.omega_o)
    true = (0.5 * (traced.value_a + traced.value_b) * weight[rows]).mean(-1).astype(np.float64)
    found = (fit * weight[rows]).mean(-1).astype(np.float64)
    ratio = found.sum() / true.sum()
    return float(ratio), float(np.sqrt(((found - ratio * true) ** 2).sum()) / true.sum())


def hard_places(mi: Any, scene: Any, size: int) -> tuple[F64, F64]:
    """Of what pixels' centers see on the smooth object: by how much its texture coordinates are stretched,
    longest side over shortest, and what share of the light that comes from above a cosine of -0.3 comes from
    below 0.3."""
    import drjit as dr

    n, each = size * size, 64
    index = dr.arange(mi.UInt32, n)
    at = mi.Point2f(mi.Float(index % size) + 0.5, mi.Float(index // size) + 0.5) / size
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    sides = np.stack([np.array(si.dp_du).T, np.array(si.dp_dv).T], -1)
    value = np.linalg.svd(np.nan_to_num(sides), compute_uv=False)
    low, all_ = np.zeros(n), np.full(n, 1e-20)
    xi = np.random.default_rng(6).random((each, 2), np.float32)
    for s, t in xi:
        point = mi.Point2f(dr.full(mi.Float, float(s), n), float(t))
        ds, arriving = scene.sample_emitter_direction(si, point, False)
        cosine, power = np.array(dr.dot(ds.d, si.sh_frame.n)), np.array(mi.luminance(arriving))
        all_ += power * (cosine > -GRAZING)
        low += power * (np.abs(cosine) < GRAZING)
    stretch = value[:, 0] / np.maximum(value[:, 1], 1e-9)
    return stretch.reshape(size, size), (low / all_).reshape(size, size)


def seen(mi: Any, scene: Any, size: int, fine: int) -> tuple[NDArray[np.bool_], F64]:
    """What rays on a grid of `fine` per pixel along both sides meet, and the cosine they see it under."""
    import drjit as dr

    n = size * fine
    index = dr.arange(mi.UInt32, n * n)
    at = mi.Point2f(mi.Float(index % n) + 0.5, mi.Float(index // n) + 0.5) / n
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    hit = np.array(si.is_valid()).reshape(n, n)
    cosine = np.where(hit, np.array(dr.abs(dr.dot(si.sh_frame.n, ray.d))).reshape(n, n), 0.0)
    return hit, cosine


def shrunk(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Mask without what lies within so many pixels of its outside."""
    from scipy.ndimage import binary_erosion

    return np.asarray(binary_erosion(mask, iterations=by) if by else mask)


def rms(a: tuple[F64, F64], b: tuple[F64, F64], mask: NDArray[np.bool_], block: int) -> float:
    """RMS difference of means over whole blocks of pixels inside a mask, as a share of the mean, without
    the noise."""

    def means(picture: F64) -> F64:
        side = len(picture) // block * block
        cut = picture[:side, :side].reshape(side // block, block, side // block, block, -1)
        return cut.mean((1, 3))

    whole = means(mask[..., None].astype(np.float64))[..., 0] == 1.0
    if not whole.any():
        return float("nan")
    first, second = (means(x - y)[whole] for x, y in zip(a, b, strict=True))
    level = means((b[0] + b[1]) / 2)[whole].mean()
    return float(np.sqrt(max(0.0, (first * second).mean())) / level)


def compare(mi: Any, scene: Scene, folder: Path, size: int, spp: int) -> tuple[dict[str, Any], list[F64]]:
    """Figures of a scene, and its two pictures."""
    from mbtf_gen.config.generator import GeneratorConfig
    from mbtf_gen.job import Job
    from mbtf_gen.material.load import load_material
    from mbtf_gen.planning.effects_plan import reference_plan
    from mbtf_gen.planning.simulation import build_estimator
    from mbtf_gen.render.bsdf.plugin import bsdf_of
    from mbtf_gen.render.scene import register_plugins

    register_plugins()
    material = load_material(ROOT / "assets" / scene.material)
    # The mesh that the data were made with.
    grid = material.grid(None, MESH)
    rough = load_object(DATA / "objects" / scene.file if scene.file else None, scene.tiles)
    base = refined(rough, SMOOTH)
    bsdf = mi.load_dict({"type": "mbtf", "material": str(folder)})
    fitted = scene_of(mi, scene, mesh_of(mi, base, bsdf, smooth=True), size, "box")
    covered, cosine = seen(mi, fitted, size, 1)
    smooth_area = seen(mi, fitted, size, 4)[0].sum() / 16
    found = halves(mi, fitted, "mbtf_path", spp)
    facing = shrunk(covered & (cosine >= LOWEST), MARGIN)
    config = GeneratorConfig.model_validate({"material": scene.material, "geometry": {"mesh": MESH}})
    job = Job(config, material)
    alone, error = fit_alone(mi, fitted, bsdf, build_estimator(job, reference_plan(job)), facing)
    stretch, low = hard_places(mi, fitted, size)
    del fitted
    fine = displaced(rough, grid)
    surface = mi.load_dict(bsdf_of(material))
    real = scene_of(mi, scene, mesh_of(mi, fine, surface, smooth=False, aspect=grid.aspect), size, "gaussian")
    met, _ = seen(mi, real, size, 1)
    area = seen(mi, real, size, 4)[0].sum() / 16
    true = halves(mi, real, "path", spp)
    both = shrunk(covered & met, MARGIN)
    inside = both & facing
    easy = inside & (stretch < EASY[0]) & (low < EASY[1])
    rim = covered & met & ~inside
    edge = covered & ~shrunk(covered, 1)
    pixel = 2 * scene.across / size

    def mean(pair: tuple[F64, F64], mask: NDArray[np.bool_]) -> float:
        return float((pair[0] + pair[1])[mask].mean() / 2) if mask.any() else float("nan")

    figures = {
        "scene": scene.name,
        "material": scene.material,
        "triangles": len(fine.faces),
        "interior_pixels": int(inside.sum()),
        "interior_mean_ratio": mean(found, inside) / mean(true, inside),
        "easy_share": float(easy.sum() / inside.sum()),
        "easy_mean_ratio": mean(found, easy) / mean(true, easy),
        "fit_ratio": alone,
        "fit_ratio_error": error,
        **{f"rms_{block}": rms(found, true, inside, block) for block in BLOCKS},
        "rim_mean_ratio": mean(found, rim) / mean(true, rim),
        "outline_pixels": float((smooth_area - area) / max(1, edge.sum())),
        "relief_pixels": float(np.median(base.size) * grid.displacement_range / pixel),
        "mean_depth_pixels": float(-np.median(base.size) * grid.z.mean() / pixel),
    }
    return figures, [(true[0] + true[1]) / 2, (found[0] + found[1]) / 2]


def draw(rows: list[tuple[dict[str, Any], list[F64]]], path: Path) -> None:
    """Reference, material, and their difference, a row per scene."""
    from PIL import Image, ImageDraw, ImageFont

    size, gap, caption = len(rows[0][1][0]), 6, 24
    titles = ("really displaced", "fitted material", "difference (gray: none)")
    sheet = Image.new(
        "RGB", (3 * (size + gap) - gap, caption + len(rows) * (size + gap) - gap), (255, 255, 255)
    )
    pen = ImageDraw.Draw(sheet)
    for column, title in enumerate(titles):
        pen.text((column * (size + gap) + 2, 4), title, (30, 30, 30), ImageFont.load_default(13))
    for row, (_, (true, found)) in enumerate(rows):
        lit = true[true.max(-1) > 0]
        exposure = auto_exposure([brightness(lit)])
        difference = np.clip(0.5 + 0.5 * 2.0**exposure * (found - true).mean(-1, keepdims=True), 0, 1)
        pictures = [to_display(p.astype(np.float32), exposure) for p in (true, found)]
        pictures.append(np.repeat(np.round(255 * difference).astype(np.uint8), 3, -1))
        for column, picture in enumerate(pictures):
            sheet.paste(Image.fromarray(picture), (column * (size + gap), caption + row * (size + gap)))
    sheet.save(path, optimize=True)


def line(f: dict[str, Any]) -> str:
    """A scene's figures as text."""
    return (
        f"{f['scene']:13} {f['material']:13} interior mean {f['interior_mean_ratio']:.3f} "
        f"(of the fit {f['fit_ratio']:.3f} ± {f['fit_ratio_error']:.3f}; where easy, "
        f"{f['easy_share']:.2f} of it, {f['easy_mean_ratio']:.3f}), RMS "
        + " ".join(f"{f[f'rms_{b}']:.3f} ({b} px)" for b in BLOCKS)
        + f"; rim mean {f['rim_mean_ratio']:.3f}; outline {f['outline_pixels']:.2f} px inside, relief "
        f"{f['relief_pixels']:.1f} px, mean depth {f['mean_depth_pixels']:.1f} px"
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "plugin_materials")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--scene", action="append", choices=[s.name for s in SCENES])
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    mi = load_mitsuba()
    import mbtf_fit.backends.mitsuba

    mbtf_fit.backends.mitsuba.register()
    rows = []
    for scene in SCENES:
        if options.scene and scene.name not in options.scene:
            continue
        folder = options.work / "materials" / scene.material
        needed = (
            folder / "material.json",
            *([DATA / "objects" / scene.file] if scene.file else []),
            DATA / "env" / scene.environment,
        )
        missing = [str(path) for path in needed if not path.exists()]
        if missing:
            print(f"{scene.name}: left out, {missing[0]} is missing", file=sys.stderr)
            continue
        rows.append(compare(mi, scene, folder, options.size, options.spp))
        print(line(rows[-1][0]), file=sys.stderr, flush=True)
    if not rows:
        raise SystemExit("nothing to compare")
    if options.picture:
        draw(rows, options.picture)
    figures = [f for f, _ in rows]
    worst = {
        "mean": max(abs(f["interior_mean_ratio"] - 1.0) for f in figures),
        "rms_16": max(f["rms_16"] for f in figures),
        "flat": max(
            (abs(f["interior_mean_ratio"] / f["fit_ratio"] - 1.0) for f in figures if f["scene"] == "plane"),
            default=None,
        ),
    }
    held = all(value is None or value <= BARS[name] for name, value in worst.items())
    print(json.dumps({"figures": worst, "bars": BARS, "held": held, "scenes": figures}))
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
