"""An ESI file's XML as small trees, one device or module at a time, within limits."""

from __future__ import annotations

import codecs
import re
import stat
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from xml.parsers import expat

from rtcp.esi.model import EsiError

FILE_LIMIT = 64 << 20
"""Largest file, bytes; the largest public one has 4.2 million."""
NODE_LIMIT = 300_000
"""Elements that are read of a device; the largest public one has 84 thousand."""
TEXT_LIMIT = 1 << 18
"""Characters in an element."""
TOKEN_LIMIT = 4 << 20
"""Bytes of a tag or a comment: expat holds them whole."""
DEPTH_LIMIT = 64
WARNING_LIMIT = 500

_CHUNK = 1 << 16
_DECLARED = re.compile(rb"""\s*<\?xml[^>]{0,100}?encoding\s*=\s*["']([A-Za-z0-9._-]{1,40})["']""")
_BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_CODECS = re.compile(r"utf-(8|16|32)(-[lb]e)?|iso8859-\d+|cp\d+|ascii|gb\w+|big5\w*|shift_jis\w*|euc_\w+|koi8-[rtu]")

ROOTS = frozenset({"EtherCATInfo", "EtherCATModule", "EtherCATInfoList", "EtherCATDict"})
READ = frozenset(
    re.findall(
        r"\w+",
        """
        Access AoE ArrayInfo AssignActivate BaseType BitLen BitSize BootStrap ByteSize ChannelInfo Class CoE Comment
        ConfigData CycleTimeSync0 CycleTimeSync1 Data DataType DataTypes Dc DefaultData DefaultString DefaultValue
        Desc Descriptions Device Devices Dictionary EBusCurrent Eeprom Electrical Elements Entry EoE Exclude Flags
        Fmmu FoE Group Groups GroupType HideType Id Index Info InitCmd LBound Mailbox MaxData MaxValue MinData
        MinValue Module ModuleClass ModuleIdent Modules Name NotationIndex Object Objects OpMode Pdo PdoMapping
        Profile ProfileNo RxPdo ShiftTimeSync0 ShiftTimeSync1 Slot Slots Sm SoE SubIdx SubIndex SubItem Symbol
        Transition TxPdo Type Unit UnitType UnitTypes Vendor VoE
        """,
    )
)
"""Elements that are read; all others are skipped with their content."""
IGNORED = frozenset(
    re.findall(
        r"\w+",
        """
        AddInfo AlternativeType Backup BitOffs Category ChannelCount DataString DcOpModeName DiagFile DiagMessages
        DictionaryFile DisplayName Enum EnumInfo ESC EtherCATController EtherCATp ExecutionUnit IdentificationAdo
        IdentificationReg134 Image16x14 ImageData16x14 ImageFile16x14 InfoReference MaxSlotCount Port ProducerInfo
        Properties Property ReadAccess SafetyMapping SafetyParaMapping SdoAccess Setting SlotSelections StateMachine
        StationAliasSupported Su SubDevice Text Timeout TreeView URL VendorSpecific
        """,
    )
)
"""Elements of ETG.2000, tools or vendors that are not needed here."""
_COLLECTED = {"Device": "Devices", "Module": "Modules", "Group": "Groups", "Vendor": None}
"""Elements that are handed out as a tree, with the element in which they stand; None: in any root."""


