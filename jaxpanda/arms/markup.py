"""XML as its author wrote it: where every tag stands, and edits that touch nothing else.

A parser that writes its tree back loses comments, line breaks or digits. Here the text stays what it is:
elements know the bytes of their start tag, and an edit replaces some of them.
"""

import dataclasses
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import escape

import numpy as np

from .. import inputs
from ..errors import InputError
from .model_file import WHOLE, Part

BYTES = 1 << 26
"""Most that a file of a model may have."""
ELEMENTS, ATTRIBUTES, DEPTH, INCLUDES = 100_000, 500, 200, 50
"""Most elements of a model (repeated ones each time), attributes of one, levels of elements and of includes."""
_COUNTS = {
    "composite": ("count",),
    "flexcomp": ("count",),
    "hfield": ("nrow", "ncol"),
    "texture": ("width", "height"),
    "user": ("dim",),
    "size": ("nuserdata", "njmax", "nconmax", "nstack", "nkey"),
}
"""Attributes that make MuJoCo allocate their product, by element."""
_MOST = 1 << 24

_ATTRIBUTE = re.compile(rb"""\s+([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")
_TAG = re.compile(rb"""<[^\s/>]+(?:"[^"]*"|'[^']*'|[^"'>])*>""")
_GAP = re.compile(rb"\s*")
_QUOTES = {'"': "&quot;", "'": "&apos;"}
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)


@dataclasses.dataclass(eq=False)
class Element:
    """An element of a file: its tag, attributes, and the bytes `start:stop` of its start tag."""

    source: str
    """Name of its text in the document."""
    file: Path
    line: int
    tag: str
    attributes: dict[str, str]
    start: int
    stop: int
    parent: "Element | None" = None
    children: list["Element"] = dataclasses.field(default_factory=list)

    def walk(self) -> Iterator["Element"]:
        """The element and all below it, in the order of the text."""
        yield self
        for child in self.children:
            yield from child.walk()

    def has_ancestor(self, tag: str) -> bool:
        return self.parent is not None and (self.parent.tag == tag or self.parent.has_ancestor(tag))


@dataclasses.dataclass(frozen=True)
class Edit:
    """What to do to one element: attributes to set (None removes one), and a child to put in first."""

    element: Element
    attributes: Mapping[str, str | None] = dataclasses.field(default_factory=dict)
    first_child: str = ""


@dataclasses.dataclass(frozen=True)
class Document:
    """A file and what it includes, as text and as one tree with the included elements in their place."""

    path: Path
    texts: Mapping[str, str]
    """Text by the name the file is included by; the main file under ''."""
    root: Element
    inclusions: Mapping[str, Element] = dataclasses.field(default_factory=dict)
    """The `include` element of each of the other texts."""
    part: Part = WHOLE
    """What of it is meant."""
    notes: tuple[str, ...] = ()
    """What became of it on the way in."""

    @property
    def text(self) -> str:
        return self.texts[""]

    @property
    def includes(self) -> dict[str, bytes]:
        return {name: text.encode() for name, text in self.texts.items() if name}


def read(path: str | Path, *roots: str, part: Part = WHOLE) -> Document:
    """The file and everything that it includes.

    Raises:
        InputError: a file cannot be read, is no well-formed XML, the first element is none of `roots`, or an
            include leads out of the model's folder and `part` does not allow that.
    """
    path = Path(path)
    return parse(_decode(inputs.read_bytes(path, BYTES), path), roots, path, part=part)


def parse(
    text: str,
    roots: str | tuple[str, ...],
    path: Path,
    known: Mapping[str, str] | None = None,
    *,
    part: Part = WHOLE,
    notes: tuple[str, ...] = (),
) -> Document:
    """The document with this text; what it includes comes from `known` or else from beside `path`."""
    tree = _tree(text, path)
    roots = (roots,) if isinstance(roots, str) else roots
    if tree.tag not in roots:
        expected = " or ".join(f"<{root}>" for root in roots)
        raise InputError(f"{path}: line {tree.line}: starts with <{tree.tag}>, where {expected} is expected")
    texts, inclusions = {"": text}, {}
    _include(tree, path, known or {}, texts, inclusions, part)
    _require_size(tree)
    return Document(path, texts, tree, inclusions, part, notes)


