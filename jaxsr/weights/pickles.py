"""Pickles of tensors by name, read without Python's unpickler: nothing in them runs, and nothing takes long.

A pickle is a program for a small stack machine. `unpickle` is that machine with the opcodes that dictionaries
of tensors need. What a pickle names is looked up in a table of the caller's and nowhere else. Keys are texts
and whole numbers: Python's own unpickler would hash a tuple whose parts share their parts, which takes for
ever. Attributes that a pickle sets on objects are ignored.
"""

import pickletools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

from jaxsr.errors import JaxsrError

MAX_BYTES = 16 << 20
"""Of a pickle. A tensor takes about 200: enough for 80,000 tensors."""
MAX_OPCODES = 1_000_000
"""Of a pickle. A tensor takes about 40, and a million takes about 2 seconds."""
_INTEGER_BITS = 64

_VALUES = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
}
"""Opcodes that push their argument."""
_NEW: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_TUPLE": tuple,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
}
_SHORT_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_PUTS, _GETS = {"PUT", "BINPUT", "LONG_BINPUT"}, {"GET", "BINGET", "LONG_BINGET"}


class Name(NamedTuple):
    """What a pickle may name: a record, not the thing itself."""

    module: str
    name: str


Known: TypeAlias = Mapping[Name, Callable[[tuple[Any, ...]], Any] | None]
"""What each name that is allowed makes of its arguments; None where it must not be called."""


def unpickle(content: bytes, known: Known, where: object) -> Any:
    """The value that a pickle describes.

    Args:
        content: the pickle, of any protocol.
        known: the names that it may use.
        where: file that an error names.

    Returns:
        Dictionaries, lists, tuples, texts, bytes, numbers, True, False, None, `Name` for what was named, the
        results of `known`, and persistent identifiers as they are.

    Raises:
        JaxsrError: a name that is not among `known`.
        ValueError: damaged, too long, an opcode or a key of another kind.
    """
    if len(content) > MAX_BYTES:
        raise ValueError(f"a pickle of {len(content)} bytes, more than {MAX_BYTES}")
    machine = _Machine(known, where)
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        if count >= MAX_OPCODES:
            raise ValueError(f"a pickle of more than {MAX_OPCODES} opcodes")
        if opcode.name == "STOP":
            return machine.pop()
        machine.run(opcode.name, argument)
    raise ValueError("a pickle without an end")


class _Machine:
    def __init__(self, known: Known, where: object):
        self.known, self.where = known, where
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def run(self, opcode: str, argument: Any) -> None:
        """One opcode: those that push here, the others by their method."""
        if opcode in _VALUES:
            if type(argument) is int and argument.bit_length() > _INTEGER_BITS:
                raise ValueError(f"an integer of {argument.bit_length()} bits")
            self.stack.append(argument)
        elif opcode in _NEW:
            self.stack.append(_NEW[opcode]())
        elif opcode in _SHORT_TUPLES:
            items = [self.pop() for _ in range(_SHORT_TUPLES[opcode])]
            self.stack.append(tuple(reversed(items)))
        elif opcode in _PUTS:
            self.memo[argument] = self.top()
        elif opcode in _GETS:
            if argument not in self.memo:
                raise ValueError(f"nothing is remembered as {argument}")
            self.stack.append(self.memo[argument])
        elif opcode not in ("PROTO", "FRAME"):
            if (method := getattr(self, f"do_{opcode.lower()}", None)) is None:
                raise ValueError(f"opcode {opcode}, which tensors do not need")
            method(argument)

    def pop(self) -> Any:
        self.top()
        return self.stack.pop()

    def top(self) -> Any:
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise ValueError("an opcode without its operand")
        return self.stack[-1]

    def since_mark(self) -> list[Any]:
        if not self.marks:
            raise ValueError("an opcode without its mark")
        first = self.marks.pop()
        items = self.stack[first:]
        del self.stack[first:]
        return items

    def do_mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def do_pop(self, _: None) -> None:
        self.pop()

    def do_pop_mark(self, _: None) -> None:
        self.since_mark()

    def do_memoize(self, _: None) -> None:
        self.memo[len(self.memo)] = self.top()

    def do_tuple(self, _: None) -> None:
        self.stack.append(tuple(self.since_mark()))

    def do_list(self, _: None) -> None:
        self.stack.append(self.since_mark())

    def do_dict(self, _: None) -> None:
        items = self.since_mark()
        self.stack.append({})
        self.set_items(items)

    def do_append(self, _: None) -> None:
        self.extend([self.pop()])

    def do_appends(self, _: None) -> None:
        self.extend(self.since_mark())

    def do_setitem(self, _: None) -> None:
        value, key = self.pop(), self.pop()
        self.set_items([key, value])

    def do_setitems(self, _: None) -> None:
        self.set_items(self.since_mark())

    def extend(self, items: list[Any]) -> None:
        if type(target := self.top()) is not list:
            raise ValueError("items for something that is not a list")
        target.extend(items)

    def set_items(self, items: list[Any]) -> None:
        if type(target := self.top()) is not dict:
            raise ValueError("entries for something that is not a dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int):
                raise ValueError(f"a key that is a {type(key).__name__}, where tensors have names")
            target[key] = value

    def do_global(self, argument: str) -> None:
        self.push_name(*argument.split(" ", 1))

    def do_stack_global(self, _: None) -> None:
        name, module = self.pop(), self.pop()
        self.push_name(module, name)

    def push_name(self, module: Any, name: Any) -> None:
        if not (isinstance(module, str) and isinstance(name, str)):
            raise ValueError("a name that is not a text")
        if (found := Name(module, name)) not in self.known:
            raise JaxsrError(
                f"the pickle names {shortened(f'{module}.{name}')}, which could run code",
                where=self.where,
                expected="tensors, dictionaries, numbers and text",
                fix="save the state dictionary alone: torch.save(model.state_dict(), path)",
            )
        self.stack.append(found)

    def do_reduce(self, _: None) -> None:
        arguments, name = self.pop(), self.pop()
        make = self.known.get(name) if isinstance(name, Name) else None
        if make is None or type(arguments) is not tuple:
            raise ValueError("a call of something that is no function")
        self.stack.append(make(arguments))

    def do_build(self, _: None) -> None:
        self.pop()
        self.top()

    def do_binpersid(self, _: None) -> None:
        self.top()  # the identifier, already on the stack, is its own record


def shortened(name: str, length: int = 80) -> str:
    """A name out of a file, for a message: printable, and not longer than this."""
    printable = name if name.isprintable() else ascii(name)[1:-1]
    return printable if len(printable) <= length else printable[:length] + "..."
