"""``mbtf-gen preview``: a first look at a material and its queries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console
from mbtf_core.errors import InputError, PartialError, UsageError
from mbtf_core.shard_schema import Tiling
from mbtf_gen.cli.common import Flags, Output, Set, angles, general, resolve_config

if TYPE_CHECKING:
    from mbtf_gen.config.pictures import PreviewConfig
    from mbtf_gen.dataset.reader import Dataset


def preview(
    material: str | None = None,
    /,
    *,
    output: Output = None,
    view: str | None = None,
    light: str | None = None,
    tiles: int | None = None,
    size: int | None = None,
    spp: int | None = None,
    height_scale: float | None = None,
    mesh: int | None = None,
    make_tileable: Tiling | None = None,
    resolution: int | None = None,
    light_width: float | None = None,
    min_cos: float | None = None,
    max_depth: int | None = None,
    seed: int | None = None,
    config: Path | None = None,
    assignments: Set | None = None,
    interactive: Annotated[bool, Parameter(negative="")] = False,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    console: Console = CONSOLE,
) -> None:
    """Draw the mesh, a path-traced picture, and the queries of a material or of a folder of shards.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, or a folder of shards.
    output
        Folder of pictures. Default: preview/
    view
        ELEVATION,AZIMUTH of the camera in degrees. Default: 40,-90
    light
        ELEVATION,AZIMUTH of the light in degrees. Default: 35,150
    tiles
        Tiles along each side of the drawn plane, 1 to 4. Default: 2
    size
        Pixels across. Default: 640
    spp
        Paths per pixel of the path-traced picture (even). Default: 16
    height_scale
        Factor on the stored heights, in tile widths. Default: the material's own
    mesh
        Mesh cells across the tile. Default: the map's width, at most 512
    make_tileable
        For maps that do not tile: 2 x 2 mirrored copies, or cross-faded edges. Default: none
    resolution
        Texels across at the finest level, a power of two. Default: from the map's width
    light_width
        RMS angle of the light per axis in degrees; 0 is a delta light. Default: 1
    min_cos
        Smallest cosine of the queries' directions to the normal. Default: 0.1
    max_depth
        Surface interactions per path; 0: no limit. Default: 0
    seed
        Root seed. Default: 0
    config
        YAML file with the options.
    interactive
        Also show the mesh in a window, to be turned with the mouse.
    overwrite
        Draw again, and replace pictures of another configuration.
    """
    look = {
        "--view": ("preview.view", angles(view, "--view")),
        "--light": ("preview.light", angles(light, "--light")),
        "--tiles": ("preview.tiles", tiles),
        "--size": ("preview.size", size),
        "--spp": ("preview.spp", spp),
    }
    rest = {
        **general(
            height_scale=height_scale,
            mesh=mesh,
            make_tileable=make_tileable,
            light_width=light_width,
            max_depth=max_depth,
            seed=seed,
        ),
        "--resolution": ("queries.resolution", resolution),
        "--min-cos": ("queries.min_cos", min_cos),
    }
    from mbtf_core.shard_schema import MANIFEST_NAME
    from mbtf_gen.config.pictures import PreviewConfig

    if interactive:
        from mbtf_gen.pictures.preview.mesh import check_display

        check_display()
    dataset = None
    if material is not None and Path(material, MANIFEST_NAME).is_file():
        from mbtf_gen.dataset.reader import Dataset

        dataset = Dataset.open(material)
        given = [flag for flag, (_, value) in rest.items() if value is not None]
        given += ["--config"] * (config is not None) + ["--set"] * bool(assignments)
        if given:
            raise UsageError(
                f"{material} holds a data set, whose configuration is settled",
                where=given[0],
                hint="leave it out, or name the material instead of its shards",
            )
        resolved = _of_dataset(dataset, look)
    else:
        resolved = resolve_config(PreviewConfig, material, config, assignments or [], {**look, **rest})
    _Preview(resolved, dataset, console).make(output or Path("preview"), overwrite, interactive)


def _of_dataset(dataset: Dataset, look: Flags) -> PreviewConfig:
    from mbtf_core.config_file import resolve
    from mbtf_gen.config.pictures import PreviewConfig

    return resolve(
        PreviewConfig,
        flags={**dataset.manifest["config"], **dict(look.values())},
        spelled={key: flag for flag, (key, _) in look.items()},
    )


class _Preview:
    """One run of the command."""

    def __init__(self, config: PreviewConfig, dataset: Dataset | None, console: Console) -> None:
        from mbtf_core.directions import from_angles
        from mbtf_gen.job import Job

        self.config = config
        self.dataset = dataset
        self.console = console
        wanted = config.preview
        self.omega_i = from_angles(wanted.light.elevation, wanted.light.azimuth)
        self.job: Job | None = None
        try:
            self.job = Job.prepare(config)
            if dataset is not None and self.job.material.digests != dataset.manifest["inputs"]:
                self.job = None
                raise InputError("has changed since the data set was made", where=config.material)
        except InputError as error:
            # Its queries can be shown without the material.
            if dataset is None:
                raise
            console.note(f"queries alone are shown: {error.where}: {error.what}")
        if self.job is not None:
            self._prepare_view(self.job)

    def _prepare_view(self, job: Any) -> None:
        from mbtf_gen.pictures.preview.view import block_camera

        wanted = self.config.preview
        grid = job.material.grid(self.config.geometry.height_scale, self.config.geometry.mesh)
        self.camera = block_camera(
            wanted.view.elevation,
            wanted.view.azimuth,
            tiles=wanted.tiles,
            aspect=grid.aspect,
            relief=grid.displacement_range,
            columns=wanted.size,
        )
        self.camera.queries(self.omega_i, grid.aspect)  # refuses a view of the horizon
        self.seen = (
            f"from elevation {wanted.view.elevation:g}, azimuth {wanted.view.azimuth:g}, "
            f"light from {wanted.light.elevation:g}, {wanted.light.azimuth:g} degrees"
        )

    def make(self, path: Path, overwrite: bool, interactive: bool) -> None:
        """Make the pictures that are missing, report them, and open the window.

        Raises
        ------
        PartialError : the mesh could not be drawn; everything else was
        EngineError : the window could not be shown
        """
        from mbtf_gen.pictures.folder import PictureFolder

        inputs = dict(self.job.material.digests) if self.job is not None else {}
        makers: dict[str, Callable[[Path], dict[str, Any]]] = {"queries": self._queries}
        if self.job is not None:
            makers = {"mesh": self._mesh, "beauty": self._beauty, **makers}
        if self.dataset is not None:
            inputs = {"data set": self.dataset.manifest["config_hash"], **inputs}
        folder = PictureFolder.claim(
            path,
            "preview",
            files=[f"{name}.png" for name in ("mesh", "beauty", "queries")],
            config=self.config.model_dump(mode="json"),
            inputs=inputs,
            overwrite=overwrite,
        )
        pictures: list[dict[str, Any]] = []
        fault = ""
        with self.console.progress(total=len(makers), label="drawing", unit="pictures") as bar:
            for name, maker in makers.items():
                file = folder.path / f"{name}.png"
                facts = folder.finished(name)
                kept = facts is not None and facts.get("of") == self._stage(name)
                if not kept:
                    facts = {**maker(file), "of": self._stage(name)}
                    if "fault" in facts:
                        fault = facts["fault"]
                        bar.advance(1)
                        continue
                    folder.keep(name, [file], facts)
                assert facts is not None
                pictures.append({"file": file, "kept": kept, **{k: v for k, v in facts.items() if k != "of"}})
                bar.advance(1)
        text = "\n".join(f"{p['file']}: {p['shows']}{' (was there)' if p['kept'] else ''}" for p in pictures)
        self.console.report({"folder": path, "pictures": pictures, "fault": fault or None}, text)
        if fault:
            raise PartialError(
                f"could not be drawn ({fault})",
                where=path / "mesh.png",
                hint="the other pictures are there; mbtf-gen doctor says what drawing needs, "
                "then the same command draws it",
            )
        if interactive and self.job is not None:
            from mbtf_gen.pictures.preview.mesh import show

            self.console.note("the mesh is shown in a window: close it to go on")
            show(self._block(), self.camera, self.omega_i)

    def _stage(self, name: str) -> int:
        """What a picture depends on besides the configuration: how many shards are finished."""
        if name != "queries" or self.dataset is None:
            return 0
        from mbtf_gen.pictures.preview.sample import finished_shards

        return len(finished_shards(self.dataset, "train"))

    def _block(self) -> Any:
        from mbtf_gen.pictures.preview.mesh import block_of

        assert self.job is not None
        geometry = self.config.geometry
        return block_of(self.job.material, self.config.preview.tiles, geometry.height_scale, geometry.mesh)

    def _mesh(self, file: Path) -> dict[str, Any]:
        from mbtf_gen.pictures.preview.mesh import draw

        block = self._block()
        fault = draw(block, self.camera, self.omega_i, file)
        if fault:
            return {"fault": fault}
        tiles, (rows, columns) = self.config.preview.tiles, block.cells
        return {
            "shows": f"the displaced mesh ({columns} x {rows} cells per tile) of {tiles} x {tiles} tiles "
            f"with its base color, {self.seen}"
        }

    def _beauty(self, file: Path) -> dict[str, Any]:
        from mbtf_gen.pictures.reference import render_reference, to_display, write_png
        from mbtf_gen.planning.effects_plan import reference_plan
        from mbtf_gen.planning.simulation import build_estimator

        assert self.job is not None
        estimator = build_estimator(self.job, reference_plan(self.job))
        spp = self.config.preview.spp
        image = render_reference(
            estimator, self.camera, self.omega_i, kind="pixel", spp=spp, seed=self.config.seed
        )
        write_png(file, to_display(image.value))
        return {"shows": f"the endless plane by the same camera, path-traced with {spp} paths per pixel"}

    def _queries(self, file: Path) -> dict[str, Any]:
        from mbtf_gen.pictures.preview.plots import level_histogram, write_plots
        from mbtf_gen.pictures.preview.sample import drawn, stored

        if self.dataset is not None:
            sample = stored(self.dataset)
            source = f"stored in {self.dataset.folder}"
        else:
            assert self.job is not None
            sample = drawn(self.job)
            source = f"to be drawn for {self.config.material}"
        shown = f"{len(sample.u)} of {sample.total} training queries {source}"
        if len(sample.level) < len(sample.u):
            shown += f", in {len(sample.level)} images of one footprint, light and view each"
        write_plots(file, sample, shown)
        edges, found, expected = level_histogram(sample)
        return {
            "shows": f"positions, levels and directions of {shown}",
            "queries": {
                "shown": len(sample.u),
                "total": sample.total,
                "level_edges": edges.tolist(),
                "level_density": found.tolist(),
                "level_density_stated": expected.tolist(),
            },
        }
