"""A tile of fibers, as it is traced."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.config.generator import GeometrySection
from mbtf_gen.tile.fibers.curves import F64, Bundle, Curve
from mbtf_gen.tile.fibers.draft import Weave
from mbtf_gen.tile.protocol import REFLECTION, Tile
from mbtf_gen.tile.tracers.protocol import TileGeometry

# Coefficients of σ_a from the color of many fibers, of a polynomial in the azimuthal roughness: Chiang et al.
# 2016, "A practical and controllable hair and fur model for production path tracing", equation 9.
_ABSORPTION = (5.969, -0.215, 2.532, -10.73, 5.574, 0.245)
# σ_a of fibers without transmission. Light inside a fiber travels 1.5 radii at least, so e⁻¹⁵⁰ of it is left.
_OPAQUE = 100.0


@dataclass(frozen=True)
class FiberScattering:
    """How fibers scatter light: Chiang et al. 2016, in Mitsuba's ``hair``.

    Attributes
    ----------
    roughness : longitudinal roughness β_M in [0, 1]
    azimuthal_roughness : azimuthal roughness β_N in [0, 1]
    scale_tilt : tilt of the cuticle scales in degrees
    ior : index of refraction
    """

    roughness: float = 0.3
    azimuthal_roughness: float = 0.3
    scale_tilt: float = 0.0
    ior: float = 1.55

    @property
    def longitudinal_variance(self) -> float:
        """Variance of the reflected lobe along the fiber, in square radians (Chiang et al. 2016,
        equation 7)."""
        b = self.roughness
        return (0.726 * b + 0.812 * b**2 + 3.7 * b**20) ** 2

    @property
    def narrowest(self) -> float:
        """Standard deviation of the narrowest lobe, along or around the fiber, in radians (Chiang et al.
        2016, equations 7 and 8). Along the fiber, the transmitted lobe is half as wide as the reflected
        one."""
        n = self.azimuthal_roughness
        along = 0.5 * self.longitudinal_variance**0.5
        # Of a logistic distribution.
        scale = np.sqrt(np.pi / 8.0) * (0.265 * n + 1.194 * n**2 + 5.372 * n**22)
        return float(min(along, scale * np.pi / np.sqrt(3.0)))


@dataclass(frozen=True)
class FiberTile(Tile):
    """Fibers of one period.

    Attributes
    ----------
    aspect : float
        H/W of the tile.
    curves : sequence of Curve
        Fibers in tile widths; the highest touches the reference plane z = 0.
    yarn : (n,) int array
        Color of each fiber.
    colors : (k, 3) float64 array
        Colors of masses of fibers, linear Rec.709 in [0, 1].
    scattering : tuple of FiberScattering
        Of the fibers of each color.
    names : tuple of str
        Names of the yarns of each color.
    weave : Weave or None
        Draft and yarns of woven cloth.
    """

    kind = "fibers"

    aspect: float
    curves: Sequence[Curve]
    yarn: NDArray[np.int_]
    colors: F64
    scattering: tuple[FiberScattering, ...] = (FiberScattering(),)
    names: tuple[str, ...] = ("yarn",)
    weave: Weave | None = None

    @classmethod
    def settled(
        cls,
        aspect: float,
        curves: Sequence[Curve],
        yarn: NDArray[np.int_],
        colors: F64,
        scattering: tuple[FiberScattering, ...] = (FiberScattering(),),
    ) -> FiberTile:
        """The tile with its fibers moved up or down until the highest touches the reference plane. Segments
        that are long for their radius are halved."""
        fine = []
        for curve, times in zip(curves, Bundle(curves).halvings(), strict=True):
            for _ in range(times):
                curve = curve.halved()
            fine.append(curve)
        _, top = Bundle(fine).heights()
        down = np.array([0.0, 0.0, -top])
        return cls(aspect, [curve.moved(down) for curve in fine], yarn, colors, scattering)

    @cached_property
    def thickness(self) -> float:
        return 0.0 - Bundle(self.curves).heights()[0]

    @property
    def segments(self) -> int:
        """Number of spline segments of one period."""
        return sum(len(curve.control) - (3 if curve.shift is None else 0) for curve in self.curves)

    def runs(self) -> tuple[list[F64], NDArray[np.int_]]:
        """Runs of control points (m, 4) that reach into the box [0, 1] x [0, aspect], with their fibers."""
        return Bundle(self.curves).copies((1.0, self.aspect))

    def trace(self, unit: float, below: bool = False) -> TileGeometry:
        from mbtf_gen.tile.tracers.curve_tracer import CurveGeometry

        runs, fiber = self.runs()
        yarn, distinct = self.yarn[fiber], self._distinct
        part = np.array([distinct.index(s) for s in self.scattering])[yarn] if len(distinct) > 1 else None
        u = (yarn + 0.5) / len(self.colors)
        return CurveGeometry.of_runs(runs, u, part, self.aspect, self.thickness, unit)

    @property
    def _distinct(self) -> list[FiberScattering]:
        """The scattering of each part of the surface."""
        return list(dict.fromkeys(self.scattering))

    def surface(
        self, on: Collection[str] = REFLECTION, slopes: NDArray[np.float64] | None = None
    ) -> dict[str, Any] | list[dict[str, Any]]:
        """Mitsuba dictionary of the scattering, or one for each that differs. σ_a of all colors is a texture
        along u. Without the effect ``transmission``, fibers absorb all light that enters them."""
        hairs = [self._hair(scattering, "transmission" in on) for scattering in self._distinct]
        return hairs if len(hairs) > 1 else hairs[0]

    def _hair(self, s: FiberScattering, transmits: bool) -> dict[str, Any]:
        import mitsuba as mi

        sigma_a = absorption(self.colors, s.azimuthal_roughness)
        pixels = np.asarray(sigma_a if transmits else np.full_like(sigma_a, _OPAQUE), np.float32)[None]
        return {
            "type": "hair",
            "sigma_a": {
                "type": "bitmap",
                "bitmap": mi.Bitmap(np.ascontiguousarray(pixels)),
                "raw": True,
                "filter_type": "nearest",
                "wrap_mode": "clamp",
            },
            "longitudinal_roughness": s.roughness,
            "azimuthal_roughness": s.azimuthal_roughness,
            "scale_tilt": s.scale_tilt,
            "int_ior": s.ior,
        }

    @property
    def base_color(self) -> F64:
        """Mean (3,) of the colors."""
        return np.asarray(self.colors.mean(axis=0))

    @property
    def bsdf_type(self) -> str:
        return "hair"

    @property
    def scatters(self) -> bool:
        return True

    def narrowest_lobe(self) -> tuple[float, str]:
        return min(s.narrowest for s in self.scattering), "narrowest lobe of the fibers"

    def properties(self) -> dict[str, Any]:
        return {"fibers": len(self.curves), "segments": self.segments}

    def inspect(self, options: GeometrySection, finest: int | None = None) -> dict[str, Any]:
        self.configured(options)
        radii = np.concatenate([curve.control[:, 3] for curve in self.curves])
        bundle = Bundle(self.curves)
        slopes = [bundle.at(v)[1][:, :3] for v in (0.0, 0.25, 0.5, 0.75)]
        length = float(np.mean([np.linalg.norm(slope, axis=1).sum() for slope in slopes]))
        volume = np.pi * float(np.mean(radii**2)) * length / (self.aspect * self.thickness)
        return {
            "resolution": self.lattice(finest).shape()[1],
            "aspect": self.aspect,
            "fibers": {
                "count": len(self.curves),
                "segments": self.segments,
                "thickness": self.thickness,
                "radius": [float(radii.min()), float(radii.max())],
                "length": length,
                "share_of_volume": volume,
            },
            "yarns": self._yarns(),
            "weave": None if (w := self.weave) is None else w.properties(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    def _yarns(self) -> dict[str, dict[str, Any]]:
        """Color, scattering and number of fibers of each yarn."""
        return {
            name: {
                "color": color.tolist(),
                **asdict(scattering),
                "fibers": int(np.count_nonzero(self.yarn == number)),
            }
            for number, (name, color, scattering) in enumerate(
                zip(self.names, self.colors, self.scattering, strict=True)
            )
        }


def absorption(color: F64, azimuthal_roughness: float) -> F64:
    """Absorption σ_a, per fiber radius, with which a mass of fibers has a color (Chiang et al. 2016, equation
    9)."""
    b = azimuthal_roughness
    powers = np.array([1.0, b, b**2, b**3, b**4, b**5])
    return np.asarray((np.log(np.clip(color, 1e-3, 1.0)) / (powers @ _ABSORPTION)) ** 2)