class Node:
    """An element."""

    __slots__ = ("attributes", "children", "line", "tag", "text", "unread")

    def __init__(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self.tag = tag
        self.attributes = attributes
        self.line = line
        self.text = ""
        self.children: list[Node] = []
        self.unread: Counter[str] | None = None
        """Elements within it that are neither read nor known to be of no use, by name."""

    def first(self, path: str) -> Node | None:
        """Return the first child of a name, and so on down a path such as `Info/Electrical`; None: there is none."""
        node: Node | None = self
        for tag in path.split("/"):
            node = next((child for child in node.children if child.tag == tag), None) if node is not None else None
        return node

    def below(self, path: str) -> list[Node]:
        """Return all elements at the end of a path."""
        nodes = [self]
        for tag in path.split("/"):
            nodes = [child for node in nodes for child in node.children if child.tag == tag]
        return nodes

    def value(self, path: str) -> str | None:
        """Return the text of the first element at a path, or an attribute of it as in `Index/@Default`; None: none."""
        path, _, attribute = path.partition("@")
        node = self.first(path.rstrip("/")) if path else self
        if node is None:
            return None
        return node.attributes.get(attribute) if attribute else node.text


class Warnings:
    """Warnings about accepted deviations, each with file and line; their number is bounded."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.sentences: list[str] = []
        self._left_out = 0

    def add(self, line: int, sentence: str) -> None:
        """Add a sentence."""
        if len(self.sentences) < WARNING_LIMIT:
            self.sentences.append(f"{self.path}:{line}: {sentence[:300]}")
        else:
            self._left_out += 1

    def all(self) -> tuple[str, ...]:
        """Return the warnings, with the number of omitted ones."""
        more = (f"{self.path}: {self._left_out} further warnings are left out",) if self._left_out else ()
        return (*self.sentences, *more)


class _Trees:
    """Handlers of expat: they build a tree for each collected element, and forget it when it has been handed out."""

    def __init__(self, path: str, parser: expat.XMLParserType, collect: Callable[[Node], None]) -> None:
        self.path = path
        self.root = ""
        self.closed = False
        self._parser = parser
        self._collect = collect
        self._stack: list[str] = []
        self._open: list[Node] = []
        self._skipped = 0
        self._count = 0
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text
        parser.StartDoctypeDeclHandler = self._doctype

    def _error(self, problem: str) -> EsiError:
        return EsiError(f"{self.path}:{self._parser.CurrentLineNumber}", problem)

    def _doctype(self, *_: object) -> None:
        raise self._error("a DOCTYPE is refused: no ESI file needs one")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        if not self.root:
            self.root = tag
            if tag not in ROOTS:
                raise self._error(f"the root element is {tag[:40]}; an ESI file has EtherCATInfo or EtherCATModule")
        if self._skipped or (tag not in READ and tag not in ROOTS):
            if not self._skipped and self._open and tag not in IGNORED:
                unread = self._open[0].unread = self._open[0].unread or Counter()
                if len(unread) < 100:
                    unread[tag[:60]] += 1
            self._skipped += 1
            if self._skipped > DEPTH_LIMIT:
                raise self._error(f"elements are nested more than {DEPTH_LIMIT} deep")
            return
        if len(self._stack) >= DEPTH_LIMIT:
            raise self._error(f"elements are nested more than {DEPTH_LIMIT} deep")
        parent = self._stack[-1] if self._stack else ""
        if self._open or (tag in _COLLECTED and (_COLLECTED[tag] in (parent, None))):
            node = Node(tag, attributes, self._parser.CurrentLineNumber)
            self._count = self._count + 1 if self._open else 1
            if self._count > NODE_LIMIT:
                raise self._error(f"{self._open[0].tag} of more than {NODE_LIMIT} elements")
            if self._open:
                self._open[-1].children.append(node)
            self._open.append(node)
        self._stack.append(tag)

    def _end(self, _tag: str) -> None:
        if self._skipped:
            self._skipped -= 1
            return
        self._stack.pop()
        self.closed = not self._stack
        if self._open:
            node = self._open.pop()
            node.text = node.text.strip()
            if not self._open:
                self._collect(node)

    def _text(self, text: str) -> None:
        if not self._skipped and self._open:
            node = self._open[-1]
            if not node.children:
                node.text += text
                if len(node.text) > TEXT_LIMIT:
                    raise self._error(f"{node.tag} holds more than {TEXT_LIMIT} characters")


def _encoding(data: bytes, path: str, warnings: Warnings) -> str:
    """Return the encoding of a file: by its mark, its declaration, or UTF-8; Latin-1 where its bytes contradict."""
    declared = "utf-8"
    if bom := next((codec for mark, codec in _BOMS if data.startswith(mark)), None):
        declared = bom
    elif match := _DECLARED.match(data):
        try:
            name = codecs.lookup(match[1].decode("ascii")).name
        except LookupError:
            name = ""
        if not _CODECS.fullmatch(name) or name.startswith(("utf-16", "utf-32")):
            raise EsiError(f"{path}:1", f"the encoding {match[1].decode('ascii')} is not known")
        declared = name
    decoder = codecs.getincrementaldecoder(declared)()
    for start in range(0, len(data) + 1, _CHUNK):
        try:
            decoder.decode(data[start : start + _CHUNK], start + _CHUNK > len(data))
        except UnicodeError:
            if declared.startswith(("utf-16", "utf-32")):
                raise EsiError(path, f"bytes that are not {declared}") from None
            line = data.count(b"\n", 0, start) + 1
            warnings.add(line, f"bytes that are not {declared} from here on; read as Latin-1")
            return "iso8859-1"
    return declared


def read_file(path: Path, most: int) -> bytes:
    """Return the content of a regular file, up to `most` bytes: opening a pipe waits for its other end.

    Raises:
        EsiError: it cannot be read, is longer, or no regular file.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise EsiError(str(path), "this is no regular file")
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise EsiError(str(path), f"cannot be read: {error.strerror}") from None
    if len(data) > most:
        raise EsiError(str(path), f"more than {most >> 10} KiB: no description is so long")
    return data


def read_trees(path: Path, collect: Callable[[Node], None], warnings: Warnings) -> str:
    """Hand out each vendor, group, device and module of a file as a tree; return the root's name. Raises EsiError."""
    data = read_file(path, FILE_LIMIT)
    decoder = codecs.getincrementaldecoder(_encoding(data, str(path), warnings))()
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    trees = _Trees(str(path), parser, collect)
    fed = 0
    try:
        for start in range(0, len(data) + 1, _CHUNK):
            last = start + _CHUNK > len(data)
            chunk = decoder.decode(data[start : start + _CHUNK], last).encode("utf-8", "replace")
            fed += len(chunk)
            parser.Parse(chunk, last)
            if fed - parser.CurrentByteIndex > TOKEN_LIMIT:
                raise EsiError(
                    f"{path}:{parser.CurrentLineNumber}", f"a tag or comment of more than {TOKEN_LIMIT} bytes"
                )
    except expat.ExpatError as error:
        if not trees.closed:
            raise EsiError(f"{path}:{error.lineno}", f"no XML: {expat.ErrorString(error.code)}") from None
        warnings.add(error.lineno, "what follows the end of the root element is left out")
    return trees.root