def require_inside(path: Path, file: Path, part: Part, what: str) -> None:
    """Refuse a file that lies outside of the folder of the model at `path`, unless the user allowed it.

    Raises:
        InputError: naming the option that allows it.
    """
    if part.outside or file.resolve().is_relative_to(path.parent.resolve()):
        return
    raise InputError(
        f"{what}, which lies outside of the model's folder; --outside allows that (from Python"
        " ModelFile(path, Part(outside=True)))"
    )


def _require_size(tree: Element) -> None:
    """Refuse what would have MuJoCo make millions of parts of a few lines."""
    total, layer = 0, [(tree, 1.0)]
    while layer:
        total += sum(times for _, times in layer)
        for element, times in layer:
            numbers = [_whole(element.attributes.get(name, "")) for name in _COUNTS.get(element.tag, ())]
            if max([times, float(np.prod([max(one, 1) for one in numbers]))]) > _MOST or total > ELEMENTS:
                raise InputError(
                    f"{element.file}: line {element.line}: <{element.tag}> makes the model larger than {ELEMENTS}"
                    f" elements or {_MOST} numbers, which no arm is"
                )
        layer = [
            (
                child,
                times
                * max(1.0, _whole(parent.attributes.get("count", "")) if parent.tag == "replicate" else 1.0),
            )
            for parent, times in layer
            for child in parent.children
        ]


def _whole(words: str) -> float:
    """The product of the numbers in an attribute; 0 where there are none, which MuJoCo will tell."""
    try:
        return float(np.prod([float(word) for word in words.split()])) if words.strip() else 0.0
    except ValueError:
        return 0.0


def edit(document: Document, edits: Iterable[Edit], names: Mapping[str, str] | None = None) -> Document:
    """The document with these edits, every other byte as it was; `names` gives included texts others."""
    texts = dict(document.texts)
    data = {name: text.encode() for name, text in texts.items()}
    replacements: dict[str, list[tuple[int, int, bytes]]] = {}
    for e in edits:
        name = e.element.source
        replacements.setdefault(name, []).extend(_replacements(data[name], e))
    for name, parts in replacements.items():
        for start, stop, new in sorted(parts, reverse=True):
            data[name] = data[name][:start] + new + data[name][stop:]
        texts[name] = data[name].decode()
    known = {(names or {}).get(name, name): text for name, text in texts.items() if name}
    return parse(texts[""], document.root.tag, document.path, known, part=document.part, notes=document.notes)


def gathered(document: Document) -> Document:
    """The document with what it includes from outside of its folder called by a name inside of it."""
    names: dict[str, str] = {}
    for name in document.inclusions:
        if (inside := os.path.normpath(name)).startswith("..") or os.path.isabs(inside):
            inside = Path(name).name
            while inside in {*document.texts, *names.values(), document.path.name}:
                inside = f"included_{inside}"
            names[name] = inside
    edits = [Edit(document.inclusions[old], {"file": new}) for old, new in names.items()]
    return edit(document, edits, names) if names else document


def quote(value: str) -> str:
    """A value as it stands between the quotes of an attribute."""
    return escape(value, _QUOTES)


