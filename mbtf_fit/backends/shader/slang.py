"""Export of a material as a Slang module, with the buffer that it reads, and in other languages."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from mbtf_core.files.atomic import write_chunks, write_text
from mbtf_fit.backends.shader.compiler import ENDINGS, SlangCompiler, Target
from mbtf_fit.backends.shader.images import F32, buffer_of
from mbtf_fit.backends.shader.program import program_of
from mbtf_fit.backends.shader.syntax import SLANG, number
from mbtf_fit.material.format import DEFAULT_MIN_COS
from mbtf_fit.material.material import Material

MODULE_NAME, TEXELS_NAME = "material.slang", "material.bin"
FILE_NAMES = (
    MODULE_NAME,
    TEXELS_NAME,
    *(str(Path(MODULE_NAME).with_suffix(end)) for end in ENDINGS.values()),
)
ENTRY = "evaluate_queries"


def module_of(material: Material) -> tuple[str, F32]:
    """The module of a material, and the vectors (n, 4) of its buffer.

    Raises
    ------
    InputError : it has an operation that shaders do not have
    """
    program = program_of(material, SLANG)
    places, first, buffer = buffer_of(program.images, program.weights)
    least = material.description["data"].get("min_cos", DEFAULT_MIN_COS)
    own = [
        SLANG.prologue,
        f"#define WEIGHT(i) material_texels[{first} + (i)]",
        *(["#define SAMPLED_LOBE"] if program.sampled else []),
        f"CONSTANT float MIN_COS = {number(least)};",
        *(SLANG.image.format(name=i, place=p) for i, p in zip(program.images, places, strict=True)),
        program.code,
    ]
    head, tail = files(__package__).joinpath("module.slang").read_text().split("//MATERIAL\n")
    head = head.replace("//MODEL", f"// Model: {material.config.model}.")
    return head + "\n".join([*own, tail]), buffer


def write_module(material: Material, folder: Path, targets: Sequence[Target] = ()) -> list[str]:
    """Write the module, its buffer, and the module in other languages; returns the names of the files.

    Raises
    ------
    InputError : the material has an operation that shaders do not have
    EngineError : Slang's compiler is missing
    """
    compiler = SlangCompiler() if targets else None
    module, buffer = module_of(material)
    write_text(folder / MODULE_NAME, module)
    write_chunks(folder / TEXELS_NAME, [buffer.astype("<f4").tobytes()])
    written = [MODULE_NAME, TEXELS_NAME]
    for target in targets:
        assert compiler is not None
        name = Path(MODULE_NAME).with_suffix(ENDINGS[target]).name
        write_chunks(folder / name, [compiler.compile(folder / MODULE_NAME, ENTRY, target)])
        written.append(name)
    return written
