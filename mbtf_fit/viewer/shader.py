"""Shader code of a material: constants, network layers, and the order of the decoder's inputs.

What all models share is written in ``page/material.glsl``; this module generates the rest in its place. A
number of the weights is part of a vector of four: for each four outputs of a layer their biases, then, for
each four inputs, the columns of a 4 × 4 matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_fit.material.material import Material
from mbtf_fit.ops.constants import (
    ALPHA2,
    AZIMUTHS,
    DIELECTRIC,
    GATE,
    GRAZING,
    IRRADIANCE_SCALE,
    LEAK,
    LEAST_COSINE,
    LEAST_LIGHT,
    LEAST_VARIANCE,
    LEAST_VIEW,
    LIGHT_BLUR,
    LIGHT_WIDTH,
    MAX_CROSSINGS,
    OFFSET_SCALE,
    PLACES,
    RGB_OF_YUV,
    STATISTICS,
)
from mbtf_fit.sections import NetworkSection

F32 = NDArray[np.float32]
# Where the generated code stands in material.glsl.
_MARK = "//GENERATED"

# Operations that read neighborhoods of texels.
_REFUSED = ("neighborhood", "inception")

_ACTIVATIONS = {
    "relu": "max(sum, 0.0)",
    "leaky-relu": f"max(sum, {LEAK} * sum)",
    "sine": "sin(sum)",
    "none": "sum",
}
_TRANSFORMS = {
    "expm1": "exp(x) - 1.0",
    "exp": "exp(x)",
    "identity": "x",
    "softplus": "max(x, 0.0) + log(1.0 + exp(-abs(x)))",
    "fourth-root": "x * abs(x * x * x)",
}


def number(value: float) -> str:
    """A number as GLSL reads it back in single precision."""
    text = f"{float(np.float32(value)):.9g}"
    return text if any(c in text for c in ".en") else f"{text}.0"


def vector(values: Sequence[float]) -> str:
    """A GLSL vector."""
    return f"vec{len(values)}({', '.join(map(number, values))})"


def _array(kind: str, values: Sequence[str]) -> str:
    return f"{kind}[{len(values)}]({', '.join(values)})"


def _integers(name: str, values: Sequence[int]) -> str:
    return f"const int {name}[{len(values)}] = {_array('int', list(map(str, values)))};"


@dataclass
class Weights:
    """Weights of the networks, in vectors of four."""

    vectors: list[F32] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Vectors so far."""
        return sum(len(v) for v in self.vectors)

    def add(self, weight: F32, bias: F32) -> int:
        """Append a layer and return the index of its first vector."""
        first = self.count
        outputs, inputs = (-(-n // 4) for n in weight.shape)
        padded = np.zeros((4 * outputs, 4 * inputs), np.float32)
        padded[: weight.shape[0], : weight.shape[1]] = weight
        biases = np.zeros(4 * outputs, np.float32)
        biases[: len(bias)] = bias
        columns = padded.reshape(outputs, 4, 4 * inputs).transpose(0, 2, 1)
        both = np.concatenate([biases.reshape(outputs, 1, 4), columns], 1)
        self.vectors.append(both.reshape(-1, 4))
        return first

    def array(self) -> F32:
        """All vectors (n, 4); one of zeros where there is no network."""
        return np.concatenate(self.vectors or [np.zeros((1, 4), np.float32)])


def _encoded(
    coordinates: Sequence[str],
    bands: int,
    pi: bool,
    network: NetworkSection,
    spreads: Sequence[str] | None = None,
) -> list[str]:
    """Expressions of encoded coordinates (mbtf_fit.pytorch.operations)."""
    if not bands:
        return list(coordinates)
    options = network.encoding
    sines, cosines = [], []
    for n, p in enumerate(coordinates):
        for k in range(bands):
            frequency = number(2.0**k * (np.pi if pi else 1.0))
            factor = f"{number(2.0**-k)} * " if options.band_attenuation else ""
            if spreads is not None:
                factor += f"exp(-0.5 * {frequency} * {frequency} * {spreads[n]} * {spreads[n]}) * "
            sines.append(f"{factor}sin({frequency} * {p})")
            cosines.append(f"{factor}cos({frequency} * {p})")
    return [*(coordinates if options.raw else []), *sines, *cosines]


def _components(name: str, count: int) -> list[str]:
    """The first numbers of an array of vectors."""
    return [f"{name}[{k // 4}].{'xyzw'[k % 4]}" for k in range(count)]


class ShaderSource:
    """GLSL of a material and the weights that it reads.

    Parameters
    ----------
    material : Material

    Attributes
    ----------
    weights : Weights

    Raises
    ------
    InputError
        The model reads neighborhoods of texels, which the shader does not.
    """

    def __init__(self, material: Material) -> None:
        for operation in material.model.operations:
            if operation.kind() in _REFUSED:
                raise InputError(
                    f"the shaders do not support the operation '{operation.kind()}'",
                    hint="fit the material with --model relief, neumip+ or neumip",
                )
        self._material = material
        self._network = material.config.network
        tensors = material.model.weights()
        self._tensors = {name: t.cpu().float().numpy() for name, t in tensors.items()}
        self.weights = Weights()

    def text(self) -> str:
        """The source: definitions, then ``material.glsl`` with the generated functions."""
        shared = files(__package__).joinpath("page/material.glsl").read_text()
        functions = [*self._offset(), *self._decode()]
        constants = self._constants()
        head, tail = shared.split(_MARK)
        return "\n".join([*constants, head, *functions, tail])

    def _levels(self, name: str) -> list[str]:
        """Columns, rows and first row of each level of a texture, coarsest first."""
        out, start = [], 0
        for level in range(self._count(name)):
            rows, columns = self._tensors[f"{name}.{level}"].shape[:2]
            out.append(f"ivec3({columns}, {rows}, {start})")
            start += rows
        return out

    def _count(self, name: str) -> int:
        return sum(key.startswith(f"{name}.") for key in self._tensors)

    def _constants(self) -> list[str]:
        tensors, lattice, network = self._tensors, self._material.lattice, self._network
        channels = tensors["pyramid.0"].shape[2]
        layers = -(-channels // 4)
        concatenated = network.blending == "concatenate"
        out = [
            f"#define LEVELS {lattice.finest + 1}",
            f"const float ASPECT = {number(lattice.aspect)};",
            *self._pyramid("PYRAMID", "pyramid"),
            f"#define PYRAMID_LAYERS {layers}",
            f"#define FEATURE_VECTORS {layers * (2 if concatenated else 1)}",
            *(["#define CONCATENATE"] if concatenated else []),
            f"const float OFFSET_SCALE = {number(OFFSET_SCALE)};",
        ]
        if network.offset != "none":
            rows, columns = tensors["offset_texture.0"].shape[:2]
            out += ["#define OFFSET_OUTPUTS", f"#define OFFSET_SIZE {columns}, {rows}"]
        if "calibration" in tensors:
            out.append(f"#define CALIBRATION_KNOTS {tensors['calibration'].shape[2]}")
        if self._material.transmittance is not None:
            shapes, start = [], 0
            for texels in self._material.transmittance.levels:
                shapes.append(f"ivec3({texels.shape[1]}, {texels.shape[0]}, {start})")
                start += texels.shape[0]
            out.append(f"#define TRANSMITTANCE_COUNT {len(shapes)}")
            out.append(f"const ivec3 TRANSMITTANCE_LEVELS[{len(shapes)}] = {_array('ivec3', shapes)};")
        if LIGHT_WIDTH in tensors:
            out += self._surface_constants()
        return out

    def _pyramid(self, prefix: str, name: str) -> list[str]:
        levels = self._levels(name)
        return [
            f"#define {prefix}_COUNT {len(levels)}",
            f"const ivec3 {prefix}_LEVELS[{len(levels)}] = {_array('ivec3', levels)};",
        ]

    def _surface_constants(self) -> list[str]:
        tensors = self._tensors
        offsets, finer = PLACES[self._network.relief.places]
        rows, columns = tensors["surface.heights"].shape[:2]
        blocks = node_blocks(rows, columns)
        width = float(tensors[LIGHT_WIDTH])
        weights = [number(w) for w in tensors["depth_weights"]]
        return [
            f"#define PLACES {len(offsets)}",
            f"const vec2 PLACE_OFFSETS[{len(offsets)}] = {_array('vec2', [vector(o) for o in offsets])};",
            f"const float PLACES_FINER = {number(finer)};",
            *self._pyramid("MAP", "surface.maps"),
            *self._pyramid("HORIZON", "surface.horizons"),
            *(["#define GLOSSY"] if tensors["surface.maps.0"].shape[2] > 6 else []),
            f"#define AZIMUTHS {AZIMUTHS}",
            f"#define MAX_CROSSINGS {MAX_CROSSINGS}",
            f"const ivec2 HEIGHT_SIZE = ivec2({columns}, {rows});",
            f"#define NODE_SHIFT {NODE_SHIFT}",
            f"#define NODE_COLUMNS {1 << NODE_SHIFT}",
            f"#define BLOCK_LEVELS {len(blocks)}",
            _integers("BLOCK_STARTS", [0, *(start for start, _ in blocks)]),
            _integers("BLOCK_STRIDES", [columns, *(stride for _, stride in blocks)]),
            f"const float LIGHT_WIDTH = {number(width)};",
            f"const float HORIZON_VARIANCE = {number((LIGHT_BLUR * width) ** 2)};",
            f"const float LEAST_VARIANCE = {number(LEAST_VARIANCE)};",
            f"const float LEAST_LIGHT = {number(LEAST_LIGHT)};",
            f"const float LEAST_VIEW = {number(LEAST_VIEW)};",
            f"const float ALPHA2_LOW = {number(ALPHA2[0])};",
            f"const float ALPHA2_HIGH = {number(ALPHA2[1])};",
            f"const float DIELECTRIC = {number(float(tensors[DIELECTRIC]))};",
            f"const float DEPTH_WEIGHTS[{len(weights)}] = {_array('float', weights)};",
        ]

    def _layers(self, network: str, inputs: Sequence[str]) -> list[str]:
        """Statements that evaluate a network; its outputs are in the array ``h``, last index at the end."""
        names = [n for n in self._tensors if n.startswith(f"{network}.") and n.endswith(".weight")]
        padded = [*inputs, *["0.0"] * (-len(inputs) % 4)]
        groups = [", ".join(padded[k : k + 4]) for k in range(0, len(padded), 4)]
        out = [f"  vec4 h0[{len(groups)}];"]
        out += [f"  h0[{k}] = vec4({group});" for k, group in enumerate(groups)]
        for n, name in enumerate(names):
            weight = self._tensors[name]
            bias = self._tensors[name.removesuffix("weight") + "bias"]
            first = self.weights.add(weight, bias)
            outputs, read = (-(-size // 4) for size in weight.shape)
            activation = _ACTIVATIONS["none" if n == len(names) - 1 else self._network.activation]
            # Unrolled code is slower in software rendering, and takes long to compile.
            out += [
                f"  vec4 h{n + 1}[{outputs}];",
                f"  for (int o = 0; o < {outputs}; o++) {{",
                f"    int at = {first} + o * {1 + 4 * read};",
                "    vec4 sum = WEIGHT(at);",
                f"    for (int i = 0; i < {read}; i++) {{",
                f"      vec4 x = h{n}[i];",
                "      int k = at + 4 * i;",
                "      sum += WEIGHT(k + 1) * x.x + WEIGHT(k + 2) * x.y + WEIGHT(k + 3) * x.z + "
                "WEIGHT(k + 4) * x.w;",
                "    }",
                f"    h{n + 1}[o] = {activation};",
                "  }",
            ]
        self._last = f"h{len(names)}"
        return out

    def _offset(self) -> list[str]:
        """Function ``offset_network``: displacement in tile widths."""
        network = self._network
        if network.offset == "none":
            return []
        channels = self._tensors["offset_texture.0"].shape[2]
        layers = -(-channels // 4)
        inputs = [*_components("t", channels), "omega_o.x", "omega_o.y"]
        depth = f"vec2({{0}}[0].x) * omega_o.xy / max(omega_o.z, {number(GRAZING)})"
        body = self._layers("offset_network", inputs)
        result = (depth if network.offset == "depth" else "{0}[0].xy").format(self._last)
        return [
            "vec2 offset_network(Corners c, vec3 omega_o) {",
            f"  vec4 t[{layers}];",
            f"  for (int k = 0; k < {layers}; k++) t[k] = bilinear(offset_texture, c, k);",
            *body,
            f"  return {result};",
            "}",
        ]

    def _decode(self) -> list[str]:
        """Function ``decode``: value in 1/sr without calibration, not clamped."""
        unit = float(self._tensors["unit"])
        body = ["  return vec3(0.0);"]
        if unit > 0:
            sliced = any(op.kind() == "standardize" for op in self._material.model.operations)
            body = self._slices(unit) if sliced else self._decoder(unit)
        return [
            "vec3 decode(Seen seen, vec3 omega_i, vec3 omega_o, vec3 half_vector, vec3 known, vec3 core) {",
            *body,
            "}",
        ]

    def _decoder(self, unit: float) -> list[str]:
        network, encoding = self._network, self._network.encoding
        channels = self._tensors["pyramid.0"].shape[2]
        statements: list[str] = []
        inputs = _components("seen.features", channels)
        if network.blending == "concatenate":
            layers = -(-channels // 4)
            inputs += _components("seen.features", 4 * layers + channels)[4 * layers :]
        if encoding.position:
            statements += [
                "  vec2 position = 2.0 * seen.u - 1.0;",
                "  vec2 spread = exp2(-seen.level) / vec2(1.0, ASPECT);",
            ]
            spreads = ["spread.x", "spread.y"] if encoding.footprint_filtered else None
            inputs += _encoded(["position.x", "position.y"], encoding.position, encoding.pi, network, spreads)
        axes = "xyz" if encoding.direction_xyz else "xy"
        for omega in ("omega_i", "omega_o"):
            coordinates = [f"{omega}.{axis}" for axis in axes]
            inputs += _encoded(coordinates, encoding.direction, encoding.direction_pi, network)
        if encoding.half_vector:
            statements.append("  vec3 difference = rotate_to_z(half_vector, omega_i);")
            inputs += [f"{name}.{axis}" for name in ("half_vector", "difference") for axis in "xyz"]
        traced = LIGHT_WIDTH in self._tensors
        if traced and network.relief.hints:
            statements.append(f"  vec3 lit = log(1.0 + core / {number(unit)});")
            inputs.append(f"log(1.0 + {number(IRRADIANCE_SCALE)} * known.x)")
            inputs += ["known.y", "known.z", "lit.x", "lit.y", "lit.z"]
        if traced and network.relief.frame:
            statements += [
                "  vec3 normal = vec3(known.yz, sqrt(max(0.0, 1.0 - dot(known.yz, known.yz))));",
                "  vec3 light_there = rotate_to_z(normal, omega_i);",
                "  vec3 view_there = rotate_to_z(normal, omega_o);",
            ]
            inputs += [f"{name}.{axis}" for name in ("light_there", "view_there") for axis in "xyz"]
        statements += self._layers("decoder", inputs)
        last, count = self._last, network.output_channels
        statements += [f"  vec3 x = {last}[0].xyz;"]
        factor = number(unit)
        if count == 6:
            rows = [f"dot(x, {vector(row)})" for row in RGB_OF_YUV]
            statements += [
                f"  vec3 y = vec3({last}[0].w, {last}[1].xy);",
                f"  x = vec3({', '.join(rows)});",
                f"  vec3 scale = {factor} * ({number(GATE)} + 1.0 / (1.0 + exp(-y)));",
            ]
            factor = "scale"
        value = f"{factor} * ({_TRANSFORMS[network.output_transform]})"
        if traced and network.relief.gate:
            gate = _components(last, count + 1)[count]
            value += f" + 2.0 / (1.0 + exp(-{gate})) * core"
        return [*statements, f"  return {value};"]

    def _slices(self, unit: float) -> list[str]:
        """Of the models of Rainer et al. (mbtf_fit.models.rainer)."""
        channels = self._tensors["pyramid.0"].shape[2]
        features = _components("seen.features", channels)
        latents, statistics = features[:-STATISTICS], features[-STATISTICS:]
        inputs = latents + [f"{w}.{axis} / (1.0 + {w}.z)" for w in ("omega_i", "omega_o") for axis in "xy"]
        mean, deviation = (f"vec3({', '.join(part)})" for part in (statistics[:3], statistics[3:]))
        return [
            *self._layers("decoder", inputs),
            f"  vec3 x = {mean} + {deviation} * {self._last}[0].xyz;",
            f"  return {number(unit)} * (exp(x) - 1.0) / max(omega_i.z, {number(LEAST_COSINE)});",
        ]


# Nodes of the height field per row of their texture, as a power of two.
NODE_SHIFT = 11


def node_blocks(rows: int, columns: int) -> list[tuple[int, int]]:
    """(first node, nodes per row) of the blocks of 2, 4, … cells, after the nodes of the cells
    (mbtf_core.height_planes)."""
    columns_log2, rows_log2 = (columns - 1).bit_length(), (rows - 1).bit_length()
    return [
        (rows * columns + (1 << (columns_log2 + rows_log2 - 2 * level)), 1 << (columns_log2 - level))
        for level in range(1, min(columns_log2, rows_log2) + 1)
    ]
