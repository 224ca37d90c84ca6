"""URLs of object stores, such as ``s3://bucket/data``."""

from __future__ import annotations

import re

# pathlib joins the slashes of a URL. One letter is the drive of a Windows path.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/{1,3}(.*)", re.DOTALL)


def split_url(folder: object) -> tuple[str, str] | None:
    """(protocol, rest) of a URL, also of one that pathlib has changed to ``s3:/bucket``; None for a path. The
    rest has the form that pathlib gives it, so that a text and a path name the same folder."""
    match = _URL.fullmatch(str(folder))
    if match is None:
        return None
    return match[1].lower(), "/".join(part for part in match[2].split("/") if part not in ("", "."))
