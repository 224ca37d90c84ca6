"""One reference rendered again by stock parts of Mitsuba alone, as a check from outside.

The picture is that of the ``pixel`` kind, near normal incidence, under a directional light without width.
What is ours is replaced part by part: the endless height field by a finite block of instances of the
tile's triangle mesh, read from a PLY file; the loop over a path by the integrator ``path``; camera rays by
the sensor ``perspective`` with a ``gaussian`` filter of half a pixel; the light by the emitter
``directional``; and the surface by ``diffuse`` with the base color as a ``bitmap``. No stock surface has the
project's gloss (docs/surface.md), so a material with one is compared a second time with its own surface
under all the other stock parts. Holes are left out: stock shadow rays do not pass through them.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.directions import from_angles
from mbtf_core.errors import UsageError
from mbtf_core.stats import Estimate, mean_estimate
from mbtf_gen.pictures.camera import PIXEL_SIGMA, Camera
from mbtf_pipeline.compare.pictures import PICTURES, write_picture, write_preview

if TYPE_CHECKING:
    from mbtf_gen.config.generator import GeneratorConfig
    from mbtf_gen.job import Job
    from mbtf_gen.material.material import Material
    from mbtf_pipeline.recipe import CompareSection, Direction, View

F64 = NDArray[np.float64]
# Elevation of the view and of the light that the finite block is good for.
LOWEST_VIEW, LOWEST_LIGHT = 75.0, 30.0
# Side of the squares of pixels that count as independent: neighbors share samples of the stock filter. What
# squares share across their borders makes error bars 5 % too small, 12 % where they are the smallest. Small
# pictures have smaller ones, so that there are _SQUARES along a side.
_BLOCK, _SMALLEST, _SQUARES = 8, 4, 4
# Squares below which the error bars say nothing: of one alone they are infinite, and all would agree.
LEAST_SQUARES = 9
# Differences that do not matter, relative to the mean value: of the mean, and root mean square over pixels.
MEAN_TOLERANCE, RMS_TOLERANCE = 0.005, 0.02
# Error bars that a larger difference may lie within: of dozens of comparisons some exceed two by chance.
BARS = 3.0
# Parts of a material that Lambert has none of.
_BARE = (
    "roughness",
    "metallic",
    "specular",
    "clearcoat",
    "clearcoat_roughness",
    "sheen",
    "sheen_color",
    "sheen_roughness",
    "normal",
    "opacity",
)


Verdict = Literal["agree", "DIFFER", "too small to tell"]


@dataclass(frozen=True)
class Agreement:
    """Two pictures of the same thing.

    Attributes
    ----------
    surface : ``base color`` or ``full``
    mean : difference of the means, ours less stock's, relative to the mean value
    square : mean squared difference free of both sides' noise, relative to the squared mean value
    ours, stock : (rows, columns, 3) values in 1/sr
    """

    surface: str
    mean: Estimate
    square: Estimate
    ours: F64
    stock: F64

    @property
    def verdict(self) -> Verdict:
        """:func:`verdict` of its two differences."""
        return verdict(self.mean, self.square)

    def as_dict(self) -> dict[str, Any]:
        """Plain data, without the pictures."""
        return {
            "surface": self.surface,
            "mean": self.mean.as_dict(),
            "square": self.square.as_dict(),
        }


def verdict(mean: Estimate, square: Estimate) -> Verdict:
    """Whether relative differences, of the means and mean square over pixels, lie within their tolerances or
    within three of their error bars."""
    if min(mean.n, square.n) < LEAST_SQUARES:
        return "too small to tell"
    places = square.value <= max(RMS_TOLERANCE**2, BARS * square.error)
    return "agree" if places and abs(mean.value) <= max(MEAN_TOLERANCE, BARS * mean.error) else "DIFFER"


def agreement(surface: str, ours: tuple[F64, F64], stock: tuple[F64, F64], margin: int = 0) -> Agreement:
    """Compare two renders (rows, columns, 3), each as two independent halves.

    Parameters
    ----------
    margin : pixels along every edge that are left out; fewer in pictures that would have none left
    """
    margin = min(margin, (min(ours[0].shape[:2]) - 1) // 2)
    inner = slice(margin, -margin if margin else None)
    a1, b1, a2, b2 = (_blocks(x[inner, inner]) for x in (*ours, *stock))
    mean = float((a1 + b1 + a2 + b2).mean() / 4.0)
    scale = 1.0 / max(mean, 1e-30)
    difference = mean_estimate((a1 + b1 - a2 - b2) / 2.0).scaled(scale)
    square = mean_estimate((a1 - a2) * (b1 - b2)).scaled(scale**2)
    return Agreement(surface, difference, square, (ours[0] + ours[1]) / 2, (stock[0] + stock[1]) / 2)


def _blocks(picture: F64) -> F64:
    """(blocks, pixels of a block, 3) of a picture; what is left over at the right and below is dropped."""
    shortest = min(picture.shape[:2])
    side = min(_BLOCK, shortest, max(_SMALLEST, shortest // _SQUARES))
    rows, columns = (n // side for n in picture.shape[:2])
    cut = picture[: rows * side, : columns * side].reshape(rows, side, columns, side, 3)
    return cut.transpose(0, 2, 1, 3, 4).reshape(rows * columns, side * side, 3)


def pick_scene(section: CompareSection) -> tuple[View, Direction, float]:
    """The first view and the first light that are high enough, and the smallest width.

    Raises
    ------
    UsageError : the comparison has none
    """
    views = [v for v in section.views if v.elevation >= LOWEST_VIEW]
    lights = [light for light in section.lights if light.elevation >= LOWEST_LIGHT]
    if not views or not lights:
        raise UsageError(
            f"stock parts want a view from {LOWEST_VIEW:g} degrees on, and a light from {LOWEST_LIGHT:g} on",
            where="compare.stock",
            hint="add them to compare.views and compare.lights, or leave the option out",
        )
    return views[0], lights[0], min(section.tiles_across)


def write_stock(
    section: CompareSection, generate: GeneratorConfig, material: Material, white: float, out: Path
) -> dict[str, Any]:
    """Compare with stock parts, write both pictures of each surface below `out`; plain data about them.

    Raises
    ------
    UsageError : the comparison has no scene for it
    """
    view, light, tiles_across = pick_scene(section)
    surfaces = []
    for found in compare_with_stock(section, generate, material):
        files = {}
        for route, value in (("ours", found.ours), ("stock", found.stock)):
            files[route] = f"{PICTURES}/stock-{found.surface.replace(' ', '-')}-{route}"
            write_picture(out / files[route], value.astype(np.float32))
            write_preview(out / files[route], value.astype(np.float32), white)
        surfaces.append({**found.as_dict(), "files": files})
    return {
        "view": view.model_dump(),
        "light": light.model_dump(),
        "tiles_across": tiles_across,
        "tolerances": {"mean": MEAN_TOLERANCE, "rms": RMS_TOLERANCE},
        "surfaces": surfaces,
    }


def compare_with_stock(
    section: CompareSection, generate: GeneratorConfig, material: Material
) -> list[Agreement]:
    """Render one scene of a comparison by both routes: bare of gloss, and with the full surface.

    Raises
    ------
    UsageError : the comparison has no scene for it
    """
    from mbtf_gen.config.generator import LightSection
    from mbtf_gen.job import Job
    from mbtf_gen.pictures.reference import render_reference
    from mbtf_gen.planning.effects_plan import reference_plan
    from mbtf_gen.planning.simulation import build_estimator

    view, light, tiles_across = pick_scene(section)
    config = generate.model_copy(update={"light": LightSection(width=0.0)})
    camera = Camera(view.elevation, view.azimuth, tiles_across, rows=section.size, columns=section.size)
    omega_i = from_angles(light.elevation, light.azimuth)
    out = []
    for surface, made in _surfaces(material).items():
        job = Job(config, made)
        estimator = build_estimator(job, reference_plan(job))
        image = render_reference(
            estimator, camera, omega_i, kind="pixel", spp=section.spp, seed=section.seed, index=0
        )
        ours = tuple(x.astype(np.float64) for x in (image.value_a, image.value_b))
        stock = render_stock(job, camera, omega_i, section.spp, section.seed)
        out.append(agreement(surface, (ours[0], ours[1]), stock, margin=4))
    return out


def _surfaces(material: Material) -> dict[str, Material]:
    """The material as a Lambert surface of its base color, and as it is, without holes."""
    if material.bsdf is not None:
        return {"full": material}
    nothing: dict[str, Any] = dict.fromkeys(_BARE)
    bare = dataclasses.replace(material, **nothing)
    full = dataclasses.replace(material, opacity=None)
    glossy = any(getattr(full, name) is not None for name in _BARE)
    return {"base color": bare, **({"full": full} if glossy else {})}


def render_stock(job: Job, camera: Camera, omega_i: F64, spp: int, seed: int) -> tuple[F64, F64]:
    """Two independent renders (rows, columns, 3) in 1/sr of `spp`/2 paths per pixel."""
    import mitsuba as mi

    with tempfile.TemporaryDirectory() as folder:
        scene = mi.load_dict(_stock_scene(job, camera, omega_i, Path(folder)))
    rng = np.random.default_rng([seed, 1])
    seeds = [int(s) for s in rng.integers(1 << 31, size=2)]
    a, b = (np.array(mi.render(scene, spp=max(1, spp // 2), seed=s), np.float64) for s in seeds)
    return a[..., :3], b[..., :3]


def _stock_scene(job: Job, camera: Camera, omega_i: F64, folder: Path) -> dict[str, Any]:
    """Mitsuba dictionary of the scene; the target lies at the origin of the x-y plane."""
    import mitsuba as mi

    from mbtf_gen.geometry.heightfield import tile_mesh
    from mbtf_gen.render.scene import LONG_SIDE

    grid = job.grid
    unit = LONG_SIDE / max(1.0, grid.aspect)
    mesh = tile_mesh(grid)
    mesh.apply_translation([-0.5, -0.5 * grid.aspect, 0.0])
    mesh.apply_scale(unit)
    file = folder / "tile.ply"
    file.write_bytes(mesh.export(file_type="ply", vertex_normal=False))
    tile = {
        "type": "ply",
        "filename": str(file),
        "face_normals": True,
        "flip_tex_coords": True,
        "bsdf": _stock_surface(job),
    }
    # What a pixel at the edge sees, and from where light and interreflection reach it.
    reach = (
        0.75 * camera.tiles_across
        + 2.0 * grid.displacement_range / math.tan(math.radians(LOWEST_LIGHT))
        + 1.0
    )
    columns, rows = (math.ceil(reach / side) for side in (1.0, grid.aspect))
    shift = mi.ScalarTransform4f().translate
    # The tile that the camera looks at lies in the middle.
    middle = np.array([camera.target[0] - 0.5, camera.target[1] - 0.5 * grid.aspect])
    instances = {
        f"tile_{i + columns}_{j + rows}": {
            "type": "instance",
            "to_world": shift([float(i * unit), float(j * grid.aspect * unit), 0.0]),
            "group": {"type": "ref", "id": "group"},
        }
        for i in range(-columns, columns + 1)
        for j in range(-rows, rows + 1)
    }
    target = np.array([*middle, 0.0]) * unit
    forward, _, up = camera.frame()
    origin = target - forward * camera.distance * unit
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": -1, "rr_depth": 8, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "fov": camera.field_of_view,
            "fov_axis": "x",
            "near_clip": 1e-3 * unit,
            "far_clip": 1e3 * camera.distance * unit,
            "to_world": mi.ScalarTransform4f().look_at(
                [float(c) for c in origin], [float(c) for c in target], [float(c) for c in up]
            ),
            "sampler": {"type": "independent"},
            "film": {
                "type": "hdrfilm",
                "width": camera.columns,
                "height": camera.rows,
                "rfilter": {"type": "gaussian", "stddev": PIXEL_SIGMA},
                "pixel_format": "rgb",
                "component_format": "float32",
                "sample_border": True,
            },
        },
        "light": {
            "type": "directional",
            "direction": [float(-c) for c in omega_i],
            "irradiance": float(1.0 / omega_i[2]),
        },
        "group": {"type": "shapegroup", "tile": tile},
        **instances,
    }


def _stock_surface(job: Job) -> dict[str, Any]:
    """Stock ``diffuse`` with the base color where the material is Lambert, else its own surface."""
    import mitsuba as mi

    from mbtf_gen.planning.simulation import normal_map_slopes
    from mbtf_gen.render.bsdf.plugin import bsdf_of

    material = job.material
    if any(getattr(material, name) is not None for name in _BARE) or material.bsdf is not None:
        mapped = normal_map_slopes(job)
        return bsdf_of(material, slopes=None if mapped is None else mapped[0])
    base = np.asarray(material.base_color, np.float32)
    if base.ndim == 1:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [float(c) for c in base]}}
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(base)), "raw": True}
    return {"type": "diffuse", "reflectance": bitmap}
