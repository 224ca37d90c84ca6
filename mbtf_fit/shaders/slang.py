"""A Slang module that evaluates a material, made of the same template as the viewer's shader.

The template is GLSL. Slang has the same operators and vector functions under names of HLSL, so that a few
replacements make Slang of it; textures become ranges of one buffer (:mod:`mbtf_fit.shaders.texels`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from mbtf_core.files.atomic import write_chunks, write_text
from mbtf_fit.material.format import DEFAULT_MIN_COS
from mbtf_fit.material.material import Material
from mbtf_fit.shaders.compiler import ENDINGS, SlangCompiler, Target
from mbtf_fit.shaders.texels import F32, texels_of
from mbtf_fit.viewer.shader import ShaderSource, number

MODULE_NAME, TEXELS_NAME = "material.slang", "material.bin"
FILE_NAMES = (
    MODULE_NAME,
    TEXELS_NAME,
    *(str(Path(MODULE_NAME).with_suffix(end)) for end in ENDINGS.values()),
)
ENTRY = "evaluate_queries"

_NAMES = (
    (r"\bivec([234])\b", r"int\1"),
    (r"\bvec([234])\b", r"float\1"),
    (r"\bmix\(", "lerp("),
    (r"\batan\(", "atan2("),
    (r"\bsampler2DArray image\b", "int3 image"),
    (r"(?m)^uniform sampler2D(?:Array)? \w+;\n", ""),
    (r"(?m)^const (\w+) (\w+)\[(\d+)\] = \w+\[\d+\]\((.*)\);$", r"static const \1 \2[\3] = { \4 };"),
    (r"(?m)^const ", "static const "),
    (r"(?m)^int visited\b", "static int visited"),
    (
        r"(?m)^float3 stage2\(.*\{$",
        r"\g<0>\n  if (min(omega_i.z, omega_o.z) <= 0.0) return float3(0.0);  // below the plane",
    ),
)
_FETCH = "texelFetch("


def _fetches(text: str) -> str:
    """``texelFetch(image, place, 0)`` as a read of the buffer."""
    out, at = [], 0
    while (found := text.find(_FETCH, at)) >= 0:
        out.append(text[at:found])
        depth, start, arguments = 1, found + len(_FETCH), []
        k = start
        while depth:
            depth += {"(": 1, ")": -1}.get(text[k], 0)
            if depth == 0 or (depth == 1 and text[k] == ","):
                arguments.append(text[start:k].strip())
                start = k + 1
            k += 1
        out.append(f"texel({arguments[0]}, {arguments[1]})")
        at = k
    return "".join([*out, text[at:]])


def translate(glsl: str) -> str:
    """Slang of GLSL that is written as the template is."""
    for pattern, replacement in _NAMES:
        glsl = re.sub(pattern, replacement, glsl)
    return _fetches(glsl)


def module_of(material: Material) -> tuple[str, F32]:
    """The module of a material, and the vectors (n, 4) of its buffer.

    Raises
    ------
    InputError
        The model reads neighborhoods of texels, which the shader does not.
    """
    source = ShaderSource(material)
    body = translate(source.text())
    buffer = texels_of(material, source.weights.array())
    images = dict(buffer.images)
    first, _, _ = images.pop("weights")
    template = files(__package__).joinpath("module.slang").read_text()
    constants = [f"static const int3 {name} = int3({a}, {w}, {h});" for name, (a, w, h) in images.items()]
    least = material.description["data"].get("min_cos", DEFAULT_MIN_COS)
    constants.append(f"static const float MIN_COS = {number(least)};")
    constants.append(f"#define WEIGHT(i) material_texels[{first} + (i)]")
    head, tail = template.split("//MATERIAL\n")
    name = material.config.model
    return head.replace("//MODEL", f"// Model: {name}.") + "\n".join([*constants, body, tail]), buffer.array()


def write_module(material: Material, folder: Path, targets: Sequence[Target] = ()) -> list[str]:
    """Write the module, its buffer, and the module in other languages; returns the names of the files.

    Raises
    ------
    InputError
        The model reads neighborhoods of texels, which the shader does not.
    EngineError
        Slang's compiler is missing.
    """
    compiler = SlangCompiler() if targets else None
    module, texels = module_of(material)
    write_text(folder / MODULE_NAME, module)
    write_chunks(folder / TEXELS_NAME, [texels.astype("<f4").tobytes()])
    files = [MODULE_NAME, TEXELS_NAME]
    for target in targets:
        assert compiler is not None
        name = Path(MODULE_NAME).with_suffix(ENDINGS[target]).name
        write_chunks(folder / name, [compiler.compile(folder / MODULE_NAME, ENTRY, target)])
        files.append(name)
    return files
