"""Independent check: one reference rendered again with plugins of unmodified Mitsuba only.

The image is of the ``pixel`` kind, near normal incidence, under a delta light. Plugins of Mitsuba replace
every part of the generator. A finite block of instances of the tile's triangle mesh, read from a PLY file,
replaces the periodic height field. The integrator ``path`` traces the paths, the sensor ``perspective``
with a ``gaussian`` filter of half a pixel generates camera rays, the emitter ``directional`` is the light,
and ``diffuse`` with a ``bitmap`` of the base color is the BSDF. Mitsuba has no equivalent of our glossy
BSDF. A glossy material is therefore rendered a second time with our BSDF and everything else from Mitsuba.
Opacity is ignored, because shadow rays of Mitsuba do not pass through masked surfaces.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.pictures import PIXEL_SIGMA, Camera
from mbtf_core.stats import Estimate, mean_estimate
from mbtf_gen.config.generator import GeneratorConfig, LightSection
from mbtf_gen.planning.job import Job
from mbtf_gen.tile.maps.material_file import ROLES
from mbtf_gen.tile.protocol import Tile
from support.mitsuba_blocks import instances
from support.mitsuba_shapes import mitsuba_shapes

F64 = NDArray[np.float64]
Halves = tuple[F64, F64]
# Lowest elevation of the light for which the finite block suffices.
LOWEST_LIGHT = 30.0
# Pixels along every edge that are ignored, and the side of the blocks taken as independent: neighboring
# pixels share samples of the Gaussian filter. Correlation across borders makes error bars 5% too small.
_MARGIN, _BLOCK = 4, 8
_SPP = 32
# Tolerated differences relative to the mean value: of the mean, and root mean square over pixels; larger ones
# are tolerated within so many standard errors.
MEAN_TOLERANCE, RMS_TOLERANCE, MAX_STANDARD_ERRORS = 0.005, 0.02, 3.0
# Properties that a Lambertian surface does not have.
_NOT_LAMBERTIAN = tuple(role for role in ROLES if role != "base_color")


def differences(mbtf: Halves, mitsuba: Halves) -> tuple[Estimate, Estimate]:
    """Difference of the means of two renderings (rows, columns, 3), and its noise-free mean square, relative
    to the mean value."""
    a1, b1, a2, b2 = (_blocks(x) for x in (*mbtf, *mitsuba))
    scale = 4.0 / float((a1 + b1 + a2 + b2).mean())
    mean = mean_estimate((a1 + b1 - a2 - b2) / 2.0).scaled(scale)
    return mean, mean_estimate((a1 - a2) * (b1 - b2)).scaled(scale**2)


def agree(mean: Estimate, square: Estimate) -> bool:
    """Whether both differences lie within their tolerance or within three standard errors."""
    return square.value <= max(RMS_TOLERANCE**2, MAX_STANDARD_ERRORS * square.error) and abs(
        mean.value
    ) <= max(MEAN_TOLERANCE, MAX_STANDARD_ERRORS * mean.error)


def _blocks(picture: F64) -> F64:
    """(blocks, pixels, 3) within the margin; incomplete blocks are dropped."""
    rows, columns = ((n - 2 * _MARGIN) // _BLOCK for n in picture.shape[:2])
    inner = picture[_MARGIN : _MARGIN + rows * _BLOCK, _MARGIN : _MARGIN + columns * _BLOCK]
    cut = inner.reshape(rows, _BLOCK, columns, _BLOCK, 3)
    return cut.transpose(0, 2, 1, 3, 4).reshape(rows * columns, -1, 3)


def render_both(
    config: GeneratorConfig, material: Tile, camera: Camera, omega_i: F64, other: Camera | None = None
) -> tuple[Halves, Halves]:
    """A reference in two halves, by mbtf and by Mitsuba, whose camera may be another one."""
    from mbtf_gen.pictures.reference import render_reference
    from mbtf_gen.planning.run_plan import reference_plan
    from mbtf_gen.planning.simulation import build_estimator

    job = Job.of(config.model_copy(update={"light": LightSection(width=0.0)}), material)
    estimator = build_estimator(job, reference_plan(job))
    image = render_reference(estimator, camera, omega_i, kind="pixel", spp=_SPP, seed=0, index=0)
    mbtf = image.value_a.astype(np.float64), image.value_b.astype(np.float64)
    return mbtf, render_with_mitsuba(job, other or camera, omega_i, _SPP, 0)


def lambertian(material: Tile) -> Tile:
    """The material as a Lambertian surface of its base color."""
    return material.with_maps(**dict.fromkeys(_NOT_LAMBERTIAN))


def _is_lambertian(material: Tile) -> bool:
    return not material.maps.keys() & set(_NOT_LAMBERTIAN)


def render_with_mitsuba(job: Job, camera: Camera, omega_i: F64, spp: int, seed: int) -> tuple[F64, F64]:
    """Two independent renderings (rows, columns, 3) in 1/sr with `spp`/2 paths per pixel each."""
    import mitsuba as mi

    with tempfile.TemporaryDirectory() as folder:
        scene = mi.load_dict(_mitsuba_scene(job, camera, omega_i, Path(folder)))
    rng = np.random.default_rng([seed, 1])
    seeds = [int(s) for s in rng.integers(1 << 31, size=2)]
    a, b = (np.array(mi.render(scene, spp=max(1, spp // 2), seed=s), np.float64) for s in seeds)
    return a[..., :3], b[..., :3]


def _mitsuba_scene(job: Job, camera: Camera, omega_i: F64, folder: Path) -> dict[str, Any]:
    """Scene dictionary for Mitsuba."""
    import mitsuba as mi

    from mbtf_gen.render.scene import LONG_SIDE

    aspect = job.material.aspect
    unit = LONG_SIDE / max(1.0, aspect)
    tile = mitsuba_shapes(job.material, unit, folder, _mitsuba_bsdf(job))
    # Surfaces within this distance affect a pixel at the edge by visibility, shadowing or interreflection.
    slope = math.tan(math.radians(LOWEST_LIGHT))
    reach = 0.75 * camera.tiles_across + 2.0 * job.material.thickness / slope + 1.0
    columns, rows = (math.ceil(reach / side) for side in (1.0, aspect))
    # The camera looks at the central tile.
    middle = np.array([camera.target[0] - 0.5, camera.target[1] - 0.5 * aspect])
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
        "group": {"type": "shapegroup", **tile},
        **instances(unit, aspect * unit, columns, rows),
    }


def _mitsuba_bsdf(job: Job) -> dict[str, Any]:
    """``diffuse`` with the base color for a Lambertian material, otherwise our BSDF."""
    import mitsuba as mi

    material = job.material
    if material.bsdf_type is not None or not _is_lambertian(material):
        mapped = material.normal_slopes()
        found = material.surface(slopes=None if mapped is None else mapped[0])
        return found if isinstance(found, dict) else {}
    base = np.asarray(material.base_color, np.float32)
    if base.ndim == 1:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [float(c) for c in base]}}
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(base)), "raw": True}
    return {"type": "diffuse", "reflectance": bitmap}
