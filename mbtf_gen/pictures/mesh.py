"""The displaced mesh with its base color, drawn by VTK in a child process, which a driver may abort."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import to_display
from mbtf_core.errors import EngineError
from mbtf_core.extras import import_extra
from mbtf_core.images.resample import resample
from mbtf_core.pictures import Camera
from mbtf_core.run.processes import run_child
from mbtf_gen.tile.heights import HeightGrid, grid_faces, grid_vertices
from mbtf_gen.tile.protocol import Tile

# Largest number of cells along each side of all tiles together, and of texels across the texture.
MOST_CELLS = 1024
MOST_TEXELS = 2048
# Seconds; software rendering of the largest mesh takes ten.
_TIMEOUT = 180.0
# Factor of supersampling, because drivers need not support anti-aliasing.
_OVERSAMPLING = 2
# Ambient light, and the largest intensity of the light, which a flat surface needs to show its base color.
_AMBIENT, _STRONGEST = 0.3, 3.0
_BACKGROUND, _WALL = (0.95, 0.95, 0.95), (0.45, 0.45, 0.45)


@dataclass(frozen=True)
class TiledMesh:
    """A mesh of repeated tiles.

    Attributes
    ----------
    points : (rows, columns, 3) positions in tile widths; uv : (rows, columns, 2), above 1 where tiles repeat
    hole : (rows-1, columns-1) cells that are left out, because their mean opacity is below 1/2
    texture : (h, w, 3) sRGB of base color over π, row 0 at ``v → 1``
    cells : (rows, columns) of one tile's mesh
    """

    points: NDArray[np.float32]
    uv: NDArray[np.float32]
    hole: NDArray[np.bool_]
    texture: NDArray[np.uint8]
    cells: tuple[int, int]


def tiled_mesh(material: Tile, tiles: int, exposure: float) -> TiledMesh:
    """Mesh of `tiles` × `tiles` tiles of a height field: the mesh that is traced, or a coarser one. The
    texture has an `exposure` in EV."""
    grid = material.coarser_grid(MOST_CELLS // tiles)
    assert grid is not None
    repeated = HeightGrid(np.tile(grid.z, (tiles, tiles)), grid.aspect)
    points = grid_vertices(repeated) * (tiles, tiles, 1)
    hole = np.zeros(repeated.z.shape, np.bool_)
    if "opacity" in material.maps:
        opacity = resample(np.atleast_2d(np.asarray(material.maps["opacity"], np.float64)), *grid.z.shape)
        # A cell lies between its vertex and the next ones, around the period.
        below = np.roll(opacity, -1, axis=0)
        cells = 0.25 * (opacity + below + np.roll(opacity, -1, axis=1) + np.roll(below, -1, axis=1))
        hole = np.tile(cells < 0.5, (tiles, tiles))
    color = np.asarray(material.base_color, np.float32)
    color = np.broadcast_to(color, (1, 1, 3)) if color.ndim == 1 else color
    share = min(1.0, MOST_TEXELS / max(color.shape[:2]))
    texels = (max(1, round(share * color.shape[0])), max(1, round(share * color.shape[1])))
    return TiledMesh(
        points.astype(np.float32),
        (points[..., :2] / (1.0, grid.aspect)).astype(np.float32),
        hole,
        to_display(resample(color, *texels) / np.pi, exposure),
        (grid.z.shape[0], grid.z.shape[1]),
    )


def draw(tiles: TiledMesh, camera: Camera, omega_i: NDArray[np.float64], path: Path) -> str:
    """Draw the mesh under light from `omega_i` (3,) as a PNG, in a child process; returns the reason of a
    failure, or ""."""
    forward, _, up = camera.frame()
    target = camera.position + camera.distance * forward
    view = {
        "camera": [camera.position.tolist(), target.tolist(), up.tolist()],
        "angle": camera.field_of_view,
        "size": [camera.columns, camera.rows],
        "light": (target + camera.distance * np.asarray(omega_i)).tolist(),
        "intensity": min(_STRONGEST, (1.0 - _AMBIENT) / float(omega_i[2])),
    }
    with tempfile.TemporaryDirectory(prefix="mbtf-preview-") as folder:
        scene = Path(folder, "scene.npz")
        np.savez(scene, points=tiles.points, uv=tiles.uv, hole=tiles.hole, texture=tiles.texture)
        return run_child(__name__, "child", str(scene), json.dumps(view), str(path), timeout=_TIMEOUT).fault


def _plotter(scene: str, view: dict[str, Any]) -> Any:
    """A plotter with the mesh, its walls, the light and the camera."""
    pyvista = import_extra("pyvista", "3D pictures")
    with np.load(scene) as stored:
        points, uv, hole, texture = (stored[name] for name in ("points", "uv", "hole", "texture"))
    rows, columns = points.shape[:2]
    faces = grid_faces(rows, columns)[np.repeat(~hole.ravel(), 2)]
    mesh = pyvista.PolyData.from_regular_faces(points.reshape(-1, 3), faces.astype(np.int64))
    mesh.active_texture_coordinates = uv.reshape(-1, 2)
    image = pyvista.Texture(np.ascontiguousarray(texture))
    image.repeat = image.interpolate = image.mipmap = True
    size = [_OVERSAMPLING * n for n in view["size"]]
    plotter = pyvista.Plotter(lighting="none", off_screen=True, window_size=size)
    plotter.set_background(_BACKGROUND)
    look = {"ambient": _AMBIENT, "diffuse": 1.0, "specular": 0.0}
    plotter.add_mesh(mesh, texture=image, **look)
    if np.ptp(points[..., 2]) > 0:
        # The sides of the mesh, from its border down to its lowest point.
        edge = np.concatenate([points[0, :-1], points[:-1, -1], points[-1, :0:-1], points[::-1, 0]])
        foot = np.column_stack([edge[:, :2], np.full(len(edge), points[..., 2].min())])
        wall = pyvista.StructuredGrid(*np.moveaxis(np.stack([edge, foot]), -1, 0))
        plotter.add_mesh(wall, color=_WALL, **look)
    light = pyvista.Light(
        position=view["light"],
        focal_point=view["camera"][1],
        light_type="scene light",
        intensity=view["intensity"],
        positional=False,
    )
    plotter.add_light(light)
    plotter.camera_position = view["camera"]
    plotter.camera.SetUseHorizontalViewAngle(True)
    plotter.camera.view_angle = view["angle"]
    plotter.reset_camera_clipping_range()
    return plotter


def child(scene: str, view_json: str, path: str) -> Iterator[dict[str, Any]]:
    """Child process of :func:`draw`."""
    from PIL import Image

    plotter = _plotter(scene, json.loads(view_json))
    picture = plotter.screenshot(return_img=True)
    plotter.close()
    if picture is None or not int(picture.max()) > int(picture.min()):
        raise EngineError("the picture came out empty")
    Image.fromarray(picture).reduce(_OVERSAMPLING).save(path, format="PNG")
    yield {"done": True}
