"""Thirty-two EVT3 words at a time: what a block of words is made of, and lists of what it says.

A block is 32 words of 16 bits, one register of AVX-512 or two of AVX2; masks are ``uint32``, bit i for word i of the
block. Which word is of which kind is worked out from four planes of bits, one for each bit of the kind, because the
processor has more room for arithmetic on masks than for comparisons of vectors. What a word means depends on words
before it (its row, its time), and where it is not simply the word before, that is a scan: the nearest word of a kind at
or before each lane, by five steps of "take the later of yourself and your neighbour 1, 2, 4, 8, 16 to the left". Events
leave by compression, so that lists stay dense and in stream order without a branch.

Lists are of 16 bits; a place in a list counts in those, whatever the array's own numbers are.
"""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types

from elpd.events.simd import (
    BITS,
    I16,
    I32,
    I64,
    LANES,
    LONGS,
    WORDS,
    Builder,
    UniTuple,
    Value,
    add,
    as_words,
    call,
    constant,
    iota,
    lanes_left,
    load,
    operation,
    population,
    running,
    splat,
    store,
    wide,
)
from elpd.events.simd_lanes import fetch, moved_up, store_packed

RATE = 0x7000_F000_F000_E014
RATE_KINDS = 0xF000_F000_F000_FFFD
"""A whole rate count as one number: OTHERS of its subtype (a bit says which) and three continuations."""

BEYOND = 0x1000
"""In a list of columns: beyond every sensor. Otherwise bits 0 to 10 are x and bit 11 is the polarity."""

_LIST = [types.uint32]


# --- what kernels call: 32 words from index *at* on must exist -------------------------------------------------------


@operation(UniTuple(types.uint32, 10), [types.uint16], types.int64, types.int64, types.int64, types.int64)
def kinds(builder: Builder, words: Value, at: Value, high: Value, low_from: Value, low_until: Value) -> list[Value]:
    """Return masks of the block.

    ADDR_X; ADDR_Y; TIME_LOW; words at which to stop; words of a vector; OTHERS that begin no rate count; whole rate
    counts (their first words); whole vector triples; first words of either so near the end that the block does not tell
    which; all words that are neither address nor time. A stop is a TIME_LOW outside ``[low_from, low_until)``
    and a TIME_HIGH other than *high*.
    """
    block = load(builder, words, at, WORDS)

    def where(bits: Value) -> Value:
        return builder.bitcast(bits, I32)

    def plane(bit: int) -> Value:
        moved = block if bit == 15 else builder.shl(block, constant(WORDS, 15 - bit))
        return where(builder.icmp_signed("<", moved, constant(WORDS, 0)))

    def equal(values: Value, to: Value) -> Value:
        return where(builder.icmp_unsigned("==", values, to))

    def both(*masks: Value) -> Value:
        first, *others = masks
        for other in others:
            first = builder.and_(first, other)
        return first

    def following(mask: Value, ahead: int) -> Value:
        return builder.lshr(mask, I32(ahead))

    eight, four, two, one = (plane(bit) for bit in (15, 14, 13, 12))
    no_eight, no_four, no_two, no_one = (builder.not_(mask) for mask in (eight, four, two, one))
    small, middle = both(no_eight, no_four), both(no_eight, four)
    row, column, base = both(small, no_two, no_one), both(small, two, no_one), both(small, two, one)
    of_12, of_8 = both(middle, no_two, no_one), both(middle, no_two, one)
    low, last = both(middle, two, no_one), both(middle, two, one)
    top = both(eight, four, two)
    other, continued = both(top, no_one), both(top, one)
    time_high = both(eight, no_four, no_two, no_one)

    same = equal(block, splat(builder, builder.or_(builder.trunc(high, I16), I16(0x8000)), WORDS))
    first = builder.or_(builder.trunc(low_from, I16), I16(0x6000))
    length = builder.sub(builder.trunc(low_until, I16), builder.trunc(low_from, I16))
    since = builder.sub(block, splat(builder, first, WORDS))
    stays = where(builder.icmp_unsigned("<", since, splat(builder, length, WORDS)))
    stop = builder.or_(both(low, builder.not_(stays)), both(time_high, builder.not_(same)))

    count = equal(builder.and_(block, constant(WORDS, 0xFFFD)), constant(WORDS, 0xE014))
    counts = both(count, following(continued, 1), following(continued, 2), following(last, 3))
    triples = both(base, following(of_12, 1), following(of_12, 2), following(of_8, 3))
    edge = both(builder.or_(count, base), I32(0xE0000000))
    vector = builder.or_(base, builder.or_(of_12, of_8))
    plain = builder.or_(builder.or_(row, column), builder.or_(low, time_high))
    others = both(other, builder.not_(count))
    return [column, row, low, stop, vector, others, counts, triples, edge, builder.not_(plain)]


