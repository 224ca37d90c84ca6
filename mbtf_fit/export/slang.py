"""A Slang module that evaluates a material, and what Slang compiles it to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mbtf_core.errors import UsageError
from mbtf_fit.backends.shader.syntax import ENDINGS, PLAIN_TARGETS, Target
from mbtf_fit.export import Export, ExportTarget, flags


@flags("Shader")
@dataclass(frozen=True)
class ShaderOptions:
    """Options of shader modules.

    Attributes
    ----------
    shader_target
        Another language that Slang compiles the module to (extra 'shaders'). Repeatable.
    shader_networks
        Networks of the other language: loops, or cooperative vectors in half precision, as the module has
        both.
    """

    shader_target: list[Target] | None = None
    shader_networks: Literal["plain", "cooperative"] | None = None


def write(export: Export, options: ShaderOptions) -> list[str]:
    """Write the module, its buffer, and the module in other languages."""
    from mbtf_fit.backends.shader.slang import MODULE_NAME, write_module
    from mbtf_fit.export.checks import check_shaders

    targets = list(dict.fromkeys(options.shader_target or []))
    cooperative = options.shader_networks == "cooperative"
    if cooperative and not targets:
        raise UsageError("is for other languages", where="--shader-networks", hint="add --shader-target")
    if cooperative and (without := [target for target in targets if target in PLAIN_TARGETS]):
        what = f"Slang has no cooperative vectors for {without[0]}"
        raise UsageError(what, where="--shader-networks", hint="export that language by a command of its own")
    check_shaders(export.material, export.folder / MODULE_NAME)
    return write_module(
        export.material, export.folder, targets, half=export.form == "float16", cooperative=cooperative
    )


TARGET = ExportTarget(
    "slang",
    "a shader module and the buffer that it reads",
    [f"material{ending}" for ending in (".slang", ".bin", *ENDINGS.values())],
    write,
    ShaderOptions,
)
