"""Output folders: what is taken, what is refused, what is swept."""

from __future__ import annotations

import os
import resource
from pathlib import Path
from types import SimpleNamespace

import pytest

from mbtf_core.errors import InputError, PartialError
from mbtf_core.files import folders
from mbtf_core.files.atomic import temporary_of
from mbtf_core.files.folders import (
    check_folder,
    check_space,
    make_folder,
    other_configuration,
    owned,
    remove_unfinished,
)
from mbtf_core.units import expectation


def is_ours(folder: Path) -> bool:
    return (folder / "record.json").exists()


def test_new_and_empty_folders_are_taken_and_ours_is_resumed(tmp_path: Path) -> None:
    folder = tmp_path / "a/b"
    assert not check_folder(folder, is_ours, "record")
    make_folder(folder)
    temporary_of(folder / "record.json").touch()
    (folder / ".record.lock").touch()
    assert not check_folder(folder, is_ours, "record")
    (folder / "record.json").touch()
    assert check_folder(folder, is_ours, "record")


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


@pytest.mark.parametrize("name", ["notes.txt", ".env"])
def test_files_of_others_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(
        InputError, match=r"is not empty and holds no record\n  choose another folder with -o"
    ):
        check_folder(tmp_path, is_ours, "record")
    with pytest.raises(InputError, match="is a file, not a folder"):
        check_folder(tmp_path / name, is_ours, "record")
    with pytest.raises(InputError, match="cannot be created"):
        make_folder(tmp_path / name / "below")


def test_another_configuration_names_what_differs(tmp_path: Path) -> None:
    error = other_configuration(tmp_path, "a fit", {"a": 1, "b": 2}, {"a": 1, "b": 3})
    assert "holds a fit of another configuration: b: 2 -> 3" in error.message
    assert "--overwrite" in error.hint


def test_only_unfinished_files_of_ours_are_removed(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        temporary_of(tmp_path / name).touch()
    remove_unfinished(tmp_path, ["a.npz"])
    assert [p.name for p in tmp_path.iterdir()] == [temporary_of(tmp_path / "b.npz").name]


def test_what_does_not_fit_on_the_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=3e9))
    check_space(tmp_path / "new" / "folder", 3e9, "hint")
    with pytest.raises(InputError, match=r"new/folder: needs 27 GB; 3.0 GB are free\n  reduce --queries"):
        check_space(tmp_path / "new" / "folder", 27e9, "reduce --queries")
    assert not (tmp_path / "new").exists()
    assert expectation(75.0, 27e9) == "expected: about 1:15, 27 GB on disk"
    assert expectation(None, 5e5) == "expected: 500 kB on disk"


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
