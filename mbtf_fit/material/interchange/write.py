"""Maps of a material and the documents that name them, in a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mbtf_core.files.atomic import write_text
from mbtf_fit.material.interchange.agreement import Agreement, fit_color
from mbtf_fit.material.interchange.documents import WRITERS, Source, check_library
from mbtf_fit.material.interchange.images import write_maps
from mbtf_fit.material.interchange.lobes import fit_lobes
from mbtf_fit.material.interchange.maps import Maps, knows_surface, level_of, surface_maps
from mbtf_fit.material.material import Material


@dataclass(frozen=True)
class Interchange:
    """What was written.

    Attributes
    ----------
    files : list of str
        Names in the folder.
    maps : Maps
    agreement : Agreement
    """

    files: list[str]
    maps: Maps
    agreement: Agreement

    def as_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "level": self.maps.level,
            "source": "fit" if self.maps.heights is None else "surface",
            "dielectric_f0": self.maps.dielectric,
            **asdict(self.agreement),
        }

    def __str__(self) -> str:
        rows, columns = self.maps.roughness.shape
        kind = "fitted to the values of" if self.maps.heights is None else "of the surface, at"
        return f"maps {kind} {columns} x {rows} texels (level {self.maps.level})\n{self.agreement}"


def write_interchange(
    material: Material,
    path: Path,
    folder: Path,
    formats: Sequence[str],
    level: int | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> Interchange:
    """Write maps and documents.

    Parameters
    ----------
    material : Material
    path : Path
        Its folder.
    folder : Path
        Where to write.
    formats : sequence of str
        Of ``gltf``, ``usd``, ``materialx``.
    level : int, optional
        The finest by default.
    advance : callable
        Called with the number of texels done since the last call.

    Returns
    -------
    Interchange

    Raises
    ------
    UsageError
        The material has no such level.
    EngineError
        A library is not installed.
    PartialError
        The folder cannot be written.
    """
    for name in formats:
        check_library(name)
    level = level_of(material, level)
    maps = surface_maps(material, level) if knows_surface(material) else fit_lobes(material, level, advance)
    maps, agreement = fit_color(material, maps)
    files = write_maps(maps, folder)
    source = Source(
        path.resolve().name,
        Path(os.path.relpath(path, folder)).as_posix(),
        material.config.model,
        material.description["weights"]["sha256"],
    )
    for name in formats:
        document, write = WRITERS[name]
        write_text(folder / document, write(maps, source))
        files.append(document)
    return Interchange(files, maps, agreement)
