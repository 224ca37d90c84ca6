"""Fully connected networks in shaders: loops over vectors of four and, in Slang, cooperative vectors.

Both are in the same module, under ``#ifdef COOPERATIVE``. Cooperative vectors are in half precision. Networks
that move lookups stay in single precision, as values are sensitive to errors of the position.
"""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_fit import ops
from mbtf_fit.backends.shader.backend import SHADER, Code, Value, in_fours
from mbtf_fit.backends.shader.images import F32, layer_vectors
from mbtf_fit.ops.constants import LEAK

ACTIVATIONS = {"relu": "max({0}, 0.0)", "leaky-relu": f"max({{0}}, {LEAK} * {{0}})", "sine": "sin({0})"}
# The same of cooperative vectors.
COOPERATIVE = {"relu": "relu({0})", "leaky-relu": f"leaky_relu({{0}}, {LEAK})", "sine": "sine({0})"}
# Weight (outputs, inputs) and bias (outputs,) of each layer.
Layers = Sequence[tuple[F32, F32]]


@SHADER.implements(ops.Network)
def _network(op: ops.Network, code: Code, x: Sequence[Value]) -> Value:
    read = Value(tuple(n for value in x for n in value.numbers))
    h = code.variable("float4", "h", len(read.vectors()), kept=False)
    code.fill(h, read.vectors(), len(read))
    names = [f"{op.weights}.{n}" for n in range(len(op.hidden) + 1)]
    layers = [(code.tensors[f"{name}.weight"], code.tensors[f"{name}.bias"]) for name in names]
    out = code.variable("float4", op.output, -(-op.outputs // 4))
    loops = ACTIVATIONS[op.activation]
    if not code.syntax.cooperative or op.weights in code.precise:
        _loops(code, layers, loops, h, out)
    else:
        code.write("#ifdef COOPERATIVE")
        _cooperative_vectors(code, layers, COOPERATIVE[op.activation], read, out)
        code.write("#else")
        _loops(code, layers, loops, h, out)
        code.write("#endif")
    return Value.of_array(out, op.outputs, code.lit)


def _loops(code: Code, layers: Layers, activation: str, h: str, out: str) -> None:
    """Write layers from an array of vectors to another one."""
    for n, (weight, bias) in enumerate(layers):
        first, (outputs, inputs) = sum(map(len, code.weights)), (-(-size // 4) for size in weight.shape)
        code.weights.append(layer_vectors(weight, bias))
        last = n == len(layers) - 1
        y = out if last else code.variable("float4", "h", outputs, kept=False)
        # Unrolled code is slower in software rendering, and takes long to compile.
        code.write(
            f"for (int o = 0; o < {outputs}; o++) {{",
            f"  int at = {first} + o * {1 + 4 * inputs};",
            "  float4 sum = WEIGHT(at);",
            f"  for (int i = 0; i < {inputs}; i++) {{",
            f"    float4 x = {h}[i];",
            "    int k = at + 4 * i;",
            "    sum += WEIGHT(k + 1) * x.x + WEIGHT(k + 2) * x.y;",
            "    sum += WEIGHT(k + 3) * x.z + WEIGHT(k + 4) * x.w;",
            "  }",
            f"  {y}[o] = {'sum' if last else activation.format('sum')};",
            "}",
        )
        h = y


def _cooperative_vectors(code: Code, layers: Layers, activation: str, read: Value, out: str) -> None:
    """Write layers from numbers to an array of vectors."""
    width, x = len(read), code.name("v")
    code.write(f"CoopVec<half, {width}> {x} = CoopVec<half, {width}>({', '.join(read.scalars())});")
    for n, (weight, bias) in enumerate(layers):
        width, y = len(weight), code.name("v")
        layer = f"layer<{width}>({x}, {code.matrix(weight)}, {code.matrix(bias[None])})"
        found = layer if n == len(layers) - 1 else activation.format(layer)
        code.write(f"CoopVec<half, {width}> {y} = {found};")
        x = y
    code.fill(out, in_fours([f"float({x}[{k}])" for k in range(width)]), width)
