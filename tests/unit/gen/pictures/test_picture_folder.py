"""Folders of pictures: claimed, resumed, refused, replaced; files of others stay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from mbtf_core.errors import InputError
from mbtf_gen.pictures.folder import PictureFolder

CONFIG = {"material": "maps", "light": {"width": 1.0}, "reference": {"size": 8, "spp": 4}}
FILES = ["a.exr", "a.png", "b.png"]


def claim(path: Path, config: dict[str, Any] | None = None, **options: Any) -> PictureFolder:
    inputs = options.pop("inputs", {"height": "0f" * 32})
    kind = options.pop("kind", "reference")
    return PictureFolder.claim(path, kind, files=FILES, config=config or CONFIG, inputs=inputs, **options)


def make(folder: PictureFolder, *names: str) -> None:
    paths = [folder.path / name for name in names]
    for path in paths:
        path.write_bytes(b"picture")
    folder.keep(names[0].partition(".")[0], paths, {"noise": 0.5})


def listing(path: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in path.iterdir()}


def test_the_same_configuration_keeps_what_is_finished(tmp_path: Path) -> None:
    make(claim(tmp_path / "out"), "a.exr", "a.png")
    record = json.loads((tmp_path / "out/pictures.json").read_text())
    assert record["pictures"] == {"a": {"files": {"a.exr": 7, "a.png": 7}, "facts": {"noise": 0.5}}}
    # Another name of the same input is the same configuration.
    again = claim(tmp_path / "out", {**CONFIG, "material": "/elsewhere/maps"})
    assert again.finished("a") == {"noise": 0.5}
    assert again.finished("b") is None
    (again.path / "a.png").write_bytes(b"pict")
    assert again.finished("a") is None
    (again.path / "a.png").unlink()
    assert again.finished("a") is None


def test_another_configuration_is_refused_with_what_differs(tmp_path: Path) -> None:
    make(claim(tmp_path / "out"), "a.exr", "a.png")
    before = listing(tmp_path / "out")
    other = {**CONFIG, "reference": {"size": 16, "spp": 4}}
    with pytest.raises(InputError) as caught:
        claim(tmp_path / "out", other, inputs={"height": "ab" * 32})
    assert "reference.size: 8 -> 16; inputs.height: 0f0f0f0f… -> abababab…" in caught.value.what
    assert "--overwrite" in caught.value.hint
    assert listing(tmp_path / "out") == before
    for overwrite in (False, True):
        with pytest.raises(InputError, match="something else than mbtf-gen preview"):
            claim(tmp_path / "out", kind="preview", overwrite=overwrite)
    assert listing(tmp_path / "out") == before


def test_overwrite_removes_its_own_files_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    make(claim(out), "a.exr", "a.png")
    (out / "b.png").write_bytes(b"written, not yet recorded")
    (out / ".b.png.0123abcd-99.tmp").write_bytes(b"half")
    mine = {"notes.txt": b"kept", "c.png": b"kept", ".c.png.0123abcd-99.tmp": b"kept", ".b.png.swp": b"kept"}
    for name, content in mine.items():
        (out / name).write_bytes(content)
    other = {**CONFIG, "reference": {"size": 16, "spp": 4}}
    replaced = claim(out, other, overwrite=True)
    assert replaced.finished("a") is None
    assert {k: v for k, v in listing(out).items() if k not in ("config.yaml", "pictures.json")} == mine
    assert "size: 16" in (out / "config.yaml").read_text()


def test_a_killed_run_is_resumed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    # Killed while the record was written, then between record and configuration, then within a picture.
    out.mkdir()
    (out / ".pictures.json.0123abcd-7.tmp").write_text("{")
    claim(out)
    (out / "config.yaml").unlink()
    (out / ".a.exr.0123abcd-7.tmp").write_bytes(b"half")
    claim(out)
    assert sorted(listing(out)) == ["config.yaml", "pictures.json"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    "files",
    [
        *({name: "mine"} for name in ("notes.txt", "a.png", "config.yaml")),
        *({"pictures.json": text} for text in ('{"mine": 1}', "{")),
    ],
    ids=["notes", "same name", "config", "foreign record", "broken record"],
)
def test_foreign_folders_are_refused_untouched(
    files: dict[str, str], overwrite: bool, tmp_path: Path
) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError):
        claim(tmp_path, overwrite=overwrite)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == files
