"""Evaluates a fitted material with NumPy, from material.json and weights.safetensors alone."""

import json
import math
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from safetensors.numpy import load_file

ACTIVATIONS = {
    "relu": lambda x: np.maximum(x, 0),
    "leaky-relu": lambda x: np.maximum(x, x / 100),
    "sine": np.sin,
}
FUNCTIONS = {
    "identity": np.positive,
    "exp": np.exp,
    "expm1": np.expm1,
    "log1p": np.log1p,
    "square": np.square,
}
FUNCTIONS["sigmoid"] = sigmoid = lambda x: 1 / (1 + np.exp(-x))
FUNCTIONS |= {"softplus": lambda x: np.logaddexp(0, x), "fourth-root": lambda x: x * abs(x) ** 3}


def dot(a, b):
    return (a * b).sum(-1, keepdims=True)


def join(*x):
    shape = np.broadcast_shapes(*(a.shape[:-1] for a in x))
    return np.concatenate([np.broadcast_to(a, (*shape, a.shape[-1])) for a in x], -1)


def normal_of(slopes):
    return join(-slopes, np.ones_like(slopes[..., :1])) / np.sqrt(1 + dot(slopes, slopes))


def bilinear(texture, u):
    size = np.array(texture.shape[1::-1])
    x = (u * [1, -1] + [0, 1]) * size - 0.5
    i = np.floor(x).astype(int)
    right, down = np.moveaxis(x - i, -1, 0)[..., None]
    (a, top), (b, low) = (np.moveaxis(k % size, -1, 0) for k in (i, i + 1))
    upper, lower = ((1 - right) * texture[row, a] + right * texture[row, b] for row in (top, low))
    return (1 - down) * upper + down * lower


def intersection(z, u, slope):
    """Height at which a line meets the heights z (row index along +v); it moves by `slope` (uv) per
    height."""
    size = np.array(z.shape[::-1])
    start, step, deepest = u * size - 0.5, slope * size, z.min()
    crossed = [(start[0], step[0]), (start[1], step[1]), (start.sum(), step.sum())]
    lines = [(np.arange(*sorted((c, c + s * deepest)), 1.0), c, s) for c, s in crossed]
    heights = [(np.ceil(n) - c) / s for n, c, s in lines if s and len(n)]
    heights = np.sort(np.concatenate([[0, deepest], *heights]).clip(deepest, 0))[::-1]
    at = start + heights[:, None] * step
    i, (x, y) = np.floor(at).astype(int), (at % 1).T
    (a, b), (c, d) = ([z[(i[:, 1] + k) % size[1], (i[:, 0] + j) % size[0]] for j in (0, 1)] for k in (0, 1))
    surface = np.where(x + y < 1, a + x * (b - a) + y * (c - a), d + (1 - x) * (c - d) + (1 - y) * (b - d))
    gap = heights - surface
    k = max(1, int(np.argmax(gap <= 1e-12)))
    share = gap[k - 1] / max(gap[k - 1] - gap[k], 1e-300) if gap[k - 1] > 0 else 0
    return heights[k - 1] + share * (heights[k] - heights[k - 1])


def ggx(f0, alpha2, n, light, view, omega_i, omega_o):
    h = (omega_i + omega_o) / np.linalg.norm(omega_i + omega_o, axis=-1, keepdims=True)
    facets = alpha2 / (np.pi * (np.maximum(0, dot(n, h)) ** 2 * (alpha2 - 1) + 1) ** 2)
    masking = sum(np.sqrt(1 + alpha2 * (1 / c**2 - 1)) for c in (light, view))
    return (f0 + (1 - f0) * (1 - dot(omega_o, h).clip(0, 1)) ** 5) * facets / (2 * masking * light * view)


