"""Output folders: what is taken, what is refused, what is swept."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbtf_core.atomic import temporary_of
from mbtf_core.errors import InputError
from mbtf_core.folders import check_folder, make_folder, other_configuration, remove_unfinished


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
