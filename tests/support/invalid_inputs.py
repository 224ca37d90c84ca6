"""Invalid command lines of the three programs, and the files that they name.

Commands of ``mbtf-gen`` whose message is tested in full are in ``tests/system/gen/test_gen_errors.py``.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import shutil
from pathlib import Path

import numpy as np

from mbtf_core.app.console import run

from .commands import Done
from .datasets import edit, write_dataset
from .fit_data import constant, write_data

# Group → command lines.
LINES: dict[str, list[str]] = {
    "command lines": [
        "mbtf-gen heights.npy --queries 1.5",
        "mbtf-gen heights.npy --set seed=-1",
        "mbtf-gen inspect heights.npy --set seed=true",
        "mbtf-gen inspect heights.npy --set material=5",
        "mbtf-gen plan heights.npy --no-measure --spp 4 --target-error 2%",
        "mbtf-gen heights.npy --set seed=2001-01-01",
        "mbtf-gen heights.npy -o textures",
        "mbtf-gen heights.npy -o set --queries 10",
        "mbtf-gen heights.np",
        "mbtf-gen steep.npy -o textures",
        "mbtf-gen steep.npy --height-scale 0.1 -o textures",
        "mbtf-gen reference heights.npy -o textures",
        "mbtf-gen reference heights.npy -o pictures",
        "mbtf-gen inspect nowhere",
        "mbtf-gen publish set",
        "mbtf-gen publish nowhere --license CC0-1.0",
        "mbtf-gen publish textures --license CC0-1.0",
        "mbtf-gen publish set --license Mine",
        "mbtf-gen publish set --license CC0-1.0 --form zip",
        "mbtf-gen publish set --license CC0-1.0 --form npz -o textures",
        "mbtf-gen publish set --license CC0-1.0 --form npz -o set",
        "mbtf-gen publish set --license CC0-1.0 --form npz -o set/card",
        "mbtf-gen publish set --license CC0-1.0 --form npz -o notes.txt",
        "mbtf-gen publish set --license CC0-1.0 --url javascript:alert(1)",
        "mbtf-gen publish set --license CC0-1.0 --date today",
        "mbtf-gen publish set --license CC0-1.0 --set author=[1]",
        "mbtf-gen publish set --license CC0-1.0 --material heights.npy",
        "mbtf-gen publish set --license CC0-1.0 --config publish.yaml",
        "mbtf-gen verify set --digests nowhere.json",
        "mbtf-gen verify set --digests set/manifest.json",
        "mbtf-fit",
        "mbtf-fit nowhere",
        "mbtf-fit shards --time 1min --steps 5",
        "mbtf-fit shards --time soon",
        "mbtf-fit shards --time 0s",
        "mbtf-fit shards --set training.rat=1",
        "mbtf-fit shards --set training.batch=0",
        "mbtf-fit shards -o notes.txt",
        "mbtf-fit shards -o textures",
        "mbtf-fit info nowhere",
        "mbtf-fit info textures",
        "mbtf-pipeline run nowhere.yaml",
        "mbtf-pipeline run textures",
        "mbtf-pipeline list nowhere",
        "mbtf-pipeline report textures",
    ],
    "materials": [
        f"mbtf-gen {name}"
        for name in (
            *("unnamed", "graynormal", "tab.yaml", "twice.yaml", "list.yaml"),
            *("latin.yaml", "number.yaml", "bomb.yaml"),
            *("longnormal", "tag.yaml", "deep.yaml", "key.yaml", "channel.yaml", "escape.yaml"),
            *("zipped", "zipped/rock.zip", "below"),
        )
    ],
    "configurations": [
        *(f"mbtf-gen heights.npy --config {name}.yaml" for name in ("types", "section")),
        "mbtf-fit shards --config fit.yaml",
    ],
    "recipes": [
        f"mbtf-pipeline run {name}.yaml"
        for name in (
            *("recipe-key", "recipe-lost", "recipe-material", "recipe-name", "recipe-view", "recipe-empty"),
            *("recipe-fits", "recipe-model", "recipe-twice"),
        )
    ],
    "special files": [
        *(
            f"mbtf-gen inspect {name}"
            for name in ("pipe.npy", "pipe.exr", "pipe.yaml", "zero.png", "zero.yaml")
        ),
        *(f"mbtf-gen inspect {name}" for name in ("piped.yaml", "loop.npy", "loop.yaml", "lost.npy")),
        "mbtf-gen plan heights.npy --config pipe.yaml",
        "mbtf-pipeline run pipe.yaml",
        "mbtf-gen inspect bsdf.yaml",
        "mbtf-gen verify shards-pipe",
        "mbtf-fit shards-pipe --steps 1",
    ],
    "shards": [
        *(f"mbtf-gen verify {name}" for name in ("textures", "foreign", "nojson")),
        *(
            f"mbtf-fit {name} --steps 1"
            for name in ("shards-nan", "shards-cut", "shards-rows", "shards-image")
        ),
        "mbtf-fit shards-empty --steps 1",
    ],
}


def write_files(folder: Path) -> None:
    """Every file and folder that the lines name."""
    heights = 0.2 * np.random.default_rng(0).random((4, 8))
    np.save(folder / "heights.npy", heights)
    np.save(folder / "steep.npy", 5.0 * heights)
    (folder / "notes.txt").write_text("no image")
    _folders(folder, heights)
    for name, text in _TEXTS.items():
        (folder / f"{name}.yaml").write_text(text)
    for suffix in ("npy", "exr", "yaml"):
        os.mkfifo(folder / f"pipe.{suffix}")
    links = {"zero.png": "/dev/zero", "zero.yaml": "/dev/zero", "lost.npy": "nowhere/heights.npy"}
    for name, target in {**links, "loop.npy": "loop.npy", "loop.yaml": "loop.yaml"}.items():
        (folder / name).symlink_to(target)
    (folder / "latin.yaml").write_bytes("# größer\nheight: heights.npy\n".encode("latin-1"))
    _shards(folder)


def _folders(folder: Path, heights: np.ndarray) -> None:
    for name in ("textures", "unnamed", "graynormal", "longnormal"):
        (folder / name).mkdir()
    for name in ("textures", "graynormal", "longnormal"):
        np.save(folder / name / "height.npy", heights)
    np.save(folder / "unnamed/picture.npy", heights)
    np.save(folder / "graynormal/normal.npy", heights)
    np.save(folder / "longnormal/normal.npy", np.full((4, 8, 3), [0.5, 0.5, 255.0]))
    (folder / "zipped").mkdir()
    (folder / "zipped/rock.zip").write_bytes(b"PK")
    (folder / "below/textures").mkdir(parents=True)
    np.save(folder / "below/textures/height.npy", heights)
    (folder / "pictures").mkdir()
    record = {"format": "mbtf-pictures", "kind": "reference", "hash": "", "depends": {}, "files": "all"}
    (folder / "pictures/pictures.json").write_text(json.dumps(record))


_BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, name in zip("abcde", "bcdef", strict=True)
)
_RECIPE = "name: r\ngenerate: {material: heights.npy, queries: {train: 10, test: 10}}\n"
_TEXTS = {
    "tab": "height: heights.npy\nbase_color:\n\tvalue: 0.5\n",
    "twice": "height: heights.npy\nheight: other.npy\n",
    "list": "- heights.npy\n",
    "number": "height: heights.npy\nroughness: rough\nmetallic: [1, 2]\n",
    "bomb": _BOMB,
    "tag": "height: !mine heights.npy\n",
    "deep": "height: " + "[" * 500 + "]" * 500,
    "key": "height: heights.npy\n1: 2\n",
    "bsdf": "height: heights.npy\nbsdf: {type: difuse}\n",
    "piped": "height: heights.npy\nroughness: pipe.npy\n",
    "channel": "height: {file: heights.npy, channel: G}\n",
    "escape": 'height: heights.npy\n"\\e[2Jroughness": 1\n',
    "publish": "author: [Ada]\nlicence: MIT\n",
    "types": "queries:\n  spp: few\n",
    "section": "queries: 5\n",
    "fit": "training:\n  time: 2min\n  btach: 5\n",
    "recipe-key": _RECIPE + "fit: {model: neumip}\nreprot: {}\n",
    "recipe-lost": _RECIPE.replace("heights.npy", "lost.npy") + "fit: {model: neumip}\n",
    "recipe-material": "name: r\ngenerate: {queries: {train: 10}}\nfit: {model: neumip}\n",
    "recipe-name": _RECIPE.replace("name: r", "name: a/b") + "fit: {model: neumip}\n",
    "recipe-view": _RECIPE + "fit: {model: neumip}\ncompare: {views: [{elevation: 5}]}\n",
    "recipe-empty": "",
    "recipe-fits": _RECIPE + "fit: {}\n",
    "recipe-model": _RECIPE + "fit: {model: neumpi}\n",
    "recipe-twice": _RECIPE + "fit: {model: neumip}\ncompare: {kinds: [query, query]}\n",
}


def _shards(folder: Path) -> None:
    write_dataset(folder / "set", queries={"train": "40", "test": "8"}, output={"shard_queries": 20})
    for name in ("foreign", "nojson"):
        shutil.copytree(folder / "set", folder / name)

    def change(name: str, old: str, new: str) -> None:
        path = folder / name / "manifest.json"
        text = path.read_text()
        assert old in text, name
        path.write_text(text.replace(old, new))

    change("foreign", "mbtf-shards", "other-shards")
    change("nojson", "{", "[")
    options: dict[str, dict[str, object]] = {
        **{name: {} for name in ("shards", "shards-nan", "shards-cut", "shards-rows")},
        "shards-image": {"layout": "image"},
        "shards-empty": {"train": 0},
    }
    for name, more in options.items():
        write_data(folder / name, constant(0.2), **{"train": 100, "test": 20, "shards": 1, **more})
    path = folder / "shards-nan" / "train-00000.npz"
    content = bytearray(path.read_bytes())
    at = content.index(b"value_a.npy")
    at = content.index(b"\n", at) + 1
    content[at : at + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(content)
    path = folder / "shards-cut" / "train-00000.npz"
    path.write_bytes(path.read_bytes()[:-100])
    edit(folder / "shards-rows" / "train-00000.json", lambda record: record.update(rows=99))
    shutil.copytree(folder / "set", folder / "shards-pipe")
    (folder / "shards-pipe" / "train-00000.npz").unlink()
    os.mkfifo(folder / "shards-pipe" / "train-00000.npz")


def call(words: list[str]) -> Done:
    """Run a command line of one of the programs in this process, in the current folder."""
    import mbtf_fit.cli.app
    import mbtf_gen.cli.app
    import mbtf_pipeline.cli.app

    program, *tokens = words
    modules = {
        "mbtf-gen": mbtf_gen.cli.app,
        "mbtf-fit": mbtf_fit.cli.app,
        "mbtf-pipeline": mbtf_pipeline.cli.app,
    }
    loggers = [logging.getLogger(name) for name in ("mbtf_core", "mbtf_gen", "mbtf_fit", "mbtf_pipeline")]
    before = [(logger, logger.handlers, logger.propagate, logger.level) for logger in loggers]
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run(modules[program].app, tokens)
    finally:
        for logger, handlers, propagate, level in before:
            logger.handlers, logger.propagate = handlers, propagate
            logger.setLevel(level)
    return Done(code, out.getvalue(), err.getvalue())


def fails(code: int, *arguments: str) -> str:
    """Error message of a failing ``mbtf-fit``: at most two lines, no traceback, no standard output."""
    done = call(["mbtf-fit", *arguments])
    assert done.code == code, done.err
    assert done.out == ""
    start = done.err.index("error: ")
    assert len(done.err[start:].splitlines()) <= 2, done.err
    assert "Traceback" not in done.err
    return done.err[start:]
