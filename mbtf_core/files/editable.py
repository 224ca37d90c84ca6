"""Texts that users may edit: written with a digest, and replaced only if they are as they were written."""

from __future__ import annotations

import hashlib
from pathlib import Path

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import file_sha256, write_chunks
from mbtf_core.paths import refuse_special

# Last line of a document, which tells whether the others are as they were written. The digest of another file
# is in a hidden file beside it.
_SEALS = {".yaml": "# sha256 of the lines above: {}\n", ".html": "<!-- sha256 of the lines above: {} -->\n"}


def write_document(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a text that users may edit, atomically. The last line of YAML and HTML is a comment with a digest
    of the others; of other formats the digest is in a hidden file.

    An InputError where there is a file that has been edited, unless it is to be overwritten, or that is not
    of this program; a PartialError where it cannot be written.
    """
    body = text if text.endswith("\n") else f"{text}\n"
    content = body.encode()
    if not overwrite:
        _refuse_edited(path)
    digest = hashlib.sha256(content).hexdigest()
    if path.suffix in _SEALS:
        write_chunks(path, [content, _SEALS[path.suffix].format(digest).encode()])
        return
    # Killed between the two, the file is still the one before.
    before = [file_sha256(path)] if path.is_file() else []
    write_chunks(_digest_file(path), ["\n".join([digest, *before]).encode()])
    write_chunks(path, [content])


def read_document(path: Path) -> str:
    """Text of a document, without the line of its digest."""
    text = path.read_text(encoding="utf-8")
    body, _, last = text[:-1].rpartition("\n")
    return f"{body}\n" if last.startswith(_SEALS[path.suffix].partition("{}")[0]) else text


def _digest_file(path: Path) -> Path:
    return path.with_name(f".{path.name}.sha256")


def _digests(path: Path) -> list[str]:
    """Digests that a file may have: of its last version, and of what was there before."""
    file = _digest_file(path)
    return file.read_text().split() if file.exists() else []


def _refuse_edited(path: Path) -> None:
    """An InputError if there is a document that is not as :func:`write_document` wrote it."""
    refuse_special(path)
    try:
        content = path.read_bytes()
        if path.suffix in _SEALS:
            body, _, last = content[:-1].rpartition(b"\n")
            wanted = _SEALS[path.suffix].format(hashlib.sha256(body + b"\n").hexdigest()).encode()
            unchanged = last + b"\n" == wanted
        else:
            unchanged = hashlib.sha256(content).hexdigest() in _digests(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    if not unchanged:
        raise changed(path)


def changed(path: Path, replaces: str = "--overwrite, where there is one,") -> InputError:
    """Error for a file that the user, or a fault of the disk, has changed; names the option that replaces
    it."""
    return InputError(
        "has been edited, or damaged, since it was written, and would be replaced",
        where=path,
        hint=f"move it away and run the same command again; {replaces} replaces all",
    )
