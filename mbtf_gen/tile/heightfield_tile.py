"""A displaced plane: a height map, and maps or constants of its reflectance."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_core.images.read import LUMINANCE
from mbtf_core.images.resample import resample
from mbtf_gen.config.generator import MAX_SCALE, GeometrySection, NormalMode, Tracer
from mbtf_gen.tile.heights import (
    HeightGrid,
    residual_slopes,
    rms_slope,
    slope_angles,
)
from mbtf_gen.tile.maps.checks import Codes, far_off, suggestion_warning
from mbtf_gen.tile.maps.file_names import Convention
from mbtf_gen.tile.maps.map_loader import Color, MapFacts
from mbtf_gen.tile.maps.material_file import LOBES, ROLES
from mbtf_gen.tile.maps.normal_map import NormalFit
from mbtf_gen.tile.maps.tiling import Seam, broken
from mbtf_gen.tile.protocol import REFLECTION, Tile, displacement_fault
from mbtf_gen.tile.reflectance import in_use, lobe_widths, plugin_dictionary
from mbtf_gen.tile.tracers.protocol import TileGeometry

# Displacement range, in tile widths, above which a default height scale is probably wrong.
_STEEP = 0.5
# Range of floats up to which they may be fractions of a tile's width, with what compression adds.
_NORMALIZED = 1.05
# Median slope in degrees that such fractions do not have, and a scale for them: that of integers.
_CLIFFS, _CUSTOMARY = 80.0, 0.05
# Default limit of the mesh cells across the tile.
DEFAULT_MESH = 512
# Luminance from charcoal to fresh snow; outside, a color map is probably not albedo.
_ALBEDO_RANGE = (0.02, 0.95)
# Order of the maps in descriptions and in what makes them tileable.
MAPS = ("height", *ROLES)


@dataclass(frozen=True)
class HeightFieldTile(Tile):
    """A displaced plane with maps, as :func:`~mbtf_gen.tile.loading.load_tile` returns it.

    All maps have row 0 at ``v → 1``; their resolutions may differ.

    Attributes
    ----------
    height : (H, W) float64 array
        Stored heights: code / largest code of integer images, unchanged numbers of float images. Quantized
        heights are smoothed within half a level; heights of a mirrored tile are halved.
    maps : dict
        Colors are linear Rec.709, (h, w, 3) or (3,); shares are (h, w) or one number, both in [0, 1];
        ``normal`` holds unit vectors (h, w, 3), x along u and y along v (OpenGL). Roles that a material lacks
        are missing. Without roughness, metallic and specular the surface is Lambert.
    height_from : {"default", "material file", "given"}
        Where the height scale comes from.
    mesh : int or None
        Cells across the tile; by default the width of the map, at most 512. Coarser grids average the map
        (box filter), finer grids interpolate it (cubic).
    tracer : {"heightfield", "mesh"}
        How rays find the surface: cell by cell, or by Mitsuba as triangles.
    max_displacement : float
        Largest accepted displacement range, in tile widths.
    bsdf : dict or None
        Mitsuba dictionary that replaces the reflectance maps.
    facts : dict of str to MapFacts
        Content of the file of each role.
    codes : Codes or None
        Distribution of integer height codes; None for floats.
    seams : tuple of Seam
        Seams of the heights before any tiling method.
    normal_fit : NormalFit or None
        Comparison of the normal map with the heights; None without a map, or where either is flat.
    normal_convention : {"gl", "dx"} or None
        Convention that the normal map was read in; None without a map.
    """

    kind = "displaced"

    height: NDArray[np.float64]
    height_from: Literal["default", "material file", "given"] = "default"
    mesh: int | None = None
    tracer: Tracer = "heightfield"
    max_displacement: float = math.inf
    bsdf: dict[str, Any] | None = None
    facts: dict[str, MapFacts] = field(default_factory=dict)
    codes: Codes | None = None
    seams: tuple[Seam, ...] = ()
    normal_fit: NormalFit | None = None
    normal_convention: Convention | None = None

    @property
    def aspect(self) -> float:
        """Height of the tile over its width, H/W of the maps."""
        return self.height.shape[0] / self.height.shape[1]

    @cached_property
    def grid(self) -> HeightGrid:
        """The heights, resampled to the grid of the mesh; an InputError where generation refuses them."""
        if fault := self._fault(self.max_displacement):
            raise InputError(fault[0], where=self.files.get("height"), hint=fault[1])
        return self._resampled

    @cached_property
    def _resampled(self) -> HeightGrid:
        columns = min(self.height.shape[1], DEFAULT_MESH) if self.mesh is None else self.mesh
        rows = max(1, round(self.aspect * columns))
        heights = resample(self.height, rows, columns, "cubic").astype(np.float64)
        return replace(HeightGrid.from_map(heights, self.height_scale, self.aspect), tracer=self.tracer)

    @cached_property
    def _median_slope(self) -> float:
        """Degrees."""
        return slope_angles(self._resampled)[0]

    def _fault(self, limit: float) -> tuple[str, str] | None:
        """(what, hint) why generation refuses the heights under a limit of their range, or None."""
        unit = None if math.isinf(limit) else self.unit_fault()
        return unit or displacement_fault(self._resampled.displacement_range, limit)

    def unit_fault(self) -> tuple[str, str] | None:
        """(what, hint) where no height scale is given, and stored heights are no tile widths; else None.

        They differ by more than a tile's width; or by more than half of it, with slopes of over 80° at half
        of the surface and no normal map that agrees; or the file declares the size of its pixels.
        """
        facts = self.facts.get("height")
        if facts is None or self.height_from != "default":
            return None
        extent = facts.high - facts.low
        if facts.pixel_size is None and (facts.bits is not None or extent <= _STEEP):
            return None
        white = 1 if facts.bits is None else 2**facts.bits - 1
        what = f"heights from {facts.low * white:.5g} to {facts.high * white:.5g} need a height scale"
        fit = self.normal_fit if self.normal_fit is not None and self.normal_fit.fits else None
        suggested = f"the normal map suggests --height-scale {fit.scale:.3g}" if fit else ""
        if facts.pixel_size is None and extent <= _NORMALIZED:
            agrees = fit is not None and not far_off(self.height_scale, fit.scale)
            steep = 0.0 if agrees else self._median_slope
            what = f"{what}: half of the surface would be steeper than {steep:.1f}°"
            hint = suggested or f"give one, such as --height-scale {_CUSTOMARY}"
            return (what, f"{hint}; 1 where heights are in tile widths") if steep > _CLIFFS else None
        if suggested:
            return what, suggested
        scale = white / (facts.columns * (facts.pixel_size or 1.0))
        if facts.pixel_size is None:
            return what, (
                f"give --height-scale {scale:.4g}, 1 / {facts.columns} columns, where pixels are 1 apart in "
                "the unit of the heights; 1 where that is the tile's width"
            )
        if scale > MAX_SCALE:
            return what, f"save them as floats: as integers they need {scale:.4g}, more than {MAX_SCALE}"
        apart = f"its pixels are {facts.pixel_size:.6g} apart"
        return what, f"give --height-scale {scale:.4g}, as {apart}, where heights have the same unit"

    @property
    def thickness(self) -> float:
        return self.grid.displacement_range

    def at(self, height_scale: float | None = None, mesh: int | None = None) -> Self:
        given: dict[str, Any] = {} if mesh is None else {"mesh": mesh}
        if height_scale is not None:
            given |= {"height_scale": height_scale, "height_from": "given"}
        return replace(self, **given)

    def configured(self, options: GeometrySection) -> Self:
        """The tile under the options of the geometry, whose range is checked once its grid is used."""
        found = self.at(options.height_scale, options.mesh)
        return replace(found, tracer=options.tracer, max_displacement=options.max_displacement)

    def trace(self, unit: float, below: bool = False) -> TileGeometry:
        return self.grid.trace(unit, below)

    def lattice(self, finest: int | None = None) -> Lattice:
        """Texel grids of the levels up to `finest`; by default up to the material's own resolution, else to
        that of the map."""
        if finest is None and self.resolution is not None:
            finest = self.resolution.bit_length() - 1
        rows, columns = self.height.shape
        return Lattice.for_map(rows, columns, finest)

    def surface(
        self, on: Collection[str] = REFLECTION, slopes: NDArray[np.float64] | None = None
    ) -> dict[str, Any]:
        if self.bsdf is not None:
            return dict(self.bsdf)
        maps = in_use(self.maps, on)
        if slopes is not None:
            maps["slopes"] = np.concatenate([slopes, np.zeros_like(slopes[..., :1])], axis=-1)
        return plugin_dictionary(maps)

    @property
    def base_color(self) -> Color:
        return np.asarray(self.maps["base_color"])

    @property
    def images(self) -> dict[str, Any]:
        return {"height": self.height, **self.maps}

    def with_maps(self, **maps: Any) -> Self:
        given = {**self.maps, **maps}
        return replace(self, maps={name: value for name, value in given.items() if value is not None})

    def normal_slopes(self, mode: NormalMode = "residual") -> tuple[NDArray[np.float64], float] | None:
        if "normal" not in self.maps or self.bsdf is not None or mode == "off":
            return None
        return residual_slopes(self.maps["normal"], self.grid, mode)

    @property
    def nbytes(self) -> int:
        return sum(np.asarray(values).nbytes for values in (self.height, *self.maps.values()))

    @property
    def bsdf_type(self) -> str | None:
        return None if self.bsdf is None else str(self.bsdf["type"])

    @property
    def is_lambert(self) -> bool:
        return self.bsdf is None and not self.maps.keys() & LOBES.keys()

    @property
    def transmits(self) -> bool:
        return "opacity" in self.maps

    def narrowest_lobe(self) -> tuple[float, str] | None:
        if self.bsdf is not None:
            return None
        return min([2.0, *lobe_widths(self.maps)]), "narrowest lobe"

    def properties(self) -> dict[str, Any]:
        return {
            "maps_shape": list(self.height.shape),
            "mesh_shape": list(self.grid.z.shape),
            "height_scale": self.height_scale,
        }

    def inspect(self, options: GeometrySection, finest: int | None = None) -> dict[str, Any]:
        """Statistics of the heights and of each map."""
        return self.at(options.height_scale, options.mesh)._statistics(finest, options.max_displacement)

    def _statistics(self, finest: int | None, max_displacement: float) -> dict[str, Any]:
        fault = self._fault(max_displacement)
        refused = [f"{self.files['height']}: generation refuses it: {'; '.join(fault)}"] if fault else []
        grid = self.grid
        median, high, steepest = slope_angles(grid)
        whole = rms_slope(self.at(mesh=self.height.shape[1]).grid)
        constants = {role: value for role, value in self.maps.items() if np.ndim(value) < 2}
        if self.bsdf is not None:
            del constants["base_color"]
        return {
            "aspect": self.aspect,
            "make_tileable": self.tiling,
            "resolution": self.lattice(finest).shape()[1],
            "maps": {role: {**asdict(f), "file": str(f.file)} for role, f in self.facts.items()},
            "constants": {role: np.asarray(value).tolist() for role, value in constants.items()},
            "surface": self.bsdf["type"] if self.bsdf else "diffuse" if self.is_lambert else "glossy",
            "geometry": {
                "height_scale": self.height_scale,
                "height_scale_from": self.height_from,
                "map": list(self.height.shape),
                "mesh": list(grid.z.shape),
                "displacement_range": abs(grid.displacement_range),
                "slope_median_deg": median,
                "slope_p99_deg": high,
                "slope_max_deg": steepest,
                "slope_kept": rms_slope(grid) / whole if whole > 0 else 1.0,
            },
            "heights": {
                "codes": None if self.codes is None else asdict(self.codes),
                "distinct": len(np.unique(self.height)),
            },
            "tiling": [{**asdict(s), "ratio": s.ratio, "tiles": not broken(s)} for s in self.seams],
            "albedo": self._albedo(),
            "normal": self._normal(),
            "opacity": self._opacity(),
            "unused": self.unused,
            "warnings": [*self.warnings_in_use(), *refused],
            "scale_warning": self.scale_warning(),
            "notes": list(self.notes),
        }

    def _albedo(self) -> dict[str, Any] | None:
        if self.bsdf is not None:
            return None
        color = np.asarray(self.base_color, np.float64)
        luminance = color @ np.asarray(LUMINANCE)
        low, high = _ALBEDO_RANGE
        return {
            "min": float(luminance.min()),
            "median": float(np.median(luminance)),
            "max": float(luminance.max()),
            "mean_rgb": color.reshape(-1, 3).mean(axis=0).tolist(),
            "share_above": float(np.mean(luminance > high)),
            "share_below": float(np.mean(luminance < low)),
        }

    def _normal(self) -> dict[str, Any] | None:
        if "normal" not in self.maps:
            return None
        tilt = np.degrees(np.arccos(np.clip(self.maps["normal"][..., 2], -1.0, 1.0)))
        median, high = (float(p) for p in np.percentile(tilt, (50, 99)))
        out: dict[str, Any] = {"tilt_median_deg": median, "tilt_p99_deg": high}
        fit = self.normal_fit
        if fit is not None:
            sign = 1.0 if self.normal_convention == "gl" else -1.0
            out |= {**asdict(fit), "correlation_v": sign * fit.correlation_v}
            out["suggested_height_scale"] = fit.scale if fit.fits else None
        return {**out, "convention": self.normal_convention}

    def _opacity(self) -> dict[str, Any] | None:
        if "opacity" not in self.maps:
            return None
        opacity = np.asarray(self.maps["opacity"])
        return {
            "holes": float(np.mean(opacity < 0.5)),
            "partly": float(np.mean((opacity > 0.02) & (opacity < 0.98))),
        }

    def summary(self) -> str:
        """Mesh, height scale and displacement range."""
        rows, columns = self.grid.z.shape
        return (
            f"mesh: {columns} x {rows} cells, height scale {self.height_scale:.4g} ({self.height_from}), "
            f"displacement range {self.thickness:.4g} tile widths"
        )

    def scale_warning(self) -> str | None:
        path, extent = self.files["height"], float(np.ptp(self.height))
        if extent == 0:
            return None
        if "normal" in self.files and (
            text := suggestion_warning(self.files["normal"], self.normal_fit, self.height_scale)
        ):
            return text
        extent *= abs(self.height_scale)
        if self.height_from == "default" and extent > _STEEP and self.unit_fault() is None:
            return f"{path}: the displacement range is {extent:.4g} tile widths; check --height-scale"
        if (median := self._median_slope) > _CLIFFS:
            return f"{path}: half of the surface is steeper than {median:.1f}°; check --height-scale"
        return None

    def warnings_in_use(self) -> tuple[str, ...]:
        flat = f"{self.files['height']}: its heights are constant: the tile is flat"
        found = (flat if np.ptp(self.height) == 0 else None, self.scale_warning())
        return (*self.warnings, *filter(None, found))
