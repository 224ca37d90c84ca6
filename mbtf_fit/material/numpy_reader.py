"""Evaluates a fitted material, query by query, from material.json and weights.safetensors alone.

This file needs nothing of the project. Exports are checked by it.
"""

# mypy: ignore-errors

import json
import math
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from safetensors.numpy import load_file
from scipy.special import erf, expit

ACTIVATIONS = {"relu": lambda x: np.maximum(x, 0), "leaky-relu": lambda x: np.maximum(x, x / 100)}
ACTIVATIONS["sine"] = np.sin
FUNCTIONS = {name: getattr(np, name) for name in ("exp", "expm1", "log1p", "square")}
FUNCTIONS |= {"identity": np.positive, "sigmoid": expit, "softplus": lambda x: np.logaddexp(0, x)}
FUNCTIONS["fourth-root"] = lambda x: x * abs(x) ** 3
OPERATIONS = {
    "half_vector": lambda omega_i, omega_o: unit(omega_i + omega_o),
    "stereographic": lambda omega: omega[:2] / (1 + omega[2]),
    "position": lambda u: 2 * (u % 1) - 1,
    "transform": lambda x, function, scale, divisor=1.0, factor=1.0, most=np.inf: (
        factor * np.minimum(FUNCTIONS[function](scale * (x / divisor if divisor else 0 * x)), most)
    ),
    "matrix": lambda x, rows: np.array(rows) @ x,
    "gate": lambda gate, x, floor, scale, plus=0.0, unit=1.0: (
        (floor + scale * expit(gate)) * x * (unit > 0) + plus
    ),
    "product": lambda x: x,
    "standardize": lambda x, mean, deviation: mean + deviation * x,
    "divide_by_cosine": lambda x, omega, least: x / max(omega[2], least),
}


def join(*x):
    return np.concatenate([np.broadcast_to(a, (*x[0].shape[:-1], a.shape[-1])) for a in x], -1)


def unit(x):
    return x / np.linalg.norm(x)


def corners(image, x):
    """The four neighbors of pixel coordinates x (column, row) in a periodic image, and x's fractions."""
    (i, j), fractions = np.moveaxis(np.floor(x).astype(int), -1, 0), np.moveaxis(x % 1, -1, 0)
    rows, columns = image.shape[:2]
    return [image[(j + b) % rows, (i + a) % columns] for b in (0, 1) for a in (0, 1)], fractions


def bilinear(texture, u):
    (a, b, c, d), f = corners(texture, (u * [1, -1] + [0, 1]) * texture.shape[1::-1] - 0.5)
    x, y = f[..., None]
    return (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)


def intersection(z, u, slope):
    """Height at which the line u + height · slope meets heights z (rows along v), the first from above."""
    start, step, deepest = u * z.shape[::-1] - 0.5, slope * z.shape[::-1], z.min()
    lines = [*zip(start, step, strict=True), (start.sum(), step.sum())]
    crossed = [(np.ceil(np.arange(*sorted((c, c + s * deepest)))) - c) / s for c, s in lines if s]
    heights = np.sort(np.concatenate([[0, deepest], *crossed]).clip(deepest, 0))[::-1]
    (a, b, c, d), (x, y) = corners(z, start + heights[:, None] * step)
    lower, upper = a + x * (b - a) + y * (c - a), d + (1 - x) * (c - d) + (1 - y) * (b - d)
    gap = heights - np.where(x + y < 1, lower, upper)
    k = max(1, np.argmax(gap <= 1e-12))
    return np.interp(0, gap[[k, k - 1]], heights[[k, k - 1]])


def normal(slopes):
    return unit(join(-slopes, np.ones(1)))


def fresnel(f0, cosine, f90=1):
    return f0 + (f90 - f0) * np.clip(1 - cosine, 0, 1) ** 5


def ggx(f0, alpha2, n, omega_i, omega_o, least):
    h, cosines = unit(omega_i + omega_o), np.maximum([n @ omega_i, n @ omega_o], least)
    facets = alpha2 / (np.pi * (max(0, n @ h) ** 2 * (alpha2 - 1) + 1) ** 2)
    masking = 2 * cosines.prod() * np.sqrt(1 + alpha2 * (1 / cosines**2 - 1)).sum()
    return fresnel(f0, omega_o @ h) * facets / masking


def projections(omega, center, matrix):
    p = omega[2] - center @ omega[:2]
    return np.array([p, np.sqrt(p**2 + omega[:2] @ matrix @ omega[:2])])


def shown(omega, center, matrix):
    return projections(omega, center, matrix).sum() / 2