def numbers(values: Any) -> str:
    """Numbers as an attribute holds them, every digit of the float64."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def _decode(data: bytes, path: Path) -> str:
    if not data.strip():
        raise InputError(f"{path}: is empty")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start + 1} is not UTF-8 text, so it cannot be MJCF") from None
    if "\0" in text:
        raise InputError(f"{path}: byte {data.index(0) + 1} is zero: a binary file, so it cannot be MJCF")
    return text


def _blank(comment: re.Match[bytes]) -> bytes:
    return re.sub(rb"[^\r\n]", b" ", comment[0])


def _tree(text: str, path: Path, source: str = "") -> Element:
    # Comments are blanked first: MuJoCo's parser takes '--' inside them, the standard's does not.
    data = _COMMENT.sub(_blank, text.encode())
    open_elements: list[Element] = []
    roots: list[Element] = []
    parser = expat.ParserCreate("utf-8")

    def start(tag: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        match = _TAG.match(data, at)
        if match is None:
            raise InputError(f"{path}: line {parser.CurrentLineNumber}: <{tag}> comes from an entity")
        if len(attributes) > ATTRIBUTES or len(open_elements) >= DEPTH:
            what = f"{ATTRIBUTES} attributes" if len(attributes) > ATTRIBUTES else f"{DEPTH} levels"
            raise InputError(
                f"{path}: line {parser.CurrentLineNumber}: <{tag}> is beyond {what}, which no model needs"
            )
        parent = open_elements[-1] if open_elements else None
        element = Element(source, path, parser.CurrentLineNumber, tag, attributes, at, match.end(), parent)
        (parent.children if parent else roots).append(element)
        open_elements.append(element)

    def refuse_entity(name: str, *_: Any) -> None:
        raise InputError(
            f"{path}: line {parser.CurrentLineNumber}: declares the entity {name!r}, which MJCF has none of"
        )

    parser.StartElementHandler = start
    parser.EntityDeclHandler = refuse_entity
    parser.EndElementHandler = lambda tag: open_elements.pop()
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise InputError(
            f"{path}: line {error.lineno}, column {error.offset + 1}: {reason}; well-formed XML is expected"
        ) from None
    return roots[0]


def _resolve(path: Path, name: str, includer: Path) -> Path:
    """Where MuJoCo looks for an included file: beside the model, else beside the file that includes it."""
    beside = path.parent / name
    return beside if beside.exists() else includer.parent / name


def _include(
    tree: Element,
    path: Path,
    known: Mapping[str, str],
    texts: dict[str, str],
    inclusions: dict[str, Element],
    part: Part,
    depth: int = 0,
) -> None:
    """Put the children of every included file where its `include` stands."""
    children = []
    for child in tree.children:
        if child.tag != "include":
            _include(child, path, known, texts, inclusions, part, depth)
            children.append(child)
            continue
        name = child.attributes.get("file", "")
        file = _resolve(path, name, child.file)
        where = f"{child.file}: line {child.line}"
        if name in texts:
            raise InputError(f"{where}: includes {name!r} a second time, which MuJoCo refuses")
        if name in known:
            texts[name] = known[name]
        else:
            require_inside(path, file, part, f"{where}: includes {name!r}")
            texts[name] = _decode(inputs.read_bytes(file, BYTES, f"{where}: includes {name!r}, which"), file)
        included = _tree(texts[name], file, name)
        inclusions[name] = child
        if depth >= INCLUDES:
            raise InputError(f"{where}: includes {name!r} at a depth of more than {INCLUDES} files")
        _include(included, path, known, texts, inclusions, part, depth + 1)
        for element in included.children:
            element.parent = tree
            children.append(element)
    tree.children[:] = children


def _replacements(data: bytes, e: Edit) -> Iterator[tuple[int, int, bytes]]:
    start, stop = e.element.start, e.element.stop
    spans = {m[1].decode(): m for m in _ATTRIBUTE.finditer(data, start, stop)}
    end = max((m.end() for m in spans.values()), default=start + 1 + len(e.element.tag.encode()))
    added = ""
    for name, value in e.attributes.items():
        if name not in spans:
            added += f' {name}="{quote(value)}"' if value is not None else ""
        elif value is None:
            yield spans[name].start(), spans[name].end(), b""
        else:
            yield spans[name].start(2) + 1, spans[name].end(2) - 1, quote(value).encode()
    if added:
        yield end, end, added.encode()
    if e.first_child:
        gap = _GAP.match(data, stop)
        yield stop, stop, _line_start(gap[0] if gap else b"") + e.first_child.encode()


def _line_start(gap: bytes) -> bytes:
    """The last line break of a gap, as the file writes it, and the indentation after it."""
    head, newline, indentation = gap.rpartition(b"\n")
    return (b"\r" if head.endswith(b"\r") else b"") + newline + indentation if newline else b""
