"""Colors and textures of meshes in the form that Mitsuba's bitmaps look up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.images.read import MAX_PIXELS
from mbtf_core.meshes.content import F64, MeshShape, Texture


def with_vertex_colors(shape: MeshShape) -> MeshShape:
    """A shape whose base color includes the colors of its vertices.

    Colors that are all equal become a factor. Others become a texture of 2 x 2 texels per triangle: bilinear
    interpolation between the centers of three of them is linear, if the fourth continues their plane.

    Raises
    ------
    InputError : the shape has textures as well
    """
    if shape.colors is None:
        return shape
    base = shape.values.get("base_color", np.ones(3))
    corners = shape.colors[shape.faces]
    if np.ptp(corners.reshape(-1, 3), axis=0).max() == 0.0:
        color = corners[0, 0]
        base = (base[0], color * base[1]) if isinstance(base, tuple) else color * base
        return replace(shape, colors=None, values={**shape.values, "base_color": base})
    if any(isinstance(value, tuple) for value in shape.values.values()):
        raise InputError(
            f"'{shape.name}' has both textures and varying colors of its vertices",
            hint="bake the colors into the texture of the base color, or remove them",
        )
    pixels, uv = _atlas(corners)
    return replace(
        shape,
        vertices=shape.vertices[shape.faces].reshape(-1, 3),
        faces=np.arange(3 * len(corners)).reshape(-1, 3),
        uv=uv,
        colors=None,
        values={**shape.values, "base_color": (Texture(pixels), base)},
    )


def _atlas(corners: F64) -> tuple[NDArray[np.float32], F64]:
    """Texture (h, w, 3) of the colors (m, 3, 3) of triangles' corners, and the corners' texture coordinates
    (3 m, 2), v up."""
    count = len(corners)
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    blocks = np.zeros((rows * columns, 4, 3), np.float32)
    # So that the mean of the texels is about that of the surface.
    blocks[count:] = corners.mean(axis=(0, 1))
    blocks[:count, :3] = corners
    blocks[:count, 3] = corners[:, 1] + corners[:, 2] - corners[:, 0]
    pixels = blocks.reshape(rows, columns, 2, 2, 3).swapaxes(1, 2).reshape(2 * rows, 2 * columns, 3)
    row, column = np.divmod(np.arange(count), columns)
    center = 2.0 * np.stack([column, row], axis=-1)[:, None] + 0.5 + np.array([[0, 0], [1, 0], [0, 1]])
    uv = center / (2 * columns, 2 * rows) * (1, -1) + (0, 1)
    return pixels, uv.reshape(-1, 2)


def with_one_wrap(value: Any, uv: F64, name: str) -> Any:
    """A value whose texture has the same wrap mode along both axes, as far as texture coordinates (n, 2) of
    the shape reach. Different modes become a larger image that repeats: mirrored copies, and borders that are
    continued where it was clamped.

    Raises
    ------
    InputError : the image would be too large
    """
    if not isinstance(value, tuple) or value[0].wrap[0] == value[0].wrap[1]:
        return value
    texture, factor = value
    pixels, matrix = texture.pixels, texture.to_uv.copy()
    reached = uv @ matrix[:, :2].T + matrix[:, 2]
    # Columns lie along u, rows against v.
    for axis, mode in enumerate(texture.wrap):
        if mode == "repeat":
            continue
        along, size = 1 - axis, pixels.shape[1 - axis]
        low, high = reached[:, axis].min(), reached[:, axis].max()
        before, after = (int(np.ceil(max(0.0, beyond) * size)) + 1 for beyond in (-low, high - 1.0))
        if mode == "mirror":
            before, after = 0, size
        if (size + before + after) * pixels.shape[axis] > MAX_PIXELS:
            raise InputError(
                f"a texture of '{name}' repeats along one axis and is clamped far along the other",
                hint="scale its texture coordinates, or use one wrap mode",
            )
        ends = [(0, 0)] * pixels.ndim
        ends[along] = (before, after) if axis == 0 else (after, before)
        pixels = np.pad(pixels, ends, "symmetric" if mode == "mirror" else "edge")
        matrix[axis] *= size / (size + before + after)
        matrix[axis, 2] += before / (size + before + after)
    return replace(texture, pixels=pixels, wrap=("repeat", "repeat"), to_uv=matrix), factor
