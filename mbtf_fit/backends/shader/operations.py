"""The operations in shaders: one function each, with the equations of :mod:`mbtf_fit.ops`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mbtf_core.data.schema import CLEARCOAT_F0
from mbtf_fit import ops
from mbtf_fit.backends.shader.backend import SHADER, Code, Value, in_fours
from mbtf_fit.backends.shader.syntax import number, vector
from mbtf_fit.ops.constants import COATED_CHANNELS, GLOSSY_CHANNELS, MAX_CROSSINGS
from mbtf_fit.ops.shade import grazing_reflectance

PER_WIDTH = "float2(1.0, ASPECT)"
FUNCTIONS = {
    "identity": "{0}",
    "exp": "exp({0})",
    "expm1": "(exp({0}) - 1.0)",
    "log1p": "log(1.0 + {0})",
    "softplus": "(max({0}, 0.0) + log(1.0 + exp(-abs({0}))))",
    "sigmoid": "(1.0 / (1.0 + exp(-({0}))))",
    "fourth-root": "({0} * abs({0} * {0} * {0}))",
    "square": "({0} * {0})",
}


@SHADER.implements(ops.Lookup)
def _lookup(op: ops.Lookup, code: Code, u: Value, level: Value | None) -> str | Value:
    image = code.image(op.textures, half=op.textures not in code.precise)
    if level is None:
        read = f"bilinear({image}, {code.let('Corners', f'corners({image.level(0)}, {u})')}, k)"
    else:
        at = f"{level} + {number(op.finer)}" if op.finer else str(level)
        read = f"blended({image}, {code.let('Pair', code.pair(image, at, str(u)), 'pair')}, k)"
    out = code.variable("float4", op.output, image.layers)
    code.write(f"for (int k = 0; k < {image.layers}; k++) {out}[k] = {read};")
    return Value.of_array(out, op.channels, code.lit)


@SHADER.implements(ops.SurfaceMaps)
def _surface_maps(op: ops.SurfaceMaps, code: Code, u: Value, level: Value) -> Value:
    maps, out = code.image(op.maps, "maps"), code.variable("float4", op.output, -(-op.channels // 4))
    pair = code.let("Pair", code.pair(maps, f"{level} + {number(op.finer)}", str(u)), "pair")
    code.write(f"for (int k = 0; k < {maps.layers}; k++) {out}[k] = blended({maps}, {pair}, k);")
    return Value.of_array(out, op.channels, code.lit)


@SHADER.implements(ops.Offset)
def _offset(op: ops.Offset, code: Code, u: Value, r: Value, omega_o: Value) -> str:
    moved = f"{number(op.scale)} * {r}"
    if len(r) == 1:
        moved += f" / max({omega_o[2:]}, {number(op.grazing)}) * {omega_o[:2]}"
    return f"{u} + {moved} / {PER_WIDTH}"


@SHADER.implements(ops.Trace)
def _trace(op: ops.Trace, code: Code, u: Value, level: Value, omega_o: Value) -> tuple[Value, ...]:
    nodes, count = _nodes(code, op.heights), len(op.places)
    places = code.constants("float2", "places", [vector(place) for place in op.places])
    mean, hits = code.variable("float", op.output), code.variable("float2", op.hits, count)
    depths = code.variable("float", op.depths, count)
    code.write(
        f"{mean} = 0.0;",
        f"for (int k = 0; k < {count}; k++) {{",
        f"  float2 at = place_of({u}, {level}, {places}[k], {omega_o}, ASPECT);",
        f"  float z = trace({nodes}, {op.crossings}, at, {omega_o});",
        f"  {depths}[k] = z;",
        f"  {hits}[k] = displaced(at, z, {omega_o}, ASPECT);",
        f"  {mean} += z / {number(count)};",
        "}",
    )
    return (
        Value.of(mean, 1, code.lit),
        Value.of_array(hits, 2 * count, code.lit, width=2),
        Value.of_array(depths, count, code.lit, width=1),
    )


def _nodes(code: Code, heights: str) -> str:
    """Table and grid of heights, the first arguments of a ray."""
    code.include("heights")
    nodes = code.image(heights, "nodes")
    rows, columns = nodes.levels[0].shape[:2]
    logarithms = ", ".join(str((n - 1).bit_length()) for n in (columns, rows))
    return f"{nodes}, Grid(int2({columns}, {rows}), int2({logarithms}), ASPECT)"


@SHADER.implements(ops.Displace)
def _displace(op: ops.Displace, code: Code, u: Value, z: Value, level: Value, omega_o: Value) -> str:
    code.include("heights")
    last = len(code.tensors[op.weights]) - 1
    weights = code.constants("float", "level_weights", [number(w) for w in code.tensors[op.weights]])
    s = code.let("int", f"max(min(int({level}), {last - 1}), 0)")
    weight = f"lerp({weights}[{s}], {weights}[min({s} + 1, {last})], {level} - float({s}))"
    return f"displaced({u}, {weight} * {z}, {omega_o}, ASPECT)"


@SHADER.implements(ops.Shade)
def _shade(
    op: ops.Shade,
    code: Code,
    hits: Value,
    level: Value,
    omega_i: Value,
    omega_o: Value,
    depths: Value | None,
) -> Value:
    code.include("textures")
    code.include("shading")
    maps = code.image(op.maps, "maps")
    horizons = code.image(op.horizons, "horizons")
    channels = maps.levels[0].shape[2]
    glossy, coated = channels >= GLOSSY_CHANNELS, channels == COATED_CHANNELS
    count, width, coat_f0 = len(hits) // 2, code.scalar(op.light_width), number(CLEARCOAT_F0)
    with code.stage_of(hits, level, omega_o):
        places = code.variable("Place", "places", count, kept=True)
        at, finer = code.variable("float2", "at", count, kept=False), f"{level} + {number(op.finer)}"
        p, q = (code.pair(image, finer, f"{at}[k]") for image in (maps, horizons))
        coats = code.variable("Coat", "coats", count, kept=True) if coated else ""
        given = f"{omega_o}, {number(op.least_view)}, {vector(op.alpha2)}"
        code.write(
            *(f"{at}[{k}] = {hits[2 * k : 2 * k + 2]};" for k in range(count)),
            f"for (int k = 0; k < {count}; k++) {{",
            f"  Pair p = {p}, q = {q};",
            f"  {places}[k] = "
            + (f"glossy_place_at({maps}, p, q, {given});" if glossy else f"place_at({maps}, p, q);"),
            *([f"  {coats}[k] = coat_at({maps}, p, {places}[k], {given});"] if coated else []),
            "}",
        )
    core = "irradiance * at.base / PI"
    if glossy:
        f0 = code.scalar(op.dielectric)
        lobe = vector((f0, grazing_reflectance(f0)))
        core = f"glossy(at, {lobe}, irradiance, light, widening, {omega_i}, {omega_o})"
    if coated:
        core = f"coated({core}, {coats}[k], at, {coat_f0}, light, widening, {omega_i}, {omega_o})"
    hints, sum_ = code.variable("float3", op.output), code.variable("float3", op.output)
    blur = f"{number((op.light_blur * width) ** 2)}, {number(op.least_variance)}"
    reaching = []
    if op.heights is not None and depths is not None:
        points = code.variable("float3", "points", count, kept=False)
        uv_and_z = (f"float3({hits[2 * k : 2 * k + 2]}, {depths[k : k + 1]})" for k in range(count))
        code.write(*(f"{points}[{k}] = {point};" for k, point in enumerate(uv_and_z)))
        ray = f"{_nodes(code, op.heights)}, {MAX_CROSSINGS}, {points}[k], {number(op.light_depth)}, {omega_i}"
        reaching = [f"  light = 0.5 * (light + reaching({ray}));"]
    code.write(
        f"{hints} = float3(0.0, 0.0, 0.0);",
        f"{sum_} = float3(0.0, 0.0, 0.0);",
        f"float3 widening = light_widening({omega_i}, {omega_o}, {number(width)});",
        f"for (int k = 0; k < {count}; k++) {{",
        f"  Place at = {places}[k];",
        "  float3 normal = normal_of(at);",
        f"  float light = lower_horizons({horizons}, {horizons.layers}, at.horizons, {blur}, {omega_i});",
        *reaching,
        f"  light /= {omega_i[2:]};",
        f"  float irradiance = light * normal.z * shown_area({omega_i}, at.center, at.spread);",
        f"  {hints} += float3(irradiance, normal.xy) / {number(count)};",
        f"  {sum_} += ({core}) / {number(count)};",
        "}",
    )
    return Value.of(hints, 3, code.lit) + Value.of(sum_, 3, code.lit)


@SHADER.implements(ops.FiberFrame)
def _fiber_frame(
    op: ops.FiberFrame, code: Code, hits: Value, level: Value, omega_i: Value, omega_o: Value
) -> Value:
    code.include("textures")
    code.include("fibers")
    maps, count = code.image(op.maps), len(hits) // 2
    with code.stage_of(hits, level):
        fibers = code.variable("Fibers", "fibers", count, kept=True)
        for k in range(count):
            pair = code.pair(maps, f"{level} + {number(op.finer)}", str(hits[2 * k : 2 * k + 2]))
            code.write(f"{fibers}[{k}] = fibers_at({maps}, {pair}, {number(op.least_tangents)});")
    sums = [code.variable("float3", op.output) for _ in range(2)]
    bounds = f"{number(op.least_cosine)}, {number(op.least_variance)}"
    code.write(
        *(f"{name} = float3(0.0, 0.0, 0.0);" for name in sums),
        f"for (int k = 0; k < {count}; k++) {{",
        f"  AboutFibers found = about_fibers({fibers}[k], {omega_i}, {omega_o}, {bounds});",
        f"  {sums[0]} += found.first / {number(count)};",
        f"  {sums[1]} += found.last / {number(count)};",
        "}",
    )
    return Value.of(sums[0], 3, code.lit) + Value.of(sums[1], 3, code.lit)


@SHADER.implements(ops.Lobe)
def _lobe(
    op: ops.Lobe,
    code: Code,
    base_color: Value,
    specular: Value,
    alpha2: Value,
    slopes: Value,
    omega_i: Value,
    omega_o: Value,
    weight: Value | None,
) -> str:
    code.include("shading")
    with code.stage_of(alpha2, slopes):
        normal = code.variable("float3", "normal", kept=True)
        roughness = code.variable("float", "alpha2", kept=True)
        code.write(
            f"{normal} = normalize(float3(-{slopes}, 1.0));",
            f"{roughness} = max({alpha2}, {number(op.least_alpha2)});",
        )
    f0 = str(specular) if len(specular) == 3 else f"float3({specular}, {specular}, {specular})"
    least = vector((op.least_light, op.least_view))
    irradiance = f"max(dot({normal}, {omega_i}), 0.0) / {omega_i[2:]}"
    lobe = f"ggx({f0}, {roughness}, {normal}, {least}, {omega_i}, {omega_o})"
    if weight is not None:
        lobe = f"{weight} * {lobe}"
    return f"{irradiance} * ({base_color} / PI + {lobe})"


@SHADER.implements(ops.HalfVector)
def _half_vector(op: ops.HalfVector, code: Code, omega_i: Value, omega_o: Value) -> str:
    return f"normalize({omega_i} + {omega_o})"


@SHADER.implements(ops.Rotate)
def _rotate(op: ops.Rotate, code: Code, axis: Value, omega: Value) -> str:
    code.include("shading")
    if len(axis) == 3:
        return f"rotate_to_z({axis}, {omega})"
    return f"rotate_to_z(float3({axis}, sqrt(max(0.0, 1.0 - dot({axis}, {axis})))), {omega})"


@SHADER.implements(ops.ToFrame)
def _to_frame(op: ops.ToFrame, code: Code, axes: Value, omega: Value) -> str:
    code.include("shading")
    return f"in_frame({axes[:3]}, {axes[3:]}, {omega}, {number(op.shortest)})"


@SHADER.implements(ops.Stereographic)
def _stereographic(op: ops.Stereographic, code: Code, omega: Value) -> str:
    return f"{omega[:2]} / (1.0 + {omega[2:]})"


@SHADER.implements(ops.Position)
def _position(op: ops.Position, code: Code, u: Value) -> str:
    return f"2.0 * ({u} - floor({u})) - 1.0"


@SHADER.implements(ops.Frequencies)
def _frequencies(op: ops.Frequencies, code: Code, x: Value, level: Value | None) -> list[str]:
    spread = Value.of("", len(x))
    if level is not None:
        spread = Value.of(code.let("float2", f"exp2(-{level}) / {PER_WIDTH}", "spread"), 2)
    sines, cosines = [], []
    for c, s in zip(x.scalars(), spread.scalars(), strict=True):
        for k in range(op.bands):
            frequency = number(2.0**k * (math.pi if op.pi else 1.0))
            factor = f"{number(2.0**-k)} * " if op.attenuated else ""
            if level is not None:
                factor += f"exp(-0.5 * {frequency} * {frequency} * {s} * {s}) * "
            sines.append(f"{factor}sin({frequency} * {c})")
            cosines.append(f"{factor}cos({frequency} * {c})")
    return in_fours([*(x.scalars() if op.raw else []), *sines, *cosines])


@SHADER.implements(ops.Transform)
def _transform(op: ops.Transform, code: Code, x: Value) -> list[str]:
    scale = op.scale
    if op.divisor is not None:
        divisor = code.scalar(op.divisor)
        scale *= 1.0 / divisor if divisor > 0 else 0.0
    factor = "" if op.factor is None else f"{number(code.scalar(op.factor))} * "
    argument = "{}" if scale == 1.0 else f"({number(scale)} * {{}})"
    bounded = "{}" if op.most is None else f"min({{}}, {number(code.scalar(op.most))})"
    found = [FUNCTIONS[op.function].format(argument.format(v)) for v in x.vectors()]
    return [factor + bounded.format(v) for v in found]


@SHADER.implements(ops.Matrix)
def _matrix(op: ops.Matrix, code: Code, x: Value) -> list[str]:
    terms = [[number(a) for a in row] for row in op.rows]
    return in_fours([" + ".join(f"{a} * {n}" for a, n in zip(t, x.scalars(), strict=True)) for t in terms])


@SHADER.implements(ops.Gate)
def _gate(op: ops.Gate, code: Code, gate: Value, x: Value, plus: Value | None) -> list[str]:
    gates = gate.vectors() if len(gate) > 1 else [str(gate)] * len(x.vectors())
    addends = [""] * len(gates) if plus is None else [f" + {v}" for v in plus.vectors()]
    if op.unit is not None and not code.scalar(op.unit) > 0:
        zeros = in_fours(["0.0"] * len(x))
        return [zero + addend for zero, addend in zip(zeros, addends, strict=True)]
    shares = (f"({number(op.floor)} + {number(op.scale)} / (1.0 + exp(-{g})))" for g in gates)
    return [f"{s} * {v}{a}" for s, v, a in zip(shares, x.vectors(), addends, strict=True)]


@SHADER.implements(ops.Standardize)
def _standardize(op: ops.Standardize, code: Code, x: Value, mean: Value, deviation: Value) -> list[str]:
    parts = zip(mean.vectors(), deviation.vectors(), x.vectors(), strict=True)
    return [f"{m} + {d} * {v}" for m, d, v in parts]


@SHADER.implements(ops.DivideByCosine)
def _divide_by_cosine(op: ops.DivideByCosine, code: Code, x: Value, omega: Value) -> list[str]:
    return [f"{v} / max({omega[2:]}, {number(op.least)})" for v in x.vectors()]


@SHADER.implements(ops.Calibrate)
def _calibrate(op: ops.Calibrate, code: Code, level: Value, omega: Value) -> str:
    _, levels, knots, _ = code.tensors[op.factors].shape
    table = code.image(op.factors, "rows")
    return f"interpolated({table}, int2({knots}, {levels}), {op.table * levels}, {level}, {omega[2:]})"


@SHADER.implements(ops.Product)
def _product(op: ops.Product, code: Code, x: Sequence[Value]) -> list[str]:
    return [" * ".join(parts) for parts in zip(*(value.vectors() for value in x), strict=True)]
