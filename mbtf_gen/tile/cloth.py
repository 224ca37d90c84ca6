"""Cloth → fibers: the tile that a :class:`~mbtf_gen.tile.fibers.cloth_file.ClothFile` describes."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, file_sha256
from mbtf_core.paths import named_file
from mbtf_gen.tile.fiber_tile import FiberScattering, FiberTile
from mbtf_gen.tile.fibers.cloth_file import ClothFile, YarnEntry
from mbtf_gen.tile.fibers.curve_file import read_curves
from mbtf_gen.tile.fibers.curves import LONGEST_SEGMENT, THINNEST, Bundle, Curve
from mbtf_gen.tile.fibers.draft import Weave
from mbtf_gen.tile.fibers.weave import knitted_lines, read_pattern, woven_lines
from mbtf_gen.tile.fibers.yarn import YARNS, CrossSection, YarnModel, count_segments, fibers_of, roughness_of

# Defaults that depend on the structure.
_WOVEN_WIDTH, _WOVEN_HEIGHT, _KNITTED_WIDTH = 0.95, 0.6, 0.45
# Radius of the fibers of a .bcc file, which has none, over the width of the period.
_CURVE_RADIUS = 0.002
# Distance in tile widths within which ends of curves count as the same place.
_AT_BORDER = 2e-3
# Periods that one fiber may reach over.
_MOST_PERIODS = 16
# Longer side of a tile over the shorter one.
_MOST_ASPECT = 64
# Spline segments of one period: they take two gigabytes.
MOST_SEGMENTS = 4_000_000


def cloth_tile(spec: ClothFile, folder: Path) -> FiberTile:
    """The tile of a cloth.

    Parameters
    ----------
    spec : what to make
    folder : folder that its file names are relative to

    Raises
    ------
    InputError : a file is unreadable, its curves do not tile, or there are too many fibers
    """
    tile = _fibers(spec, folder)
    files = {
        key: named_file(folder, name)
        for key in ("pattern", "curves")
        if (name := getattr(spec, key)) is not None
    }
    digests = {role: file_sha256(path) for role, path in files.items()}
    # What the defaults stand for changes the data as well.
    settings = spec.model_dump(mode="json", exclude={"pattern", "curves"})
    settings["scattering"] = [asdict(scattering) for scattering in tile.scattering]
    settings["longest_segment"] = LONGEST_SEGMENT
    settings["types"] = [asdict(YARNS[entry.type]) for entry in _kinds(spec).values()]
    digests["settings"] = data_sha256(settings)
    kind = next(key for key in ("weave", "knit", "pattern", "curves") if getattr(spec, key) is not None)
    named = f" of {files[kind].name}" if kind in files else ""
    note = (
        f"fibers: {len(tile.curves):,} with {tile.segments:,} segments ({kind}{named}), "
        f"{tile.thickness:.3g} tile widths thick"
    )
    return replace(tile, files=files, digests=digests, notes=(note,), resolution=spec.resolution)


def _kinds(spec: ClothFile) -> dict[str, YarnEntry]:
    """Kinds of yarns by name."""
    return {name: spec.yarn.updated(entry) for name, entry in spec.yarns.items()} or {"yarn": spec.yarn}


def _fibers(spec: ClothFile, folder: Path) -> FiberTile:
    rng = np.random.default_rng(spec.seed)
    where, woven = folder, None
    if spec.curves is not None:
        return _of_curves(spec, named_file(folder, spec.curves))
    if spec.pattern is not None:
        where = named_file(folder, spec.pattern)
        aspect, yarns = _of_pattern(spec, where)
    elif spec.knit is not None:
        aspect, yarns = _knitted(spec)
    else:
        woven = spec.woven
        aspect, yarns = _woven(spec, woven)
    _check_aspect(aspect, where)
    kinds = _kinds(spec)
    total = sum(count_segments(line, section, _model(kinds[name])) for line, section, name in yarns)
    if not total <= MOST_SEGMENTS:
        size = "" if woven is None else f" of {len(woven.warp)} warps and {len(woven.weft)} wefts"
        raise InputError(
            f"a tile{size} would have {total:.2g} fiber segments, more than {MOST_SEGMENTS:,}",
            where=where,
            hint="take fewer repeats or fibers, shorter sequences, or wider yarns",
        )
    curves: list[Curve] = []
    kind: list[int] = []
    for line, section, name in yarns:
        fibers = fibers_of(line, section, _model(kinds[name]), rng)
        curves += fibers
        kind += [list(kinds).index(name)] * len(fibers)
    return replace(_settled(aspect, curves, np.array(kind), spec, where), weave=woven)


# Center line, cross-section, and name of its kind.
_Yarn = tuple[Curve, CrossSection, str]


def _woven(spec: ClothFile, woven: Weave) -> tuple[float, list[_Yarn]]:
    rows, columns = woven.draft.shape
    sections = {
        name: _section(entry, 1.0 / columns, _WOVEN_WIDTH, _WOVEN_HEIGHT, True)
        for name, entry in _kinds(spec).items()
    }
    # Square crossings: yarns of both sets are equally far apart.
    aspect = rows / columns
    warp, weft = (np.array([sections[name].height for name in names]) for names in (woven.warp, woven.weft))
    warps, wefts = woven_lines(woven.draft, aspect, warp + weft[:, None])
    # From v = 0: the order of the random numbers.
    lines = zip([*warps, *wefts[::-1]], [*woven.warp, *woven.weft[::-1]], strict=True)
    return aspect, [(line, sections[name], name) for line, name in lines]


def _knitted(spec: ClothFile) -> tuple[float, list[_Yarn]]:
    knit = spec.knit
    assert knit is not None
    aspect = knit.aspect * knit.rows / knit.stitches
    section = _section(spec.yarn, 0.5 / knit.stitches, _KNITTED_WIDTH, 1.0, False)
    lines = knitted_lines(knit.stitches, knit.rows, aspect)
    return aspect, [(line, section, "yarn") for line in lines]


def _of_pattern(spec: ClothFile, path: Path) -> tuple[float, list[_Yarn]]:
    pattern = read_pattern(path)
    section = _section(spec.yarn, 2.0 * pattern.radius, 1.0, 1.0, False)
    period = np.array([1.0, pattern.aspect, 0.0])
    lines = [Curve.through(yarn.points, 0.0, np.append(yarn.shift, 0) * period) for yarn in pattern.yarns]
    return pattern.aspect, [(line, section, "yarn") for line in lines]


def _check_aspect(aspect: float, where: Path) -> None:
    if not 1 / _MOST_ASPECT <= aspect <= _MOST_ASPECT:
        raise InputError(
            f"the tile would be 1 x {aspect:.4g}; a side may be {_MOST_ASPECT} times as long as the other",
            where=where,
            hint="check the period, or the rows of the weave",
        )


def _settled(
    aspect: float, curves: list[Curve], kind: NDArray[np.int_], spec: ClothFile, where: Path
) -> FiberTile:
    """The tile with its fibers below the reference plane, unless they are too thick, too thin, or too many to
    be traced."""
    bundle, size = Bundle(curves), np.array([1.0, aspect])
    points, starts = bundle.points, bundle.starts
    span = np.maximum.reduceat(points[:, :2], starts) - np.minimum.reduceat(points[:, :2], starts)
    reach = (span + 2.0 * np.maximum.reduceat(points[:, 3:], starts)) / size
    # Tracing would never end.
    if not reach.max() <= _MOST_PERIODS:
        raise InputError(
            f"a fiber reaches over {reach.max():.3g} periods, more than {_MOST_PERIODS}",
            where=where,
            hint="check radii, widths and the period",
        )
    low, high = bundle.heights()
    radius, least = points[:, 3].min(), THINNEST * max(1.0, aspect, high - low)
    if radius < least:
        raise InputError(
            f"a fiber has a radius of {radius:.2g} tile widths; rays miss those thinner than {least:.2g}",
            where=where,
            hint="set a larger 'yarn.radius', which is a factor, or make a smaller tile",
        )
    total = float(np.exp2(bundle.halvings()) @ np.bincount(bundle.owner))
    if total > MOST_SEGMENTS:
        raise InputError(
            f"has {total:.3g} fiber segments of at most {LONGEST_SEGMENT:g} radii, more than "
            f"{MOST_SEGMENTS:,}",
            where=where,
            hint="take fewer or thicker fibers, or a smaller tile",
        )
    kinds = _kinds(spec)
    colors = np.array([entry.color for entry in kinds.values()])
    scattering = tuple(map(_scattering, kinds.values()))
    return replace(FiberTile.settled(aspect, curves, kind, colors, scattering), names=tuple(kinds))


def _section(entry: YarnEntry, space: float, width: float, height: float, flat: bool) -> CrossSection:
    half = 0.5 * space * (entry.width or width)
    return CrossSection(half, half * (entry.height or height), flat)


def _model(entry: YarnEntry) -> YarnModel:
    model = YARNS[entry.type]
    return replace(
        model,
        fibers=entry.fibers or model.fibers,
        fiber_radius=model.fiber_radius * entry.radius,
        loops=model.loops * entry.flyaways,
        hairs=model.hairs * entry.flyaways,
    )


def _scattering(entry: YarnEntry) -> FiberScattering:
    along, around = roughness_of(entry.type)
    return FiberScattering(
        along if entry.roughness is None else entry.roughness,
        around if entry.azimuthal_roughness is None else entry.azimuthal_roughness,
        entry.scale_tilt,
        entry.ior,
    )


def _of_curves(spec: ClothFile, path: Path) -> FiberTile:
    curves, deviation = read_curves(path)
    bundle = Bundle(curves)
    ends = np.concatenate([bundle.at(v)[0][:, :3] for v in (0.0, 1.0)])
    low, high = ends.min(axis=0), ends.max(axis=0)
    width, height = spec.period or (high[0] - low[0], high[1] - low[1])
    if not (width > 0 and height > 0):
        raise InputError("its curves have no extent along x or y", where=path, hint="give their 'period'")
    if ((high - low)[:2] > 3.0 * np.array([width, height])).any():
        raise InputError(
            f"its curves reach over {high[0] - low[0]:.4g} x {high[1] - low[1]:.4g}, more than three periods",
            where=path,
            hint="check 'period'",
        )
    _check_aspect(height / width, path)
    radius = _CURVE_RADIUS * spec.yarn.radius
    out = []
    for curve in curves:
        control = curve.control.copy()
        control[:, :3] = (control[:, :3] - low) / width
        control[:, 3] = np.where(control[:, 3] > 0, control[:, 3] / width * spec.yarn.radius, radius)
        out.append(replace(curve, control=control))
    tile = _settled(height / width, out, np.zeros(len(out), int), spec, path)
    warnings = []
    if deviation / width > radius:
        what = f"splines deviate from its curves by up to {deviation / width:.2g} tile widths"
        warnings.append(f"{path}: {what}, more than the radius; give more points")
    if loose := loose_ends(tile):
        what = f"{loose} ends at the border have no partner on the opposite side"
        warnings.append(f"{path}: {what}: the tile has a seam; check 'period'")
    return replace(tile, warnings=tuple(warnings))


def loose_ends(tile: FiberTile) -> int:
    """Number of curves' ends on the tile's border that no end on the opposite side continues."""
    opened = [curve for curve in tile.curves if curve.shift is None]
    if not opened:
        return 0
    from scipy.spatial import cKDTree

    bundle = Bundle(opened)
    start = bundle.starts - 3 * np.arange(len(opened))
    stop = np.append(start[1:], len(bundle.owner)) - 1
    sides = zip(bundle.at(0.0), bundle.at(1.0), strict=True)
    end, slope = (np.concatenate([first[start], last[stop]]) for first, last in sides)
    loose = 0
    for axis, size in enumerate((1.0, tile.aspect)):
        # A curve crosses the border that it runs towards.
        crossing = np.abs(slope[:, axis]) >= np.abs(slope[:, 1 - axis])
        low, high = (end[crossing & (np.abs(end[:, axis] - side) < _AT_BORDER)] for side in (0.0, size))
        if not len(low) or not len(high):
            loose += len(low) + len(high)
            continue
        other, box = 1 - axis, [(1.0, tile.aspect)[1 - axis], 0.0]
        # The remainder of -1e-17 is the period itself.
        places = [np.column_stack([side[:, other] % box[0] % box[0], side[:, 2]]) for side in (low, high)]
        near, index = cKDTree(places[1], boxsize=box).query(places[0], distance_upper_bound=_AT_BORDER)
        # Each end continues at most one of the other side.
        loose += len(low) + len(high) - 2 * len(np.unique(index[np.isfinite(near)]))
    return loose