class Material:
    """A folder made by mbtf-fit; each method below `read` is an operation, on (n, rows, columns, numbers)."""

    def __init__(self, folder):
        about = json.loads(Path(folder, "material.json").read_text())
        self.finest, self.operations = about["levels"]["finest"], about["operations"]
        self.scale = np.array([1.0, about["tile"]["aspect"]])
        stored = load_file(Path(folder, "weights.safetensors"))
        self.tensors = {name: tensor.astype(np.float64) for name, tensor in stored.items()}

    def evaluate(self, u, sigma, omega_i, omega_o):
        level = np.clip(-np.log2(2.0 * sigma), 0, self.finest)
        given = {"u": u, "level": level, "omega_i": omega_i, "omega_o": omega_o}
        self.values = {k: np.reshape(v, (len(u), 1, 1, -1)).astype(np.float64) for k, v in given.items()}
        for fields in map(dict, self.operations):
            kind, name = fields.pop("operation"), fields.pop("output")
            self.values[name] = getattr(self, kind)(**{key: self.read(x) for key, x in fields.items()})
        return np.maximum(self.values[name][:, 0, 0], 0)

    def read(self, x):
        """A field: a value `name` or `name[a:b]`, several of them, a tensor, or anything else."""
        if isinstance(x, list) and x and isinstance(x[0], str):
            return join(*map(self.read, x))
        name, _, part = x.partition("[") if isinstance(x, str) else ("", "", "")
        if name not in self.values:
            return self.tensors.get(x, x) if isinstance(x, str) else x
        return self.values[name][..., slice(*map(int, part[:-1].split(":"))) if part else slice(None)]

    def lookup(self, u, level, textures, blending="blend", **_):
        count = sum(name.startswith(f"{textures}.") for name in self.tensors)
        levels = range(1) if level is None else range(count)
        weights = [
            1.0 if level is None else np.maximum(0, 1 - abs(level.clip(0, count - 1) - s)) for s in levels
        ]
        parts = [
            w * bilinear(self.tensors[f"{textures}.{s}"], u) for s, w in zip(levels, weights, strict=True)
        ]
        return sum(parts) if blending == "blend" else join(sum(parts[::2]), sum(parts[1::2], 0 * parts[0]))

    def neighborhood(self, u, level, margin):
        columns, steps = 2 ** np.floor(level + 0.5), np.arange(-margin, margin + 1.0)
        i, j = np.meshgrid(steps, steps)
        return u + join(
            i[..., None] / columns, -j[..., None] / np.maximum(1, np.round(self.scale[1] * columns))
        )

    def offset(self, u, r, omega_o, scale, grazing):
        r = r if r.shape[-1] == 2 else r * omega_o[..., :2] / np.maximum(omega_o[..., 2:], grazing)
        return u + scale * r / self.scale

    def trace(self, hits, u, level, omega_o, heights, places, **_):
        length = np.linalg.norm(omega_o[..., :2], axis=-1, keepdims=True)
        along = np.where(length > 0, omega_o[..., :2] / np.maximum(length, 1e-300), [1.0, 0.0])
        across, slope = along[..., ::-1] * [-1, 1], omega_o[..., :2] / omega_o[..., 2:] / self.scale
        x = [u + 0.5 ** (level + 1) * (a * across + b * along) / self.scale for a, b in places]
        meet = np.vectorize(lambda p, s: intersection(heights[::-1, :, 0], p, s), signature="(k),(k)->()")
        z = [meet(at, slope)[..., None] for at in x]
        self.values[hits] = join(*(at + h * slope for at, h in zip(x, z, strict=True)))
        return sum(z) / len(z)

    def displace(self, u, z, level, omega_o, weights):
        weight = np.interp(level, np.arange(len(weights)), weights)
        return u + weight * z * omega_o[..., :2] / omega_o[..., 2:] / self.scale

    def shade(self, hits, level, omega_i, omega_o, maps, horizons, light_width, dielectric, finer, light_blur,
              least_light, least_view, least_variance, alpha2):  # fmt: skip
        total = 0
        for hit in np.split(hits, hits.shape[-1] // 2, -1):
            m, both = (self.lookup(hit, level + finer, textures) for textures in (maps, horizons))
            count = both.shape[-1] // 2
            x = np.arctan2(omega_i[..., 1:2] + 0.0, omega_i[..., :1] + 0.0) * count / (2 * np.pi)
            first = np.floor(x).astype(int)
            at = [
                np.take_along_axis(both[..., k : k + count], (first + s) % count, -1)
                for k in (0, count)
                for s in (0, 1)
            ]
            mean, square = (a + (x - first) * (b - a) for a, b in (at[:2], at[2:]))
            variance = np.maximum(0, square - mean**2) + (light_blur * light_width) ** 2
            over = (np.arcsin(omega_i[..., 2:]) - mean) / np.sqrt(2 * np.maximum(variance, least_variance))
            n, base = normal_of(m[..., :2]), m[..., 3:6]
            e = (0.5 + 0.5 * np.vectorize(math.erf)(over)) * np.maximum(0, dot(n, omega_i)) / omega_i[..., 2:]
            core = base / np.pi
            if m.shape[-1] == 8:
                metal, spread = m[..., 7:], np.maximum(0, m[..., 2:3] - dot(m[..., :2], m[..., :2]))
                a2, f0 = (
                    (m[..., 6:7] + spread + light_width**2).clip(*alpha2),
                    dielectric + metal * (base - dielectric),
                )
                cosines = np.maximum(dot(n, omega_i), least_light), np.maximum(dot(n, omega_o), least_view)
                core = (1 - metal) * core + ggx(f0, a2, n, *cosines, omega_i, omega_o)
            total = total + join(e, n[..., :2], e * core)
        return total / (hits.shape[-1] // 2)

    def lobe(
        self, base_color, specular, alpha2, slopes, omega_i, omega_o, least_alpha2, least_light, least_view
    ):
        n, alpha2 = normal_of(slopes), np.maximum(alpha2, least_alpha2)
        cosines = np.maximum(dot(n, omega_i), least_light), np.maximum(dot(n, omega_o), least_view)
        lobe = ggx(specular, alpha2, n, *cosines, omega_i, omega_o)
        return np.maximum(0, dot(n, omega_i)) / omega_i[..., 2:] * (base_color / np.pi + lobe)

    def half_vector(self, omega_i, omega_o):
        return (omega_i + omega_o) / np.linalg.norm(omega_i + omega_o, axis=-1, keepdims=True)

    def rotate(self, axis, omega):
        xy, t = axis[..., :2], dot(axis[..., :2], omega[..., :2])
        z = axis[..., 2:] if axis.shape[-1] == 3 else np.sqrt(np.maximum(0, 1 - dot(xy, xy)))
        return join(omega[..., :2] - xy * (omega[..., 2:] + t / (1 + z)), z * omega[..., 2:] + t)

    def stereographic(self, omega):
        return omega[..., :2] / (1 + omega[..., 2:])

    def position(self, u):
        return 2 * (u % 1) - 1

    def frequencies(self, x, level, bands, pi, raw, attenuated):
        f = 2.0 ** np.arange(bands) * (np.pi if pi else 1)
        left = 1 if level is None else np.exp(-(((0.5**level / self.scale)[..., None] * f) ** 2) / 2)
        left = left * (0.5 ** np.arange(bands) if attenuated else 1)
        parts = [(left * wave(x[..., None] * f)).reshape(*x.shape[:-1], -1) for wave in (np.sin, np.cos)]
        return join(*([x] if raw else []), *parts)

    def network(self, x, weights, hidden, activation, **_):
        for k in range(len(hidden) + 1):
            x = ACTIVATIONS[activation](x) if k else x
            x = x @ self.tensors[f"{weights}.{k}.weight"].T + self.tensors[f"{weights}.{k}.bias"]
        return x

    def inception(self, features, shared, weights, modules, activation, **_):
        def convolved(x, name, activate=ACTIVATIONS[activation]):
            w, b = (self.tensors[f"{weights}.{name}.{part}"] for part in ("weight", "bias"))
            patches = sliding_window_view(x, w.shape[2:], (1, 2))
            return activate(np.einsum("nrcikl,oikl->nrco", patches, w) + b)

        x = convolved(join(features, shared), "first")
        for k in range(modules):
            largest = sliding_window_view(x, (3, 3), (1, 2)).max((-2, -1))[:, 1:-1, 1:-1]
            one, three = convolved(x, f"{k}.one")[:, 2:-2, 2:-2], convolved(x, f"{k}.before3")[:, 1:-1, 1:-1]
            five = convolved(convolved(x, f"{k}.before5"), f"{k}.five")
            x = join(one, convolved(three, f"{k}.three"), five, convolved(largest, f"{k}.pooled"))
        return convolved(x, "last", np.positive)

    def transform(self, x, function, scale, divisor=1.0, factor=1.0):
        return factor * FUNCTIONS[function](scale * (x / divisor if divisor else 0 * x))

    def matrix(self, x, rows):
        return x @ np.transpose(rows)

    def gate(self, gate, x, floor, scale, plus=0.0, unit=1.0):
        return (floor + scale * sigmoid(gate)) * x * (unit > 0) + plus

    def standardize(self, x, mean, deviation):
        return mean + deviation * x

    def divide_by_cosine(self, x, omega, least):
        return x / np.maximum(omega[..., 2:], least)

    def calibrate(self, level, omega, factors, table):
        _, levels, knots, _ = factors.shape
        at = level.clip(0, levels - 1), omega[..., 2:].clip(0, 1) * (knots - 1)
        rows, columns = (
            np.maximum(0, 1 - abs(x - np.arange(n))) for x, n in zip(at, (levels, knots), strict=True)
        )
        return np.einsum("...s,...k,skc->...c", rows, columns, factors[table])

    def product(self, x):
        return np.prod(np.split(x, x.shape[-1] // 3, -1), 0)