def reflected(alpha2, c, spread, h, omega_o, light, least_view):
    middle = (1 - alpha2) / (1 + alpha2 * c @ c) * c
    facets = alpha2 * (1 + c @ c) / (1 + alpha2 * c @ c) * (np.eye(2) + np.outer(middle, c)) + spread
    own, width = (np.sqrt(max(1e-20, np.linalg.det(x))) for x in (facets, light))
    s, forms = h[:2] / h[2] + middle, []
    for matrix in facets + 2.5 * light, light + (0.6 + 0.5 / (own / width + 0.6)) * facets:
        forms += [np.sqrt(np.linalg.det(matrix)), s @ np.linalg.solve(matrix, s)]
    wide, d, narrow, e = forms
    density = own / wide**2 / (1 + d) ** 2 + (1 - own / wide) * np.exp(-e / 2) / (2 * narrow)
    return density / h[2] ** 4 / (4 * np.pi * max(shown(omega_o, middle, facets), least_view))


def light_widening(omega_i, omega_o, width):
    both = omega_i + omega_o
    s = -both[:2] / both[2]
    q = omega_i[:2] + omega_i[2] * s
    return (width / both[2]) ** 2 * (np.eye(2) + np.outer(s, s) - np.outer(q, q))


def left(f0, f90, alpha2, *cosines):
    added = alpha2 / (0.06 + 2.5 * np.sqrt(alpha2))
    t = 1 - np.sqrt(added)
    mean = 1 - f0 - (f90 - f0) * 2 * t**6 * (1 / 6 - t / 7) / (1 - added)
    return np.prod([1 - fresnel(f0, np.sqrt(x**2 + (1 - x**2) * added), f90) for x in cosines]), mean


def own_shadowing(alpha2, light, view):
    a, b = (np.sqrt(alpha2 + (1 - alpha2) * x**2) for x in (light, view))
    return light * (view + b) / (light * b + view * a)


def doubled_scatter(center, moments):
    xx, xy, yy = moments - np.outer(center, center)[[0, 0, 1], [0, 1, 1]]
    xx, yy = max(0, xx), max(0, yy)
    xy = np.clip(xy, -np.sqrt(xx * yy), np.sqrt(xx * yy))
    return 2 * np.array([[xx, xy], [xy, yy]])


def texels_of_blocks(blocks, rows, columns, _):
    """Numbers from 0 to 1 of BC4 blocks: two end points, and 3 bits per texel."""
    first, last = np.moveaxis(blocks[..., :2] / 255, -1, 0)[..., None]
    bits = np.unpackbits(blocks[..., 2:], axis=-1, bitorder="little")
    code = bits.reshape(*bits.shape[:-1], 16, 3) @ [1, 2, 4]
    step = np.array([0, 7, 1, 2, 3, 4, 5, 6])[code] / 7
    texels = (first + (last - first) * step).reshape(*code.shape[:-1], 4, 4).transpose(0, 3, 1, 4, 2)
    return texels.reshape(4 * len(blocks), -1, blocks.shape[2])[:rows, :columns]


