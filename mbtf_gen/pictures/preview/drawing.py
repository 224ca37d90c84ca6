"""The pictures of ``mbtf-gen preview``: displaced mesh, path-traced picture, and query distribution."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mbtf_core.app.console import Console
from mbtf_core.color import auto_exposure, brightness, describe_exposure
from mbtf_core.data.dataset import Dataset
from mbtf_core.directions import from_angles
from mbtf_core.errors import InputError, PartialError
from mbtf_core.files.folders import check_space, owned
from mbtf_core.pictures import PNG_BYTES, claim_pictures, tiles_camera, write_display
from mbtf_core.run.signals import keep_on_interruption
from mbtf_gen.config.pictures import PreviewConfig
from mbtf_gen.forecast import announce
from mbtf_gen.job import Job
from mbtf_gen.pictures.preview import mesh
from mbtf_gen.pictures.preview.plots import level_histogram, write_plots
from mbtf_gen.pictures.preview.sample import sampled_queries, stored_queries
from mbtf_gen.pictures.reference import picture_seconds, render_reference
from mbtf_gen.planning.effects_planner import reference_plan
from mbtf_gen.planning.simulation import build_estimator


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
        self.config, self.dataset, self.console = config, dataset, console
        options = config.preview
        self.exposure = 0.0
        view, light = options.view, options.light
        self.job: Job | None = None
        try:
            job = Job.prepare(config)
            if dataset is not None and job.material.digests != dataset.manifest["inputs"]:
                raise InputError("has changed since the data set was made", where=config.material)
        except InputError as error:
            # Its queries can be shown without the material.
            if dataset is None:
                raise
            console.note(f"only the queries are drawn: {error.where}: {error.what}")
            return
        self.job, self.config = job, config.model_copy(update=dict(job.config))
        self.omega_i = from_angles(light.elevation, light.azimuth)
        self.camera = tiles_camera(
            view.elevation,
            view.azimuth,
            tiles=options.tiles,
            aspect=job.material.aspect,
            displacement_range=job.material.thickness,
            columns=options.size,
        )
        self.camera.queries(self.omega_i, job.material.aspect)  # refuses a view of the horizon
        self.seen = (
            f"from elevation {view.elevation:g}, azimuth {view.azimuth:g}, "
            f"light from {light.elevation:g}, {light.azimuth:g} degrees"
        )

    def draw(self, path: Path, overwrite: bool, interactive: bool) -> None:
        """Draw the missing pictures, report them, and open the window.

        Raises
        ------
        PartialError : the mesh could not be drawn; everything else was
        EngineError : the window could not be shown
        """
        makers: dict[str, Callable[[Path], dict[str, Any]]] = {"queries": self._queries}
        inputs: dict[str, str] = {}
        # Plots of stored queries also depend on how many shards are finished.
        stages: dict[str, Any] = {"mesh": self.config.exposure, "beauty": self.config.exposure, "queries": 0}
        if self.job is not None:
            # The mesh has the exposure of the path-traced picture.
            makers = {"beauty": self._beauty, "mesh": self._mesh, **makers}
            if self.job.material.grid is None:
                del makers["mesh"], stages["mesh"]
            inputs |= self.job.material.digests
        if self.dataset is not None:
            inputs["data set"] = self.dataset.manifest["config_hash"]
            stages["queries"] = len(self.dataset.shards("train", finished_only=True))
        size = len(stages) * PNG_BYTES * self.config.preview.size**2
        check_space(path, size, "reduce --size, or choose another folder with -o")
        found: dict[str, dict[str, Any]] = {}
        fault = ""
        keep_on_interruption(f"the finished pictures are kept in {path}")
        with (
            owned(path),
            self.console.progress(total=len(makers), label="drawing", unit="pictures") as bar,
        ):
            folder = claim_pictures(
                path,
                "mbtf-gen preview",
                files=[f"{name}.png" for name in stages],
                config=self.config.model_dump(mode="json"),
                inputs=inputs,
                overwrite=overwrite,
            )
            for name, maker in makers.items():
                file, facts = folder.path / f"{name}.png", folder.finished(name)
                kept = facts is not None and facts.get("of") == stages[name]
                if facts is None or not kept:
                    facts = {**maker(file), "of": stages[name]}
                self.exposure = facts.get("exposure", self.exposure)
                bar.advance(1)
                if "fault" in facts:
                    fault = facts["fault"]
                    continue
                if not kept:
                    folder.keep(name, [file], facts)
                found[name] = {"file": file, "kept": kept, **{k: v for k, v in facts.items() if k != "of"}}
        pictures = [found[name] for name in stages if name in found]
        lines = [f"{p['file']}: {p['shows']}{' (kept)' if p['kept'] else ''}" for p in pictures]
        if self.job is not None:
            lines.append(describe_exposure(self.exposure))
        self.console.report({"folder": path, "pictures": pictures, "fault": fault or None}, "\n".join(lines))
        if fault:
            raise PartialError(
                f"could not be drawn ({fault})",
                where=path / "mesh.png",
                hint="the other pictures are finished; mbtf-gen doctor names the missing package, "
                "then the same command draws it",
            )
        if not interactive or self.job is None:
            return
        tiled = mesh.tiled_mesh(self.job.material, self.config.preview.tiles, self.exposure)
        if tiled is None:
            self.console.note("only height maps are shown in a window")
        else:
            self.console.note("the mesh is shown in a window: close it to continue")
            mesh.show(tiled, self.camera, self.omega_i)

    def _mesh(self, file: Path) -> dict[str, Any]:
        assert self.job is not None
        drawn = mesh.tiled_mesh(self.job.material, self.config.preview.tiles, self.exposure)
        assert drawn is not None
        if fault := mesh.draw(drawn, self.camera, self.omega_i, file):
            return {"fault": fault}
        tiles, (rows, columns) = self.config.preview.tiles, drawn.cells
        return {
            "shows": f"the displaced mesh ({columns} x {rows} cells per tile) of {tiles} x {tiles} tiles "
            f"with its base color, {self.seen}",
            "exposure": self.exposure,
        }

    def _beauty(self, file: Path) -> dict[str, Any]:
        assert self.job is not None
        estimator = build_estimator(self.job, reference_plan(self.job))
        spp, seed = self.config.preview.spp, self.config.seed
        paths = self.camera.rows * self.camera.columns * self.config.preview.spp
        announce(
            self.console,
            paths,
            lambda: picture_seconds(estimator, self.camera, self.omega_i, paths),
            PNG_BYTES * self.config.preview.size**2,
        )
        image = render_reference(estimator, self.camera, self.omega_i, kind="pixel", spp=spp, seed=seed)
        exposure = self.config.exposure
        if exposure is None:
            exposure = auto_exposure([brightness(image.value)])
        write_display(file.with_suffix(""), image.value, exposure)
        return {
            "shows": f"the infinite plane from the same camera, path-traced with {spp} paths per pixel",
            "exposure": exposure,
        }

    def _queries(self, file: Path) -> dict[str, Any]:
        if self.dataset is not None:
            sample, source = stored_queries(self.dataset), f"stored in {self.dataset.folder}"
        else:
            assert self.job is not None
            sample, source = sampled_queries(self.job), f"sampled for {self.config.material}"
        shown = f"{len(sample.u)} of {sample.total} training queries {source}"
        if len(sample.level) < len(sample.u):
            shown += f", in {len(sample.level)} images or slices, of which the first query is shown"
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