@operation(types.void, [types.uint16], types.int64, types.uint32, types.int64, _LIST, types.int64)
def spread(builder: Builder, words: Value, at: Value, mask: Value, before: Value, out: Value, begin: Value) -> None:
    """Write for each lane the content of the nearest word in *mask* at or before it; until the first, *before*."""
    content = builder.and_(load(builder, words, at, WORDS), constant(WORDS, 0x0FFF))
    said = builder.bitcast(mask, BITS)
    found = _by_index(builder, content, said) if wide() else _by_content(builder, content, said)
    before_first = builder.and_(builder.not_(mask), builder.sub(mask, I32(1)))
    of_lane = builder.select(builder.bitcast(before_first, BITS), splat(builder, before, WORDS), found)
    store(builder, of_lane, as_words(builder, out), begin)


def _by_index(builder: Builder, content: Value, said: Value) -> Value:
    """Spread which lane says something, then fetch what: where any lane may be fetched at once."""
    zero = constant(WORDS, 0)
    index = builder.select(said, iota(WORDS), zero)
    for shift in (1, 2, 4, 8, 16):
        moved = moved_up(builder, index, shift, zero)
        index = builder.select(builder.icmp_unsigned(">", moved, index), moved, index)
    return call(builder, "llvm.x86.avx512.permvar.hi.512", WORDS, [content, index])


def _by_content(builder: Builder, content: Value, said: Value) -> Value:
    """Spread what is said, marked by the sign bit."""
    zero = constant(WORDS, 0)
    content = builder.select(said, builder.or_(content, constant(WORDS, 0x8000)), zero)
    for shift in (1, 2, 4, 8, 16):
        moved = moved_up(builder, content, shift, zero)
        content = builder.select(builder.icmp_signed("<", content, zero), content, moved)
    return builder.and_(content, constant(WORDS, 0x7FFF))


@operation(types.void, [types.uint16], types.int64, types.uint32, _LIST, types.int64)
def pack_words(builder: Builder, words: Value, at: Value, mask: Value, out: Value, n: Value) -> None:
    """Write the contents of the words in *mask* densely to *out* from *n* on, where there must be room for 32."""
    content = builder.and_(load(builder, words, at, WORDS), constant(WORDS, 0x0FFF))
    store_packed(builder, content, mask, as_words(builder, out), n)


@operation(types.void, [types.uint16], types.int64, types.uint32, _LIST, types.int64)
def pack_words_before(builder: Builder, words: Value, at: Value, mask: Value, out: Value, n: Value) -> None:
    """Write the contents of the words one before each in *mask* densely to *out* from *n* on; room as above."""
    first = builder.icmp_signed("==", at, I64(0))
    before = builder.select(first, at, builder.sub(at, I64(1)))
    entering = builder.insert_element(constant(WORDS, 0), builder.load(builder.gep(words, [before])), I32(0))
    block = moved_up(builder, load(builder, words, at, WORDS), 1, entering)
    store_packed(builder, builder.and_(block, constant(WORDS, 0x0FFF)), mask, as_words(builder, out), n)


@operation(types.void, _LIST, types.int64, types.uint32, _LIST, types.int64)
def pack(builder: Builder, lists: Value, begin: Value, mask: Value, out: Value, n: Value) -> None:
    """Write those of 32 numbers from *begin* on that are in *mask* densely to *out* from *n* on; room as above."""
    lanes = load(builder, as_words(builder, lists), begin, WORDS)
    store_packed(builder, lanes, mask, as_words(builder, out), n)


@operation(types.void, types.int64, types.uint32, _LIST, types.int64)
def pack_places(builder: Builder, at: Value, mask: Value, out: Value, n: Value) -> None:
    """Write ``at + i`` for each bit i of *mask* densely to *out* from *n* on; room as above."""
    places = builder.add(iota(WORDS), splat(builder, at, WORDS))
    store_packed(builder, places, mask, as_words(builder, out), n)


