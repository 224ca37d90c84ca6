"""The shard format: schema version, arrays, units, conventions in words.

All other modules, the manifest and ``docs/reference/data-format.md`` use these names and descriptions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]

FORMAT_NAME = "mbtf-shards"
SCHEMA_VERSION = 6
MANIFEST_NAME = "manifest.json"
CONFIG_NAME = "config.yaml"
GEOMETRY_NAME = "geometry.exr"

Layout = Literal["shuffled", "image", "slices"]
# Leading axes of all arrays.
LEADING_AXES: dict[Layout, tuple[str, ...]] = {
    "shuffled": ("n",),
    "image": ("items", "rows", "columns"),
    "slices": ("items", "directions"),
}
# Directions of the slices layout: a spiral, or those of the measured BTFs of Bonn.
SliceDirections = Literal["spiral", "ubo2003"]
ArrayFormat = Literal["npz", "exr"]
# How maps that do not tile are made tileable.
Tiling = Literal["none", "mirror", "blend"]
Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = ("train", "test")


@dataclass(frozen=True)
class ShardEntry:
    """A shard of a data set, rendered or not.

    Attributes
    ----------
    split : {"train", "test"}
    index : number within the split, from 0
    file : file name
    rows : number of queries, of images in the image layout, or of positions in the slices layout
    """

    split: Split
    index: int
    file: str
    rows: int


@dataclass(frozen=True)
class Queries:
    """A batch of queries; the leading axes are ``(n,)`` or ``(items, rows, columns)``.

    Attributes
    ----------
    u : (..., 2) float32 array
        Positions on the reference plane, uv in [0, 1).
    sigma : (...) float32 array
        Standard deviations of the footprints, in tile widths.
    omega_i, omega_o : (..., 3) float32 arrays
        Unit vectors towards the light and towards the viewer.
    """

    u: F32
    sigma: F32
    omega_i: F32
    omega_o: F32

    @property
    def lead(self) -> tuple[int, ...]:
        """Shape of the leading axes."""
        return self.sigma.shape

    def flat(self) -> Queries:
        """The same queries with one leading axis."""
        return Queries(
            self.u.reshape(-1, 2),
            self.sigma.reshape(-1),
            self.omega_i.reshape(-1, 3),
            self.omega_o.reshape(-1, 3),
        )

    def take(self, rows: Any) -> Queries:
        """Select along the first axis by a slice, an index array or a mask."""
        return Queries(self.u[rows], self.sigma[rows], self.omega_i[rows], self.omega_o[rows])


@dataclass(frozen=True)
class ArraySpec:
    """One stored array: its trailing shape after the query axes, its unit, its meaning, its EXR channels."""

    name: str
    trailing: tuple[int, ...]
    unit: str
    meaning: str
    channels: tuple[str, ...]
    optional: bool = False


def _array(name: str, channels: str, unit: str, meaning: str, optional: bool = False) -> ArraySpec:
    suffixes = channels.split()
    names = tuple(f"{name}.{c}" for c in suffixes) if suffixes else (name,)
    return ArraySpec(name, (len(suffixes),) if suffixes else (), unit, meaning, names, optional=optional)


ARRAYS: tuple[ArraySpec, ...] = (
    _array(
        "u", "x y", "uv", "query position on the reference plane, uv in [0,1)^2, v = 0 at the images' bottom"
    ),
    _array("sigma", "", "tile widths", "standard deviation of the isotropic Gaussian footprint"),
    _array("omega_i", "x y z", "unit vector", "direction from the surface towards the light, z > 0"),
    _array("omega_o", "x y z", "unit vector", "direction from the surface towards the viewer, z > 0"),
    _array("value_a", "R G B", "1/sr", "first independent estimate of M (linear Rec.709 RGB)"),
    # Measured data have neither a second value nor paths.
    _array("value_b", "R G B", "1/sr", "second estimate, independent of the first", optional=True),
    _array("spp", "", "paths", "paths traced for this query, both halves together", optional=True),
    _array("transmittance", "", "1", "fraction of the footprint that rays pass through", optional=True),
    _array(
        "weight", "", "1", "of test queries drawn by highlights: weight in means over queries", optional=True
    ),
)
ARRAY: dict[str, ArraySpec] = {a.name: a for a in ARRAYS}

# F0 of clear coats.
CLEARCOAT_F0 = 0.04
# Images of `GEOMETRY_NAME`. Means are over a texel; the optional ones are left out where they do not apply.
GEOMETRY: tuple[ArraySpec, ...] = (
    _array(
        "height",
        "",
        "tile widths",
        "height z <= 0 of the mesh at its vertices, maximum 0; of fibers, as seen from above",
    ),
    _array("slope", "x y", "rise per length", "mean slopes dz/dx and dz/dy of the shading normal"),
    _array("slope_moment", "xx xy yy", "(rise per length)^2", "means of the products of these slopes"),
    _array("base_color", "R G B", "1", "mean base color (linear Rec.709 RGB)", optional=True),
    _array("roughness", "", "1", "mean roughness", optional=True),
    _array("metallic", "", "1", "mean metallic", optional=True),
    _array("specular", "", "1", "mean specular", optional=True),
    _array("opacity", "", "1", "mean opacity", optional=True),
    _array("clearcoat", "", "1", "mean weight of the clear coat, whose F0 is 4%", optional=True),
    _array("clearcoat_roughness", "", "1", "mean roughness of the clear coat", optional=True),
    _array(
        "tangent_moment",
        "xx xy xz yy yz zz",
        "unit vector^2",
        "means of the products of the fibers' directions as seen from above, 0 in gaps",
        optional=True,
    ),
    _array(
        "longitudinal_variance",
        "",
        "rad^2",
        "mean variance of the reflected lobe along the fiber (Chiang et al. 2016, equation 7), 0 in gaps",
        optional=True,
    ),
)

CONVENTIONS: dict[str, str] = {
    "tile": "the material's period; uv in [0,1)^2; position on the reference plane x = (u, a*v), "
    "z its normal; a = H/W is the aspect; lengths (sigma, heights) are in tile widths, isotropic in x",
    "image_rows": "row 0 of every map is the side v -> 1; texel centers at ((i+1/2)/W, 1-(j+1/2)/H)",
    "heights": "z = height_scale * h - max(height_scale * h) with the heights h on the grid of the mesh: "
    "the highest vertex touches the reference plane z = 0",
    "directions": "omega_i from the surface towards the light, omega_o from the surface towards the viewer, "
    "unit vectors in the tile's frame, z > 0",
    "light": "von Mises-Fisher lobe p around omega_i, cut at the horizon and normalized so that the "
    "irradiance on the reference plane is exactly 1; its width is the RMS angle per axis in degrees, "
    "0 a delta light",
    "value": "M(u, sigma, omega_i, omega_o) in 1/sr: radiance leaving towards omega_o under that light, "
    "averaged over a Gaussian footprint on the reference plane, wrapped on the torus; "
    "no cosine, no clamp, no log; a Lambert plane gives albedo/pi",
    "sigma": "standard deviation of the footprint in tile widths; level l = -log2(2 sigma)",
    "levels": "level s has 2^s x max(1, round(a 2^s)) texels and sigma_s = 2^-s / 2; data lie in l in [0, k]",
    "halves": "value_a and value_b are independent estimates from spp/2 paths each; the value is their mean "
    "and (a-b)^2/4 an unbiased estimate of the variance of that mean",
    "color": "linear, Rec.709 primaries, RGB order",
    "holes": "a ray that passes through a hole sees black; value is premultiplied",
}
