"""A Slang module that evaluates a material, and what Slang compiles it to."""

from __future__ import annotations

from pydantic import Field

from mbtf_core.config.settings import Settings
from mbtf_fit.backends.shader.syntax import ENDINGS, Target
from mbtf_fit.export import Export, ExportTarget


class ShaderOptions(Settings):
    """Options of shader modules."""

    shader_target: list[Target] | None = Field(
        None, description="another language that Slang compiles the module to (extra 'shaders'). Repeatable"
    )


def write(export: Export, options: ShaderOptions) -> list[str]:
    """Write the module, its buffer, and the module in other languages."""
    from mbtf_fit.backends.shader.slang import MODULE_NAME, write_module
    from mbtf_fit.export.checks import check_shaders

    check_shaders(export.material, export.folder / MODULE_NAME)
    return write_module(export.material, export.folder, list(dict.fromkeys(options.shader_target or [])))


TARGET = ExportTarget(
    "slang",
    "a shader module and the buffer that it reads",
    [f"material{ending}" for ending in (".slang", ".bin", *ENDINGS.values())],
    write,
    ShaderOptions,
)
