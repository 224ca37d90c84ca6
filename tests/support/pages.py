"""What a page would load from elsewhere."""

from __future__ import annotations

import re
from html.parser import HTMLParser


class Loads(HTMLParser):
    """Collects everything a page would load, and its pictures."""

    def __init__(self) -> None:
        super().__init__()
        self.external: list[str] = []
        self.pictures: list[str] = []
        self.style = ""
        self._open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        # Data for a script are read by it, never run; what it may load stands in the script.
        inert = tag == "script" and ("type", "application/json") in attrs
        self._open.append("data" if inert else tag)
        for name, value in attrs:
            if name == "style":
                self._css(value or "")
            loading = ("src", "href", "xlink:href", "srcset", "data", "poster", "action", "background")
            # A link loads nothing until it is followed.
            if tag != "a" and name in loading:
                if tag == "img" and name == "src":
                    self.pictures.append(value or "")
                if not (value or "").startswith(("data:", "#")):
                    self.external.append(f"{tag} {name}={value}")

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "style":
            self._css(data)
        elif self._open and self._open[-1] == "script":
            self.external += re.findall(r"(?:fetch|import|XMLHttpRequest|WebSocket|https?:)[^\n]*", data)

    def _css(self, text: str) -> None:
        self.external += re.findall(r"@import[^;]*", text)
        found = re.findall(r"url\(\s*['\"]?([^)'\"]*)", text)
        self.external += [url for url in found if not url.startswith(("data:", "#"))]


def loads(html: str) -> Loads:
    parser = Loads()
    parser.feed(html)
    return parser
