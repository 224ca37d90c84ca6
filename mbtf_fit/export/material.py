"""A copy of a material, in a folder of its own."""

from __future__ import annotations

from contextlib import suppress

from mbtf_core.errors import InputError
from mbtf_fit.export import Export, ExportTarget

_NAMES = ["weights.safetensors", "material.json", "transmittance.safetensors"]


def write(export: Export, options: None) -> list[str]:
    """Write a material folder, unless the folder holds it already."""
    from mbtf_fit.export.checks import check_values
    from mbtf_fit.material.format import DESCRIPTION_NAME, QUERY
    from mbtf_fit.material.material import Material
    from mbtf_fit.material.material import export as write_material

    material, description = export.material, export.material.description
    names = _NAMES if material.transmittance is not None else _NAMES[:2]
    with suppress(InputError):
        Material.load(export.folder)
        return names
    written = write_material(
        material.model,
        material.config,
        export.folder,
        data=description["data"],
        training=description["training"],
        form=export.form,
        transmittance=material.transmittance,
        sampler=material.sampler,
    )
    found = written.evaluate(*(material.conformance[name] for name in QUERY))
    check_values(found, material, export.folder / DESCRIPTION_NAME)
    return names


TARGET = ExportTarget(
    "material",
    "another material folder, in a folder of its own; the same command again keeps it",
    _NAMES,
    write,
)
