"""What the generator asks of a tile, whatever it is made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Tiling
from mbtf_core.errors import InputError, UsageError
from mbtf_core.meshes.content import numbers_of
from mbtf_gen.config.generator import GeometrySection, NormalMode
from mbtf_gen.tile.heights import HeightGrid
from mbtf_gen.tile.maps.map_loader import Color
from mbtf_gen.tile.maps.material_file import REFLECTING
from mbtf_gen.tile.tracers.protocol import TileGeometry

# Effects of how a surface reflects or transmits.
REFLECTION = (*REFLECTING, "transmission")


@dataclass(frozen=True, kw_only=True)
class Tile(ABC):
    """One period of a material: its shape, its reflectance, and the files that they come from.

    Attributes
    ----------
    kind : str
        What it is made of, in a word.
    files : dict of str to Path
        File of each role.
    digests : dict of str to str
        SHA-256 of each role's file; ``settings`` covers all other inputs that change the data.
    warnings, notes : tuple of str
        Warnings that apply under any options, and remarks.
    unused : dict of str to str
        Reason why an image of the folder is not used, by file name.
    resolution : int or None
        Texels across at the finest level, from the material file; None without one there.
    height_scale : float
        Tile widths per stored height; 1 without a height map.
    tiling : {"none", "mirror", "blend"}
        Method that made the maps tileable.
    maps : dict
        Maps and constants of the reflectance by role (:data:`~mbtf_gen.tile.maps.material_file.ROLES`); empty
        for tiles without maps.
    """

    kind: ClassVar[str]
    files: dict[str, Path] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    unused: dict[str, str] = field(default_factory=dict)
    resolution: int | None = None
    height_scale: float = 1.0
    tiling: Tiling = "none"
    maps: dict[str, Any] = field(default_factory=dict)

    # Shape.

    if TYPE_CHECKING:

        @property
        def aspect(self) -> float:
            """H/W of the tile."""

    @property
    @abstractmethod
    def thickness(self) -> float:
        """Largest height difference of the surface, in tile widths."""

    @property
    def grid(self) -> HeightGrid | None:
        """The heights that are traced; None for tiles that are no height field."""
        return None

    def at(self, height_scale: float | None = None, mesh: int | None = None) -> Self:
        """The tile at another height scale and resolution of the mesh, where it has them."""
        return self

    @abstractmethod
    def trace(self, unit: float, below: bool = False) -> TileGeometry:
        """The surface as rays meet it.

        Parameters
        ----------
        unit : float
            Scene units per tile width.
        below : bool
            Whether rays may be below the surface, as behind an opacity mask.
        """

    def lattice(self, finest: int | None = None) -> Lattice:
        """Texel grids of the levels up to `finest`; by default up to the material's own resolution."""
        return Lattice((self.resolution or 1).bit_length() - 1 if finest is None else finest, self.aspect)

    def configured(self, options: GeometrySection) -> Self:
        """The tile under the options of the geometry.

        Raises
        ------
        UsageError
            An option does not apply to this kind of tile.
        InputError
            The tile is thicker than accepted.
        """
        given = {
            # A finished job states the scale 1.
            "--height-scale": options.height_scale not in (None, 1.0),
            "--mesh": options.mesh is not None,
            "--tracer": options.tracer != GeometrySection.model_fields["tracer"].default,
        }
        for flag, refused in given.items():
            if refused:
                raise UsageError("is for height maps, not for fibers and triangles", where=flag)
        if fault := displacement_fault(self.thickness, options.max_displacement):
            raise InputError(fault[0], where=next(iter(self.files.values()), None), hint=fault[1])
        return self

    # Reflectance.

    @abstractmethod
    def surface(
        self, on: Collection[str] = REFLECTION, slopes: NDArray[np.float64] | None = None
    ) -> Mapping[str, Any] | Sequence[Mapping[str, Any]]:
        """Mitsuba dictionary of the reflectance; one per part of a mesh or kind of yarn.

        Parameters
        ----------
        on : names of the effects that are simulated; all of the surface but opacity by default
        slopes : (h, w, 2) slopes that shading adds to those of the geometry
        """

    @property
    @abstractmethod
    def base_color(self) -> Color:
        """(h, w, 3) or (3,) linear color, of tiles without maps their mean."""

    def weight(self, effect: str) -> float:
        """Largest weight of a layer of the reflection; 0 where the tile lacks it."""
        return layer_weight(self.maps, effect)

    @property
    def images(self) -> Mapping[str, Any]:
        """Maps and constants by role, heights included, to show them."""
        return self.maps

    def with_maps(self, **maps: Any) -> Self:
        """The tile with some maps or constants replaced, and without those that are None."""
        return self

    def normal_slopes(self, mode: NormalMode = "residual") -> tuple[NDArray[np.float64], float] | None:
        """Slopes (h, w, 2) that a normal map adds to the mesh, and the share of the mesh's own slopes that it
        repeats; None without a map or where `mode` is ``off``."""
        return None

    @property
    def nbytes(self) -> int:
        """Bytes of the maps."""
        return 0

    @property
    def bsdf_type(self) -> str | None:
        """Type of the BSDF that replaces the maps and is not analyzed; None where there are maps."""
        return "mbtf_surface"

    @property
    def is_lambert(self) -> bool:
        """Whether the base layer is Lambert because no roughness, metallic or specular is given."""
        return False

    @property
    def scatters(self) -> bool:
        """Whether light passes through the matter itself, as through fibers."""
        return False

    @property
    def transmits(self) -> bool:
        """Whether rays can pass through the tile."""
        return True

    def narrowest_lobe(self) -> tuple[float, str] | None:
        """(width in radians, what it is of) of the narrowest lobe; None where it is not known."""
        return None

    # Description.

    @abstractmethod
    def properties(self) -> dict[str, Any]:
        """What the tile is made of, for the manifest."""

    @abstractmethod
    def inspect(self, options: GeometrySection, finest: int | None = None) -> dict[str, Any]:
        """Statistics as plain data, ``warnings`` and ``notes`` among them, for levels up to `finest`."""

    def summary(self) -> str | None:
        """The options in use, in a line; None where there are none."""
        return None

    def scale_warning(self) -> str | None:
        """The warning that the height scale in use is implausible; None where it is not."""
        return None

    def warnings_in_use(self) -> tuple[str, ...]:
        """Warnings, those that depend on the options included."""
        return self.warnings


def layer_weight(maps: Mapping[str, Any], effect: str) -> float:
    """Largest weight of a layer in some maps and constants by role; its color counts."""
    weight = float(np.max(numbers_of(maps.get(effect, 0.0))))
    color = maps.get(f"{effect}_color")
    return weight if color is None else weight * float(np.max(numbers_of(color)))


def displacement_fault(found: float, limit: float) -> tuple[str, str] | None:
    """Fault and hint of a displacement range above the accepted one, both in tile widths."""
    if found <= limit:
        return None
    return (
        f"the displacement range is {found:.4g} tile widths; at most {limit:g} are accepted",
        "set a smaller --height-scale, or raise geometry.max_displacement",
    )
