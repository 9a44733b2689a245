"""XML that is edited in place: elements with the bytes they stand at, so that all else stays byte for byte."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from xml.parsers import expat

from musclefit.errors import InputError

_TAG_END = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>")

DEEPEST = 200
"""Elements in each other; OpenSim's own files need about 15."""


@dataclass(slots=True)
class Element:
    """An element of a file.

    Parameters
    ----------
    tag, name : str
        ``name`` is the attribute of that name.
    line : int
    start, end : int
        Where its content stands in the file, bytes.
    """

    tag: str
    name: str
    line: int
    start: int
    end: int = -1
    text: str = ""
    attributes: dict[str, str] = field(default_factory=dict)
    children: list[Element] = field(default_factory=list)

    def child(self, tag: str) -> Element | None:
        """The first child with a tag."""
        return next((child for child in self.children if child.tag == tag), None)

    def words(self, tag: str) -> str:
        """The text of the first child with a tag; "" where there is none."""
        child = self.child(tag)
        return child.text.strip() if child else ""

    def objects(self, tag: str) -> list[Element]:
        """What the ``objects`` of a set hold, or a plain list of children."""
        found = self.child(tag)
        if found is None:
            return []
        inner = found.child("objects")
        return list((inner or found).children)

    def all(self, *tags: str) -> Iterator[Element]:
        """Every element below with one of the tags, in the file's order."""
        for child in self.children:
            if child.tag in tags:
                yield child
            yield from child.all(*tags)


def parse_xml(data: bytes, *, source: str) -> Element:
    """Read XML in UTF-8 or another encoding of single bytes.

    Raises
    ------
    InputError
        Not well-formed, in another encoding, with a document type, or nested too deeply; the message names the line.
    """
    if not data.strip():
        raise InputError(f"{source}: an empty file; export it again")
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{source}: is UTF-16; save it as UTF-8")
    root = Element("", "", 0, 0)
    stack = [root]
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def opened(tag: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        if len(stack) > DEEPEST:
            raise InputError(f"{source}: line {parser.CurrentLineNumber}: more than {DEEPEST} elements in each other")
        tag_end = _TAG_END.match(data, at)
        end = tag_end.end() if tag_end else at
        element = Element(tag, attributes.get("name", ""), parser.CurrentLineNumber, end, attributes=attributes)
        stack[-1].children.append(element)
        stack.append(element)

    def closed(_tag: str) -> None:
        element = stack.pop()
        element.end = max(parser.CurrentByteIndex, element.start)

    def said(text: str) -> None:
        stack[-1].text += text

    def refused(*_: object) -> None:
        raise InputError(f"{source}: declares a document type, which may name other files; remove its <!DOCTYPE ...>")

    parser.StartElementHandler, parser.EndElementHandler = opened, closed
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = said, refused
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise InputError(
            f"{source}: line {error.lineno} is not valid XML ({expat.errors.messages[error.code]}); it is damaged "
            "or cut short: export it again"
        ) from None
    except (LookupError, ValueError) as error:  # an encoding that Python does not know, or of several bytes
        raise InputError(f"{source}: its XML declaration names no encoding that is known ({error})") from None
    return root.children[0]


def replaced(data: bytes, edits: Sequence[tuple[Element, str]]) -> bytes:
    """The file with the content of some elements replaced, all else byte for byte.

    Parameters
    ----------
    data : bytes
    edits : sequence of (Element, text)
        The text must need no escaping; no element lies in another.
    """
    parts, at = [], 0
    for element, text in sorted(edits, key=lambda edit: edit[0].start):
        parts += [data[at : element.start], text.encode()]
        at = element.end
    return b"".join([*parts, data[at:]])
