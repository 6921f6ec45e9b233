"""Reads a page of a report as a browser without a network would: elements with their attributes, tables, pictures, embedded numbers."""

from __future__ import annotations

import base64
import itertools
import json
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np


@dataclass
class Element:
    tag: str
    attributes: dict[str, str]
    parent: Element | None
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str, **having: str) -> list[Element]:
        """Those of a tag below this one, in order, with the given attributes (``class_``: one of its classes)."""
        own = [self] if self.tag == tag and all(self._has(key, value) for key, value in having.items()) else []
        return own + [found for child in self.children for found in child.all(tag, **having)]

    def _has(self, key: str, value: str) -> bool:
        stated = self.attributes.get(key.rstrip("_"), "")
        return value in stated.split() if key == "class_" else value == stated

    def whole_text(self) -> str:
        return self.text + "".join(child.whole_text() for child in self.children)


class Page(HTMLParser):
    """A page read from its file; it must be well-formed: what is opened is closed."""

    VOID = ("meta", "img", "input", "br", "link")

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.source = path, path.read_text(encoding="utf-8")
        self.root = self.at = Element("", {}, None)
        self.feed(self.source)
        self.close()
        assert self.at is self.root, f"<{self.at.tag}> is never closed"

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        made = Element(tag, {key: value or "" for key, value in attributes}, self.at)
        self.at.children.append(made)
        if tag not in self.VOID:
            self.at = made

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.at.children.append(Element(tag, {key: value or "" for key, value in attributes}, self.at))

    def handle_endtag(self, tag: str) -> None:
        assert self.at.tag == tag, f"</{tag}> closes <{self.at.tag}>"
        assert self.at.parent is not None
        self.at = self.at.parent

    def handle_data(self, data: str) -> None:
        self.at.text += data

    def table(self, label: str) -> list[list[str]]:
        """Header and rows of the table of that label."""
        (region,) = self.root.all("div", **{"aria-label": label})
        return [[cell.whole_text() for cell in row.children] for row in region.all("tr")]

    def spectra(self) -> dict[str, dict[str, Any]]:
        """By title of a row: what is embedded, with measured, rendered, deviation (height, width, C), NaN where no ray is."""
        found = {}
        for section in self.root.all("section", class_="modality"):
            for script in section.all("script", type="application/json"):
                stored = json.loads(script.text)
                shape = (stored["height"], stored["width"], len(stored["channels"]))
                for key in ("measured", "rendered", "deviation"):
                    if key in stored:
                        steps = np.frombuffer(base64.b64decode(stored[key]), "<u2").reshape(shape)
                        values = stored["low"] + steps / 65534 * (stored["high"] - stored["low"])
                        stored[key] = np.where(steps == 65535, np.nan, values)
                found[section.all("h3")[0].text.strip()] = stored
        return found


def picture_of(image: Element) -> np.ndarray:
    """Pixels of an <img>."""
    content = base64.b64decode(image.attributes["src"].split(",", 1)[1])
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)


def check(path: Path) -> Page:
    """Read a page and assert what every page keeps: nothing from elsewhere, links that lead somewhere, text for every picture, order."""
    page = Page(path)
    root = page.root
    assert len(page.source) < 6_000_000
    for element in (e for tag in ("img", "a", "script", "link", "iframe", "use", "image", "source") for e in root.all(tag)):
        for key in ("src", "href", "xlink:href"):
            address = element.attributes.get(key, "#")
            if address.startswith("data:"):
                assert address.startswith(("data:image/png;base64,", "data:image/jpeg;base64,"))
            elif not address.startswith("#"):
                assert element.tag == "a" and not re.match(r"[a-z]+:|//|/", address), address
                assert (path.parent / unquote(address)).exists(), f"{address} is not there"
    assert not re.search(r"url\(\s*['\"]?(?!#)|@import", page.source)
    (policy,) = root.all("meta", **{"http-equiv": "Content-Security-Policy"})
    assert policy.attributes["content"].startswith("default-src 'none'")
    assert root.all("html")[0].attributes["lang"] == "en" and len(root.all("main")) == len(root.all("h1")) == 1
    levels = [int(tag[1]) for tag in re.findall(r"<(h[1-6])[ >]", page.source)]
    assert levels[0] == 1 and all(after <= before + 1 for before, after in itertools.pairwise(levels))
    style = root.all("style")[0].text
    for part in ("prefers-color-scheme: dark", "color-scheme: light dark", "@media print", ":focus-visible"):
        assert part in style
    for image in root.all("img"):
        assert image.attributes["alt"].strip() and "src" in image.attributes
        height, width = picture_of(image).shape[:2]
        if image.parent is not None and image.parent.tag == "div":
            assert image.attributes["width"] == str(width) and image.attributes["height"] == str(height)
    for wipe in root.all("figure", class_="wipe"):
        over, under = wipe.all("div", class_="pair")[0].all("img")
        assert picture_of(over).shape == picture_of(under).shape
        (slider,) = wipe.all("input")
        assert slider.attributes["type"] == "range" and slider.attributes["aria-label"]
    for drawing in root.all("figure", class_="drawing"):
        (inside,) = drawing.all("div", role="img")
        assert inside.attributes["aria-label"] and inside.all("svg")
    for label in [region.attributes["aria-label"] for region in root.all("div", class_="scroll")]:
        table = page.table(label)
        assert {len(row) for row in table} == {len(table[0])}, label
    ids = re.findall(r'<h2 id="([^"]*)"', page.source)
    assert len(set(ids)) == len(ids) == len(root.all("h2"))
    return page
