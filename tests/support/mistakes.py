"""Mistakes that people make with the three programs: command lines, and the files that they name."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import shutil
from pathlib import Path

import numpy as np

from mbtf_core.console import run

from .commands import Done
from .datasets import write_dataset
from .fit_data import constant, write_data
from .image_samples import jpgs, png, pngs

# Group → command lines.
LINES: dict[str, list[str]] = {
    "command lines": [
        "mbtf-gen --queries 5",
        "mbtf-gen verfy set",
        "mbtf-gen heights.npy nan.npy",
        "mbtf-gen nowhere.exr",
        "mbtf-gen heights.np",
        "mbtf-gen heights.npy --queries many",
        "mbtf-gen heights.npy --queries -5",
        "mbtf-gen heights.npy --queries 0/texel",
        "mbtf-gen heights.npy --queries 4/pixel",
        "mbtf-gen heights.npy --queries 1.5",
        "mbtf-gen heights.npy --queries 1e12/texel",
        "mbtf-gen heights.npy --spp 5",
        "mbtf-gen heights.npy --resolution 99",
        "mbtf-gen heights.npy --light-width 60",
        "mbtf-gen heights.npy --light-width 0.001",
        "mbtf-gen heights.npy --min-cos 0",
        "mbtf-gen heights.npy --set queries.ssp=4",
        "mbtf-gen heights.npy --set queries",
        "mbtf-gen heights.npy --set seed=-1",
        "mbtf-gen heights.npy --set seed=2001-01-01",
        "mbtf-gen heights.npy --set queries.mixture.finest=0 --set queries.mixture.log_uniform=0",
        "mbtf-gen heights.npy --slice 4/3",
        "mbtf-gen heights.npy -o notes.txt",
        "mbtf-gen heights.npy -o notes.txt/below",
        "mbtf-gen heights.npy -o textures",
        "mbtf-gen steep.npy -o textures",
        "mbtf-gen steep.npy --height-scale 0.1 -o textures",
        "mbtf-gen heights.npy -o set --queries 10",
        "mbtf-gen reference heights.npy --view 5,0",
        "mbtf-gen reference heights.npy --view 60",
        "mbtf-gen reference heights.npy --view -10,0",
        "mbtf-gen reference heights.npy --tiles-across 1,zwei",
        "mbtf-gen reference heights.npy --tiles-across 1,1.0",
        "mbtf-gen reference heights.npy --size 0",
        "mbtf-gen reference heights.npy -o textures",
        "mbtf-gen reference heights.npy -o pictures",
        "mbtf-gen inspect nowhere",
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
    "images": [
        f"mbtf-gen {name}"
        for name in (
            *("text.exr", "cut.exr", "cut.png", "empty.png", "garbage.npy", "misnamed.exr", "notes.txt"),
            *("nan.npy", "inf.npy", "objects.npy", "whole.npy", "flat.npy", "huge.png", "short.png"),
            *("layers.exr", "crop.exr", "color.npy", "ink.jpg"),
        )
    ],
    "materials": [
        f"mbtf-gen {name}"
        for name in (
            *("empty", "twice", "unnamed", "aspects", "beyond", "graynormal", "unknown.yaml", "broken.yaml"),
            *("tab.yaml", "twice.yaml", "lost.yaml", "list.yaml", "latin.yaml", "number.yaml", "range.yaml"),
            *("nothing.yaml", "both.yaml", "bsdf.yaml", "bsdftype.yaml", "bsdffile.yaml", "bomb.yaml"),
            *("longnormal", "tag.yaml", "deep.yaml", "key.yaml", "channel.yaml", "escape.yaml"),
            *("zipped", "zipped/rock.zip", "below"),
        )
    ],
    "configurations": [
        *(f"mbtf-gen heights.npy --config {name}.yaml" for name in ("no", "config", "types", "section")),
        "mbtf-gen heights.npy --config config.yaml --seed 1",
        "mbtf-fit shards --config fit.yaml",
    ],
    "recipes": [
        f"mbtf-pipeline run {name}.yaml"
        for name in (
            *("recipe-key", "recipe-lost", "recipe-material", "recipe-name", "recipe-view", "recipe-empty"),
            *("recipe-fits", "recipe-model", "recipe-twice"),
        )
    ],
    "shards": [
        *(f"mbtf-gen verify {name}" for name in ("nowhere", "textures", "schema", "foreign", "nojson")),
        *(f"mbtf-gen verify {name}" for name in ("altered", "outside", "flipped", "cut", "missing")),
        "mbtf-gen merge schema",
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
    _images(folder, heights)
    _folders(folder, heights)
    for name, text in _TEXTS.items():
        (folder / f"{name}.yaml").write_text(text)
    (folder / "latin.yaml").write_bytes("# größer\nheight: heights.npy\n".encode("latin-1"))
    _shards(folder)


def _images(folder: Path, heights: np.ndarray) -> None:
    import OpenEXR

    (folder / "text.exr").write_text("no image")
    (folder / "empty.png").write_bytes(b"")
    (folder / "garbage.npy").write_bytes(b"\x93NUMPYgarbage")
    (folder / "cut.png").write_bytes(pngs()["L.png"][:50])
    (folder / "misnamed.exr").write_bytes(pngs()["L.png"])
    (folder / "ink.jpg").write_bytes(jpgs()["CMYK.jpg"])
    (folder / "huge.png").write_bytes(png(60_000, 60_000, 8, 0, b""))
    (folder / "short.png").write_bytes(png(11_000, 11_000, 8, 0, b""))
    spoilt = heights.copy()
    spoilt[2, 5] = spoilt[3, 0] = np.nan
    np.save(folder / "nan.npy", spoilt)
    spoilt[2, 5], spoilt[3, 0] = 0.5, -np.inf
    np.save(folder / "inf.npy", spoilt)
    np.save(folder / "objects.npy", np.array([[None]]), allow_pickle=True)
    np.save(folder / "whole.npy", np.zeros((4, 4), np.int64))
    np.save(folder / "flat.npy", np.zeros(16))
    np.save(folder / "color.npy", np.random.default_rng(0).random((4, 4, 3)))

    def exr(name: str, channels: dict[str, np.ndarray], **more: object) -> None:
        header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage, **more}
        pixels = {key: channel.astype(np.float32) for key, channel in channels.items()}
        OpenEXR.File(header, pixels).write(str(folder / name))

    exr("cut.exr", {"Y": heights})
    (folder / "cut.exr").write_bytes((folder / "cut.exr").read_bytes()[:-40])
    exr("layers.exr", {"first.Z": heights, "second.Z": heights})
    window = (np.array([0, 0], np.int32), np.array([15, 15], np.int32))
    exr("crop.exr", {"Y": heights}, displayWindow=window)


def _folders(folder: Path, heights: np.ndarray) -> None:
    for name in ("empty", "textures", "twice", "unnamed", "aspects", "beyond", "graynormal", "longnormal"):
        (folder / name).mkdir()
    for name in ("textures", "twice", "aspects", "beyond", "graynormal", "longnormal"):
        np.save(folder / name / "height.npy", heights)
    np.save(folder / "twice/displacement.npy", heights)
    np.save(folder / "unnamed/picture.npy", heights)
    np.save(folder / "aspects/base_color.npy", np.zeros((8, 8, 3)))
    np.save(folder / "graynormal/normal.npy", heights)
    np.save(folder / "longnormal/normal.npy", np.full((4, 8, 3), [0.5, 0.5, 255.0]))
    (folder / "zipped").mkdir()
    (folder / "zipped/rock.zip").write_bytes(b"PK")
    (folder / "below/textures").mkdir(parents=True)
    np.save(folder / "below/textures/height.npy", heights)
    (folder / "pictures").mkdir()
    record = {"format": "mbtf-pictures", "kind": "reference", "hash": "", "depends": {}, "files": "all"}
    (folder / "pictures/pictures.json").write_text(json.dumps(record))
    spoilt = np.full((4, 8), 0.5)
    spoilt[1, 3] = 1.5
    np.save(folder / "beyond/roughness.npy", spoilt)


_BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, name in zip("abcde", "bcdef", strict=True)
)
_RECIPE = "name: r\ngenerate: {material: heights.npy, queries: {train: 10, test: 10}}\n"
_TEXTS = {
    "unknown": "height: heights.npy\nruoghness: 0.5\n",
    "broken": "height: heights.npy\n  roughness: 0.5\n",
    "tab": "height: heights.npy\nbase_color:\n\tvalue: 0.5\n",
    "twice": "height: heights.npy\nheight: other.npy\n",
    "lost": "height: heights.npy\nbase_color: nowhere.png\n",
    "list": "- heights.npy\n",
    "number": "height: heights.npy\nroughness: rough\nmetallic: [1, 2]\n",
    "range": "height: heights.npy\nroughness: 1.5\n",
    "nothing": "base_color: 0.5\n",
    "both": "height: heights.npy\nroughness: {file: heights.npy, value: 0.5}\n",
    "bsdf": "height: heights.npy\nroughness: 0.5\nbsdf: {type: diffuse}\n",
    "bsdftype": "height: heights.npy\nbsdf: {reflectance: 0.5}\n",
    "bsdffile": "height: heights.npy\nbsdf: {type: diffuse, reflectance: {type: bitmap, filename: no.png}}\n",
    "bomb": _BOMB,
    "tag": "height: !mine heights.npy\n",
    "deep": "height: " + "[" * 500 + "]" * 500,
    "key": "height: heights.npy\n1: 2\n",
    "channel": "height: {file: heights.npy, channel: G}\n",
    "escape": 'height: heights.npy\n"\\e[2Jroughness": 1\n',
    "config": "queries:\n  spp: 4\n  mincos: 0.2\n",
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
    for name in ("schema", "foreign", "nojson", "altered", "outside", "flipped", "cut", "missing"):
        shutil.copytree(folder / "set", folder / name)

    def change(name: str, old: str, new: str) -> None:
        path = folder / name / "manifest.json"
        text = path.read_text()
        assert old in text, name
        path.write_text(text.replace(old, new))

    change("schema", '"schema": 2', '"schema": 99')
    change("foreign", "mbtf-shards", "other-shards")
    change("nojson", "{", "[")
    change("altered", '"rows": 20', '"rows": "twenty"')
    change("outside", "train-00001.npz", "../train-00001.npz")
    shard = "train-00001.npz"
    content = bytearray((folder / "flipped" / shard).read_bytes())
    content[-500] ^= 1
    (folder / "flipped" / shard).write_bytes(content)
    (folder / "cut" / shard).write_bytes(content[:-1])
    (folder / "missing" / shard).unlink()
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
    (folder / "shards-rows" / "train-00000.json").write_text(json.dumps({"rows": 99}))


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