class NumpyMaterial:
    """Content of material.json, and arrays by name; methods below `read` are operations."""

    def __init__(self, about, tensors):
        self.finest, self.operations = about["levels"]["finest"], about["operations"]
        self.scale = np.array([1, about["tile"]["aspect"]])
        self.tensors = {name: np.asarray(x, float) for name, x in tensors.items()}

    @classmethod
    def load(cls, folder):
        about = json.loads(Path(folder, "material.json").read_text())
        stored, tensors = load_file(Path(folder, "weights.safetensors")), {}
        for name, shape in about["weights"]["shapes"].items():
            tensors[name] = stored[name]
            if stored[name].dtype.kind == "u":
                low, high = stored[name.rstrip("0123456789").rstrip(".") + ".range"].astype(float)
                blocks = stored[name].ndim == 4
                largest = 1 if blocks else np.iinfo(stored[name].dtype).max
                share = (texels_of_blocks(stored[name], *shape) if blocks else stored[name]) / largest
                tensors[name] = np.float32(low + (high - low) * share)
        return cls(about, tensors)

    def evaluate(self, u, sigma, omega_i, omega_o):
        level = np.clip(-np.log2(2.0 * sigma), 0, self.finest)[:, None]
        return np.array([*map(self.evaluate_query, u, level, omega_i, omega_o)])

    def evaluate_query(self, *query):
        self.values = dict(zip(("u", "level", "omega_i", "omega_o"), map(np.float64, query), strict=True))
        for fields in map(dict, self.operations):
            kind, name = fields.pop("operation"), fields.pop("output")
            execute = OPERATIONS.get(kind) or getattr(self, kind, None)
            if execute is None:
                raise NotImplementedError(f"NumPy does not support the operation '{kind}'")
            if kind == "product":
                fields["x"] = math.prod(map(self.read, fields["x"]))
            self.values[name] = execute(**{key: self.read(x) for key, x in fields.items()})
        return np.maximum(self.values[name], 0)

    def read(self, x):
        """A field: a value `name` or `name[a:b]`, several of them, a tensor, or anything else."""
        if isinstance(x, list) and x and isinstance(x[0], str):
            return join(*map(self.read, x))
        name, _, part = x.partition("[") if isinstance(x, str) else ("", "", "")
        if name not in self.values:
            return self.tensors.get(x, x) if isinstance(x, str) else x
        return self.values[name][..., slice(*map(int, part[:-1].split(":"))) if part else slice(None)]

    def lookup(self, u, level, textures, finer=0, **_):
        levels = [x for name, x in self.tensors.items() if name.startswith(f"{textures}.")]
        at = np.clip((level or 0) + finer, 0, len(levels) - 1)
        weights = np.maximum(0, 1 - abs(at - range(len(levels))))
        return sum(w * bilinear(x, u) for w, x in zip(weights, levels, strict=True) if w)

    def neighborhood(self, u, level, margin):
        columns, steps = 2 ** np.floor(level + 0.5), np.arange(-margin, margin + 1)
        size = join(columns, np.maximum(1, np.round(self.scale[1] * columns)))
        return u + np.stack(np.meshgrid(steps, -steps), -1) / size

    def offset(self, u, r, omega_o, scale, grazing):
        r = r if r.shape[-1] == 2 else r * omega_o[:2] / max(omega_o[2], grazing)
        return u + scale * r / self.scale

    def trace(self, hits, depths, u, level, omega_o, heights, places, **_):
        along = unit(omega_o[:2]) if omega_o[:2].any() else np.array([1, 0])
        across, slope = along[::-1] * [-1, 1], omega_o[:2] / omega_o[2] / self.scale
        starts = [u + 0.5 ** (level + 1) * (a * across + b * along) / self.scale for a, b in places]
        z = [intersection(heights[::-1, :, 0], x, slope) for x in starts]
        self.values[hits] = join(*(x + h * slope for x, h in zip(starts, z, strict=True)))
        self.values[depths] = np.array(z)
        return np.mean(z, keepdims=True)

    def displace(self, u, z, level, omega_o, weights):
        return u + np.interp(level, range(len(weights)), weights) * z * omega_o[:2] / omega_o[2] / self.scale

    def surface_maps(self, u, level, maps, finer, **_):
        return self.lookup(u, level + finer, maps)

    def shade(self, hits, level, omega_i, omega_o, maps, horizons, light_width, dielectric, finer, light_blur,
              least_view, least_variance, alpha2, light_depth, depths=None, heights=None, **_):  # fmt: skip
        hints = []
        for k, hit in enumerate(hits.reshape(-1, 2)):
            known, horizon = (self.lookup(hit, level + finer, textures) for textures in (maps, horizons))
            azimuth, moments = np.arctan2(*omega_i[1::-1]) / (2 * np.pi), horizon.reshape(2, -1)
            count = moments.shape[1]
            mean, square = (np.interp(azimuth * count, range(count), x, period=count) for x in moments)
            variance = max(0, square - mean**2) + (light_blur * light_width) ** 2
            over = (np.arcsin(omega_i[2]) - mean) / np.sqrt(2 * max(variance, least_variance))
            seen = 0.5 + 0.5 * erf(over)
            if heights is not None:
                slope = omega_i[:2] / omega_i[2] / self.scale
                first = intersection(heights[::-1, :, 0], hit - depths[k] * slope, slope)
                below = max(0, first - depths[k]) / omega_i[2]
                seen = 0.5 * (seen + np.exp(-below / light_depth))
            light, c, n, base = seen / omega_i[2], known[:2], normal(known[:2]), known[5:8]
            spread = doubled_scatter(c, known[2:5])
            irradiance = light * n[2] * shown(omega_i, c, spread)
            core, h = irradiance * base / np.pi, unit(omega_i + omega_o)
            widening = light_widening(omega_i, omega_o, light_width)
            shared = c, spread, h, omega_o, widening, least_view
            cosines = [min(1, n[2] * projections(omega, c, spread)[1]) for omega in (omega_i, omega_o)]
            if len(known) >= 10:
                metal, grazing = known[9], min(1, 50 * dielectric)
                f = fresnel(
                    dielectric + metal * (base - dielectric), omega_o @ h, grazing + metal * (1 - grazing)
                )
                rough = np.clip(known[8], *alpha2)
                below, mean = left(dielectric, grazing, rough, *cosines)
                lobe = light * own_shadowing(rough, *cosines) * reflected(rough, *shared)
                core = (1 - metal) * below / mean * core + f * lobe
            if len(known) == 12:
                weight, rough = known[10], np.clip(known[11], *alpha2)
                lobe = light * own_shadowing(rough, *cosines) * reflected(rough, *shared)
                core = left(0.04 * weight, weight, rough, *cosines)[0] * core
                core = core + weight * fresnel(0.04, omega_o @ h) * lobe
            hints.append(np.array([irradiance, *n[:2], *core]))
        return np.mean(hints, 0)

    def fiber_frame(self, hits, level, omega_i, omega_o, maps, finer, least_tangents, least_cosine,
                    least_variance):  # fmt: skip
        found, h = [], omega_i + omega_o
        for hit in hits.reshape(-1, 2):
            known = self.lookup(hit, level + finer, maps)
            t, v = known[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]], known[6]
            c = max(0, np.trace(t))
            mean = axis = t / max(c, least_tangents)
            for _ in range(3):
                axis = axis @ axis / max(np.trace(axis @ axis), 1e-12)
            si, so = (np.clip(w @ axis @ w, 0, 1) for w in (omega_i, omega_o))
            both = omega_i @ axis @ omega_o
            cosines = max(np.sqrt((1 - si) * (1 - so)), least_cosine)
            off = si + so + 2 * both
            spread = max(0, h @ mean @ h - off * np.trace(mean @ axis))
            w = max(v / max(c, least_tangents) + spread, least_variance)
            lobe = c * np.exp(-off / (2 * w)) / np.sqrt(2 * np.pi * w)
            found.append([lobe, np.clip((omega_i @ omega_o - both) / cosines, -1, 1), si, so, both, c])
        return np.mean(found, 0)

    def lobe(
        self,
        base_color,
        specular,
        alpha2,
        slopes,
        omega_i,
        omega_o,
        least_alpha2,
        least_light,
        least_view,
        weight=1,
    ):
        n, least = normal(slopes), [least_light, least_view]
        lobe = weight * ggx(specular, max(alpha2, least_alpha2), n, omega_i, omega_o, least)
        return max(0, n @ omega_i) / omega_i[2] * (base_color / np.pi + lobe)

    def rotate(self, axis, omega):
        xy, t = axis[:2], axis[:2] @ omega[:2]
        z = axis[2] if len(axis) == 3 else np.sqrt(max(0, 1 - xy @ xy))
        return np.array([*omega[:2] - xy * (omega[2] + t / (1 + z)), z * omega[2] + t])

    def to_frame(self, axes, omega, shortest):
        x, _, z = np.eye(3)
        n, toward = axes[:3] + z, axes[3:] + x
        n = n / max(np.sqrt(n @ n), shortest)
        t = toward - (toward @ n) * n
        t = t / max(np.sqrt(t @ t), shortest * (1 + np.sqrt(toward @ toward)))
        return np.array([t, np.cross(n, t), n]) @ omega

    def frequencies(self, x, level, bands, pi, raw, attenuated):
        f = 2.0 ** np.arange(bands) * (np.pi if pi else 1)
        left = 1 if level is None else np.exp(-(((0.5**level / self.scale)[:, None] * f) ** 2) / 2)
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
            return activate(np.einsum("rcikl,oikl->rco", sliding_window_view(x, w.shape[2:], (0, 1)), w) + b)

        x = convolved(join(features, shared), "first")
        for k in range(modules):
            largest = sliding_window_view(x, (3, 3), (0, 1)).max((-2, -1))[1:-1, 1:-1]
            one, three = convolved(x, f"{k}.one")[2:-2, 2:-2], convolved(x, f"{k}.before3")[1:-1, 1:-1]
            five = convolved(convolved(x, f"{k}.before5"), f"{k}.five")
            x = join(one, convolved(three, f"{k}.three"), five, convolved(largest, f"{k}.pooled"))
        return convolved(x, "last", np.positive)[0, 0]

    def calibrate(self, level, omega, factors, table):
        _, levels, knots, _ = factors.shape
        at = (level.clip(0, levels - 1), levels), (omega[2:].clip(0, 1) * (knots - 1), knots)
        rows, columns = (np.maximum(0, 1 - abs(x - np.arange(n))) for x, n in at)
        return np.einsum("s,k,skc->c", rows, columns, factors[table])
