"""Overlapping scales of a fish: a mesh that folds over itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .noise import Field, mix, uniform

# Scales across and rows of the tile; quads across and along a scale.
ACROSS, ROWS = 7, 10
QUADS = (12, 14)
# Coordinates are multiples of this: far more than the last bit of a root, far less than shows.
QUANTUM = 2.0**-14


def scale(column: int, row: int) -> tuple[Field, Field]:
    """(vertices (n, 3), sRGB (n, 3)) of a scale: it lies on its root and rises to a rounded, free tip."""
    number = row * ACROSS + column
    own = [float(uniform(50 + k, number)[0]) for k in range(5)]
    t, s = np.meshgrid(np.linspace(0.0, 1.0, QUADS[1] + 1), np.linspace(-1.0, 1.0, QUADS[0] + 1))
    width = 0.62 / ACROSS * np.sqrt(np.maximum(1.0 - np.clip((t - 0.45) / 0.55, 0.0, 1.0) ** 2.4, 0.004))
    width = width * (0.8 + 0.45 * t)
    x = (column + 0.5 * (row % 2) + 0.5 + 0.10 * (own[0] - 0.5)) / ACROSS + width * s
    y = 1.0 - (row + 0.1 * own[1]) / ROWS - 2.3 / ROWS * t + 0.08 / ROWS * s**2
    ridges = 0.0012 * np.cos(2.0 * np.pi * 5.0 * s) * np.sqrt(t)
    z = (0.042 + 0.02 * own[2]) * t**1.3 - 0.020 * s**2 * (0.4 + 0.6 * t) + ridges
    # Dark at the root, a bright seam before the tip; each scale has its own tone.
    tone = mix((0.30, 0.42, 0.44), (0.62, 0.56, 0.38), np.full_like(t, own[3]))
    color = mix((0.16, 0.20, 0.22), tone, np.clip(1.6 * t - 0.3 + 0.2 * own[4], 0.0, 1.0))
    color = mix(color, (0.72, 0.72, 0.66), np.where((t > 0.86) & (t < 0.95), 0.5, 0.0))
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), color.reshape(-1, 3)


def write(folder: Path) -> None:
    """Write the mesh as binary PLY with colors of vertices, and its ``material.yaml``."""
    made = [scale(column, row) for row in range(ROWS) for column in range(ACROSS)]
    corner = np.arange((QUADS[0] + 1) * (QUADS[1] + 1)).reshape(QUADS[0] + 1, QUADS[1] + 1)
    a, b, c, d = (corner[i : i + QUADS[0], j : j + QUADS[1]].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    faces = np.concatenate([faces + k * corner.size for k in range(len(made))])
    # The skin below them closes the tile.
    skin = np.array([(x, y, -0.025) for y in (0.0, 1.0) for x in (0.0, 1.0)])
    faces = np.concatenate([faces, np.array([(0, 1, 3), (0, 3, 2)]) + len(made) * corner.size])
    points = np.concatenate([*(points for points, _ in made), skin])
    colors = np.concatenate([*(colors for _, colors in made), np.full((4, 3), 0.25)])
    vertex = np.zeros(len(points), [("at", "<f4", 3), ("color", "u1", 4)])
    vertex["at"] = np.round(points / QUANTUM) * QUANTUM
    vertex["color"][:, :3] = np.round(colors * 255.0)
    vertex["color"][:, 3] = 255
    face = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    face["count"], face["corners"] = 3, faces
    properties = [f"property float {name}" for name in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue", "alpha")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}", *properties]
    header += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", ""]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scales.ply").write_bytes("\n".join(header).encode() + vertex.tobytes() + face.tobytes())
    lines = ["mesh: scales.ply", "period: [1, 1]", "up: z", "roughness: 0.35", ""]
    (folder / "material.yaml").write_text("\n".join(lines), encoding="utf-8")
