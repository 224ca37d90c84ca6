"""GLSL and Slang: what differs between them. All other code is written once, in the part that both have.

The common part has the names of Slang (``float3``, ``lerp``); GLSL defines them. Both define ``CONSTANT`` and
``GLOBAL`` for what is declared outside of functions, ``IMAGE`` (layers of texels) and ``TABLE`` (one layer),
which ``TEXEL(image, at)`` reads, and ``WEIGHT(i)``, a vector of the networks' weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

# Languages that Slang compiles to, and the endings of their files.
Target = Literal["hlsl", "spirv", "glsl", "wgsl", "metal", "cuda", "cpp"]
ENDINGS: dict[Target, str] = {
    "hlsl": ".hlsl",
    "spirv": ".spv",
    "glsl": ".comp",
    "wgsl": ".wgsl",
    "metal": ".metal",
    "cuda": ".cu",
    "cpp": ".cpp",
}
# Those without cooperative vectors.
PLAIN_TARGETS: tuple[Target, ...] = ("wgsl", "metal")


@dataclass(frozen=True)
class Syntax:
    """A language.

    Attributes
    ----------
    prologue : definitions of the common part
    array : constant array of a type, name, count and values
    image : declaration of an image: kind (IMAGE or TABLE), name, and place (first, width, height) in a buffer
    cooperative : whether it has cooperative vectors
    """

    prologue: str
    array: str
    image: str
    cooperative: bool = False


GLSL = Syntax(
    prologue="""\
#define float2 vec2
#define float3 vec3
#define float4 vec4
#define int2 ivec2
#define int3 ivec3
#define lerp mix
#define atan2 atan
#define CONSTANT const
#define GLOBAL
#define IMAGE sampler2DArray
#define TABLE sampler2D
#define TEXEL(image, at) texelFetch(image, at, 0)""",
    array="const {type} {name}[{count}] = {type}[{count}]({values});",
    image="uniform {kind} {name};",
)
SLANG = Syntax(
    prologue="""\
#define CONSTANT static const
#define GLOBAL static
#define IMAGE int3
#define TABLE int3
#define TEXEL(image, at) texel(image, at)""",
    array="static const {type} {name}[{count}] = {{ {values} }};",
    image="static const int3 {name} = int3({place});",
    cooperative=True,
)


def number(value: float) -> str:
    """A number as both languages read it back in single precision."""
    text = f"{float(np.float32(value)):.9g}"
    return text if any(c in text for c in ".en") else f"{text}.0"


def vector(values: Sequence[float]) -> str:
    """A vector of two to four numbers."""
    return f"float{len(values)}({', '.join(map(number, values))})"
