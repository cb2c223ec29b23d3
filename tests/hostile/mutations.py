"""Valid files, damaged: bytes flipped, cut and repeated, lines dropped and exchanged, numbers made impossible."""

import re
from collections.abc import Callable

from hypothesis import strategies as st
from tests.hostile.edges import Edge

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
# Read for numbers no further than this: an index of images has none.
_NUMBERS_WITHIN = 20_000
_NOT_A_NUMBER = (b"nan", b".nan", b"inf", b"-.inf", b"1e999", b"null", b"[]", b"{}", b"''", b"true", b"*a")
_UNUSUAL = (b"-1", b"0", b"1e308", b"-1e-320", b"0x10", b"99999999999999999999999", b"1e9", b"2147483648", b"100000")

Mutation = Callable[[bytes], bytes]


def _at(content: bytes, place: float) -> int:
    return int(place * len(content))


def _flip(place: float, value: int) -> Mutation:
    def mutated(content: bytes) -> bytes:
        at = _at(content, place)
        return content[:at] + bytes([value]) + content[at + 1 :]

    return mutated


def _cut(place: float, length: int) -> Mutation:
    return lambda content: content[: _at(content, place)] + content[_at(content, place) + length :]


def _end(place: float) -> Mutation:
    return lambda content: content[: _at(content, place)]


def _repeat(place: float, length: int) -> Mutation:
    def mutated(content: bytes) -> bytes:
        at = _at(content, place)
        return content[: at + length] + content[at:]

    return mutated


def _insert(place: float, word: bytes, over: bool) -> Mutation:
    def mutated(content: bytes) -> bytes:
        at = _at(content, place)
        return content[:at] + word + content[at + (len(word) if over else 0) :]

    return mutated


def _number(which: float, word: bytes) -> Mutation:
    def mutated(content: bytes) -> bytes:
        found = list(_NUMBER.finditer(content[:_NUMBERS_WITHIN]))
        if not found:
            return content
        match = found[min(int(which * len(found)), len(found) - 1)]
        return content[: match.start()] + word + content[match.end() :]

    return mutated


def _line(which: float, other: float, twice: bool) -> Mutation:
    """Drop a line, or put it in another's place."""

    def mutated(content: bytes) -> bytes:
        lines = content.split(b"\n")
        taken = lines.pop(int(which * (len(lines) - 1)))
        if twice:
            lines.insert(int(other * len(lines)), taken)
        return b"\n".join(lines)

    return mutated


def mutations(words: tuple[bytes, ...]) -> st.SearchStrategy[Mutation]:
    """One damage; words: of the format."""
    place, length = st.floats(0, 1), st.sampled_from((1, 2, 8, 64, 500))
    word = st.sampled_from(words) if words else st.binary(min_size=1, max_size=8)
    return st.one_of(
        st.builds(_flip, place, st.integers(0, 255)),
        st.builds(_cut, place, length),
        st.builds(_end, place),
        st.builds(_repeat, place, length),
        st.builds(_insert, place, word, st.booleans()),
        st.builds(_number, place, st.sampled_from(_NOT_A_NUMBER + _UNUSUAL)),
        st.builds(_line, place, place, st.booleans()),
    )


@st.composite
def damaged(draw: st.DrawFn, edge: Edge) -> bytes:
    """A valid file of an edge with one to four damages."""
    content = draw(st.sampled_from(edge.valid()))
    for mutation in draw(st.lists(mutations(edge.dictionary), min_size=1, max_size=4)):
        content = mutation(content)
    return content
