"""The pictures of ``mbtf-gen preview``: displaced mesh, path-traced picture, and query distribution."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.console import Console
from mbtf_core.errors import InputError, PartialError

if TYPE_CHECKING:
    from mbtf_gen.config.pictures import PreviewConfig
    from mbtf_gen.dataset.reader import Dataset
    from mbtf_gen.pictures.preview.mesh import TiledMesh


class PreviewPictures:
    """Preview pictures of a material or a data set.

    Parameters
    ----------
    config : PreviewConfig
        Options of the pictures and of the material.
    dataset : Dataset, optional
        Data set whose queries are shown; those that a run would draw by default.
    console : Console
        Where notes and results go.

    Raises
    ------
    InputError
        The material cannot be read, and there is no data set either.
    UsageError
        The view shows the horizon.
    """

    def __init__(self, config: PreviewConfig, dataset: Dataset | None, console: Console) -> None:
        from mbtf_core.directions import from_angles
        from mbtf_gen.job import Job

        self.config = config
        self.dataset = dataset
        self.console = console
        light = config.preview.light
        self.omega_i = from_angles(light.elevation, light.azimuth)
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
            console.note(f"only the queries are drawn: {error.where}: {error.what}")
        if self.job is not None:
            self._prepare_view(self.job)

    def _prepare_view(self, job: Any) -> None:
        from mbtf_gen.pictures.preview.view import tiles_camera

        options = self.config.preview
        grid = job.material.grid(self.config.geometry.height_scale, self.config.geometry.mesh)
        self.camera = tiles_camera(
            options.view.elevation,
            options.view.azimuth,
            tiles=options.tiles,
            aspect=grid.aspect,
            displacement_range=grid.displacement_range,
            columns=options.size,
        )
        self.camera.queries(self.omega_i, grid.aspect)  # refuses a view of the horizon
        self.seen = (
            f"from elevation {options.view.elevation:g}, azimuth {options.view.azimuth:g}, "
            f"light from {options.light.elevation:g}, {options.light.azimuth:g} degrees"
        )

    def draw(self, path: Path, overwrite: bool, interactive: bool) -> None:
        """Draw the missing pictures, report them, and open the window.

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
        text = "\n".join(f"{p['file']}: {p['shows']}{' (kept)' if p['kept'] else ''}" for p in pictures)
        self.console.report({"folder": path, "pictures": pictures, "fault": fault or None}, text)
        if fault:
            raise PartialError(
                f"could not be drawn ({fault})",
                where=path / "mesh.png",
                hint="the other pictures are finished; mbtf-gen doctor names the missing package, "
                "then the same command draws it",
            )
        if interactive and self.job is not None:
            from mbtf_gen.pictures.preview.mesh import show

            self.console.note("the mesh is shown in a window: close it to continue")
            show(self._tiled_mesh(), self.camera, self.omega_i)

    def _stage(self, name: str) -> int:
        """What a picture depends on besides the configuration: how many shards are finished."""
        if name != "queries" or self.dataset is None:
            return 0
        from mbtf_gen.pictures.preview.sample import finished_shards

        return len(finished_shards(self.dataset, "train"))

    def _tiled_mesh(self) -> TiledMesh:
        from mbtf_gen.pictures.preview.mesh import tiled_mesh

        assert self.job is not None
        geometry = self.config.geometry
        return tiled_mesh(self.job.material, self.config.preview.tiles, geometry.height_scale, geometry.mesh)

    def _mesh(self, file: Path) -> dict[str, Any]:
        from mbtf_gen.pictures.preview.mesh import draw

        mesh = self._tiled_mesh()
        fault = draw(mesh, self.camera, self.omega_i, file)
        if fault:
            return {"fault": fault}
        tiles, (rows, columns) = self.config.preview.tiles, mesh.cells
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
        return {"shows": f"the infinite plane from the same camera, path-traced with {spp} paths per pixel"}

    def _queries(self, file: Path) -> dict[str, Any]:
        from mbtf_gen.pictures.preview.plots import level_histogram, write_plots
        from mbtf_gen.pictures.preview.sample import sampled_queries, stored_queries

        if self.dataset is not None:
            sample = stored_queries(self.dataset)
            source = f"stored in {self.dataset.folder}"
        else:
            assert self.job is not None
            sample = sampled_queries(self.job)
            source = f"sampled for {self.config.material}"
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
