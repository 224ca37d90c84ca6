"""Long commands state their time and size before they start, and refuse what does not fit on the disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mbtf_core.app.console import CONSOLE, run
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.files import folders
from mbtf_core.pictures import Camera
from mbtf_gen import forecast
from mbtf_gen.cli.app import app
from mbtf_gen.generation import run as generation
from mbtf_gen.generation.manifest import Summary
from mbtf_gen.pictures import reference
from mbtf_gen.tile.loading import load_material

DRAFT = 400 * 128**2 + 65536


@pytest.fixture
def heights(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", np.random.default_rng(0).random((256, 256)))
    return tmp_path / "height.npy"


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("reference", "--size", "512"),
        ("preview", "--size", "1024"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(
    heights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    out = heights.parent / "out"
    line = [*words[:1], str(heights), *words[1:], "--height-scale", "0.01", "-o", str(out)]
    assert run(app, line) == 3
    message = capsys.readouterr().err
    assert "1.0 MB are free" in message
    assert "-o" in message.splitlines()[-1]
    assert not out.exists()


def stop(*_: Any, **__: Any) -> Any:
    raise KeyboardInterrupt


@pytest.mark.parametrize(("options", "queries"), [((), DRAFT), (("--resolution", "64"), 400 * 64**2 + 65536)])
def test_a_long_run_states_time_and_size(
    heights: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    queries: int,
) -> None:
    """Before the first shard, and, for a new data set, before its folder is made."""
    out = heights.parent / "out"
    seen: list[bool] = []

    def pilot(*_: Any, **__: Any) -> Any:
        seen.append(out.exists())
        return SimpleNamespace(start=5.0, seconds=600.0)

    monkeypatch.setattr(generation, "open_folder", lambda job, folder, plan, overwrite: stop(plan(job)))
    monkeypatch.setattr(forecast, "LONG_RUN", 1)
    monkeypatch.setattr(forecast, "forecast", pilot)
    plan = SimpleNamespace(effects=SimpleNamespace(closed_form=False))
    monkeypatch.setattr(generation, "plan_run", lambda *_: plan)
    words = [str(heights), "--height-scale", "0.01", "--quality", "draft", *options, "-o", str(out)]
    assert run(app, words) == 130
    size = f"{queries * row_bytes(holes=False) / 1e6:.0f} MB"
    err = capsys.readouterr().err
    assert f"resolution {options[1] if options else 128}, {size}" in err
    assert f"expected: about 10:05, {size} on disk; faster: --queries 100/texel" in err
    assert seen == [False]


LINE = "expected: about 1:15, 27 GB on disk\n"


@pytest.mark.parametrize(
    ("paths", "fibers", "line"), [(3e7, False, LINE), (2.9e7, False, ""), (1e6, True, LINE), (9e5, True, "")]
)
def test_only_many_paths_are_announced(
    paths: float, fibers: bool, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def seconds() -> float:
        return 75.0 if line else pytest.fail("a measurement")

    forecast.announce(CONSOLE, paths, seconds, 27e9, fibers)
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(("rate", "most"), [(3e4, 1e5), (5e5, 8e5), (5e6, 2e6)])
def test_the_pilot_of_a_picture_is_short_and_exact(
    monkeypatch: pytest.MonkeyPatch, rate: float, most: float
) -> None:
    """At a rate of paths per second, after a compilation of 3 s."""
    clock, traced = [0.0], [0]

    def render(_: Any, camera: Camera, omega_i: Any, *, spp: int) -> None:
        paths = camera.rows * camera.columns * spp
        clock[0] += paths / rate + 3.0 * (not traced[0])
        traced[0] += paths

    monkeypatch.setattr(reference, "render_reference", render)
    monkeypatch.setattr(reference, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    found = reference.picture_seconds(None, Camera(rows=500), None, 10_000_000)  # type: ignore[arg-type]
    assert found == pytest.approx(1e7 / rate)
    assert traced[0] < most


@pytest.mark.parametrize(
    ("quality", "options", "resolution"),
    [
        ("draft", (), 128),
        ("high", (), 256),
        ("paper", (), 256),
        ("high", ("--set", "queries.resolution=64"), 64),
    ],
)
def test_a_preset_sets_the_resolution_up_to_that_of_the_map(
    heights: Path, quality: str, options: tuple[str, ...], resolution: int
) -> None:
    from mbtf_gen.cli.generate import GenerateOptions, prepare_job

    words = ["plan", str(heights), "--height-scale", "0.01", "--quality", quality, *options]
    _, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    arguments = dict(bound.arguments)
    job = prepare_job(arguments.get("options", GenerateOptions()), str(heights), arguments["quality"])
    assert job.lattice.shape() == (resolution, resolution)


def test_notes_on_maps_are_logged_where_data_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other commands, and one that finds all shards finished, do not repeat them."""
    codes = np.random.default_rng(0).integers(0, 256, (32, 32), np.uint8)
    Image.fromarray(codes).save(tmp_path / "height.png")
    path = str(tmp_path / "height.png")

    def printed(*words: str) -> str:
        run(app, [*words, "-o", str(tmp_path / "out")] if words[0] == path else list(words))
        return capsys.readouterr().err

    monkeypatch.setattr(generation, "generate", stop)
    notes = load_material(path).notes + load_material(path).warnings_in_use()
    assert len(notes) > 2
    assert all(note in printed(path) for note in notes)
    planned = printed("plan", path, "--no-measure")
    assert not any(note in planned for note in notes)
    assert f"mbtf-gen inspect {path}" in planned
    monkeypatch.setattr(generation, "unfinished", lambda *_: [])
    assert not any(note in printed(path) for note in notes)


def test_an_implausible_height_scale_is_the_last_line_of_a_run(
    heights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(heights, np.tile(0.4 + 0.4 * np.sin(np.linspace(0, 2 * np.pi, 64, endpoint=False)), (64, 1)))
    done = Summary(
        "out", True, 9, {"train": 9}, 9, 1.0, 9.0, 0.0, 0.0, 1.0, None, [0.1] * 3, 0, 0, 0, [], None
    )
    monkeypatch.setattr(generation, "generate", lambda *_, **__: done)
    for scale, warned in (("0.1", False), (None, True)):
        words = [] if scale is None else ["--height-scale", scale]
        assert run(app, [str(heights), *words, "--resolution", "8", "-o", str(heights.parent / "out")]) == 0
        last = capsys.readouterr().err.splitlines()[-1]
        assert ("check --height-scale" in last) == warned
