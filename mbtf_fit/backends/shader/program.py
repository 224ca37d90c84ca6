"""A material's shader: the code of its operations, as functions of a position and directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbtf_fit import ops
from mbtf_fit.backends.shader import network as _networks  # noqa: F401
from mbtf_fit.backends.shader import operations as _implementations  # noqa: F401
from mbtf_fit.backends.shader.backend import SHADER, Code, Value
from mbtf_fit.backends.shader.images import F16, F32, TexelImage
from mbtf_fit.backends.shader.syntax import Syntax, number
from mbtf_fit.material.material import Material
from mbtf_fit.material.transmittance import LEAST_COSINE, named_levels
from mbtf_fit.ops.operation import INPUTS, SAMPLER, output_names, parse, reached_from
from mbtf_fit.ops.sampler import BOUNDS, sampler_sizes

# Images of its coefficients, before the layer.
TRANSMITTANCE = "material.transmittance"


@dataclass(frozen=True)
class Program:
    """Code, and the numbers that it reads.

    Attributes
    ----------
    code : functions ``stage1(u, sigma, omega_o)``, ``stage2(seen, omega_i, omega_o)`` and
        ``transmittance(u, sigma, omega_o)``, without the declarations of images
    images : in the order of their declarations
    weights : vectors (n, 4) of the networks
    matrices : of their cooperative vectors
    """

    code: str
    images: list[TexelImage]
    weights: F32
    matrices: list[F16]


def program_of(material: Material, syntax: Syntax, *, sampled: bool = False) -> Program:
    """The shader of a material; with its sampler where that is wanted.

    Raises
    ------
    InputError : it has an operation that shaders do not have
    """
    operations = material.model.stored_operations()
    SHADER.check(operations)
    lit = reached_from(operations, "omega_i")
    read = {parse(r)[0] for op in operations if op.output in lit for r in op.inputs()}
    last = operations[-1].output
    tensors = {name: t.cpu().float().numpy() for name, t in material.model.weights().items()}
    if material.transmittance is not None:
        tensors |= {f"{TRANSMITTANCE}.{name}": a for name, a in named_levels(material.transmittance).items()}
    sampler = material.sampler if sampled else None
    if sampler is not None:
        tensors |= {name: t.numpy() for name, t in sampler.tensors.items()}
    code = Code(syntax, tensors, {*read, last, SAMPLER}, _moving(operations))
    values = {
        name: Value.of(name if name.startswith("omega") else f"seen.{name}", size, name == "omega_i")
        for name, size in INPUTS.items()
    }
    more = [] if sampler is None else sampler.operations
    sizes = sampler_sizes(operations, more)
    for op in [*operations, *more]:
        code.lit = op.output in lit
        found = SHADER[op](op, code, *op.arguments(lambda name, part: values[name][part]))
        results = found if isinstance(found, tuple) else (found,)
        for name, result in zip(output_names(op), results, strict=True):
            values[name] = code.result(name, sizes[name], result)
    level = f"clamp(-log2(2.0 * sigma), 0.0, {material.lattice.finest}.0)"
    through = _transmittance(material, code, level)
    text = [
        "CONSTANT float PI = 3.14159265358979;",
        f"CONSTANT float ASPECT = {number(material.lattice.aspect)};",
        *code.globals,
        "// What does not depend on the light (stage 1).",
        "struct Seen {",
        *(f"  {field}" for field in ("float2 u;", "float level;", *code.fields)),
        "};",
        "Seen stage1(float2 u, float sigma, float3 omega_o) {",
        "  Seen seen;",
        "  seen.u = u - floor(u);",
        f"  seen.level = {level};",
        *code.bodies[0],
        "  return seen;",
        "}",
        "// Value for light from omega_i (stage 2), at least 0; 0 below the plane.",
        "float3 stage2(Seen seen, float3 omega_i, float3 omega_o) {",
        "  if (min(omega_i.z, omega_o.z) <= 0.0) return float3(0.0, 0.0, 0.0);",
        *code.bodies[1],
        f"  return max({values[last]}, float3(0.0, 0.0, 0.0));",
        "}",
        *through,
    ]
    # WebGL has no empty uniforms.
    weights = np.concatenate(code.weights or [np.zeros((1, 4), np.float32)])
    if sampler is not None:
        x = values[SAMPLER]
        bounds = zip(("LEAST_ALPHA", "LARGEST_LOG", "LARGEST_WEIGHT"), BOUNDS, strict=True)
        text += [
            "#define SAMPLER",
            *(f"CONSTANT float {name} = {number(bound)};" for name, bound in bounds),
            f"float3 sampler_scales(Seen seen) {{ return {x[0:3]}; }}",
            f"float3 sampler_slopes(Seen seen) {{ return {x[3:6]}; }}",
        ]
    return Program("\n".join(text), [*code.images.values()], weights, code.matrices)


def _moving(operations: list[ops.Operation]) -> set[str]:
    """Textures and networks that move lookups."""
    lookups = [op for op in operations if isinstance(op, ops.Lookup)]
    networks = [op for op in operations if isinstance(op, ops.Network)]
    positions = {parse(op.u)[0] for op in lookups}
    sources = [(op.output, op.textures) for op in lookups] + [(op.output, op.weights) for op in networks]
    return {name for output, name in sources if positions & reached_from(operations, output)}


def _transmittance(material: Material, code: Code, level: str) -> list[str]:
    """Function of the transparent fraction of the footprint (mbtf_fit.material.transmittance)."""
    body = ["  return 0.0;"]
    if material.transmittance is not None:
        cosine = f"max(abs(omega_o.z), {number(LEAST_COSINE)})"
        body = ["  float2 w = omega_o.z < 0.0 ? -omega_o.xy : omega_o.xy, x;"]
        body += ["  float sum = 0.0;", "  float4 a, b;", "  Pair p;"]
        for k, z in enumerate(material.transmittance.depths):
            image = code.image(f"{TRANSMITTANCE}.{k}")
            body += [
                f"  x = u + {number(z)} / {cosine} * float2(w.x, w.y / ASPECT);",
                f"  p = {code.pair(image, level, 'x - floor(x)')};",
                f"  a = blended({image}, p, 0); b = blended({image}, p, 1);",
                "  sum += a.x + dot(a.yz, w) + a.w * w.x * w.x + b.x * w.x * w.y + b.y * w.y * w.y;",
            ]
        body += ["  return clamp(sum, 0.0, 1.0);"]
    head = "float transmittance(float2 u, float sigma, float3 omega_o) {"
    return ["// Transparent fraction of the footprint.", head, *body, "}"]