@operation(types.void, types.int64, types.int64, types.uint32, _LIST, types.int64)
def pack_run(builder: Builder, first: Value, on: Value, mask: Value, out: Value, n: Value) -> None:
    """Write column ``first + i`` with polarity *on* for each bit i of *mask* densely to *out* from *n* on."""
    column = builder.add(iota(WORDS), splat(builder, first, WORDS))
    within = builder.icmp_unsigned("<", column, constant(WORDS, 2048))
    column = builder.select(within, column, constant(WORDS, BEYOND))
    column = builder.or_(column, splat(builder, builder.shl(on, I64(11)), WORDS))
    store_packed(builder, column, mask, as_words(builder, out), n)


@operation(types.void, _LIST, types.int64, _LIST, types.int64, types.int64)
def copy_run(builder: Builder, source: Value, begin: Value, out: Value, n: Value, count: Value) -> None:
    """Copy *count* numbers, 32 at a time: up to 32 places beyond are touched, one step is always made."""
    source, out = as_words(builder, source), as_words(builder, out)
    with cgutils.for_range_slice(builder, I64(0), count, I64(LANES)) as (done, _):
        store(builder, load(builder, source, builder.add(begin, done), WORDS), out, builder.add(n, done))


@operation(types.void, types.int64, _LIST, types.int64)
def fill_run(builder: Builder, value: Value, out: Value, n: Value) -> None:
    """Write *value* to the 32 places of *out* from *n* on."""
    store(builder, splat(builder, value, WORDS), as_words(builder, out), n)


@operation(types.int64, _LIST, types.int64)
def entry(builder: Builder, lists: Value, at: Value) -> Value:
    """Return one number of a list."""
    return builder.zext(builder.load(builder.gep(as_words(builder, lists), [at])), I64)


@operation(types.uint64, [types.uint16], types.int64)
def four_words(builder: Builder, words: Value, at: Value) -> Value:
    """Return four words as one number, the first lowest."""
    loaded = builder.load(builder.bitcast(builder.gep(words, [at]), I64.as_pointer()))
    loaded.align = 2
    return loaded


@operation(types.int64, types.uint32)
def count(builder: Builder, mask: Value) -> Value:
    """Return how many bits are set."""
    return population(builder, mask)


@operation(types.int64, types.uint32)
def highest(builder: Builder, mask: Value) -> Value:
    """Return the index of the highest set bit; -1 for none."""
    return builder.sub(I64(31), builder.zext(builder.ctlz(mask, ir.IntType(1)(0)), I64))


@operation(UniTuple(types.int64, 3), [types.uint16], types.int64, _LIST, types.int64, types.int64)
def take_counts(builder: Builder, words: Value, position: Value, lists: Value, begin: Value, n: Value) -> list[Value]:
    """Take the whole rate counts out of a list of *n* places, from *begin* on, relative to *position*.

    Returns how many places remain, and the sums of the counts before and after the controller. Eight at a time: up to 8
    places beyond the list are touched.
    """
    some = ir.VectorType(I32, 8)
    kept = running(builder, I64)
    sums = [running(builder, LONGS) for _ in range(2)]
    zero = constant(LONGS, 0)
    lists = as_words(builder, lists)
    from_here = builder.gep(words, [position])
    with cgutils.for_range_slice(builder, I64(0), n, I64(8)) as (done, _):
        place = load(builder, lists, builder.add(begin, done), ir.VectorType(I16, 8))
        there = lanes_left(builder, done, n, some)
        four = fetch(builder, from_here, builder.zext(place, some), there, LONGS)
        whole = builder.icmp_unsigned("==", builder.and_(four, constant(LONGS, RATE_KINDS)), constant(LONGS, RATE))

        def bits(shift: int, mask: int, four: Value = four) -> Value:
            return builder.and_(builder.lshr(four, constant(LONGS, shift)), constant(LONGS, mask))

        number = builder.or_(builder.or_(bits(16, 0xFFF), bits(20, 0xFFF000)), bits(24, 0xF000000))
        is_after = builder.icmp_unsigned("!=", bits(0, 2), zero)
        for which, total in zip((builder.not_(is_after), is_after), sums, strict=True):
            add(builder, total, builder.select(builder.and_(whole, which), number, zero))
        rest = builder.and_(there, builder.not_(whole))
        store_packed(builder, place, rest, lists, builder.add(begin, builder.load(kept)))
        add(builder, kept, population(builder, rest))
    totals = [call(builder, "llvm.vector.reduce.add.v8i64", I64, [builder.load(total)]) for total in sums]
    return [builder.load(kept), *totals]
