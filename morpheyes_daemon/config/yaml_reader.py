"""YAML of limited size and depth, read so that nothing in it is taken for what it does not say.

Of YAML's many spellings only the unmistakable ones are numbers: `1:30`, `012` and `1_000` are text, `1e-3` is a
number. Keys that stand twice, aliases that multiply, foreign tags and files too large are refused with the line.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import SafeConstructor

from morpheyes_daemon.errors import ConfigError

LARGEST_FILE = 1_000_000
LARGEST_NODES = 20_000
"""Keys and values, aliases counted as what they stand for; a calibration of 81 baselines has 1500."""
DEEPEST = 50
LONGEST_NUMBER = 40

_TAG = "tag:yaml.org,2002:"
_KNOWN_TAGS = frozenset(_TAG + name for name in ("null", "bool", "int", "float", "str", "seq", "map", "merge"))
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_SURROGATE = re.compile("[\ud800-\udfff]")
_BASE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BASE):  # type: ignore[misc]
    """The safe loader, in C where PyYAML has it, with the spellings below."""


_SPELLINGS = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF", list("yYnNtTfFoO")),
    ("int", r"[-+]?(?:0|[1-9][0-9]*)", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,4})?|[-+]?[0-9]{1,20}[eE][-+]?[0-9]{1,4}"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+0123456789."),
    ),
    ("merge", r"<<", ["<"]),
)
_Loader.yaml_implicit_resolvers = {}
for _name, _pattern, _first in _SPELLINGS:
    _Loader.add_implicit_resolver(_TAG + _name, re.compile(f"^(?:{_pattern})$"), _first)


def read_text(path: Path) -> str:
    """Read a text file of bounded size; raises ConfigError with a sentence."""
    try:
        with open(path, "rb", opener=_open_without_waiting) as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                raise ConfigError(f"{path}: is not a file; name one that holds text.")
            content = stream.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file.") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}).") from None
    if len(content) > LARGEST_FILE:
        raise ConfigError(f"{path}: is larger than {LARGEST_FILE // 1_000_000} MB, so it is no file of this kind.")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}).") from None


def _open_without_waiting(path: str, flags: int) -> int:
    """A FIFO that nobody writes to does not hold up the one who opens it."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)


def parse_yaml(text: str, name: str) -> tuple[Any, yaml.Node | None]:
    """Return the plain data and the node tree (for line numbers) of one YAML document; raises ConfigError."""
    root = compose(text, name)
    if root is None:
        return {}, None
    try:
        data = SafeConstructor().construct_document(root)
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise _invalid(error, name) from None
    return ({} if data is None else data), root


def compose(text: str, name: str) -> yaml.Node | None:
    """Return the checked node tree of one YAML document, None when it is empty; raises ConfigError."""
    if len(text) > LARGEST_FILE:
        raise ConfigError(f"{name}: is larger than {LARGEST_FILE // 1_000_000} MB, so it is no file of this kind.")
    _refuse_unprintable(text, name)
    try:
        _refuse_excess(text, name)
        root: yaml.Node | None = yaml.compose(text, Loader=_Loader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise _invalid(error, name) from None
    if root is not None:
        _Tree(name).check(root)
    return root


def _invalid(error: Exception, name: str) -> ConfigError:
    mark = getattr(error, "problem_mark", None)
    where = f"{name}:{mark.line + 1}" if mark else name
    words = " ".join(str(getattr(error, "problem", None) or error).split())
    return ConfigError(f"{where}: not valid YAML: {words}.")


def _refuse_unprintable(text: str, name: str) -> None:
    found = _UNPRINTABLE.search(text)
    if found is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise ConfigError(f"{name}:{line}: not valid YAML: the character U+{ord(found[0]):04X} may not stand in it.")


def _refuse_excess(text: str, name: str) -> None:
    """Count events, which costs no recursion, before a tree is made of them."""
    depth = nodes = 0
    event: Any
    for event in yaml.parse(text, Loader=_Loader):
        nodes += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST or nodes > LARGEST_NODES:
            words = f"is nested more than {DEEPEST} deep" if depth > DEEPEST else _too_many()
            raise ConfigError(f"{name}:{event.start_mark.line + 1}: {words}, so it is no file of this kind.")


def _too_many() -> str:
    return f"holds more than {LARGEST_NODES} keys and values"


class _Tree:
    """Checks a node tree, in which an alias is the same node once more."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._known: dict[int, tuple[int, int]] = {}
        self._open: set[int] = set()

    def check(self, node: yaml.Node) -> tuple[int, int]:
        """Return how many nodes stand for `node`, aliases written out, and how deep; raises ConfigError."""
        if id(node) in self._known:
            return self._known[id(node)]
        if id(node) in self._open:
            self._refuse(node, "contains itself")
        if node.tag not in _KNOWN_TAGS:
            self._refuse(node, f"the tag {node.tag.removeprefix(_TAG)!r} has no meaning here")
        if isinstance(node, yaml.ScalarNode):
            self._check_scalar(node)
        self._open.add(id(node))
        count, depth = 1, 0
        for child in self._children(node):
            below = self.check(child)
            count, depth = count + below[0], max(depth, below[1])
        self._open.remove(id(node))
        if count > LARGEST_NODES:
            self._refuse(node, _too_many())
        if depth >= DEEPEST:
            self._refuse(node, f"is nested more than {DEEPEST} deep")
        self._known[id(node)] = count, depth + 1
        return self._known[id(node)]

    def _children(self, node: yaml.Node) -> list[yaml.Node]:
        if isinstance(node, yaml.MappingNode):
            self._check_keys(node)
            return [part for pair in node.value for part in pair]
        return list(node.value) if isinstance(node, yaml.SequenceNode) else []

    def _check_keys(self, node: yaml.MappingNode) -> None:
        lines: dict[str, int] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self._refuse(key, "a key must be a word")
            line = key.start_mark.line + 1
            if key.value in lines:
                self._refuse(key, f"{key.value[:60]}: stands there twice, first on line {lines[key.value]}")
            lines[key.value] = line

    def _check_scalar(self, node: yaml.ScalarNode) -> None:
        if node.tag in (_TAG + "int", _TAG + "float") and len(node.value) > LONGEST_NUMBER:
            self._refuse(node, f"a number of {len(node.value)} digits is none that is meant")
        if _SURROGATE.search(node.value):
            self._refuse(node, "a text with half a character")

    def _refuse(self, node: yaml.Node, words: str) -> None:
        raise ConfigError(f"{self._name}:{node.start_mark.line + 1}: {words}.")
