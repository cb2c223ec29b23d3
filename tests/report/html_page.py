"""An HTML page as a tree, for tests that look for what is on it."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser

import cv2
import numpy as np

from needletrack.records import Float, Image

# Written without an end; those of SVG close themselves.
_VOID = {"meta", "input", "br", "link", "img"}


@dataclass
class Node:
    """An element: its attributes, and the elements and texts in it, in their order."""

    tag: str
    attributes: dict[str, str]
    content: list["Node | str"] = field(default_factory=list)

    @property
    def children(self) -> list["Node"]:
        return [each for each in self.content if isinstance(each, Node)]

    @property
    def text(self) -> str:
        """All text within, blanks made one."""
        return " ".join(" ".join(each if isinstance(each, str) else each.text for each in self.content).split())

    @property
    def classes(self) -> set[str]:
        return set(self.attributes.get("class", "").split())

    def walk(self) -> Iterator["Node"]:
        """This element and all within."""
        yield self
        for child in self.children:
            yield from child.walk()

    def all(self, tag: str, *classes: str) -> list["Node"]:
        """All elements within of that name and those classes."""
        return [node for node in self.walk() if node.tag == tag and node.classes >= set(classes)]

    def one(self, tag: str, *classes: str) -> "Node":
        (found,) = self.all(tag, *classes)
        return found

    def by_id(self, name: str) -> "Node":
        (found,) = (node for node in self.walk() if node.attributes.get("id") == name)
        return found


class _Builder(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.root = Node("document", {})
        self._open = [self.root]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        node = Node(tag, {name: value or "" for name, value in attrs})
        self._open[-1].content.append(node)
        if tag not in _VOID:
            self._open.append(node)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._open[-1].content.append(Node(tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop().tag == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        self._open[-1].content.append(data)


def parsed(text: str) -> Node:
    """The page as a tree; fails where an element is not closed in its turn."""
    builder = _Builder()
    builder.feed(text)
    builder.close()
    assert builder._open == [builder.root]
    return builder.root


def decoded(uri: str) -> Image:
    """The image in a data URI."""
    head, _, data = uri.partition(",")
    assert head == "data:image/webp;base64"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def points_of(path: Node) -> Float:
    """The points (N, 2) of a path that is one polyline."""
    text = path.attributes["d"]
    assert text.count("M") == 1
    return np.array([point.split() for point in text[1:].split("L")], dtype=np.float64)
