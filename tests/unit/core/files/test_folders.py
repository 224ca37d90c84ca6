"""Output folders: claimed, resumed, refused, replaced; files of others stay."""

from __future__ import annotations

import hashlib
import json
import os
import resource
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mbtf_core.errors import InputError, PartialError
from mbtf_core.files import editable
from mbtf_core.files.editable import write_document
from mbtf_core.files.folders import (
    OutputFolder,
    OutputKind,
    owned,
)

CONFIG = {"light": {"width": 1.0}, "reference": {"size": 8, "spp": 4}}
KIND = OutputKind("pictures.json", "mbtf-pictures", 1, "pictures")
FILES = ["a.exr", "a.png", "b.png"]


def test_one_command_owns_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "a/b"
    with owned(folder):
        with pytest.raises(PartialError, match=rf"process {os.getpid()} on .*, for 0 s"), owned(folder):
            pass
        with owned(tmp_path / "a"):
            pass
    assert not folder.exists(), "nothing was written"
    with owned(folder):
        (folder / "file").touch()
    with owned(folder):
        assert (folder / "file").exists()
    (folder / "file").unlink()
    with owned(folder):
        pass
    assert folder.exists(), "it was there before"


def test_a_full_disk_leaves_neither_lock_nor_folder(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        for name in ("there", "new"):
            with pytest.raises(PartialError, match="cannot be written"), owned(tmp_path / name):
                pytest.fail("a lock that names nobody")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [path.name for path in tmp_path.rglob("*")] == ["there"]


def claim(path: Path, config: dict[str, Any] = CONFIG, height: str = "0f", **options: Any) -> OutputFolder:
    depends = {**config, "inputs": {"height": 32 * height}}
    return OutputFolder.claim(path, KIND, depends, FILES, config=config, **options)


def make(folder: OutputFolder, *names: str) -> None:
    paths = [folder.path / name for name in names]
    for path in paths:
        path.write_bytes(b"picture")
    folder.keep(names[0].partition(".")[0], paths, {"noise": 0.5})


def listing(path: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in path.iterdir()}


def test_the_same_configuration_keeps_what_is_finished(tmp_path: Path) -> None:
    make(claim(tmp_path / "out"), "a.exr", "a.png")
    record = json.loads((tmp_path / "out/pictures.json").read_text())
    stored = {"bytes": 7, "sha256": hashlib.sha256(b"picture").hexdigest()}
    assert record["items"] == {"a": {"files": {"a.exr": stored, "a.png": stored}, "facts": {"noise": 0.5}}}
    again = claim(tmp_path / "out")
    assert again.finished("a") == {"noise": 0.5}
    assert again.finished("b") is None
    (again.path / "a.png").unlink()
    assert again.finished("a") is None
    # Killed while it is made again: its files may have other bytes now.
    (again.path / "a.exr").write_bytes(b"other")
    assert claim(tmp_path / "out").finished("a") is None
    make(claim(tmp_path / "out"), "a.exr", "a.png")
    assert claim(tmp_path / "out").finished("a", noise=0.5) == {"noise": 0.5}
    assert claim(tmp_path / "out").finished("a", noise=0.4) is None
    (again.path / "a.exr").write_bytes(b"other")
    assert claim(tmp_path / "out").finished("a") is None


@pytest.mark.parametrize("name", ["a.exr", "a.png", "config.yaml"])
def test_a_changed_file_is_replaced_on_request_only(tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    make(claim(out), "a.exr", "a.png")
    content = (out / name).read_bytes()
    # Its size and its date are those of before.
    edited = bytes([content[0] ^ 1]) + content[1:]
    (out / name).write_bytes(edited)
    before = listing(out)
    with pytest.raises(InputError, match=rf"{name}: has been edited, or damaged"):
        claim(out).finished("a")
    assert listing(out) == before
    make(claim(out, overwrite=True), "a.exr", "a.png")
    assert (out / name).read_bytes() == content


def test_documents_are_replaced_unless_they_were_edited(tmp_path: Path) -> None:
    texts = ((".yaml", "a: 1", "a: 2\n"), (".html", "<p>1</p>", "<p>2</p>\n"), (".csv", "a,1", "a,2\n"))
    for suffix, first, second in texts:
        path = tmp_path / f"page{suffix}"
        write_document(path, first)
        write_document(path, second)
        text = path.read_text()
        assert text.startswith(second)
        for edit in (text.replace("2", "3", 1), f"{text}\n", f"{text}more", text.splitlines()[0], ""):
            path.write_text(edit)
            with pytest.raises(InputError, match="has been edited"):
                write_document(path, first)
            assert path.read_text() == edit
        write_document(path, second, overwrite=True)
        assert path.read_text() == text


def test_a_document_is_written_again_after_a_kill_between_its_digest_and_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, write = tmp_path / "table.csv", editable.write_chunks

    def killed(to: Path, chunks: Iterable[bytes]) -> object:
        if to == path:
            raise KeyboardInterrupt
        return write(to, chunks)

    for text, again in (("a,1\n", "a,2\n"), ("a,3\n", "a,4\n")):
        with monkeypatch.context() as patch:
            patch.setattr(editable, "write_chunks", killed)
            with pytest.raises(KeyboardInterrupt):
                write_document(path, text)
            with pytest.raises(KeyboardInterrupt):
                write_document(path, again)
        write_document(path, again)
        assert path.read_text() == again


def test_another_configuration_is_refused_with_what_differs(tmp_path: Path) -> None:
    make(claim(tmp_path / "out"), "a.exr", "a.png")
    before = listing(tmp_path / "out")
    other = {**CONFIG, "reference": {"size": 16, "spp": 4}}
    with pytest.raises(InputError) as caught:
        claim(tmp_path / "out", other, "ab")
    assert "reference.size: 8 -> 16; inputs.height: 0f0f0f0f… -> abababab…" in caught.value.what
    assert "--overwrite" in caught.value.hint
    assert listing(tmp_path / "out") == before
    older = replace(KIND, schema=0)
    with pytest.raises(InputError, match="has schema version 1, this program reads version 0"):
        OutputFolder.claim(tmp_path / "out", older, {}, FILES, overwrite=True)
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
        *({"pictures.json": text} for text in ('{"format": "mine"}', "{")),
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


def test_a_record_cannot_remove_what_lies_elsewhere(tmp_path: Path) -> None:
    claim(tmp_path / "out")
    record = json.loads((tmp_path / "out/pictures.json").read_text())
    record["listed"].append("../mine.txt")
    (tmp_path / "out/pictures.json").write_text(json.dumps(record))
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(InputError, match=r"is damaged .*must lie in the folder"):
        claim(tmp_path / "out", overwrite=True)
    assert (tmp_path / "mine.txt").exists()
